"""Camera frames in, wheel commands out: joins image, policy and safety; no ROS, injected time.

The policy runs when a frame arrives, not on a timer of its own: a free-running 10 Hz timer adds 0 to 100 ms of dead
time by chance, a frame trigger adds none. The tick is the backstop that keeps commands coming and stops the vehicle
when frames do not.
"""

import contextlib
import time
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from bridge.policy import Policy
from bridge.safeguards.safety import Command, SafetyConfig, State, Supervisor
from bridge.sensing.image import ImageError, RawImage
from bridge.sensing.senses import PATIENCE, Senses
from bridge.sensing.view import View

BACKSTOP = 1.25
"""Periods without a command after which the last one is sent again (while its frame is young) or zero."""
BEFORE_EXPIRY = 0.75
"""Share of the time after which the base forgets a command, at which it is sent again at the latest."""
BLIND_FRAMES = 5
"""Uniform frames in a row that count as a dark or saturated camera."""
BLIND = "dark or saturated camera"
OnBlind = Literal["warn", "slow", "stop"]
NOVEL = "surroundings unlike the training"
OnNovel = Literal["ignore", "slow", "stop"]


@dataclass(frozen=True)
class Caution:
    """What doubtful images cause."""

    blind: OnBlind = "warn"
    """A dark or saturated camera."""
    novel: OnNovel = "stop"
    """Images that surprise the policy more than its training did, where its file says how much that is."""


class Controller:
    """One policy driving one vehicle."""

    def __init__(self, policy: Policy, safety: SafetyConfig, clock: Callable[[], float] = time.monotonic,
                 pace_by_stamp: bool = False, view: View | None = None, caution: Caution = Caution()) -> None:
        """Join a policy and its limits.

        Args:
            policy: what drives.
            safety: limits and times.
            clock: steady clock, read only to time a policy step.
            pace_by_stamp: run the policy at its rate in the time of the stamps instead of the wall clock's, for a
                simulator whose time is slower or faster than the wall clock.
            view: what the policy sees of the camera's image; None: all of it.
            caution: what doubtful images cause.
        """
        self.policy = policy
        self.supervisor = Supervisor(safety)
        self.unusable = ""
        """Why the last frame could not be used; empty where it could."""
        self.image_bytes = 0
        """Size of the last camera message."""
        self.digest = 0
        """Hash of the last usable image."""
        self.stepped = -np.inf
        """Steady time of the last step that a frame made [s], driving or not."""
        self._clock = clock
        self._caution = caution
        self._pace_by_stamp = pace_by_stamp
        self._view = view or View(policy.pacer.size if policy.pacer.kind == "camera" else (1, 1))
        self._period = 1 / policy.commands.rate_hz
        self._backstop = min(BACKSTOP * self._period, BEFORE_EXPIRY * safety.expiry)
        self.senses = Senses(policy.sensors, policy.pacer, self._period, self.supervisor)
        self._waiting: tuple[float, np.ndarray] | None = None
        self._due = -np.inf
        self._arrived = -np.inf
        self._sent = -np.inf
        self._last = Command(0.0, 0.0, "no frame yet")
        self._ticks = 0
        self._uniform: dict[str, int] = {}  # uniform images in a row of each camera
        self._prepared = 0.0  # time that the next step took before its frame came [s]

    def on_image(self, now: float, stamp: float, stamp_age: float, image: RawImage) -> Command | None:
        """Take one camera message; return the command to publish, None where there is none to send now.

        Args:
            now: steady time of receipt [s].
            stamp: stamp of the message [s].
            stamp_age: time of receipt minus stamp, on the clock that made the stamp [s].
            image: the message, sensor_msgs/Image.
        """
        self.image_bytes = image.height * image.step
        return self._on_decoded(now, stamp, stamp_age, lambda: self._view.raw(image))

    def on_compressed(self, now: float, stamp: float, stamp_age: float, data: object) -> Command | None:
        """Take one sensor_msgs/CompressedImage, JPEG or PNG; times and result as of `on_image`."""
        content = bytes(data)  # type: ignore[call-overload]  # any buffer
        self.image_bytes = len(content)
        return self._on_decoded(now, stamp, stamp_age, lambda: self._view.compressed(content))

    def _on_decoded(self, now: float, stamp: float, stamp_age: float, decode: Callable[[], np.ndarray]
                    ) -> Command | None:
        try:
            image = decode()
        except ImageError as error:
            self.refuse(str(error))
            return None
        return self.on_rgb8(now, stamp, stamp_age, image)

    def on_rgb8(self, now: float, stamp: float, stamp_age: float, image: np.ndarray) -> Command | None:
        """Take one image (H, W, 3) uint8 of the policy's size; times and result as of `on_image`."""
        return self.on_paced(now, stamp, stamp_age, image, zlib.crc32(image.data))

    def on_paced(self, now: float, stamp: float, stamp_age: float, value: np.ndarray, digest: int) -> Command | None:
        """Take a value of the sensor that paces the policy, with a hash of what was measured; the rest as `on_image`.

        Where it has several cameras, the step waits for the images of the others, `PATIENCE` at most.
        """
        self.digest, self.unusable = digest, ""
        if self.supervisor.frame(now, stamp, digest, stamp_age) != "fresh":
            return None
        self.watch_exposure(self.policy.pacer.name, value)
        if not self._is_due(stamp if self._pace_by_stamp else now):
            return None  # a camera faster than the policy
        if not self.senses.complete:
            self._waiting = now, value
            return None
        return self._step(now, value)

    def on_sensed(self, now: float, name: str, stamp: float, stamp_age: float, value: np.ndarray, digest: int
                  ) -> Command | None:
        """Take a value of another sensor; return the command of a step that waited for it alone."""
        stream = self.senses.streams[name]
        stream.take(now, stamp, stamp_age, value, digest, self.supervisor.is_moving)
        self.watch_exposure(name, value)
        self.senses.watch(now)
        if self._waiting is None or not self.senses.complete:
            return None
        return self._step(now, self._waiting[1])

    def refuse(self, why: str) -> None:
        """Count a message of the pacer that could not be used."""
        self.unusable = why
        self.supervisor.counts["unusable"] += 1

    def _step(self, now: float, value: np.ndarray) -> Command | None:
        """Let the policy act on what its sensors show, where it may drive."""
        supervisor, self._waiting, self.stepped = self.supervisor, None, now
        if supervisor.take_reset():
            self.policy.reset()
            self.senses.begin()
            self._ticks, self._prepared = 0, 0.0
        self._ticks += 1
        if not supervisor.may_drive or (self._ticks - 1) % self.policy.commands.action_repeat:
            return self._send(now, supervisor.tick(now))
        start = self._clock()
        try:
            action = self.policy.step(self.senses.observation(value))
        except Exception as error:  # the runtime's own exception types all derive from Exception directly
            supervisor.counts["policy error"] += 1
            self.unusable = f"the policy failed: {error}"
            action = np.full(2, np.nan)
        self._watch_novelty()
        elapsed, prepared, self._prepared = self._clock() - start, self._prepared, 0.0
        command = supervisor.action(now, action, elapsed, prepared)
        self.senses.sent(command)
        return self._send(now, command)

    def prepare(self) -> None:
        """Compute what of the next step no observation changes; to be called after each command that was sent."""
        start = self._clock()
        with contextlib.suppress(Exception):  # the step then fails the same way, and stops the vehicle
            self.policy.prepare()
        self._prepared = max(self._prepared, self._clock() - start)

    def on_tick(self, now: float) -> Command | None:
        """Return a command where one is due although no frame came: a stop at once, else the last one again."""
        if self.senses.streams:
            self.senses.watch(now)
            if self._waiting is not None and now - self._waiting[0] >= PATIENCE:
                return self._step(now, self._waiting[1])
        command = self.supervisor.tick(now)
        stops_now = command.reason != "" and self._last.reason == ""
        if stops_now or now - self._sent >= self._backstop:
            return self._send(now, command)
        return None

    def farewell(self) -> bool:
        """Return whether the vehicle needs zeros before the bridge ends; not where it never drove or yielded."""
        supervisor = self.supervisor
        return supervisor.state is not State.YIELDED and supervisor.take_turn()

    def _send(self, now: float, command: Command) -> Command | None:
        self._sent, self._last = now, command
        return command if self.supervisor.take_turn() else None

    def _is_due(self, now: float) -> bool:
        """Return whether a policy step may start, and if so plan the next one.

        The frame nearest to the plan is taken, and the plan follows half of each deviation. So a camera near the
        policy's rate is never skipped however its clock drifts, and a faster one is thinned out to the policy's rate.
        """
        interval, self._arrived = min(now - self._arrived, self._period), now
        if now < self._due - interval / 2 and self._due - now < 2 * self._period:  # else the stamps began again
            return False
        self._due = (now if abs(now - self._due) > self._period else (now + self._due) / 2) + self._period
        return True

    def watch_exposure(self, name: str, image: np.ndarray) -> None:
        """Count a camera's runs of uniformly black or saturated images, and do what was asked for while they last."""
        if image.ndim != 3:
            return
        runs = self._uniform
        runs[name] = runs.get(name, 0) + 1 if image.max() <= 2 or image.min() >= 253 else 0
        if runs[name] == BLIND_FRAMES:
            self.supervisor.counts["dark or saturated"] += 1
        if self._caution.blind == "stop":
            self.supervisor.block(BLIND, self.is_blind)
        elif self._caution.blind == "slow":
            (self.supervisor.slow.add if self.is_blind else self.supervisor.slow.discard)(BLIND)

    def _watch_novelty(self) -> None:
        """Slow down, then stop for good, while the policy's surprise is larger than its own world made it."""
        limits = getattr(self.policy.contract, "novelty", None)
        if limits is None or self._caution.novel == "ignore":
            return
        slow, stop = limits
        novelty = self.policy.novelty
        (self.supervisor.slow.add if novelty >= slow else self.supervisor.slow.discard)(NOVEL)
        if novelty >= stop and self._caution.novel == "stop":
            self.supervisor.counts["novel surroundings"] += 1
            self.supervisor.latch(NOVEL)

    @property
    def is_blind(self) -> bool:
        """True while a camera shows one uniform black or white."""
        return max(self._uniform.values(), default=0) >= BLIND_FRAMES

"""Decides, on every frame and every tick, whether the vehicle may move; pure Python with injected time.

The supervisor stands between the camera, the policy and the wheels. It never sleeps and never reads a clock, so each
rule is tested with made-up times. All times `now` are seconds of a steady (monotonic) clock, which no clock change can
move; only the age of a stamp is a difference of two wall or simulation times, computed by the caller.
"""

import math
from collections import Counter, deque
from dataclasses import dataclass
from typing import Literal

import numpy as np

Verdict = Literal["fresh", "repeated", "out of order", "late"]


@dataclass(frozen=True)
class SafetyConfig:
    """Limits and times of the supervisor."""

    low: tuple[float, float]
    """Smallest command the vehicle may get: v [m/s], omega [rad/s]."""
    high: tuple[float, float]
    """Largest command the vehicle may get."""
    frame_age: float = 0.25
    """Frames older than this [s] since their receipt stop the vehicle."""
    stamp_age: float = 0.3
    """Stamps further than this [s] from the time of receipt are discarded; infinite where clocks are not shared."""
    resume_frames: int = 3
    """Fresh frames in a row before the vehicle moves, at the start and after every stop."""
    frozen_frames: int = 5
    """Frames with identical pixels, received while moving, that count as a frozen camera."""
    moving: tuple[float, float] = (0.05, 0.1)
    """Commands above either count as moving: |v| [m/s], |omega| [rad/s]."""
    bad_actions: int = 3
    """Non-finite actions within `bad_window` after which only an operator re-arms."""
    bad_window: float = 10.0
    """[s]"""
    overrun: float = 0.08
    """A policy step longer than this [s] is an overrun; three in a row stop the vehicle."""

    def __post_init__(self) -> None:
        if not all(-math.inf < a <= 0 <= b < math.inf for a, b in zip(self.low, self.high, strict=True)):
            raise ValueError(f"SafetyConfig: limits {self.low} to {self.high} must be finite and include 0, because "
                             "stopping is a zero command. Correct the limits.")


@dataclass(frozen=True)
class Command:
    """What is sent to the wheels, and why."""

    v: float
    """[m/s]"""
    omega: float
    """[rad/s]"""
    reason: str = ""
    """Empty while driving, else the rule that stopped the vehicle."""


class Supervisor:
    """Safety state of one drive.

    The caller passes each frame to `frame`; while it then says `may_drive`, runs the policy and passes its action to
    `action`; and calls `tick` regularly. After any of them `take_reset` says whether the policy must forget its state.
    """

    def __init__(self, config: SafetyConfig) -> None:
        self.config = config
        self.counts: Counter[str] = Counter()
        """How often each rule acted."""
        self.latched = ""
        """Reason of a stop that only `rearm` ends."""
        self.stopped = "no frame yet"
        """Reason of a stop that fresh frames end; empty while driving."""
        self._blocked: set[str] = set()  # conditions that hold the vehicle while they last
        self._fresh = 0
        self._last_frame = -math.inf
        self._last_stamp: float | None = None
        self._digest: int | None = None
        self._same = 0
        self._bad: deque[float] = deque()
        self._overruns = 0
        self._reset = True
        self._command = Command(0.0, 0.0, self.stopped)

    @property
    def reason(self) -> str:
        """Why the vehicle may not move; empty while it may."""
        return self.latched or ", ".join(sorted(self._blocked)) or self.stopped

    @property
    def may_drive(self) -> bool:
        """True while the policy may be asked for an action."""
        return not self.reason

    def take_reset(self) -> bool:
        """Return whether the policy must reset its recurrent state now; asking clears the request."""
        reset, self._reset = self._reset, False
        return reset

    def frame(self, now: float, stamp: float, digest: int, stamp_age: float = 0.0) -> Verdict:
        """Judge one valid frame. Only a fresh one may reach the policy.

        Args:
            now: steady time of receipt [s].
            stamp: the frame's own stamp [s].
            digest: hash of its pixels.
            stamp_age: time of receipt minus stamp, both of the camera's clock [s].
        """
        silent = now - self._last_frame > self.config.frame_age
        if self._last_stamp is not None and stamp == self._last_stamp:
            return self._discard("repeated")
        if self._last_stamp is not None and stamp < self._last_stamp and not silent:
            return self._discard("out of order")  # after a silence a smaller stamp is a restarted camera
        if not abs(stamp_age) <= self.config.stamp_age:
            return self._discard("late")
        if silent:
            self._fresh = 0
            if not self.stopped:
                self._stop("frame age")
        self._last_frame, self._last_stamp = now, stamp
        frozen = self._is_frozen(digest)
        if frozen and self.stopped != "frozen pixels":
            self._stop("frozen pixels")
        self._fresh = 0 if frozen else self._fresh + 1
        if self.stopped and self._fresh >= self.config.resume_frames:
            self.stopped = ""
            self._reset = True
        self.counts["frames"] += 1
        return "fresh"

    def action(self, now: float, action: np.ndarray, elapsed: float = 0.0) -> Command:
        """Return the command for a policy output.

        Args:
            now: steady time [s].
            action: (2,) v [m/s], omega [rad/s] as the policy wants them.
            elapsed: how long the policy step took [s].
        """
        self._overruns = self._overruns + 1 if elapsed > self.config.overrun else 0
        if self._overruns:
            self.counts["overrun"] += 1
        if not np.isfinite(action).all():
            self.counts["not finite"] += 1
            self._bad.append(now)
            while now - self._bad[0] > self.config.bad_window:
                self._bad.popleft()
            if len(self._bad) >= self.config.bad_actions:
                self.latched = "repeated non-finite actions"
            self._stop("non-finite action")
        elif self._overruns >= 3:
            self._overruns = 0
            self._stop("policy too slow")
        if not self.may_drive:
            return self._zero()
        limited = np.clip(action, self.config.low, self.config.high)
        if np.abs(limited - action).max() > 1e-6:
            self.counts["clamped"] += 1
        self._command = Command(float(limited[0]), float(limited[1]))
        return self._command

    def tick(self, now: float) -> Command:
        """Return the command to hold: the last one while its frame is young enough, else zero."""
        if not self.stopped and now - self._last_frame > self.config.frame_age:
            self._stop("frame age")
        return self._command if self.may_drive else self._zero()

    def clock_jump(self) -> None:
        """The camera's clock was set: stop, forget the stamps, go on with fresh frames."""
        self._last_stamp = None
        self._stop("clock jump")

    def latch(self, reason: str) -> None:
        """Stop until an operator re-arms: collision, emergency stop."""
        if not self.latched:
            self.counts[reason] += 1
        self.latched = self.latched or reason
        self._stop(reason)

    def block(self, reason: str, active: bool) -> None:
        """Stop for as long as a condition is active: a held emergency stop, a second commander."""
        if active and reason not in self._blocked:
            self._blocked.add(reason)
            self._stop(reason)
        elif not active:
            self._blocked.discard(reason)

    def rearm(self) -> bool:
        """Operator: release the latch. Returns False, and stays latched, while a condition still blocks."""
        if self._blocked:
            return False
        self.latched = ""
        self._bad.clear()
        return True

    def _discard(self, verdict: Verdict) -> Verdict:
        self.counts[verdict] += 1
        return verdict

    def _is_frozen(self, digest: int) -> bool:
        """Return whether the stamps advance while the pixels stand still, although the vehicle moves."""
        v_moving, omega_moving = self.config.moving
        moving = abs(self._command.v) > v_moving or abs(self._command.omega) > omega_moving
        if digest != self._digest:
            self._digest, self._same = digest, 1
        elif moving:
            self._same += 1
        elif self.stopped != "frozen pixels":  # a parked vehicle may see the same picture for ever
            self._same = 1
        return self._same >= self.config.frozen_frames

    def _stop(self, reason: str) -> None:
        self.counts[f"stop: {reason}"] += 1
        self.stopped = reason
        self._fresh = 0
        self._reset = True
        self._zero()

    def _zero(self) -> Command:
        self._command = Command(0.0, 0.0, self.reason)
        return self._command

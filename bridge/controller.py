"""Camera frames in, wheel commands out: joins image, policy and safety; no ROS, injected time.

The policy runs when a frame arrives, not on a timer of its own: a free-running 10 Hz timer adds 0 to 100 ms of dead
time by chance, a frame trigger adds none. The tick is the backstop that keeps commands coming and stops the vehicle
when frames do not.
"""

import time
import zlib
from collections.abc import Callable

import numpy as np

from bridge.image import ImageError, to_rgb8
from bridge.policy import Policy
from bridge.safety import Command, SafetyConfig, Supervisor

BACKSTOP = 1.25
"""Periods without a command after which the last one is sent again (while its frame is young) or zero."""
BLIND_FRAMES = 5
"""Uniform frames in a row that count as a dark or saturated camera."""


class Controller:
    """One policy driving one vehicle."""

    def __init__(self, policy: Policy, safety: SafetyConfig, clock: Callable[[], float] = time.monotonic) -> None:
        self.policy = policy
        self.supervisor = Supervisor(safety)
        self.last_error = ""
        """Why the last unusable frame was dropped."""
        self._clock = clock  # only for the duration of a policy step
        self._period = 1 / policy.contract.rate_hz
        self._due = -np.inf
        self._arrived = -np.inf
        self._sent = -np.inf
        self._last = Command(0.0, 0.0, "no frame yet")
        self._ticks = 0
        self._uniform = 0

    def on_image(self, now: float, stamp: float, stamp_age: float, height: int, width: int, encoding: str, step: int,
                 data: object) -> Command | None:
        """Take one camera message; return the command to publish, None where there is none to send now.

        Args:
            now: steady time of receipt [s].
            stamp: stamp of the message [s].
            stamp_age: time of receipt minus stamp, on the clock that made the stamp [s].
            height, width, encoding, step, data: the fields of sensor_msgs/Image.
        """
        contract, supervisor = self.policy.contract, self.supervisor
        try:
            image = to_rgb8(height, width, encoding, step, data, (contract.height, contract.width))
        except ImageError as error:
            self.last_error = str(error)
            supervisor.counts["unusable"] += 1
            return None
        if supervisor.frame(now, stamp, zlib.crc32(image.data), stamp_age) != "fresh":
            return None
        self._watch_exposure(image)
        if not self._is_due(now):
            return None  # a camera faster than the policy
        if supervisor.take_reset():
            self.policy.reset()
            self._ticks = 0
        self._ticks += 1
        if not supervisor.may_drive or (self._ticks - 1) % contract.action_repeat:
            return self._send(now, supervisor.tick(now))
        start = self._clock()
        action = self.policy.step(image)
        return self._send(now, supervisor.action(now, action, self._clock() - start))

    def on_tick(self, now: float) -> Command | None:
        """Return a command where one is due although no frame came: a stop at once, else after BACKSTOP periods."""
        command = self.supervisor.tick(now)
        stops_now = command.reason != "" and self._last.reason == ""
        if stops_now or now - self._sent >= BACKSTOP * self._period:
            return self._send(now, command)
        return None

    def _send(self, now: float, command: Command) -> Command:
        self._sent, self._last = now, command
        return command

    def _is_due(self, now: float) -> bool:
        """Return whether a policy step may start, and if so plan the next one.

        The frame nearest to the plan is taken, and the plan follows half of each deviation. So a camera near the
        policy's rate is never skipped however its clock drifts, and a faster one is thinned out to the policy's rate.
        """
        interval, self._arrived = min(now - self._arrived, self._period), now
        if now < self._due - interval / 2:
            return False
        self._due = (now if now - self._due > self._period else (now + self._due) / 2) + self._period
        return True

    def _watch_exposure(self, image: np.ndarray) -> None:
        """Count runs of images that are uniformly black or saturated; they are shown in the status."""
        self._uniform = self._uniform + 1 if image.max() <= 2 or image.min() >= 253 else 0
        if self._uniform == BLIND_FRAMES:
            self.supervisor.counts["dark or saturated"] += 1

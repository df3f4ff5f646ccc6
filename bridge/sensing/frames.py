"""Judges camera frames by their times and pixels; pure Python with injected time.

Receipt times are seconds of a steady clock. Only the age of a stamp is a difference of two wall or simulation times,
computed by the caller.
"""

import math
from typing import Literal

Verdict = Literal["fresh", "repeated", "out of order", "late"]


class FrameWatch:
    """Remembers the last frames of one camera."""

    def __init__(self, frame_age: float, stamp_age: float, frozen_frames: int) -> None:
        """Set the limits.

        Args:
            frame_age: a longer time [s] since the last receipt is a silence.
            stamp_age: stamps further than this [s] from their receipt are late.
            frozen_frames: identical images in a row, received while moving, that count as a frozen camera.
        """
        self.frozen = False
        """True while the pixels stand still although the vehicle moved."""
        self._frame_age, self._stamp_age, self._frozen_frames = frame_age, stamp_age, frozen_frames
        self._received = -math.inf
        self._stamp: float | None = None
        self._digest: int | None = None
        self._same = 0

    def is_silent(self, now: float) -> bool:
        """Return whether the newest frame is older than the limit."""
        return now - self._received > self._frame_age

    def judge(self, now: float, stamp: float, digest: int, stamp_age: float, moving: bool) -> Verdict:
        """Return what the times of a frame say, and remember it where it is fresh.

        Args:
            now: steady time of receipt [s].
            stamp: the frame's own stamp [s].
            digest: hash of its pixels.
            stamp_age: time of receipt minus stamp, both of the camera's clock [s].
            moving: whether the vehicle was commanded to move.
        """
        if self._stamp is not None and stamp == self._stamp:
            return "repeated"
        if self._stamp is not None and stamp < self._stamp and not self.is_silent(now):
            return "out of order"  # after a silence a smaller stamp is a restarted camera
        if not abs(stamp_age) <= self._stamp_age:
            return "late"
        self._received, self._stamp = now, stamp
        self._compare(digest, moving)
        return "fresh"

    def forget_stamps(self) -> None:
        """Accept any next stamp: the camera's clock was set."""
        self._stamp = None

    def _compare(self, digest: int, moving: bool) -> None:
        if digest != self._digest:
            self._digest, self._same = digest, 1
        elif moving:
            self._same += 1
        elif not self.frozen:  # a parked vehicle may see the same picture for ever
            self._same = 1
        self.frozen = self._same >= self._frozen_frames

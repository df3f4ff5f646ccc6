"""What the published sets share: poses that hold between updates, and limits of what is read."""

from __future__ import annotations

import numpy as np

from sysid.logs.records import PoseStream

LARGEST = 1e6  # m, rad or rad/s that a measured value stays below
CONVERT = "Convert the original again"
MOVING = 0.05  # m of track or wheel travel below which a window shows nothing
HELD = 1e-9  # difference [m, rad] below which two poses are one that was held: rounding differs from sample to sample
MAX_GAP = 0.5  # s without a measurement; windows with a longer gap are left out


def only_changes(t: np.ndarray, x: np.ndarray, y: np.ndarray, yaw: np.ndarray) -> PoseStream:
    """The samples at which the pose differs from the one before (yaw unwrapped); the first sample is the start."""
    yaw = np.unwrap(yaw)
    moved = np.abs([np.diff(x), np.diff(y), np.diff(yaw)]).max(axis=0)
    changed = np.flatnonzero(moved > HELD) + 1
    return PoseStream(t[changed], x[changed], y[changed], yaw[changed])

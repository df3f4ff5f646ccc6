"""A yaw rate measured on the vehicle: its sign.

Gyros are mounted upside down or logged with the sign of another convention. The yaw of an outside pose or of the
odometry shows which way the vehicle really turned.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

SURE = 0.9
"""Least correlation of both turns, of either sign, that settles the sign."""
LEAST_TURN = 0.5
"""Root of the summed squares of the turns [rad] below which nothing turned."""


def told_sign(turns: Sequence[tuple[float, float]]) -> float | None:
    """1.0 or -1.0, by which a gyro's rate is multiplied to agree with the yaw seen otherwise; None where nothing shows.

    Args:
        turns: of pieces of the log, the turn [rad] that the gyro adds up to and the one seen by something else.
    """
    if not len(turns):
        return None
    gyro, seen = np.asarray(turns, float).T
    size = float(np.linalg.norm(gyro) * np.linalg.norm(seen))
    if min(np.linalg.norm(gyro), np.linalg.norm(seen)) < LEAST_TURN or abs(gyro @ seen) < SURE * size:
        return None
    return float(np.sign(gyro @ seen))

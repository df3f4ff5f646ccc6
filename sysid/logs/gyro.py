"""A yaw rate measured on the vehicle: its sign, by the yaw of an outside pose or of the odometry."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sysid.logs.planar import added_up
from sysid.logs.records import Trial

SURE = 0.9  # least correlation of both turns, of either sign, that settles the sign
LARGEST = 1.25
"""Factor by which a gyro may turn more or less than what is seen otherwise: as far as `gyro_bias.scale` goes."""
LEAST_TURN = 0.5  # root of the summed squares of the turns [rad] below which nothing turned


def sign_shown(turns: Sequence[tuple[float, float]]) -> float | None:
    """1.0 or -1.0, by which a gyro's rate is multiplied to agree with the yaw seen otherwise; None if nothing shows.

    `turns`: of pieces of the log, the turn [rad] that the gyro adds up to and the one seen by something else.
    """
    if not len(turns):
        return None
    gyro, seen = np.asarray(turns, float).T
    size = float(np.linalg.norm(gyro) * np.linalg.norm(seen))
    if min(np.linalg.norm(gyro), np.linalg.norm(seen)) < LEAST_TURN or abs(gyro @ seen) < SURE * size:
        return None
    return float(np.sign(gyro @ seen))


def with_sign(trials: Sequence[Trial]) -> tuple[tuple[Trial, ...], list[str]]:
    """Trials with the gyro's turns counter-clockwise, and notes on what was changed.

    A gyro whose turns do not follow the yaw that is seen otherwise is left out: another axis or unit.
    """
    turns = [each for trial in trials if (each := _turns(trial)) is not None]
    if not any(trial.gyro is not None for trial in trials):
        return tuple(trials), []
    without = tuple(replace(trial, gyro=None) for trial in trials)
    sign = sign_shown(turns)
    if sign is None:
        if float(np.linalg.norm([seen for _, seen in turns])) < LEAST_TURN:
            return tuple(trials), ["nothing turns enough to show the gyro's sign: it is taken as logged"]
        return without, ["the gyro does not follow the turns that pose or odometry show: it is left out. Record the "
                         "yaw rate about the vertical axis, in rad/s"]
    gyro, seen = np.asarray(turns, float).T
    factor = float(gyro @ seen / (gyro @ gyro)) * sign
    if not 1 / LARGEST < factor < LARGEST:
        return without, [f"the gyro turns {1 / factor:.3g} times as far as pose or odometry show: it is left out. "
                         "Record its yaw rate in rad/s"]
    if sign > 0:
        return tuple(trials), []
    turned = tuple(trial if trial.gyro is None else replace(trial, gyro=replace(trial.gyro, turn=-trial.gyro.turn))
                   for trial in trials)
    return turned, ["the gyro turns against the yaw that is seen otherwise: its sign is changed"]


def _turns(trial: Trial) -> tuple[float, float] | None:
    """Longest turn of the gyro and of the outside pose, or else the odometry [rad], from lowest to highest heading;
    None without both. Absolute turns would not show the sign, and whole drives may end as they began."""
    pose, odometry = trial.ground_truth, trial.odometry
    if trial.gyro is None:
        return None
    if pose is not None and len(pose.t) > 1:
        t, seen = pose.t, pose.yaw
    elif odometry is not None and len(odometry.t) > 1:
        t, seen = odometry.t, added_up(odometry.t, odometry.omega, odometry.t)
    else:
        return None
    inside = (t >= trial.gyro.t[0]) & (t <= trial.gyro.t[-1])
    if inside.sum() < 2:
        return None
    t, seen = t[inside], seen[inside]
    gyro = np.interp(t, trial.gyro.t, trial.gyro.turn)
    low, high = int(np.argmin(seen)), int(np.argmax(seen))
    return float(gyro[high] - gyro[low]), float(seen[high] - seen[low])

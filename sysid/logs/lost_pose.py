"""Trials whose outside pose was lost: its yaw contradicts a yaw rate that was measured on the vehicle.

Scan matching fails where the vehicle turns fast or its surroundings show little: the pose jumps, and may stay wrong for
the rest of the trial. No vehicle model is asked: the outside yaw must follow the integral of the rate, however late it
is and with whatever factor a gyro of its kind may have.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sysid.logs.records import Log, Trial
from sysid.logs.streams import added_up

LOST = 0.5  # yaw [rad] by which the outside pose may part from the rate: at 3 m/s it is off by 1.5 m a second later
LATEST, STEP = 1.2, 0.05  # s, delays of the outside pose that are tried
FACTOR = 0.15  # by which the rate's scale may be off
LEAST = 8  # training trials that must be left for lost ones to be left out


def yaw_contradiction(trial: Trial, rate: tuple[np.ndarray, np.ndarray]) -> float:
    """Largest difference [rad] between the outside yaw and the integral of a yaw rate, at the delay where it is least.

    Args:
        rate: times (T,) [s] and yaw rates of the body (T,) [rad/s]. Before its first time the vehicle turned as then.

    Returns:
        nan where the trial has no outside pose.
    """
    pose, (when, turning) = trial.ground_truth, rate
    if pose is None or len(pose.t) == 0 or len(when) < 2:
        return float("nan")
    t = np.concatenate([[0.0], pose.t])
    yaw = np.concatenate([[0.0], pose.yaw - trial.start.yaw])
    parted = []
    for delay in np.arange(0.0, LATEST + STEP / 2, STEP):
        follows = added_up(when, turning, t - delay)
        follows -= follows[0]
        factor = np.clip(follows @ yaw / max(follows @ follows, 1e-12), 1 - FACTOR, 1 + FACTOR)
        parted.append(np.abs(yaw - factor * follows).max())
    return float(min(parted))


def lost(log: Log) -> tuple[str, ...]:
    """Names of the trials whose outside pose was lost; none where no yaw rate was measured (`fields["yaw_rate"]`)."""
    rates = log.fields.get("yaw_rate", {})
    return tuple(trial.name for trial in log.trials
                 if trial.name in rates and yaw_contradiction(trial, rates[trial.name]) > LOST)


def without_lost(log: Log) -> Log:
    """The log without training trials whose outside pose was lost, and a note of it; held-out ones are kept.

    Where fewer than `LEAST` would be left, all are kept.
    """
    gone = set(lost(log)) & {trial.name for trial in log.training}
    left = len(log.training) - len(gone)
    if not gone:
        return log
    contradicted = (f"{len(gone)} of {len(gone) + left} training trials have an outside yaw that contradicts the gyro "
                    f"by more than {LOST:g} rad: their outside pose was lost")
    if left < LEAST:
        return replace(log, notes=(*log.notes, f"{contradicted}; they are fitted all the same, since too few others "
                                               "are left"))
    kept = log.select(lambda trial: trial.held_out or trial.name not in gone)
    return replace(kept, notes=(*log.notes, f"{contradicted}, and they are not fitted"))

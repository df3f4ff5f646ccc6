"""Trials that would be fitted as what they are not: with a lost outside pose, or of a vehicle that stands.

Scan matching fails where the vehicle turns fast or its surroundings show little: the pose may stay wrong for the rest
of the trial. No vehicle model is asked: the outside yaw must follow the integral of a measured yaw rate, however late
it is and with whatever factor a gyro may have. A vehicle stands though commanded to move as it did elsewhere where its
emergency stop was pressed, its motors were off or its wheels blocked.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sysid.logs.records import Log, Trial, logged_pose
from sysid.logs.stream_quality import added_up, speeds

LOST = 0.5  # yaw [rad] by which the outside pose may part from the rate: at 3 m/s it is off by 1.5 m a second later
LATEST, STEP = 1.2, 0.05  # s, delays of the outside pose that are tried
FACTOR = 0.15  # by which the rate's scale may be off
LEAST = 8  # training trials that must be left for lost ones to be left out
STANDS = 0.1  # share of the commanded speeds (root mean square) below which a vehicle stands: what is left is noise
RESPONSE = 0.3  # s, of a usual vehicle
STILL = 0.01  # m/s of commands that ask for nothing
FOLLOWS = 0.5  # share of a commanded speed at which a vehicle moves
SLOWEST = 0.1  # quantile of the commands at which it does, below which its dead zone may lie


def yaw_contradiction(trial: Trial, rate: tuple[np.ndarray, np.ndarray]) -> float:
    """Largest difference [rad] between the outside yaw and the integral of a yaw rate, at the delay where it is least.

    `rate`: times (T,) [s] and yaw rates of the body (T,) [rad/s]; nan where the trial has no outside pose.
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


def stood(trials: Sequence[Trial], reach: float) -> list[str]:
    """Names of the trials in which the vehicle stands, though commanded to move as fast as where it moves in others.

    Smaller commands that do not move it show its dead zone. `reach` of a wheel [m]: by it yaw rates count as speeds.
    """
    seen = {trial.name: sizes_of(trial, reach) for trial in trials}
    asked = {name: _size(one[0]) for name, one in seen.items()}
    stands = {name: _size(one[1]) < STANDS * asked[name] for name, one in seen.items()}
    moved = [wanted[(wanted > STILL) & (size > FOLLOWS * wanted)]
             for name, (wanted, size) in seen.items() if not stands[name]]  # fmt: skip
    instants = np.concatenate(moved) if moved else np.zeros(0)
    least = float(np.quantile(instants, SLOWEST)) if len(instants) else 0.0
    return [name for name in seen if stands[name] and asked[name] > max(STILL, least)]


def sizes_of(trial: Trial, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Commanded and measured speeds (T,) [m/s], of odometry, its pose or outside pose: what moves most, or empty."""
    found = []
    by_its_pose = replace(trial, ground_truth=logged_pose(trial.odometry))  # a driver may leave the speeds at zero
    for one, channel in ((trial, "odometry"), (trial, "ground_truth"), (by_its_pose, "ground_truth")):
        rates = speeds(one, channel)
        if rates is not None:
            v, omega = trial.command.at(rates[0] - RESPONSE, (0.0, 0.0))
            found.append((np.hypot(v, reach * omega), np.hypot(rates[1], reach * rates[2])))
    return max(found, key=lambda one: _size(one[1]), default=(np.zeros(0), np.zeros(0)))


def _size(values: np.ndarray) -> float:
    """Root mean square of values (T,); 0 of none."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0


def without_standing(log: Log, place: str) -> Log:
    """The log without training trials in which the vehicle stands though commanded to move, and a note that names them.

    ValueError, which names the `place`, where it moves in no training trial.
    """
    gone = {name for name in stood(log.trials, log.spec.track / 2)} & {trial.name for trial in log.training}
    if not gone:
        return log
    kept = tuple(trial for trial in log.trials if trial.name not in gone)
    if all(trial.held_out for trial in kept):
        raise ValueError(f"{place}: the vehicle stands in all training trials, though it is commanded to move. Release "
                         "its emergency stop, switch its motors on, or check which streams were recorded.")
    return replace(log, trials=kept, notes=(*log.notes, said(sorted(gone)) + ": left out"))


def said(names: Sequence[str]) -> str:
    """What these trials show, in words."""
    more = f" and {len(names) - 1} more" if len(names) > 1 else ""
    return f"{names[0]}{more}: the vehicle stands though commanded to move (an emergency stop?)"

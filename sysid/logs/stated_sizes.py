"""Nominal sizes that a log contradicts: the outside pose goes or turns further than the odometry, which uses them."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sysid.logs.directions import APART, SURE, VARIED, WHOLE, direction, motion_of
from sysid.logs.records import Trial
from sysid.logs.streams import GRID_DT, clock_shift
from whill_mjx.vehicle.specs import VehicleSpec

USUAL = 0.06  # share by which data sheets, worn tyres and creeping wheels make a size differ

Gain = tuple[float, float]  # outside motion over that of the odometry, and its standard error


def wrong_sizes(trials: Sequence[Trial], spec: VehicleSpec, reach: float) -> list[str]:
    """Sentences on a wheel radius and a track that are further off than is usual.

    Whether these are wrong or the odometry has a scale of its own, the outside pose does not show; a ruler does.
    `reach`: how far from the axle's centre a tracked point may be [m].
    """
    each = [gains for trial in trials if (gains := _gains(trial, reach)) is not None]
    way, turn = (_pooled([one[k] for one in each if one[k] is not None]) for k in (0, 1))
    if spec.drive == "skid":
        turn = None  # it scrubs in turns
    found = []
    if way is not None:
        found.append(f"ground_truth: it goes {_times(way)} as far as the odometry says: the wheel radius is then "
                     f"{spec.wheel_radius * way[0]:.3g} m, not {spec.wheel_radius:.3g} m, or the odometry has a scale "
                     "of its own. Measure the wheels; a fit finds both.")
    across = None if turn is None else spec.track * (1.0 if way is None else way[0]) / turn[0]
    if turn is not None and across is not None and abs(np.log(across / spec.track)) > USUAL:
        found.append(f"ground_truth: it turns {_times(turn)} as far as the odometry says: the track is then "
                     f"{across:.3g} m, not {spec.track:.3g} m, or the odometry has a scale of its own. Measure the "
                     "track; a fit finds both.")
    return found


def _times(gain: Gain) -> str:
    return f"{gain[0]:.3f} times ({gain[0] - 2 * gain[1]:.3f} to {gain[0] + 2 * gain[1]:.3f})"


def _gains(trial: Trial, reach: float) -> tuple[Gain | None, Gain | None] | None:
    """Of a trial's way and of its turns; None for what it does not show."""
    pose, odometry = trial.ground_truth, trial.odometry
    if pose is None or odometry is None:
        return None
    late = [shift.delay for shift in clock_shift(trial).values()]
    on_time = replace(trial, ground_truth=replace(pose, t=pose.t - (float(np.median(late)) if late else 0.0)))
    motion = motion_of(on_time, "ground_truth")
    if motion is None:
        return None
    along = direction(motion, reach)
    sure = along.explained > WHOLE and np.isfinite(along.gain_error)
    way = (along.gain, along.gain_error) if sure else None
    power = float(motion.omega @ motion.omega)
    if motion.omega.std() < VARIED:
        return way, None
    gain = float(motion.turn @ motion.omega) / power
    left = motion.turn - gain * motion.omega
    explained = 1 - float(left @ left) / max(float(motion.turn @ motion.turn), 1e-12)
    error = float(np.sqrt(left @ left / max(len(left) * GRID_DT / APART, 1.0) / power))
    return way, (gain, error) if explained > WHOLE else None


def _pooled(found: Sequence[Gain | None]) -> Gain | None:
    """The gain of all trials together, where it is surely further from 1 than is usual."""
    known = [one for one in found if one is not None]
    if not known:
        return None
    gains, errors = np.array(known).T
    weights = 1 / np.maximum(errors, 1e-4) ** 2
    gain = float((weights * gains).sum() / weights.sum())
    scatter = float((weights * (gains - gain) ** 2).sum() / weights.sum() / max(len(known) - 1, 1))
    error = float(np.sqrt(max(1 / weights.sum(), scatter)))
    sure = gain > SURE * error and abs(np.log(gain)) > max(USUAL, SURE * error / gain)
    return (gain, error) if sure else None

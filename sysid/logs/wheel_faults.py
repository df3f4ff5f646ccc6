"""What a log shows to be wrong with the wheels: one that counts backwards, and nominal sizes that are not theirs.

v and omega give the speeds of the two rims, v -+ omega track / 2. Negating the left one turns them into omega track / 2
and 2 v / track; negating the right one turns them into the negatives of these. Where the sizes are wrong, the outside
pose goes or turns further than the odometry, which uses them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sysid.logs.directions import ALIKE, APART, RESPONSE, SURE, UNLIKE, VARIED, WHOLE, direction, likeness, motion_of
from sysid.logs.records import Log, Trial
from sysid.logs.stream_quality import GRID_DT, clock_shift, speeds
from whill_mjx.vehicle.specs import VehicleSpec

STILL = 1e-3  # standard deviation of a speed that hardly changes
LEAST = {True: 0.1, False: 0.4}  # gain of a yaw rate that follows, of a skid drive, which scrubs, and of others
USUAL = 0.06  # share by which data sheets, worn tyres and creeping wheels make a size differ

Gain = tuple[float, float]  # outside motion over that of the odometry, and its standard error


def backward_wheel(log: Log) -> str:
    """A sentence on the wheel that counts backwards, where nothing else explains the measured speeds; else ""."""
    measured_input = log.fields.get("input") == "wheels"
    for beside in ("outside pose",) if measured_input else ("outside pose", "commands"):
        pairs = [pair for trial in log.trials if (pair := _speeds_beside(trial, beside, measured_input)) is not None]
        if not pairs:
            continue
        own, reference = (np.concatenate(each, axis=1) for each in zip(*pairs, strict=True))
        if _alike(own, reference):
            return ""
        if side := _side(own, reference, log.spec.track / 2, LEAST[log.spec.drive == "skid"], beside == "commands"):
            scale = f"{'-' if side == 'right' else ''}{log.spec.track / 2:.3g}"
            where = "command" if measured_input else "odometry"
            return (f"{where}: the {side} wheel counts backwards: with its speed negated, v and omega follow the "
                    f"{beside}. Turn its sign in the driver. In this log v must become {scale} omega and omega v / "
                    f"{scale}{'' if measured_input else ', and x, y and yaw what these add up to'}.")
    return ""


def _speeds_beside(trial: Trial, beside: str, measured_input: bool) -> tuple[np.ndarray, np.ndarray] | None:
    """Speeds (2, G) v, omega of the wheels, and what they should be; None where a trial lacks one."""
    pose, odometry = speeds(trial, "ground_truth"), speeds(trial, "odometry", smooth=True)
    if beside == "outside pose" and pose is not None and measured_input:
        return np.array(trial.command.at(pose[0], (0.0, 0.0))), np.array(pose[1:])
    if odometry is None or beside == "outside pose" and pose is None:
        return None
    if beside == "commands" or pose is None:
        return np.array(odometry[1:]), np.array(trial.command.at(odometry[0] - RESPONSE, (0.0, 0.0)))
    inside = (pose[0] >= odometry[0][0]) & (pose[0] <= odometry[0][-1])
    if not inside.any():
        return None
    return (np.array([np.interp(pose[0][inside], odometry[0], one) for one in odometry[1:]]),
            np.array([one[inside] for one in pose[1:]]))


def _alike(own: np.ndarray, reference: np.ndarray) -> bool:
    """Whether speeds (2, G) follow those beside them as they are."""
    varied = [k for k in (0, 1) if reference[k].std() > VARIED]
    return bool(varied) and all(likeness(own[k], reference[k], STILL) > ALIKE for k in varied)


def _side(own: np.ndarray, reference: np.ndarray, half: float, least: float, commands: bool) -> str:
    """"left" or "right" where negating that wheel, and nothing else, explains speeds (2, G); else "".

    `commands`: the reference, whose columns may be exchanged instead: then the gains decide, which no scale of wheels
    is in.
    """
    gains, scales = [], []
    for now, turned, scale, lowest in ((0, half * own[1], half, 0.4), (1, own[0] / half, 1 / half, least)):
        beside = reference[now] - reference[now].mean()
        if beside.std() <= VARIED:
            continue
        follows = likeness(turned, beside, STILL)
        gain = float(turned @ beside / (beside @ beside))
        if abs(follows) < ALIKE or 1 - abs(follows) > UNLIKE * (1 - likeness(own[now], beside, STILL)) or not (
                lowest < abs(gain) < 1 / lowest):
            return ""
        gains.append(gain)
        scales.append(scale)
    if not gains or len({gain > 0 for gain in gains}) > 1:
        return ""
    turned_off, exchanged_off = (sum(abs(np.log(abs(gain) / scale)) for gain, scale in zip(gains, each, strict=True))
                                 for each in (np.ones(len(gains)), scales))
    if commands and gains[0] > 0 and exchanged_off < turned_off:
        return ""
    return "left" if gains[0] > 0 else "right"


def wrong_sizes(trials: Sequence[Trial], spec: VehicleSpec, reach: float) -> list[str]:
    """Sentences on a wheel radius and a track that are further off than is usual.

    Whether these are wrong or the odometry has a scale of its own, the outside pose does not show; a ruler does.
    `reach`: how far from the axle's centre a tracked point may be [m].
    """
    each = [_odometry_gains(trial, reach) for trial in trials]
    way, turn = (_pooled([one[k] for one in each]) for k in (0, 1))
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


def _odometry_gains(trial: Trial, reach: float) -> tuple[Gain | None, Gain | None]:
    """Of a trial's way and of its turns; None for what it does not show."""
    pose = trial.ground_truth
    if pose is None or trial.odometry is None:
        return None, None
    late = [shift.delay for shift in clock_shift(trial).values()]
    on_time = replace(trial, ground_truth=replace(pose, t=pose.t - (float(np.median(late)) if late else 0.0)))
    motion = motion_of(on_time, "ground_truth")
    if motion is None:
        return None, None
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

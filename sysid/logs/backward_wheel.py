"""A wheel that counts backwards: driving straight then looks like a turn, and a turn like driving straight.

v and omega give the speeds of the two rims, v -+ omega track / 2. Negating the left one turns them into omega track / 2
and 2 v / track; negating the right one turns them into the negatives of these.
"""

import numpy as np

from sysid.logs.directions import ALIKE, RESPONSE, UNLIKE, VARIED, likeness
from sysid.logs.records import Log, Trial
from sysid.logs.streams import speeds

STILL = 1e-3  # standard deviation of a speed that hardly changes
LEAST = {True: 0.1, False: 0.4}  # gain of a yaw rate that follows, of a skid drive, which scrubs, and of others


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

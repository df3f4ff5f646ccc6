"""Poses that contradict the speeds beside them: another axis, frame or clock, a reset, or speeds that are none;
and poses that no vehicle drives: jumps from row to row, rows that take turns between two poses or stand still, columns
that never change.

Clocks are compared by rates of turning and of motion, since no frame changes them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sysid.logs.directions import (
    MOVING,
    NONE,
    PLAINER,
    RESPONSE,
    SURE,
    UNLIKE,
    VARIED,
    WHOLE,
    Motion,
    direction,
    far_point,
    in_fixed_frame,
    inverted,
    likeness,
    motion_of,
    pooled,
)
from sysid.logs.planar import differenced, half_span
from sysid.logs.records import Trial, logged_pose
from sysid.logs.stream_quality import SMOOTHING, speeds

LITTLE = 0.75  # share of the motion that a direction must explain, below which something is wrong
ANGLE = np.deg2rad(3.0)  # between an axis and the way of travel, that is named
SAME_WAY, OTHER_SIZE = 0.9, (1.25, 10.0)
"""Correlation of a pose's rate with the speed beside it, and factors between them that calibration does not explain;
larger ones are units, which the commands show."""
BACKWARDS = np.deg2rad(150.0)  # beyond which the sign of v says it already
FASTER = 0.3  # share of a pose's usual speed, above which it counts as moving
EMPTY = 0.15  # share of the time in which a pose moves, for which speeds of exactly zero are no standstill
REACH, LAG_DT = 10.0, 0.1  # s of delays that are tried beside a clock that runs fast, and steps of delays
LONGEST = 3600.0  # s of a drive over which a clock that runs fast is looked for: tables of it grow with the time
LATE = (0.6, 1.5)  # s that the fit does not reach, beside odometry and beside commands, which a vehicle follows late
LEFT = {"odometry": 0.5, "commands": UNLIKE}
"""Of what is not alike, what a clock that runs fast may leave, beside what is measured and beside commands."""
DRIFT = 0.3  # s by which clocks must come apart in a drive to differ from a delay
MOST, FAST, RATE_STEP = 0.15, 0.2, 0.005  # by which a clock may run fast or slow, how far is searched, and its steps
JUMP = (0.1, 3.0)  # m or rad, and times the way that the speed gives, of a step that is a jump
RARE = (3, 0.05)  # jumps of one drive, and of the rows of an outside pose; more are noise
TURNS, ROWS = 0.5, 100  # share of the squared steps from row to row, and rows that show it
"""Squared steps over two rows, below which rows take turns: of noise alone they are as large, of motion larger."""
HELD = 0.5  # s for which rows repeat before a jump when a driver was held up
FROZEN = 1.0  # s for which rows repeat that is longer than a driver takes between two updates
FOLLOWS = 0.5  # share of a commanded speed at which a vehicle moves
STILL = 1e-3  # m/s and rad/s below which a speed is none
MOVED = 0.5  # m and rad that a vehicle goes and turns by when each of its columns must change


def contradictions(trials: Sequence[Trial], reach: float = 1.0) -> dict[str, list[str]]:
    """Sentences for "odometry" and "ground_truth" on what contradicts the speeds beside it.

    `reach`: how far from the axle's centre a tracked point may be [m]. That of the odometry is the centre.
    """
    found: dict[str, list[str]] = {}
    for name in ("odometry", "ground_truth"):
        alone = name == "odometry" or bool(found["odometry"]) or any(trial.odometry is None for trial in trials)
        found[name] = _of_stream(name, trials, reach if name == "ground_truth" else 0.0,
                                 "commands" if alone else "odometry")
    if found["ground_truth"] and found["ground_truth"] == [running_fast("ground_truth", trials, "odometry")]:
        found["odometry"] = found["ground_truth"]  # whichever of the two clocks is wrong
    if not any(found.values()) and (far := far_point(trials, reach)):
        found["ground_truth"] = [far]
    return found


def _of_stream(name: str, trials: Sequence[Trial], reach: float, beside: str) -> list[str]:
    empty = [*_empty_speeds(trials), *_without_sign(trials)] if name == "odometry" else []
    if found := (constant_columns(name, trials) or frozen(name, trials) or two_sources(name, trials)
                 or [*jumps(name, trials), *empty]):
        return found
    motions = [motion for trial in trials if (motion := motion_of(trial, name)) is not None]
    if name == "odometry" and motions and in_fixed_frame(motions) and not _is_mirrored(motions, reach):
        return [f"{name}: v is the speed along the fixed x axis, not along the vehicle: the twist is in the frame "
                "odom. Its pose agrees with the commands; turn the twist by -yaw, into the vehicle's frame."]
    if said := running_fast(name, trials, beside) or another_clock(name, trials):
        return [said]
    if not motions:
        return []
    if name == "odometry" and (of_size := _of_another_size(trials)):
        return of_size
    plain = pooled([direction(one, reach) for one in motions])
    against = float(np.median([likeness(one.turn, one.omega) for one in motions]))
    if against < -WHOLE and pooled([direction(inverted(one), reach) for one in motions]).explained > max(
            WHOLE, plain.explained):
        return [f"{name}: its pose is that of the fixed frame as the vehicle sees it: parent and child are exchanged. "
                "Invert the transform: (x, y) = -R(-yaw) (x, y), then yaw = -yaw."]
    if plain.explained < LITTLE:
        mirrored = pooled([direction(one, reach, mirrored=True) for one in motions])
        if mirrored.explained > WHOLE:
            return [f"{name}: x and y turn against yaw: the frame is left-handed (y mirrored, or x and y exchanged), "
                    "or yaw is a compass heading. Counter-clockwise is positive yaw; negate y, exchange the axes, or "
                    "take 90 deg - heading."]
        if name == "odometry" and plain.explained < LITTLE / 2:
            return [f"{name}: its pose and its speeds contradict each other: v explains {plain.explained:.0%} of how "
                    "the pose moves. Check that both are of one vehicle, frame and clock."]
        return []
    if name == "odometry" and against < -WHOLE and _obeys(trials):
        return ["odometry: its yaw turns against its own omega, which follows the commands: yaw has the wrong sign. "
                "Counter-clockwise is positive; negate yaw, and y if that turns with it."]
    if plain.explained > WHOLE and ANGLE < abs(plain.angle) < BACKWARDS and abs(plain.angle) > SURE * plain.error:
        degrees = np.rad2deg(plain.angle)
        side = "left" if degrees > 0 else "right"
        what = "the outside pose" if name == "ground_truth" else "its pose"
        remedy = (f"add {degrees:.0f} deg to its yaw (sysid.convert takes --truth-turned {-degrees:.0f})"
                  if name == "ground_truth" else "its speeds agree with the commands; turn x and y")
        return [f"{name}: {what} moves {abs(degrees):.0f} deg to the {side} of its own heading: its axes are not "
                f"the vehicle's. Correct them: {remedy}."]
    return []


def _of_another_size(trials: Sequence[Trial]) -> list[str]:
    """Sentences on an odometry whose pose goes, or turns, by more or less than its own speeds say."""
    said, moving = [], [one for one in trials if one.odometry is not None and one.odometry.v.std() > NONE]
    found = [(one, motion) for one in moving if (motion := motion_of(one, "odometry")) is not None]
    for what, name, columns in (("goes", "v", "x and y"), ("turns", "omega", "yaw")):
        gains, obeyed = [], []
        for trial, motion in found:
            ways = {"v": (np.hypot(*motion.steps.T), np.abs(motion.v)), "omega": (motion.turn, motion.omega)}
            pose, speed = ways[name]
            if likeness(pose, speed) > SAME_WAY:
                gains.append(float(pose @ speed / (speed @ speed)))
                sent = np.abs(trial.command.at(motion.t - RESPONSE, (0.0, 0.0))[int(name == "omega")])
                obeyed.append([float(np.abs(one) @ sent / max(sent @ sent, 1e-12)) for one in (pose, speed)])
        gain = float(np.median(gains)) if gains else 1.0
        if not OTHER_SIZE[0] < max(gain, 1 / gain) < OTHER_SIZE[1]:
            continue
        pose_off, speed_off = np.abs(np.log(np.maximum(np.median(obeyed, axis=0), 1e-6)))
        better, remedy = ((name, f"multiply {columns} by {1 / gain:.3g}") if speed_off < pose_off else
                          ("the pose", f"multiply {name} by {gain:.3g}"))
        said.append(f"odometry: its pose {what} {gain:.2g} times as far as its own {name} says. By the commands "
                    f"{better} is right: {remedy}, or take both from one source.")
    return said


def _is_mirrored(motions: Sequence[Motion], reach: float) -> bool:
    """Whether a pose travels along its own heading rather with y negated."""
    mirrored, plain = (pooled([direction(one, reach, mirrored=way) for one in motions]).explained
                       for way in (True, False))
    return mirrored > max(WHOLE, plain)


def _obeys(trials: Sequence[Trial]) -> bool:
    """Whether the odometry's yaw rate has the sign of the commanded one."""
    found = [likeness(one.odometry.omega, one.command.at(one.odometry.t - RESPONSE)[1])
             for one in trials if one.odometry is not None]
    return bool(np.median(found) > 0)


def another_clock(name: str, trials: Sequence[Trial], beside: str = "speeds beside it") -> str:
    """A sentence on a stream of which most trials are late or early beside the speeds (or "commands"); else ""."""
    lates = [late for trial in trials if (late := lateness(trial, name, beside == "commands")) is not None]
    if len(lates) <= len([trial for trial in trials if getattr(trial, name) is not None]) / 2:
        return ""
    late = float(np.median(lates))
    return (f"{name}: its motion comes {abs(late):.1f} s {'later' if late > 0 else 'earlier'} than the {beside}: "
            f"another clock. {'Subtract' if late > 0 else 'Add'} {abs(late):.1f} s {'from' if late > 0 else 'to'} its "
            "t.")


def running_fast(name: str, trials: Sequence[Trial], beside: str = "commands") -> str:
    """A sentence on a stream whose clock runs faster or slower than that of "odometry" or "commands"; else ""."""
    rates = np.arange(-FAST, FAST + RATE_STEP / 2, RATE_STEP)
    curves = [curve for trial in trials if (curve := _unlikeness(trial, name, beside, rates)) is not None]
    if not curves:
        return ""
    unlike = np.mean(curves, axis=0)
    k, now = int(np.argmin(unlike)), float(unlike[len(rates) // 2])
    if beside == "commands" and now < PLAINER and not (
            name == "odometry" and running_fast("ground_truth", trials, "odometry")):
        return ""  # a lag behind ramps of the commands does as much; only an outside pose shows less
    if not 0 < k < len(rates) - 1 or 1 - unlike[k] < WHOLE or unlike[k] > LEFT[beside] * now:
        return ""
    bend = unlike[k - 1] - 2 * unlike[k] + unlike[k + 1]
    rate = rates[k] + (0.5 * float((unlike[k - 1] - unlike[k + 1]) / bend) if bend > 0 else 0.0) * RATE_STEP
    if abs(rate) > MOST or abs(rate) * max(trial.duration for trial in trials) < DRIFT:
        return ""
    how = f"about {abs(rate):.0%} {'faster' if rate > 0 else 'slower'}"
    return (f"{name}: its clock runs {how} than that of the {beside}: the two come apart by {abs(rate) * 60:.1f} s in "
            f"a minute. Multiply its t by {1 / (1 + rate):.2f}, or that of the {beside} by {1 + rate:.2f}, whichever "
            "clock is wrong.")


def lateness(trial: Trial, name: str, beside: bool = False) -> float | None:
    """By how much a pose's motion comes later than the speeds beside it [s], where that is more than a fit reaches and
    explains what nothing else does; None otherwise.

    Rates of turning and motion are compared: no frame changes them. `beside`: with the commands in any case.
    """
    pose, odometry = logged_pose(getattr(trial, name), 20), trial.odometry
    if pose is None:
        return None
    half = half_span(pose.t)
    t = np.arange(min(pose.t[0], trial.command.t[0]), max(pose.t[-1], trial.command.t[-1]), LAG_DT)
    inside = (t > pose.t[0] + half) & (t < pose.t[-1] - half)
    x, y, yaw = (differenced(pose.t, one, t, half) * inside for one in pose.values.T)
    v, omega = trial.command.at(t - RESPONSE, (0.0, 0.0))
    commanded = beside or odometry is None or bool(max(odometry.v.std(), odometry.omega.std()) <= NONE)
    if odometry is not None and not commanded:
        v, omega = (np.interp(t, odometry.t, one, 0.0, 0.0) for one in (odometry.v, odometry.omega))
    pairs = [(ours, theirs) for ours, theirs in ((yaw, omega), (np.hypot(x, y), np.abs(v)))
             if min(ours.std(), theirs.std()) > VARIED]
    if not pairs:
        return None
    most = len(t) - 1
    # A skid drive turns late and little, a circle has one speed: the pair that fits best shows the clock.
    alike = max((_likeness_by_lag(ours, theirs) for ours, theirs in pairs), key=np.max)
    now, k = float(alike[most]), int(np.argmax(alike))
    bend = alike[k - 1] - 2 * alike[k] + alike[k + 1] if 0 < k < 2 * most else 0.0
    late = (k - most + (0.5 * float((alike[k - 1] - alike[k + 1]) / bend) if bend < 0 else 0.0)) * LAG_DT
    near = round(LATE[commanded] / LAG_DT)
    against = -float(alike[most - near : most + near + 1].min())  # where the sign is reversed
    clear = alike[k] > WHOLE and 1 - alike[k] < UNLIKE * (1 - max(now, against))
    return late if clear and abs(late) > LATE[commanded] else None


def _unlikeness(trial: Trial, name: str, beside: str, rates: np.ndarray) -> np.ndarray | None:
    """How little a stream's motion is like that beside it, at the best delay, if its clock is fast by shares (R,)."""
    ours = speeds(trial, name, smooth=True)
    theirs = _commanded(trial) if beside == "commands" else speeds(trial, "odometry", smooth=True)
    if ours is None or theirs is None:
        return None
    begin, end = min(ours[0][0], theirs[0][0]), max(ours[0][-1], theirs[0][-1])
    t = np.arange(begin, min(end, begin + LONGEST), LAG_DT)
    lags = np.arange(-REACH, REACH + LAG_DT / 2, LAG_DT)
    found = []
    for one, other in ((np.abs(ours[1]), np.abs(theirs[1])), (ours[2], theirs[2])):
        if min(one.std(), other.std()) > VARIED:
            stretched = np.stack([np.interp(t * (1 + rate), ours[0], one, 0.0, 0.0) for rate in rates])
            shifted = np.stack([np.interp(t - lag, theirs[0], other, 0.0, 0.0) for lag in lags])
            sizes = [np.linalg.norm(each, axis=1, keepdims=True) + 1e-9 for each in (stretched, shifted)]
            found.append(1 - ((stretched / sizes[0]) @ (shifted / sizes[1]).T).max(axis=1))
    return np.mean(found, axis=0) if found else None


def _commanded(trial: Trial) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Times [s], speed and yaw rate that a vehicle has which follows its commands with a usual lag; None where nothing
    is measured after the first of them."""
    from scipy.signal import lfilter

    t = np.arange(trial.command.t[0], max(trial.duration, trial.command.t[-1]), LAG_DT / 2)
    if not len(t):
        return None
    kept = np.exp(-LAG_DT / 2 / RESPONSE)
    v, omega = (lfilter([1 - kept], [1.0, -kept], one, zi=[kept * one[0]])[0] for one in trial.command.at(t))
    return t, v, omega


def _likeness_by_lag(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """Likeness (2T - 1,) of rates (T,) with others (T,) so many rows earlier, from 1 - T; outside nothing moves."""
    size = 2 * len(ours)
    found = np.fft.irfft(np.fft.rfft(ours, size) * np.conj(np.fft.rfft(theirs, size)), size)
    return np.roll(found, len(ours) - 1)[: size - 1] / max(float(np.linalg.norm(ours) * np.linalg.norm(theirs)), 1e-9)


def _empty_speeds(trials: Sequence[Trial]) -> list[str]:
    """Odometry whose pose moves, or turns, while the speed of it is exactly zero."""
    found = [shares for trial in trials if (shares := _empty_shares(trial)) is not None]
    usual = [float(np.median(known)) if (known := [one[k] for one in found if np.isfinite(one[k])]) else 0.0
             for k in (0, 1)]
    empty = [name for name, share in zip(("v", "omega"), usual, strict=True) if share > EMPTY]
    if not empty:
        return []
    how = "all zero" if max(usual) > 0.95 else f"zero in {max(usual):.0%} of that time"
    return [f"odometry: its pose moves with the commands, but its speeds {' and '.join(empty)} are {how}: the driver "
            "does not fill the twist. Compute v and omega from the pose, or record a topic that has them."]


def _empty_shares(trial: Trial) -> tuple[float, float] | None:
    """Shares of the time in which the pose travels and v is exactly zero, or it turns and omega is; or nan."""
    stream, pose = trial.odometry, logged_pose(trial.odometry, 20)
    if stream is None or pose is None:
        return None
    t, half = pose.t, max(SMOOTHING, float(np.median(np.diff(pose.t))))
    x, y, turn = (differenced(t, one, t, half) for one in pose.values.T)
    first = np.maximum(np.searchsorted(t, t - half) - 1, 0)  # for as long as the pose is looked at, and a row more
    last = np.minimum(np.searchsorted(t, t + half, side="right") + 1, len(t))
    shares = []
    for rate, speed in ((np.hypot(x, y), stream.v), (np.abs(turn), stream.omega)):
        faster = rate > max(MOVING, FASTER * float(np.percentile(rate, 95)))
        moved = np.append(0, np.cumsum(speed != 0))
        silent = (moved[last] == moved[first])[faster]
        shares.append(float(silent.mean()) if faster.sum() > 10 else float("nan"))
    return shares[0], shares[1]


def _without_sign(trials: Sequence[Trial]) -> list[str]:
    """A sentence on a speed of the odometry that is never negative, though the vehicle moves when it is sent back."""
    streams = [(trial, trial.odometry) for trial in trials if trial.odometry is not None]
    if not streams or any((stream.v < 0).any() for _, stream in streams):
        return []
    sent = np.concatenate([trial.command.at(stream.t - RESPONSE, (0.0, 0.0))[0] for trial, stream in streams])
    back = sent < -MOVING
    v = np.concatenate([stream.v for _, stream in streams])
    if back.sum() <= 10 or float(np.median(v[back] / -sent[back])) < FOLLOWS:
        return []
    return ["odometry: v is never negative, though the vehicle moves when it is sent backwards: it is the size of the "
            "speed alone. Record the speed along the vehicle's x axis, or give v the sign of the motion."]


def jumps(name: str, trials: Sequence[Trial]) -> list[str]:
    """A sentence on steps of a pose that its speeds do not allow."""
    found = [(trial, at) for trial in trials if len(at := _jumps_of(name, trial))]
    if not found:
        return []
    trial, at = found[0]
    stream, first = getattr(trial, name), int(at[0])
    x, y, turn = np.abs([np.diff(one)[first] for one in (stream.x, stream.y, stream.yaw)])
    size = " and ".join(f"{step:.2f} {unit}" for step, unit in ((np.hypot(x, y), "m"), (turn, "rad")) if step > JUMP[0])
    said = (f"{name}: in {len(found)} of {len(trials)} trials ({trial.name}, at {stream.t[first + 1]:.1f} s) its pose "
            f"jumps by {size} from one row to the next, ")
    if name == "ground_truth":
        return [f"{said}faster than it moves elsewhere: tracking was lost, or took another body for the vehicle. Leave "
                "those rows out, or split the trial there."]
    rows = np.stack([stream.x, stream.y], axis=-1)[: first + 1]
    other = np.flatnonzero((rows != rows[-1]).any(axis=1))
    if (held := float(stream.t[first] - stream.t[other[-1] + 1 if len(other) else 0])) > HELD:
        return [f"{said}after rows that repeat for {held:.1f} s: its driver was held up. Split the trial there."]
    return [f"{said}which its speeds do not: it was reset there. Split the trial there."]


def _jumps_of(name: str, trial: Trial) -> np.ndarray:
    """Rows before the jumps (J,) of a stream of a trial; none where there are so many that they are noise."""
    pose, odometry = logged_pose(getattr(trial, name), 20), trial.odometry
    if pose is None:
        return np.zeros(0, int)
    dt = np.diff(pose.t)
    found = np.zeros(len(dt), bool)
    for step, speed in ((np.hypot(np.diff(pose.x), np.diff(pose.y)), "v"), (np.abs(np.diff(pose.yaw)), "omega")):
        usual = float(np.percentile(step / dt, 95)) * dt
        if odometry is not None:
            rate = np.abs(np.interp(pose.t, odometry.t, getattr(odometry, speed)))
            way = np.maximum(rate[1:], rate[:-1]) * dt
            usual = np.maximum(usual, np.max([np.roll(way, shift) for shift in (-2, -1, 0, 1, 2)], axis=0))
        found |= step > JUMP[0] + JUMP[1] * usual  # rows held up catch up at once
    most = RARE[0] if name == "odometry" else max(RARE[0], RARE[1] * len(dt))
    at = np.flatnonzero(found)
    return at if len(at) <= most else at[:0]


def two_sources(name: str, trials: Sequence[Trial]) -> list[str]:
    """A sentence on a pose whose rows take turns between two."""
    found = []
    for trial in trials:
        if (pose := logged_pose(getattr(trial, name), ROWS)) is not None:
            place = pose.x + 1j * pose.y
            next_one, over_two = (float(np.mean(np.square(np.abs(place[k:] - place[:-k])))) for k in (1, 2))
            if over_two < TURNS * next_one:
                found.append((trial, float(np.sqrt(next_one))))
    if not found:
        return []
    trial, apart = found[0]
    return [f"{name}: in {len(found)} of {len(trials)} trials ({trial.name}) its rows take turns between two poses "
            f"{apart:.2g} m apart, as where two nodes send on one topic. Record each on a topic of its own."]


def frozen(name: str, trials: Sequence[Trial]) -> list[str]:
    """A sentence on a pose that stands still while another stream shows that the vehicle drives on."""
    found = [(trial, *span) for trial in trials if (span := _frozen_of(name, trial)) is not None]
    if not found:
        return []
    trial, begin, end, other, way = found[0]
    return [f"{name}: in {len(found)} of {len(trials)} trials ({trial.name}, from {begin:.1f} to {end:.1f} s) its rows "
            f"repeat while the {other} moves on by {way:.1f} m: nothing was measured there. Leave these rows "
            "out."]


def _frozen_of(name: str, trial: Trial) -> tuple[float, float, str, float] | None:
    """Begin and end [s] of the longest time in which a pose repeats, what moves on meanwhile, and how far."""
    other = "odometry" if name == "ground_truth" else "ground_truth"
    stream, beside, odometry = logged_pose(getattr(trial, name)), logged_pose(getattr(trial, other)), trial.odometry
    if stream is None or beside is None:
        return None
    same = (np.diff(stream.values, axis=0) == 0).all(axis=1)
    if name == "odometry" and odometry is not None:  # at rest it repeats as well
        same &= (np.abs(odometry.v[:-1]) > STILL) | (np.abs(odometry.omega[:-1]) > STILL)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], same, [False]]).astype(int)))
    runs = [(float(stream.t[a]), float(stream.t[b])) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    begin, end = max(runs, key=lambda one: one[1] - one[0], default=(0.0, 0.0))
    inside = (beside.t >= begin) & (beside.t <= end)
    if end - begin < FROZEN or inside.sum() < 2:
        return None
    steps = np.stack([np.diff(one[inside]) for one in (beside.x, beside.y)])
    steps[:, np.isin(np.flatnonzero(inside)[:-1], _jumps_of(other, trial))] = 0.0  # no vehicle drives these
    way = float(np.hypot(*np.ptp(np.cumsum(steps, axis=1), axis=1)))
    return (begin, end, other, way) if way > MOVED else None


def constant_columns(name: str, trials: Sequence[Trial]) -> list[str]:
    """A sentence on a pose of which one column never changes, though the vehicle drives and turns."""
    moving = [stream for trial in trials if (stream := getattr(trial, name)) is not None and _moves(trial)]
    for column in ("yaw", "x", "y"):
        values = [getattr(one, column) for one in moving]
        if not values or any(one is None or np.ptp(one) > 0 for one in values):
            continue
        remedy = ("the column is empty. Record the heading, or leave the pose out" if column == "yaw" else
                  "is another axis up? Take the two axes of the floor")
        return [f"{name}: its {column} never changes, though the vehicle drives and turns: {remedy}."]
    return []


def _moves(trial: Trial) -> bool:
    """Whether a vehicle is commanded to go and to turn so far that each column of its pose changes."""
    command = trial.command
    hold = np.diff(np.append(command.t, max(trial.duration, float(command.t[-1]))))
    return all(float((np.abs(one) * hold).sum()) > MOVED for one in (command.v, command.omega))

"""What a log excites, how well its drives repeat, and what therefore no fit can find in it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sysid.logs.contradictions import another_clock, contradictions
from sysid.logs.directions import ALIKE, UNLIKE
from sysid.logs.metrics import CHANNELS, ideal_replay, replicate_groups, replicate_noise
from sysid.logs.odd_trials import before_its_commands, odd_trials, short_timeout
from sysid.logs.records import CHECK, Command, Log, Trial, logged_pose
from sysid.logs.stream_quality import Shift, response_shift, speeds, standstill
from sysid.logs.time_faults import forward_jump, pauses, set_forward, time_faults, uncommanded
from sysid.logs.unusable import LOST, lost, said, stood
from sysid.logs.wheel_faults import backward_wheel, wrong_sizes

STILL = {"v": 0.02, "omega": 0.02}  # m/s, rad/s below which a command counts as none
SLOW = {"v": 0.08, "omega": 0.1}  # m/s, rad/s below which dead zones and static friction show
SLOW_SECONDS = 1.0  # s of such commands that are enough
SHORTEST = 6.0  # s of a trial in which clocks can be compared
LEAST_REACH = 0.3  # m from the axle's centre that a tracked point may be at on the smallest vehicle
CLOSELY = 0.8  # correlation with the command at a usual delay that needs no search for a better one
SETTLED = 1.0  # s after which a vehicle has reached what it makes of a constant command
FEW = 50  # instants at which a vehicle must follow a command, and fall short of one, to show its limit
TOP = 0.98  # quantile of what is measured that counts as the most
FOLLOWS = 0.5  # correlation with the command below which no gain shows a sign or a unit
Responses = Mapping[str, Mapping[str, Mapping[str, Shift]]]
"""Channel -> trial -> "v" or "omega" -> how late it follows the command."""
SPREAD_NAMES = {"ground_truth": ("x", "y", "yaw"), "odometry": ("x", "y", "yaw", "v", "omega")}


@dataclass(frozen=True)
class Excitation:
    """What one trial asks of the vehicle. Commands, except where measured is said."""

    v: tuple[float, float]  # least and greatest speed [m/s]
    omega: tuple[float, float]  # least and greatest yaw rate [rad/s]
    reversals: int  # changes of the driving direction
    turn_changes: int  # changes of the turning direction
    slow_seconds: float  # time at speeds or yaw rates so low that a dead zone shows, the other channel no faster [s]
    steps: int  # changes of the command
    step_sizes: int  # distinct sizes of such changes, to 0.1 m/s and 0.1 rad/s
    acceleration: float  # greatest measured acceleration, over 0.2 s [m/s^2]
    distance: float  # path that the commands ask for [m]
    turn: float  # sum of turning, whatever direction [rad]
    heading: float  # start heading in the room [rad]; nan without outside pose
    headings: float  # share of the circle of headings that is visited, in 30 degree sectors; nan without outside pose
    standstill: tuple[float, float]  # seconds of standstill before and after the drive


def excitation(trial: Trial) -> Excitation:
    """What one trial asks of the vehicle."""
    command = trial.command
    hold = np.maximum(np.diff(np.append(command.t, max(trial.duration, command.t[-1]))), 0.0)
    v, omega = np.abs(command.v), np.abs(command.omega)
    slow = (np.maximum(v, omega) > 1e-6) & (v < SLOW["v"]) & (omega < SLOW["omega"])
    changes = np.abs(np.diff(command.table[:, 1:], axis=0))
    changed = changes[(changes > 1e-3).any(axis=1)]
    heading = headings = float("nan")
    if trial.ground_truth is not None:
        heading = float(np.angle(np.exp(1j * trial.start.yaw)))
        sectors = np.floor(np.mod(trial.ground_truth.yaw, 2 * np.pi) / (np.pi / 6)).astype(int) % 12
        headings = len(np.unique(sectors)) / 12
    return Excitation(
        (float(command.v.min()), float(command.v.max())), (float(command.omega.min()), float(command.omega.max())),
        sign_changes(command.v, STILL["v"]), sign_changes(command.omega, STILL["omega"]), float(hold[slow].sum()),
        len(changed), len(np.unique(np.round(changed, 1), axis=0)), _peak_acceleration(trial),
        float((v * hold).sum()), float((omega * hold).sum()), heading, headings, standstill(command, trial.duration))


def sign_changes(values: np.ndarray, dead: float) -> int:
    """How often values (T,) go from above `dead` to below -dead or back."""
    signs = np.sign(values[np.abs(values) > dead])
    return int((np.diff(signs) != 0).sum())


def _peak_acceleration(trial: Trial) -> float:
    """Greatest measured acceleration [m/s^2]: of the odometry where there is one, since a pose is noise when it is
    differenced twice; nan of a short trial."""
    found = [speeds(trial, channel, smooth=True) for channel in CHANNELS]
    rates = [np.abs(np.gradient(one[1], one[0])) for one in found if one is not None and len(one[0]) > 10]
    return float(np.percentile(rates[-1], 99)) if rates else float("nan")


def replicate_spread(trials: tuple[Trial, ...]) -> list[dict[str, Any]]:
    """Of each group of replicates `trials`, and the `spread`: standard deviation between drives, in the frame of each
    start, like "ground_truth.x" [m]."""
    groups = []
    for group in replicate_groups(trials):
        noise = replicate_noise(tuple(group)) or {}
        spread = {f"{channel}.{name}": float(value) for channel, values in noise.items()
                  for name, value in zip(SPREAD_NAMES[channel], values, strict=True) if np.isfinite(value)}
        groups.append({"trials": [trial.name for trial in group], "spread": spread})
    return groups


def sanity(log: Log, responses: Responses | None = None) -> list[str]:
    """Signs that a column has another unit, sign or origin than it should, as sentences.

    `responses`: `response_shift` of every trial by channel, where it is known.
    """
    standing = stood(log.trials, log.spec.track / 2)
    if standing:
        found = [f"{said(standing)}. A fit leaves such trials out."]
        moved = replace(log, trials=tuple(trial for trial in log.trials if trial.name not in standing))
        return found + sanity(moved) if moved.trials else found
    found = faults(log, responses)
    if not found:  # a wrong frame, unit or clock shows no size
        found += wrong_sizes(log.trials, log.spec, max(log.spec.track, LEAST_REACH))
    return [*found, *pauses(log.trials)]


def doubts(log: Log) -> list[str]:
    """What a fit and a closed loop say first of a log: faults of it that they do not take care of."""
    long = tuple(trial for trial in log.trials if trial.duration >= SHORTEST)
    return [f"{CHECK}{one}" for one in faults(replace(log, trials=long))] if long else []


def faults(log: Log, responses: Responses | None = None) -> list[str]:
    """Of what `sanity` says, units, signs, frames and times that are wrong."""
    trials, skid = log.trials, log.spec.drive == "skid"
    if jumped := set_forward(trials):  # these trials show no other fault, and hide none of the others
        others = tuple(trial for trial in trials if forward_jump(trial) is None)
        return [*jumped, *(faults(replace(log, trials=others), responses) if others else [])]
    if backwards := backward_wheel(log):  # its speeds contradict every pose and command
        return [backwards]
    found: list[str] = []
    cut = sum(uncommanded(trial) > 0 for trial in trials) >= len(trials) / 2  # as if it did not follow its commands
    contradicted = contradictions(trials, max(log.spec.track, LEAST_REACH))
    for channel in CHANNELS:
        found += [one for one in contradicted[channel] if one not in found]
        seen, reversed_ones, clear = list[str](), list[str](), True
        shifts = [responses[channel][trial.name] if responses else response_shift(trial, channel) for trial in trials]
        for index, (name, unit) in enumerate((("v", "m/s"), ("omega", "rad/s")), start=1):
            gains = _gains(trials, channel, index, shifts)
            if not gains or cut or contradicted[channel]:  # a wrong frame or clock shows neither sign nor unit
                continue
            least = 0.1 if skid and name == "omega" else 0.4  # a skid drive scrubs most of its turn
            gain, follows = max(gains, key=lambda one: (least < one[0] < 2.0, abs(one[1])))
            if abs(gains[-1][1]) > CLOSELY:
                gain, follows = gains[-1]
            where = f"{channel}: {name} is {gain:.2f} times the command (median of {len(trials)} trials)"
            odd = not least < gain < 2.0
            clear &= not odd or abs(follows) >= FOLLOWS and (gain > 0 or least < -gain < 2.0)
            if odd and abs(follows) < FOLLOWS:
                seen.append(f"{where}, which it hardly follows (correlation {follows:.2f}): check its clock and its "
                             "frame; such a log shows neither its sign nor its unit.")
            elif gain < 0:
                reversed_ones.append(f"{where}{_reversal(channel, name)}")
            elif odd and (limit := _limit(trials, channel, index)) is not None:
                found.append(f"{where}, but follows commands below {limit:.2g} {unit}: it is limited to about that. "
                             "Larger commands act as that one; cut them in command.csv before a fit.")
            elif odd:
                seen.append(f"{where}: check its unit ({unit}), or the wheel radius and track that the commands "
                             "were computed with.")
        if clear:
            seen += reversed_ones
        elif reversed_ones and not seen:
            seen.append(f"{channel}: its motion goes with the commands neither as it is nor with a sign reversed: "
                        "check its clock and its frame.")
        other = (another_clock(channel, trials, "commands") or _exchanged(channel, trials)) if seen else ""
        found += [] if seen or contradicted[channel] else before_its_commands(channel, shifts)
        found += [other] if other else seen  # such a log shows neither sign nor unit
        if contradicted[channel]:
            continue
        ratios = [ratio for trial in trials if np.isfinite(ratio := _longer(trial, channel))]
        if ratios and not 0.3 < np.median(ratios) < 3.0:
            found.append(f"{channel}: the path is {np.median(ratios):.2g} times as long as the commands ask for: x and "
                         "y must be in metres, of the reference point.")
    found += odd_trials(trials, [channel for channel in CHANNELS if not contradicted[channel]])
    found += [*short_timeout(trials, log.fields.get("command_timeout")), *time_faults(trials)]
    gone = () if contradicted["ground_truth"] else lost(log)
    if gone:
        found.append(f"ground_truth: in {len(gone)} of {len(trials)} trials ({gone[0]}, ...) its yaw contradicts the "
                     f"gyro by more than {LOST:g} rad, however late it is: the outside pose was lost there. Errors "
                     "against it say little of a model; a fit leaves such trials out.")
    return found


def _reversal(channel: str, name: str) -> str:
    """What a speed or a yaw rate against the command means, and what to negate."""
    if channel != "ground_truth":
        return ": its sign is reversed. Forward is positive v, counter-clockwise positive omega and yaw; negate it."
    if name == "v":
        return (": its sign is reversed. The outside pose moves against its own yaw: add pi to yaw, or negate the "
                "commands' v, whichever is wrong.")
    return (": it turns against the commands, and x and y with it. Either z of its frame points down (NED): negate y "
            "and yaw; or the commands' omega has the wrong sign.")


def _gains(
    trials: Sequence[Trial], channel: str, index: int, shifts: Sequence[Mapping[str, Shift]]
) -> list[tuple[float, float]]:
    """Two estimates of a measured speed (1) or yaw rate (2) over the command, each with its correlation (medians).

    One is at the delay and lag that fit best, and errs where commands are short or periodic. The other is at a usual
    delay, and errs where the vehicle follows late.
    """
    best = [(shift.gain, shift.correlation) for one in shifts if (shift := one.get(("v", "omega")[index - 1]))]
    usual = [one for trial in trials if (one := _gain(trial, channel, index)) is not None]
    return [(float(np.median(gains)), float(np.median(follows)))
            for gains, follows in (zip(*both, strict=True) for both in (best, usual) if both)]


def _gain(trial: Trial, channel: str, index: int) -> tuple[float, float] | None:
    """Regression of the measured speed (1) or yaw rate (2) on the command, where that varies, and their correlation."""
    rates = speeds(trial, channel)
    if rates is None:
        return None
    # The response takes a while; only the rough size counts.
    commanded = trial.command.at(rates[0] - 0.3, (0.0, 0.0))[index - 1]
    if commanded.std() < 0.05:
        return None
    centred = commanded - commanded.mean()
    measured = rates[index] - rates[index].mean()
    norm = np.sqrt((centred @ centred) * (measured @ measured))
    return float(centred @ measured / (centred @ centred)), float(centred @ measured / norm) if norm > 1e-12 else 0.0


def _exchanged(channel: str, trials: Sequence[Trial]) -> str:
    """A sentence where measured speed follows the commanded yaw rate, and the reverse, not its own; else "".

    An outside pose must agree by how it turns, which no frame changes.
    """
    if not all(_follows_other(channel, trials, index) for index in (1, 2)) or (
            _follows_other("ground_truth", trials, 2) is False):
        return ""
    return (f"command: the speed that {channel} shows follows omega, and its yaw rate follows v: the two columns are "
            "exchanged.")


def _follows_other(channel: str, trials: Sequence[Trial], index: int) -> bool | None:
    """Whether a measured speed (1) or yaw rate (2) follows the command of the other, not its own; None where neither
    is known."""
    other = [replace(one, command=Command(one.command.t, one.command.omega, one.command.v)) for one in trials]
    as_it_is, follows = ([gain[1] for one in these if (gain := _gain(one, channel, index)) is not None]
                         for these in (trials, other))
    if not follows:
        return None
    return bool(np.median(follows) >= ALIKE and not (
        as_it_is and 1 - np.median(follows) > UNLIKE * (1 - np.median(as_it_is))))


def _limit(trials: Sequence[Trial], channel: str, index: int) -> float | None:
    """Size of a measured speed (1) or yaw rate (2) that larger commands, unlike smaller ones, do not raise, or None."""
    rows = []
    for trial in trials:
        rates = speeds(trial, channel)
        if rates is not None:
            now, before = (trial.command.at(rates[0] - ago)[index - 1] for ago in (0.0, SETTLED))
            rows.append(np.abs(np.column_stack([now, rates[index]])[now == before]))
    asked, seen = np.concatenate(rows).T if rows else np.zeros((2, 0))
    if len(asked) < FEW:
        return None
    limit = float(np.quantile(seen, TOP))
    small, large = (asked > 0.1 * limit) & (asked < 0.8 * limit), asked > 1.5 * limit
    if min(small.sum(), large.sum()) < FEW:
        return None
    follows = float(asked[small] @ seen[small] / (asked[small] @ asked[small]))
    return limit if 0.5 < follows < 2.0 else None


def _longer(trial: Trial, channel: str) -> float:
    """How many times as long a path is as the commands ask for; nan where there is none, or they ask for hardly any."""
    pose, ideal = logged_pose(getattr(trial, channel)), logged_pose(getattr(ideal_replay(trial), channel))
    if pose is None or ideal is None:
        return float("nan")
    rows = np.searchsorted(pose.t, np.arange(pose.t[0], pose.t[-1], 0.5))  # half a second apart
    length, asked = (float(np.hypot(np.diff(x), np.diff(y)).sum())
                     for x, y in ((pose.x[rows], pose.y[rows]), (ideal.x, ideal.y)))
    return length / asked if asked > 1.0 else float("nan")


@dataclass(frozen=True)
class Blind:
    """One thing that the log does not determine."""

    cause: str
    hidden: str  # what stays unknown for that reason
    remedy: str


def blind_spots(log: Log, excitations: dict[str, Excitation]) -> list[Blind]:
    """What the training trials of a log do not determine, with the drive or sensor that would."""
    trials = log.training or log.trials
    found = [excitations[trial.name] for trial in trials]
    rules: list[tuple[bool, str, str, str]] = [
        (not any(t.ground_truth is not None for t in trials), "no outside pose",
         "slip, effective wheel radius and track, lateral damping, odometry scale: odometry shows no motion of its own "
         "wheels against the ground", "measure the pose from outside: motion capture, lidar, or marks on the floor"),
        (not any(t.odometry is not None for t in trials), "no odometry",
         "wheel speeds apart from slip, odometry filter and scale", "log the wheel encoders"),
        (not any(e.reversals for e in found), "no reversal",
         "backlash, caster or omni-wheel swing, friction at a change of direction, differences forward and back",
         "drive forward, back, forward (manoeuvre reversal)"),
        (sum(e.slow_seconds for e in found) < SLOW_SECONDS, "no slow crossing of zero",
         "dead zone of the command, static and Stribeck friction",
         "cross zero slowly in speed and in yaw rate (manoeuvre slow_sine)"),
        (not any(e.turn_changes for e in found) and not (
            any(e.omega[0] < -0.1 for e in found) and any(e.omega[1] > 0.1 for e in found)), "turns to one side only",
         "track apart from a difference of the wheel radii, from an offset of the centre of mass and from gyro scale",
         "drive every turn to both sides"),
        (not any(abs(bound) > 0.1 for e in found for bound in e.omega), "no turn", "track, yaw inertia, scrub",
         "turn on the spot and drive circles to both sides"),
        (not any(abs(bound) > 0.05 for e in found for bound in e.v), "no straight motion",
         "rolling resistance, forward slip, wheel radius", "drive straight at two speeds"),
        (_one_speed(found), "one speed", "resistance that grows with speed, air drag; acceleration limit apart "
         "from delay and lag", "drive the same manoeuvre at half and at full speed"),
        (max((e.step_sizes for e in found), default=0) < 3, "steps of hardly any different size",
         "delay, lag and acceleration limit apart from one another: only their scaling with the step separates them",
         "add random steps (manoeuvre random_steps) or a sweep of step sizes"),
        (_one_heading(found), "one heading of the room",
         "slope and side force apart from a difference of the wheel radii: they act along fixed directions of the room",
         "start the same drive at four headings, or drive a square"),
        (sum(sum(e.standstill) for e in found) < 5.0, "hardly any standstill",
         "gyro bias and drift; the noise of the sensors apart from motion", "stand 5 s before and after the drive"),
        (max((e.standstill[0] for e in found), default=0) < 0.5, "no standstill before the first command",
         "the start pose, except from its first sample; drives that begin in motion need the wheel speeds",
         "stand one second before each drive"),
        (not replicate_groups(tuple(trials)), "no replicates",
         "the noise floor, and so whether anything is missing in a model",
         "repeat each manoeuvre two or three times with the same commands (circle_1, circle_2, ...)"),
        (not log.held_out, "nothing held out", "how well the fit predicts", "name a manoeuvre in held_out"),
        (not any(e.acceleration > 2.0 for e in found), "no hard acceleration",
         "torque limit and friction limit: they only bound what is seen",
         "brake and start at the full command, on the surface in question"),
        (True, "velocities and poses only",
         "mass, motor gain and battery voltage apart from one another: they act as ratios",
         "weigh the vehicle, add a known mass, or log the motor current"),
    ]
    return [Blind(*words) for holds, *words in rules if holds]


def _one_speed(found: Sequence[Excitation]) -> bool:
    """Whether the trials' greatest speeds, where they move at all, differ by less than 0.1 m/s."""
    moving = [greatest for e in found if (greatest := max(map(abs, e.v))) > 0.05]
    return bool(moving) and max(moving) - min(moving) < 0.1 and all(e.step_sizes < 3 for e in found)


def _one_heading(found: Sequence[Excitation]) -> bool:
    """Whether the headings of all trials together cover less than half the circle."""
    known = [e for e in found if np.isfinite(e.heading)]
    if not known or max(e.headings for e in known) > 0.5:
        return False
    starts = np.exp(1j * np.array([e.heading for e in known]))
    return bool(abs(starts.mean()) > 0.7)

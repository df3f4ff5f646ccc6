"""The next drive: the one that separates effects which these drives do not.

Rivals are simulated at their own fitted values on every drive of a library. What base parameters within their spread
and the other's own coordinates can absorb is projected out of the difference of two. The drive with the largest worst
case is proposed. All last as long as the log's longest trial, so that they go through the compiled replay.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from sysid.logs.manoeuvre_library import FRACTIONS, OWN, REVERSING, make_command
from sysid.logs.metrics import integrate
from sysid.logs.records import Command, GyroStream, OdometryStream, PoseStream, Start, Trial
from sysid.missing.drives import Drives
from sysid.missing.joint_fit import Refit
from sysid.missing.joint_fit import Start as FitStart
from sysid.missing.refit import Refitter, own_sizes
from sysid.missing.signatures import base_columns
from sysid.pages.loop_words import command_of
from sysid.replay.arrays import Quotients
from sysid.verdict.result import Result
from sysid.verdict.vehicles import refitter_of
from whill_mjx.effects import EFFECTS, card_of
from whill_mjx.logs.dataset import COMMAND_HEADER, write_csv
from whill_mjx.logs.manoeuvres import MANOEUVRES, STANDSTILL

FILE = "next_command.csv"
TIE = 0.2  # A refit whose gain falls short of the best one's by less than this share is a rival
LEAST, ENOUGH = 3.0, 5.0  # standard deviations by which a drive separates effects, and that repetitions should reach
MOST_REPEATS = 9
SIZES = (1.0, 0.5, 0.2)  # shares of the log's largest speed and yaw rate that every manoeuvre is tried at
HEADINGS = (0.0, 90.0, 180.0, 270.0)  # start headings [degrees] that are tried where a rival is fixed in the room
PATH = 200  # points of a path that commands ask for
REFINED = 24  # drives for which the absorbed part is computed as well
POLISH = 3  # iterations of the refit of a rival that the search has not refitted


@dataclass(frozen=True)
class PlannedDrive:
    """One drive of the library: a manoeuvre and how it is driven."""

    manoeuvre: str
    v: float  # speed [m/s]
    omega: float  # yaw rate [rad/s]
    seconds: float  # time in motion [s]
    start: tuple[float, float, float]  # x, y [m] and heading [rad] in the room
    dt: float = 0.1  # command period [s]

    @property
    def command(self) -> Command:
        """The commands, with a second of standstill before and after."""
        return make_command(self.manoeuvre, self.v, self.omega, self.seconds, self.dt)


@dataclass(frozen=True)
class Rival:
    """One explanation of the drives."""

    effect: str
    fit: Refit


def next_manoeuvre(result: Result) -> dict[str, Any] | None:
    """The drive that best separates the rivals of a verdict; None where it has none, or no drive is short enough.

    Returns:
        `name`, `parameters` {v [m/s], omega [rad/s], seconds, dt [s]} and `start` {x, y [m], heading [rad]} of the
        drive, `splits` (the effects that it separates), `expected_separation` (standard deviations, the worst pair of
        these, one drive), `replicates` (drives after which that is `ENOUGH`), `file`, and `not_split`: pairs of effects
        that no drive separates, with the best `separation` and the `sensor` that would. Where no drive separates
        any of them, name, parameters, start and file are None.
    """
    rounds = rivals_of(result)
    if not rounds:
        return None
    refitter = refitter_of(result)
    groups = [_refitted(result, refitter, number, each) for number, each in rounds]
    pairs = [pair for group in groups for pair in combinations(group, 2)]
    room_fixed = any(EFFECTS[one.effect].room_fixed for group in groups for one in group)
    library = drive_library(result, HEADINGS if room_fixed else HEADINGS[:1])
    if not library:
        return None
    separation, library = separations(result, refitter, groups, library)
    return _proposal(pairs, separation, library)


def rivals_of(result: Result) -> list[tuple[int, list[tuple[str, Refit | None]]]]:
    """Accepted effects with rivals: number, and effects with their refits, the accepted one first."""
    found = result.search
    if found.verdict != "named":
        return []
    out = []
    for number, (best, names) in enumerate(zip(found.accepted, found.classes, strict=True)):
        its_round = next(each for each in found.rounds if any(one is best for one in each))  # some accept nothing
        tried = {one.hypothesis.effect: one for one in its_round}
        near = [name for name, one in tried.items() if one.gain > (1 - TIE) * best.gain]
        every = dict.fromkeys([best.hypothesis.effect, *names, *near])
        if len(every) > 1:
            out.append((number, [(name, tried[name].refit if name in tried else None) for name in every]))
    return out


def _refitted(result: Result, refitter: Refitter, number: int, rivals: Sequence[tuple[str, Refit | None]]
              ) -> list[Rival]:
    """Rivals of accepted effect `number`; those that the search took for alike and did not refit are refitted now."""
    found, starts = result.search, {}
    chosen = found.accepted[number].refit
    before = np.concatenate([[], *chosen.split[:-1]])
    for effect in (name for name, fit in rivals if fit is None):
        mine = [i for i, one in enumerate(result.hypotheses) if one.effect == effect]
        best = max(mine, key=lambda i: found.scan.gain[i])
        starts[effect] = FitStart((*chosen.hypotheses[:-1], result.hypotheses[best]), chosen.u,
                                  np.concatenate([before, found.scan.q[best]]))
    more = dict(zip(starts, refitter.fit_all(list(starts.values()), POLISH), strict=True)) if starts else {}
    return [Rival(name, more[name] if fit is None else fit) for name, fit in rivals]


def drive_library(result: Result, headings: Sequence[float] = HEADINGS) -> list[PlannedDrive]:
    """Every manoeuvre at several sizes and start headings [degrees], within speeds, space and time of the training.

    A training that never drove ahead or back, or never turned, says nothing of that speed: 0.1 m/s and 0.5 rad/s then,
    or the vehicle's limit where that is less.
    """
    trials, spec = result.log.training, result.log.spec
    v = max(float(np.abs(trial.command.v).max()) for trial in trials) or min(spec.v_max, 0.1)
    omega = max(float(np.abs(trial.command.omega).max()) for trial in trials) or min(spec.omega_max, 0.5)
    longest = max(trial.duration for trial in trials)
    steps = np.concatenate([np.diff(trial.command.t) for trial in trials])
    dt = round(float(np.clip(np.median(steps), 0.02, 0.2)), 3)
    low, high = _space(trials)
    found: dict[tuple[Any, ...], PlannedDrive] = {}
    for name in (*MANOEUVRES, *OWN):
        for size in SIZES if name != "standstill" else SIZES[:1]:
            speed = min(size * v, -spec.v_min if name in REVERSING else spec.v_max)
            if speed <= 0.0:
                continue
            for heading in headings:
                start = (0.0, 0.0, math.radians(heading))
                whole = PlannedDrive(name, speed, size * omega, longest - 2 * STANDSTILL, start, dt)
                drive = _fitting(whole, low, high, longest)
                if drive is not None:
                    command = drive.command
                    found.setdefault((command.v.tobytes(), command.omega.tobytes(), heading), drive)
    return list(found.values())


def _space(trials: Sequence[Trial]) -> tuple[np.ndarray, np.ndarray]:
    """Corners (2,), (2,) of the space that trials took up [m]: by the outside pose, else by their commands."""
    paths = []
    for trial in trials:
        truth = trial.ground_truth
        ideal = integrate(trial.command, trial.start, np.linspace(0.0, trial.duration, PATH))
        paths.append(np.column_stack(ideal[:2] if truth is None else [truth.x, truth.y]))
    points = np.concatenate(paths)
    return points.min(0), points.max(0)


def _fitting(whole: PlannedDrive, low: np.ndarray, high: np.ndarray, longest: float) -> PlannedDrive | None:
    """A manoeuvre as long as time and space allow, placed in the middle of the space; None where none fits."""
    heading = whole.start[2]
    for fraction in FRACTIONS:
        drive = replace(whole, seconds=math.floor(10 * fraction * whole.seconds + 1e-9) / 10)
        if drive.seconds <= 0:
            return None
        command = drive.command
        if command.t[-1] + drive.dt > longest + 1e-9:
            continue
        path = np.column_stack(integrate(command, Start(yaw=heading), np.linspace(0.0, longest, PATH))[:2])
        if (np.ptp(path, axis=0) <= high - low + 1e-9).all():
            x, y = (low + high) / 2 - (path.min(0) + path.max(0)) / 2
            return replace(drive, start=(float(x), float(y), heading))
    return None


def _as_trial(command: Command, start: Start, duration: float, poses: int, readings: int, turns: int = 0) -> Trial:
    """A trial yet to be measured, with so many samples of outside pose, odometry and gyro; none for 0."""
    t, s = np.linspace(0.0, duration, max(poses, 2)), np.linspace(0.0, duration, max(readings, 2))
    truth = PoseStream(t, 0 * t, 0 * t, 0 * t) if poses else None
    odometry = OdometryStream(s, None, None, None, 0 * s, 0 * s) if readings else None
    turn = GyroStream(np.linspace(0.0, duration, turns), np.zeros(turns)) if turns else None
    return Trial("next", "next", command, odometry, truth, start, gyro=turn)


def plan_drives(result: Result, drives: Drives, library: Sequence[PlannedDrive]) -> Drives:
    """Drives of the library, sampled like the log's longest trial, through the same compiled replay."""
    trials = result.log.training
    longest = max(trial.duration for trial in trials)
    rates = [max((len(stream.t) / trial.duration for trial in trials
                  if (stream := getattr(trial, channel)) is not None), default=0.0)
             for channel in ("ground_truth", "odometry", "gyro")]
    counts = [round(rate * longest) for rate in rates]
    moving = any(trial.start.v or trial.start.omega for trial in trials)
    planned = []
    for one in library:
        x, y, heading = one.start
        # A replay that was compiled for trials that start in motion settles every trial: a start just off rest does so.
        start = Start(x, y, heading, v=1e-9 if moving else 0.0)
        planned.append(_as_trial(one.command, start, longest, *counts))
    return drives.of(tuple(planned))


def separations(
    result: Result, refitter: Refitter, groups: Sequence[Sequence[Rival]], library: Sequence[PlannedDrive]
) -> tuple[np.ndarray, list[PlannedDrive]]:
    """Separation (D, pairs) by the most promising drives, and these drives; pairs as `combinations` of each group."""
    flat = [one for group in groups for one in group]
    place = {id(one): i for i, one in enumerate(flat)}
    pairs = [(place[id(a)], place[id(b)]) for group in groups for a, b in combinations(group, 2)]
    seen, drives = _seen(result, refitter, flat, library)
    raw = np.stack([np.linalg.norm(seen[i] - seen[j], axis=-1) for i, j in pairs], axis=-1)  # (D, pairs)
    best = np.unique(np.argsort(-raw, axis=0)[: max(REFINED // len(pairs), 4)])  # each pair's own best
    chosen = [library[i] for i in best]
    seen, drives = _seen(result, refitter, flat, chosen)
    white = result.reference.whitener.flat
    base = white(base_columns(drives, result.reference, refitter.values, result.names), drives.mask)
    columns = [np.concatenate([base, _own_columns(refitter, drives, one.fit, seen[i])], axis=-1)
               for i, one in enumerate(flat)]
    held = [_held(result, one.fit) for one in flat]
    inflation = math.sqrt(1 + max(result.search.excess[1], 0.0))
    out = np.zeros((len(chosen), len(pairs)))
    for k, (i, j) in enumerate(pairs):
        for d in range(len(chosen)):
            difference = seen[i][d] - seen[j][d]
            out[d, k] = min(absorbed(difference, columns[one][d], held[one]) for one in (i, j)) / inflation
    return out, chosen


def absorbed(difference: np.ndarray, columns: np.ndarray, held: np.ndarray) -> float:
    """Length of what columns (n, P), held by the precision (P, P), cannot absorb of a white difference (n,)."""
    moments = columns.T @ difference
    matrix = columns.T @ columns + held
    matrix[np.diag_indices(len(matrix))] += 1e-9 * max(float(np.diag(matrix).max()), 1e-12)
    return math.sqrt(max(float(difference @ difference - moments @ np.linalg.solve(matrix, moments)), 0.0))


def _seen(result: Result, refitter: Refitter, rivals: Sequence[Rival], library: Sequence[PlannedDrive]
          ) -> tuple[np.ndarray, Drives]:
    """White features (rivals, D, n) of each rival on each drive."""
    drives = plan_drives(result, refitter.drives, library)
    features = drives.simulate(np.stack([one.fit.values for one in rivals]))
    drives = drives.weighted(features[0], result.reference.factors, result.log.spec.track)
    return np.stack([result.reference.whitener.flat(one, drives.mask) for one in features]), drives


def _own_columns(refitter: Refitter, drives: Drives, fit: Refit, at: np.ndarray) -> np.ndarray:
    """(D, n, k) derivative of the white features by a rival's own coordinates, by differences."""
    own = Quotients.forward(fit.q, own_sizes(fit.q))
    seen = drives.simulate(np.stack([refitter.values_at(fit.hypotheses, fit.u, q) for q in own.above]))
    white = refitter.reference.whitener.flat
    return np.asarray(own.slopes(np.stack([white(one, drives.mask) for one in seen]), at))


def _held(result: Result, fit: Refit) -> np.ndarray:
    """(P + k, P + k) precision of a rival on a new day: base by the spread, coordinates by drives and wander."""
    size, precision = len(fit.u), result.evidence.precision
    matrix = fit.products(precision)
    cross = matrix[:size, size:]
    out = np.zeros_like(matrix)
    out[:size, :size] = precision
    separable = matrix[size:, size:] - cross.T @ np.linalg.solve(matrix[:size, :size], cross)
    covariance = np.linalg.inv(separable + 1e-9 * np.eye(len(separable)))
    for one, part in zip(fit.hypotheses, fit.parts, strict=True):
        covariance[part, part] += result.prepared.wander.at(
            result.evidence.columns, result.hypotheses.index(one), fit.q[part])
    out[size:, size:] = np.linalg.inv(covariance)
    return out


def _proposal(pairs: Sequence[tuple[Rival, Rival]], separation: np.ndarray, library: Sequence[PlannedDrive]
              ) -> dict[str, Any]:
    """The drive with the largest worst case over the pairs that any drive separates."""
    reach = separation.max(0)
    separable = reach >= LEAST
    missing = [{"effects": [a.effect, b.effect], "separation": float(reach[k]),
                "sensor": sensor_for(a.effect, b.effect)} for k, (a, b) in enumerate(pairs) if not separable[k]]
    if not separable.any():
        return {"name": None, "parameters": None, "start": None, "splits": [], "file": None,
                "expected_separation": float(reach.min()), "replicates": None, "not_split": missing}
    worst = separation[:, separable].min(1)
    best = int(np.argmax(worst))
    drive, least = library[best], float(worst[best])
    splits = [one.effect for k, pair in enumerate(pairs) if separable[k] for one in pair]
    repeats = min(math.ceil((ENOUGH / max(least, 1e-6)) ** 2), MOST_REPEATS)
    x, y, heading = drive.start
    return {"name": drive.manoeuvre,
            "parameters": {"v": drive.v, "omega": drive.omega, "seconds": drive.seconds, "dt": drive.dt},
            "start": {"x": x, "y": y, "heading": heading}, "splits": list(dict.fromkeys(splits)),
            "expected_separation": least, "replicates": repeats, "file": FILE, "not_split": missing}


def sensor_for(a: str, b: str) -> str:
    """What separates two effects that no drive separates: a sensor that measures one of them by itself."""
    return card_of(a).sensor or card_of(b).sensor or "motor currents, which show how much force the drives need"


def write_next_command(out: Path, proposal: dict[str, Any] | None) -> Path | None:
    """Write the commands of a proposal into a run folder, in a dataset's format; None where there is no drive."""
    if proposal is None or proposal["file"] is None:
        return None
    path = Path(out) / proposal["file"]
    write_csv(path, COMMAND_HEADER, command_of(proposal).table)
    return path

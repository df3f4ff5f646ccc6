"""Healthy driving logs of many robots, and the same with one fault of time or of frames in them, at three sizes.

A drive is a dictionary of tables with t [s] in the first column: "command" (T, 3), "odometry" (T, 6) and
"ground_truth" (T, 4), as in docs/log_format.md. All come from drives of the shipped chair and of simulated robots, in
other sizes, speeds, rates and noises. Every fault is one that drivers, recorders and tracking systems are known for.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

Drive = dict[str, np.ndarray]
Random = np.random.Generator
ROOT = Path(__file__).parents[1]
SIMULATED = ("create", "husky")
"""Built-in vehicles that are simulated besides the shipped chair: a small differential drive, and a skid drive."""
TRACKS = {"chair": 0.496, "create": 0.235, "husky": 0.55}  # m
MANOEUVRES = ("circle", "s_curve", "figure_eight", "random_steps", "reversal")
LAG = 0.15  # s in which a base follows a command to stop


@cache
def bases() -> dict[str, tuple[Drive, ...]]:
    """Drives that nothing is wrong with by robot: those of the shipped chair, and simulated ones."""
    from benchmarks.planted_logs import Schedule, write_dataset
    from sysid.logs.log import load_log
    from whill_mjx.vehicle.presets import preset_params
    from whill_mjx.vehicle.specs import find_spec

    logs = {"chair": load_log(ROOT / "sysid/data/chair")}
    with TemporaryDirectory() as folder:
        for name in SIMULATED:
            spec = find_spec(name)
            params = preset_params(spec, "physical")
            logs[name] = load_log(write_dataset(Path(folder) / name, spec, params,
                                                Schedule(manoeuvres=MANOEUVRES, held_out=(), replicates=1)))
    return {name: tuple({
        "command": trial.command.table, "odometry": np.column_stack([trial.odometry.t, trial.odometry.values]),
        "ground_truth": np.column_stack([trial.ground_truth.t, trial.ground_truth.values])}
        for trial in log.trials if trial.odometry is not None and trial.ground_truth is not None)
        for name, log in logs.items()}


@dataclass(frozen=True)
class Robot:
    """A robot and some drives of it."""

    drive: str
    """"differential" or "skid"."""
    track: float  # m
    drives: list[Drive]


def healthy(random: Random, turning: float = 0.0, whole: bool = False) -> Robot:
    """One to four drives of one robot.

    Args:
        turning: least turn that every drive commands [rad].
        whole: keep odometry and outside pose, at 10 Hz at least.
    """
    name = str(random.choice(["chair", *SIMULATED]))
    able = [drive for drive in bases()[name] if _turned(drive) >= turning]
    chosen = [able[i] for i in random.choice(len(able), min(int(random.integers(1, 5)), len(able)), replace=False)]
    size, speed = np.exp(random.uniform(np.log(0.3), np.log(2.5))), np.exp(random.uniform(np.log(0.6), np.log(1.6)))
    side = random.choice([-1.0, 1.0])
    rates = {"command": random.choice([0.0, 5.0, 10.0, 20.0]), "odometry": random.choice([10.0, 20.0, 30.0, 50.0]),
             "ground_truth": random.choice([10.0, 20.0, 60.0] if whole else [4.0, 10.0, 20.0, 60.0])}
    noise, lost = random.uniform(0.2, 2.0), random.choice([0.0, 0.0, 0.02, 0.1])
    mount = random.uniform(-0.2, 0.2, 2), np.deg2rad(random.uniform(-1.0, 1.0))
    scales, late = random.uniform(0.96, 1.04, 2), random.uniform(-0.1, 0.1)
    drives = []
    for drive in chosen:
        made = _other_robot(drive, size, speed, side)
        made = _calibrated(made, scales)
        made = {name: _sampled(name, table, rates[name], random) for name, table in made.items()}
        made = _mounted(made, *mount)
        made["ground_truth"][:, 0] += max(late, -float(made["ground_truth"][0, 0]))
        made = {name: _noisy(name, table, noise * min(size, 1.0), random) for name, table in made.items()}
        drives.append({name: _thinned(table, lost, random) if name != "command" else table
                       for name, table in made.items()})
    if not whole and random.random() < 0.3:
        gone = random.choice(["odometry", "ground_truth"])
        drives = [{name: table for name, table in drive.items() if name != gone} for drive in drives]
    return Robot("skid" if name == "husky" else "differential", size * TRACKS[name], drives)


@dataclass(frozen=True)
class Fault:
    """Something that goes wrong with logs."""

    name: str
    sizes: tuple[float, float, float]
    """From plain to so small that a fit is hardly worse."""
    unit: str
    apply: Callable[[list[Drive], float, Random], list[Drive]]
    says: str
    """Regular expression of what a sentence must say of it."""
    turning: float = 0.0
    """Least turn of the drives in which it can show [rad]."""
    receipt: bool = False
    """Whether it is of the times at which a recorder gets messages, so that header stamps are there as well."""


def _other_robot(drive: Drive, size: float, speed: float, side: float) -> Drive:
    """The same drive by a robot of another size, faster or slower, and with left and right exchanged."""
    units = {"t": 1 / speed, "x": size, "y": side * size, "yaw": side, "v": size * speed, "omega": side * speed}
    columns = {"command": ("t", "v", "omega"), "odometry": ("t", "x", "y", "yaw", "v", "omega"),
               "ground_truth": ("t", "x", "y", "yaw")}
    return {name: table * [units[one] for one in columns[name]] for name, table in drive.items()}


def _calibrated(drive: Drive, scales: np.ndarray) -> Drive:
    """Odometry with wrong scales of distance and turn, as an uncalibrated one has."""
    return {**drive, "odometry": drive["odometry"] * [1, scales[0], scales[0], 1, scales[0], scales[1]]}


def _sampled(name: str, table: np.ndarray, rate: float, random: Random) -> np.ndarray:
    """Rows at another rate [Hz]; commands at rate 0 come only where they change."""
    if name == "command":
        if rate == 0.0:
            changed = np.append(True, (np.diff(table[:, 1:], axis=0) != 0).any(axis=1))
            return table[changed]
        t = np.arange(table[0, 0], table[-1, 0], 1 / rate)
        return np.column_stack([t, table[np.searchsorted(table[:, 0], t + 1e-9, side="right") - 1, 1:]])
    t = np.arange(table[0, 0], table[-1, 0], 1 / rate)
    t[1:] += np.clip(random.normal(0, 0.03 / rate, len(t) - 1), -0.2 / rate, 0.2 / rate)
    t = np.clip(t, table[0, 0], table[-1, 0])
    return np.column_stack([t, *(np.interp(t, table[:, 0], column) for column in table[:, 1:].T)])


def _mounted(drive: Drive, offset: np.ndarray, angle: float) -> Drive:
    """The tracked point beside the axle's centre, and its axes a little off."""
    table = drive["ground_truth"].copy()
    cos, sin = np.cos(table[:, 3]), np.sin(table[:, 3])
    table[:, 1] += cos * offset[0] - sin * offset[1]
    table[:, 2] += sin * offset[0] + cos * offset[1]
    table[:, 3] += angle
    return {**drive, "ground_truth": table}


def _noisy(name: str, table: np.ndarray, share: float, random: Random) -> np.ndarray:
    sigma = {"odometry": [0, 5e-4, 5e-4, 5e-4, 5e-3, 1e-2], "ground_truth": [0, 2e-3, 2e-3, 2e-3]}.get(name)
    return table if sigma is None else table + share * np.array(sigma) * random.normal(size=table.shape)


def _thinned(table: np.ndarray, lost: float, random: Random) -> np.ndarray:
    """The table without a share of its rows, and without half a second of them where any are lost."""
    if lost == 0.0:
        return table
    kept = random.random(len(table)) > lost
    begin = random.uniform(table[0, 0], table[-1, 0])
    kept &= (table[:, 0] < begin) | (table[:, 0] > begin + random.uniform(0.2, 1.0))
    kept[:3] = kept[-3:] = True
    return table[kept]


def _turned(drive: Drive) -> float:
    return float(np.ptp(drive["ground_truth"][:, 3]))


def _moving_at(drive: Drive, random: Random) -> float:
    """A time at which the vehicle drives at half of its greatest speed or more [s], away from the ends."""
    odometry = drive["odometry"]
    effort = np.abs(odometry[:, 4]) / max(np.abs(odometry[:, 4]).max(), 0.1)
    effort += np.abs(odometry[:, 5]) / max(np.abs(odometry[:, 5]).max(), 0.2)
    edge = min(3.0, 0.3 * float(odometry[-1, 0]))
    inside = (odometry[:, 0] > edge) & (odometry[:, 0] < odometry[-1, 0] - edge)
    able = np.flatnonzero(inside & (effort > 0.5 * effort[inside].max()))
    return float(odometry[random.choice(able), 0])


def _set_forward(drives: list[Drive], size: float, random: Random) -> list[Drive]:
    made = []
    for drive in drives:
        at = _moving_at(drive, random)
        made.append({name: np.column_stack([table[:, 0] + size * (table[:, 0] > at), table[:, 1:]])
                     for name, table in drive.items()})
    return made


def _pause(drives: list[Drive], size: float, random: Random) -> list[Drive]:
    """Commands stop coming for `size` seconds, and the base stops by its time-out until they come again."""
    timeout = random.uniform(0.25, 0.6)
    made = []
    for drive in drives:
        at = _moving_at(drive, random)
        added = max(size - timeout, 0.0)

        def travelled(t: np.ndarray, at: float = at, added: float = added) -> np.ndarray:
            """Time of the drive without the stop that it has come to at times t (T,), and its rate."""
            grid = np.arange(0.0, t[-1] + 0.01, 0.01)
            going = np.where((grid > at + timeout) & (grid <= at + timeout + added), 0.0, 1.0)
            rate = np.empty_like(going)
            rate[0] = 1.0
            for k in range(1, len(grid)):
                rate[k] = rate[k - 1] + (going[k] - rate[k - 1]) * (1 - np.exp(-0.01 / LAG))
            way = np.concatenate([[0.0], np.cumsum(rate[:-1]) * 0.01])
            return np.stack([np.interp(t, grid, way), np.interp(t, grid, rate)])

        found: Drive = {}
        command = drive["command"]
        every = min(0.1, float(np.median(np.diff(command[:, 0]))) if len(command) > 1 else 0.1)
        times = np.arange(command[0, 0], drive["odometry"][-1, 0] + added, every)  # a base with a time-out is sent them
        times = times[(times <= at) | (times >= at + timeout + added)]
        before = travelled(np.append(times, times[-1] + 1.0))[0][:-1]
        held = np.searchsorted(command[:, 0], before + 1e-9, side="right") - 1
        found["command"] = np.column_stack([times, command[np.maximum(held, 0), 1:]])
        for name in ("odometry", "ground_truth"):
            table = drive[name]
            spacing = float(np.median(np.diff(table[:, 0])))
            stop = table[:, 0] >= at + timeout
            inserted = np.arange(at + timeout, at + timeout + added, spacing)
            t = np.sort(np.concatenate([table[~stop, 0], inserted, table[stop, 0] + added]))
            t = t[np.append(True, np.diff(t) > 1e-3)]
            way, rate = travelled(t)
            columns = [np.interp(way, table[:, 0], column) for column in table[:, 1:].T]
            if name == "odometry":
                columns[3:] = [column * rate for column in columns[3:]]
            found[name] = np.column_stack([t, *columns])
        made.append(found)
    return made


def _bursts(drives: list[Drive], size: float, random: Random) -> list[Drive]:
    name = str(random.choice(["odometry", "ground_truth"]))
    return [{**drive, name: np.column_stack([_received_in_bursts(drive[name][:, 0], size), drive[name][:, 1:]])}
            for drive in drives]


def _received_in_bursts(t: np.ndarray, size: float) -> np.ndarray:
    """Times of receipt of messages that wait for the next multiple of a time."""
    return np.ceil(t / size) * size + 1e-3 * (t % size) / size + 1e-6 * np.arange(len(t))


def _unit_of_all(drives: list[Drive], size: float, random: Random) -> list[Drive]:
    return [{name: np.column_stack([table[:, 0] * size, table[:, 1:]]) for name, table in drive.items()}
            for drive in drives]


def _unit_of_one(drives: list[Drive], size: float, random: Random) -> list[Drive]:
    name = str(random.choice(["command", "odometry", "ground_truth"]))
    return [{**drive, name: drive[name] * np.append(size, np.ones(drive[name].shape[1] - 1))} for drive in drives]


def _reset(drives: list[Drive], size: float, random: Random) -> list[Drive]:
    made = []
    for drive in drives:
        table, at = drive["odometry"].copy(), _moving_at(drive, random)
        angle = random.uniform(-np.pi, np.pi)
        table[table[:, 0] > at, 1:4] += np.array([np.cos(angle), np.sin(angle), random.uniform(-1, 1)]) * size
        made.append({**drive, "odometry": table})
    return made


def _cut_at_turn(drive: Drive, most: float) -> Drive:
    """The drive until it has turned so far [rad] after it first moved."""
    yaw = drive["ground_truth"][:, 3]
    beyond = np.flatnonzero(np.abs(yaw - yaw[0]) > most)
    end = drive["ground_truth"][beyond[0], 0] if len(beyond) else np.inf
    t = max(end, 8.0)
    return {name: table[table[:, 0] <= t] for name, table in drive.items()}


def _twist_in_odom(drives: list[Drive], size: float, random: Random) -> list[Drive]:
    made = []
    for drive in drives:
        drive = _cut_at_turn(drive, size)
        table = drive["odometry"].copy()
        table[:, 4] *= np.cos(size / 6.0 * table[:, 3]) if size < 1.0 else np.cos(table[:, 3])
        made.append({**drive, "odometry": table})
    return made


def _empty_speeds(drives: list[Drive], size: float, random: Random) -> list[Drive]:
    made = []
    for drive in drives:
        table = drive["odometry"].copy()
        moving = np.flatnonzero(np.abs(table[:, 4:]).max(axis=1) > 0.05)
        first, last = (moving[0], moving[-1]) if len(moving) else (0, len(table) - 1)
        empty = slice(0 if size == 1.0 else first, first + round(size * (last - first)) if size < 1.0 else len(table))
        table[empty, 4:] = 0.0
        made.append({**drive, "odometry": table})
    return made


def _exchanged(drives: list[Drive], size: float, random: Random) -> list[Drive]:
    """x and y of the odometry exchanged, or of the outside pose; of a share of the drive's turn only where small."""
    name = str(random.choice(["odometry", "ground_truth"]))
    made = []
    for drive in (_cut_at_turn(drive, size) for drive in drives):
        table = drive[name].copy()
        table[:, [1, 2]] = table[:, [2, 1]]
        made.append({**drive, name: table})
    return made


def _mirrored(drives: list[Drive], size: float, random: Random) -> list[Drive]:
    made = []
    for drive in (_cut_at_turn(drive, size) for drive in drives):
        table = drive["ground_truth"].copy()
        table[:, 2] *= -1.0
        made.append({**drive, "ground_truth": table})
    return made


def _body_turned(drives: list[Drive], size: float, random: Random) -> list[Drive]:
    angle = np.deg2rad(size) * random.choice([-1.0, 1.0])
    return [{**drive, "ground_truth": drive["ground_truth"] + [0, 0, 0, angle]} for drive in drives]


def _pose_late(drives: list[Drive], size: float, random: Random) -> list[Drive]:
    return [{**drive, "ground_truth": drive["ground_truth"] + [size, 0, 0, 0]} for drive in drives]


def _clock_fast(drives: list[Drive], size: float, random: Random) -> list[Drive]:
    """The clock of one stream runs fast or slow, and its times begin with the others'."""
    name, rate = str(random.choice(["odometry", "ground_truth"])), 1 + size * random.choice([-1.0, 1.0])
    return [{**drive, name: drive[name] * np.append(rate, np.ones(drive[name].shape[1] - 1))} for drive in drives]


def _commands_late(drives: list[Drive], size: float, random: Random) -> list[Drive]:
    """Commands of another clock."""
    return [{**drive, "command": drive["command"] + [size, 0, 0]} for drive in drives]


def _commands_cut(drives: list[Drive], size: float, random: Random) -> list[Drive]:
    """Commands of which only the first part was recorded; that of the vehicle's last motion is lost."""
    made = []
    for drive in drives:
        t, v, omega = drive["odometry"][:, [0, 4, 5]].T
        moving = t[(np.abs(v) > 0.05) | (np.abs(omega) > 0.1)]
        end = moving[-1] - size * (moving[-1] - moving[0]) if len(moving) else t[-1]
        made.append({**drive, "command": drive["command"][drive["command"][:, 0] <= end]})
    return made


def _recorder_paused(drives: list[Drive], size: float, random: Random) -> list[Drive]:
    """Drives of which a part of all streams was not recorded; commands come at a rate, so that they are missed."""
    made = []
    for drive in drives:
        drive = {**drive, "command": _sampled("command", drive["command"], 20.0, random)}
        at = _moving_at(drive, random)
        made.append({name: table[(table[:, 0] < at) | (table[:, 0] > at + size)] for name, table in drive.items()})
    return made


def _z_down(drives: list[Drive], size: float, random: Random) -> list[Drive]:
    """The outside pose in a frame whose z points down, of the first part of the turn only where small."""
    return [{**drive, "ground_truth": drive["ground_truth"] * [1, 1, -1, -1]}
            for drive in (_cut_at_turn(drive, size) for drive in drives)]


def _sizes(drives: list[Drive], size: float, random: Random) -> list[Drive]:
    """Nominal sizes by which the odometry goes and turns too far, or not far enough."""
    scale = 1 + size * random.choice([-1.0, 1.0])
    return [_calibrated(drive, np.full(2, scale)) for drive in drives]


def _set_back(drives: list[Drive], size: float, random: Random) -> list[Drive]:
    """Times of receipt of all streams by a recorder whose clock is set back; messages keep their order of receipt."""
    made = []
    for drive in drives:
        at = _moving_at(drive, random)
        made.append({name: np.column_stack([table[:, 0] - size * (table[:, 0] > at), table[:, 1:]])
                     for name, table in drive.items()})
    return made


def _all_bursts(drives: list[Drive], size: float, random: Random) -> list[Drive]:
    return [{**drive, "odometry": np.column_stack([_received_in_bursts(drive["odometry"][:, 0], size),
                                                   drive["odometry"][:, 1:]])} for drive in drives]


FAULTS: Sequence[Fault] = (
    Fault("clock set forward", (2.0, 0.8, 0.02), "s", _set_forward, "clock was set forward"),
    Fault("recorder's clock set forward", (2.0, 0.8, 0.02), "s", _set_forward, "clock was set forward", receipt=True),
    Fault("recorder's clock set back", (2.0, 0.8, 0.02), "s", _set_back, "clock was set back", receipt=True),
    Fault("commands pause", (3.0, 1.5, 0.2), "s", _pause, "time-out"),
    Fault("rows in bursts", (1.0, 0.5, 0.04), "s", _bursts, "come in bursts"),
    Fault("messages in bursts", (1.0, 0.5, 0.04), "s", _all_bursts, "came in bursts", receipt=True),
    Fault("unit of time", (1e9, 1e3, 1.002), "1/s", _unit_of_all,
          "(milli|micro|nano)seconds|milli-, micro- or nanoseconds"),
    Fault("unit of one stream's time", (1e6, 1e3, 1.002), "1/s", _unit_of_one,
          "(milli|micro|nano)seconds|milli-, micro- or nanoseconds"),
    Fault("odometry reset", (2.0, 0.5, 0.01), "m, rad", _reset, "reset"),
    Fault("twist in odom", (6.0, 2.0, 0.1), "rad", _twist_in_odom, "twist is in the frame odom", 2.0),
    Fault("speeds empty", (1.0, 0.5, 0.02), "share", _empty_speeds, "speeds .* zero"),
    Fault("x and y exchanged", (6.0, 1.0, 0.02), "rad", _exchanged, "left-handed|exchanged", 1.0),
    Fault("mirrored", (6.0, 1.0, 0.02), "rad", _mirrored, "left-handed|mirrored", 1.0),
    Fault("tracked body turned", (20.0, 6.0, 1.0), "deg", _body_turned, "of its own heading"),
    Fault("outside pose late", (4.0, 1.5, 0.1), "s", _pose_late, "another clock"),
    Fault("clock fast", (0.12, 0.06, 0.001), "share", _clock_fast, "its clock runs", 1.0),
    Fault("commands late", (5.0, 2.5, 0.1), "s", _commands_late, "another clock", 1.0),
    Fault("nominal sizes wrong", (0.2, 0.09, 0.01), "share", _sizes, "as far as the odometry says", 1.0),
    Fault("recorder paused", (3.0, 1.5, 0.1), "s", _recorder_paused, "the recording paused"),
    Fault("z down", (6.0, 2.0, 0.02), "rad", _z_down, "points down|left-handed", 2.0),
    Fault("commands cut", (0.7, 0.5, 0.0), "share", _commands_cut, "commands end", 1.0),
)

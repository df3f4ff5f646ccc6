"""The DRIVE set: commanded wheel speeds against lidar ICP motion of skid-steered robots, as its authors publish it.

Baril et al., "DRIVE", ICRA 2024, github.com/norlab-ulaval/DRIVE, BSD-3-Clause. Each window restarts from the measured
pose and wheel speeds. Two faults of the files are mended here. Their converter turned the positions of a window by the
mean of its first five yaws but counted yaw from the first one; and an ICP update that fell between two windows is in
neither.
"""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from sysid.logs.gyro import sign_shown, with_sign
from sysid.logs.planar import turned_by, twist_of_wheels, yaw_of
from sysid.logs.published.poses import CONVERT, HELD, LARGEST, MAX_GAP, MOVING, only_changes
from sysid.logs.records import Command, GyroStream, Log, OdometryStream, PoseStream, Start, Trial, hash_files
from whill_mjx.io.fields import counted, shown
from whill_mjx.io.reading import csv_rows, read_arrays, read_gzip
from whill_mjx.vehicle.specs import HUSKY, WARTHOG, VehicleSpec

TERRAINS = ("asphalt", "grass", "gravel", "ice", "mud", "sand", "snow", "tile")
ENDS = (".npz", ".csv", ".csv.gz")
DT = 0.05  # s, sampling of the DRIVE windows (20 Hz)
ROWS = 40  # samples of one window (2 s)
WINDOW_COLUMNS = ("cmd_left", "cmd_right", "left_wheel_vel", "right_wheel_vel", "icp_x", "icp_y", "icp_yaw", "imu_yaw")
STEP_WINDOWS = 3  # windows of one step of constant command (6 s)
FRAME_SAMPLES = 5  # samples whose mean yaw the converter of the DRIVE windows took for the frame of their positions
RARE = 0.5  # of an update, by which intervals that a run does not show are counted
BREAK = 0.5  # probability of a lost update from which the motion over a joint is not compared bin by bin
MAX_NANOSECONDS = 86_400 * 10**9
CONTINUOUS_COLUMNS = (
    *(f"icp_quat_{axis}" for axis in "xyzw"), "icp_pos_x", "icp_pos_y", "meas_left_vel", "meas_right_vel", "cmd_vel_x",
    "cmd_vel_omega")
YAW_RATE = "imu_z"  # of a continuous log


def drive_spec(run: str) -> VehicleSpec:
    """Nominal geometry of the robot that drove `run`, a Warthog unless its name says otherwise."""
    return HUSKY if HUSKY.name in run else WARTHOG


def drive_files(folder: Path) -> dict[str, Path]:
    """Run -> file of the DRIVE runs in a folder."""
    return {path.name.split(".")[0]: path for path in sorted(folder.glob("*")) if path.name.endswith(ENDS)}


def drive_selection(folder: Path, keys: Sequence[str]) -> tuple[str, ...]:
    """Runs that selections name: RUN, one of its trials, or GROUP; FileNotFoundError where one names none."""
    runs = drive_files(folder)
    chosen: list[str] = []
    for key in keys:
        found = [run for run in runs if key.split("/")[0] == run or key == drive_group(run)]
        if not found:
            known = sorted({*runs, *map(drive_group, runs)})
            raise FileNotFoundError(f"{folder}: no run {key!r} (known: {', '.join(known)}).")
        chosen += found
    return tuple(dict.fromkeys(chosen))


def drive_group(run: str) -> str:
    """Terrain of a run: warthog_sand_1 -> sand; the run's own name where the terrain is not stated."""
    return next((word for word in run.split("_") if word in TERRAINS), run)


def most_runs(folder: Path) -> tuple[str, ...]:
    """The runs in a folder of the robot that has most of them."""
    robots: dict[str, list[str]] = {}
    for run in (run for run, path in drive_files(folder).items() if path.suffix != ".csv"):
        robots.setdefault(drive_spec(run).name, []).append(run)
    most = max(robots.values(), key=len)
    return tuple(most)


def load_drive(folder: str | Path, runs: tuple[str, ...], chained: bool = False) -> Log:
    """Load DRIVE runs of one robot from a folder of .npz and .csv.gz files: a trial per window, as RUN/STEP.WINDOW.

    Args:
        runs: file stems, or groups of them, e.g. ("warthog_sand_1",).
        chained: join the three 2 s windows of a step into one of 6 s. The joints can miss an ICP update; the motion
            is then that of wheels and gyro, by its probability, and the note on the log states how often and how much.

    `fields`: "gyro" has the mean gyro yaw rate of each window, "yaw_rate" all of it (times [s], rates [rad/s]), and
    "pose_stamps" is "receipt": how old a pose is at its stamp is not known.
    """
    folder = Path(folder)
    runs, files = drive_selection(folder, runs), drive_files(folder)
    specs = {drive_spec(run) for run in runs}
    if len(specs) != 1:
        raise ValueError(f"{folder}: runs {runs} are of {len(specs)} different robots; fit one robot at a time.")
    trials: list[Trial] = []
    notes = []
    gyro: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    for run in runs:
        if files[run].suffix == ".npz":
            run_trials, note, run_gyro = _window_trials(files[run], run, chained)
            gyro.update(run_gyro)
        else:
            run_trials, note = _continuous_trials(files[run], run, 6.0 if chained else 2.0)
            gyro.update({one.name: (one.gyro.t, np.gradient(one.gyro.turn, one.gyro.t)) for one in run_trials
                         if one.gyro is not None})
        if not any(spec.name in run for spec in (HUSKY, WARTHOG)):
            note += "; its name has no robot: it is taken for a Warthog"
        trials += run_trials
        notes.append(note)
    return Log("drive_norlab", specs.pop(), tuple(trials), hash_files(folder), tuple(notes),
               {"gyro": {name: float(rate.mean()) for name, (_, rate) in gyro.items()}, "yaw_rate": gyro,
                "pose_stamps": "receipt"})


def _window_trials(path: Path, run: str, chained: bool
                   ) -> tuple[list[Trial], str, dict[str, tuple[np.ndarray, np.ndarray]]]:
    """Trials of a run's windows, or of its steps where `chained`; a note; times [s] and gyro [rad/s] of each trial."""
    blocks, spec = _blocks(path), drive_spec(run)
    command, wheels = (twist_of_wheels(blocks[left], blocks[right], spec.wheel_radius, spec.track) for left, right in (
        ("cmd_left", "cmd_right"), ("left_wheel_vel", "right_wheel_vel")))
    x, y, yaw = in_first_frame(blocks["icp_x"], blocks["icp_y"], blocks["icp_yaw"])
    gyro, count = blocks["imu_yaw"], len(x)
    sign = sign_shown([(DT * gyro[row, 1:].sum(), yaw[row, -1]) for row in range(count)])
    gyro *= sign or 1.0
    joints = _joints(x, y, yaw, wheels[0], gyro) if chained else None
    motion = np.stack([*command, *wheels, gyro])
    length = STEP_WINDOWS if chained else 1
    t = np.arange(ROWS * length) * DT
    trials, missed = list[Trial](), list[tuple[float, float]]()
    rates = {}
    for row in range(0, count - length + 1, length):
        rows = slice(row, row + length)
        step, window = divmod(row, STEP_WINDOWS)
        name = f"{run}/{step:03d}.{window}"
        pose: tuple[np.ndarray, ...] = (x[row], y[row], yaw[row])
        breaks: list[tuple[float, float]] = []
        for k in range(row, row + length - 1):
            assert joints is not None
            likely = float(joints.probability[k])
            pose = _chain(pose, (x[k + 1], y[k + 1], yaw[k + 1]), likely * joints.way[k], likely * joints.turn[k])
            missed.append((likely, float(abs(joints.way[k]))))
            if likely > BREAK:
                before, after = (ROWS * (k - row) + joints.between[k]) * DT
                breaks.append((float(before), float(after)))
        mine, truth = motion[:, rows].reshape(len(motion), -1), only_changes(t, *pose)
        _, _, way, turn, _ = DT * np.abs(mine).sum(axis=1)
        if len(truth.t) == 0 or way + spec.track / 2 * turn < MOVING:
            continue
        trials.append(replace(_trial(name, run, t, mine, truth), manoeuvre=f"{run}.{window}", breaks=tuple(breaks)))
        rates[name] = t, mine[4]
    note = f"{run}: {len(trials)} windows of {DT * ROWS * length:g} s"
    if sign != 1.0:
        note += (", whose gyro turns against the outside yaw: its sign is changed" if sign else
                 ", in which nothing turns enough to show the gyro's sign: it is taken as logged")
    return trials, note + (_said_missed(missed) if chained else ""), rates


def _trial(name: str, run: str, t: np.ndarray, motion: np.ndarray, truth: PoseStream) -> Trial:
    """A window of a run that starts as measured; motion (5, T): commanded speed and yaw rate, those of the wheels, and
    the gyro's, nan where it was not logged."""
    _, _, v, omega, turning = motion
    return Trial(name, run, Command(t, *motion[:2]), OdometryStream(t, None, None, None, v, omega), truth,
                 Start(v=float(v[0]), omega=float(omega[0]), measured=True), group=drive_group(run),
                 gyro=GyroStream.of_rates(t, turning) if np.isfinite(turning).all() else None)


def _blocks(path: Path) -> dict[str, np.ndarray]:
    """The columns of a DRIVE file that are used, each (N, 40) of N windows, checked."""
    arrays = read_arrays(path, "missing. Give the file of a run.", CONVERT)
    missing = {"data", "columns"} - set(arrays)
    if missing:
        raise ValueError(f"{path}: no array {sorted(missing)[0]!r}. It needs `data` and `columns`; see its README.")
    data, columns = arrays["data"], [str(name) for name in arrays["columns"].ravel()]
    if data.dtype.kind not in "iuf" or data.ndim != 2 or data.shape[1] != len(columns):
        raise ValueError(f"{path}: data is {data.dtype} of shape {data.shape}; it must be numbers, one column for each "
                         f"of the {len(columns)} names in `columns`. {CONVERT}")
    index = {name: i for i, name in enumerate(columns)}
    blocks = {}
    for name in WINDOW_COLUMNS:
        try:
            blocks[name] = data[:, [index[f"{name}_{i}"] for i in range(ROWS)]]
        except KeyError as error:
            raise ValueError(f"{path}: no column {error}. It needs {name}_0 to {name}_{ROWS - 1}.") from None
        if not (np.abs(blocks[name]) < LARGEST).all():
            raise ValueError(f"{path}: {name} is not finite, or {LARGEST:g} or more. {CONVERT} and leave out "
                             "incomplete windows.")
    return blocks


def _said_missed(missed: list[tuple[float, float]]) -> str:
    """How often a joint lost an update of the pose, and how much: of each joint its probability and the way [m]."""
    likely, way = np.array(missed or [(0.0, 0.0)]).T
    late = way[likely > BREAK] if (likely > BREAK).any() else np.zeros(1)
    return (f", chained by the last pose of each 2 s window: {likely.mean():.0%} of the joints seem to miss an ICP "
            f"update, whose motion is taken from wheels and gyro: {np.median(late):.2f} m (median), {late.max():.2f} m "
            "at most")


def in_first_frame(x: np.ndarray, y: np.ndarray, yaw: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Windows (N, 40) in the frame of their first sample, yaw unwrapped.

    The publishers' converter (dataset_parser.py, build_torch_ready_dataset) turned the positions by the mean of the
    first five yaws, which it did not unwrap: where yaw passes +-pi within them the mean is far off.
    """
    return *turned_by(x, y, yaw[:, :FRAME_SAMPLES].mean(axis=1, keepdims=True)), np.unwrap(yaw, axis=1)


@dataclass(frozen=True)
class _Joints:
    """What is lost between each window of N and the next one: an ICP update may be in neither."""

    probability: np.ndarray  # (N - 1,) that one is lost
    way: np.ndarray  # (N - 1,) m, that the wheels went between the last update of a window and its end
    turn: np.ndarray  # (N - 1,) rad, that the gyro turned meanwhile
    between: np.ndarray  # (N - 1, 2) int, samples of the update before and of the one after, from the window's start


def _joints(x: np.ndarray, y: np.ndarray, yaw: np.ndarray, v: np.ndarray, omega: np.ndarray) -> _Joints:
    """Joints of windows (N, 40) in the frame of their first sample.

    An update at a window's first sample shows in none. Whether there was one follows from two things. Updates come at
    the run's usual intervals: either one lasts over the joint, or two meet there. And the first update of a window is
    as far from the one before as wheels and gyro moved meanwhile: since the last update of the window before, or since
    the window's start alone. Within windows both are apart by so much (Laplace, which bears jumps).
    """
    count = len(x)
    changes: list[list[int]] = [
        (np.flatnonzero(np.abs(np.diff([x[k], y[k], yaw[k]], axis=1)).max(axis=0) > HELD) + 1).tolist()
        for k in range(count)]
    way, turn = (DT * np.cumsum(np.pad(rate, ((0, 0), (1, 0))), axis=1) for rate in (v, omega))  # before a sample

    def apart(k: int, begin: int, end: int, gone: float, turned: float) -> np.ndarray:
        """(2,) motion of the ICP between two samples of a window, less a way and a turn."""
        middle = (yaw[k, begin] + yaw[k, end]) / 2
        ahead = np.cos(middle) * (x[k, end] - x[k, begin]) + np.sin(middle) * (y[k, end] - y[k, begin])
        return np.array([ahead - gone, yaw[k, end] - yaw[k, begin] - turned])

    inside = [apart(k, a, b, way[k, b] - way[k, a], turn[k, b] - turn[k, a])
              for k in range(count) for a, b in pairwise(changes[k])]
    usual = np.abs(inside).mean(axis=0) if inside else np.ones(2)
    found = _Joints(np.zeros(count - 1), np.zeros(count - 1), np.zeros(count - 1),
                    np.full((count - 1, 2), ROWS))
    ratio = np.full(count - 1, np.nan)
    for k in range(count - 1):
        if len(changes[k]) and len(changes[k + 1]):
            last, first = changes[k][-1], changes[k + 1][0]
            found.between[k] = last, ROWS + first
            found.way[k], found.turn[k] = way[k, -1] - way[k, last], turn[k, -1] - turn[k, last]
            lost = apart(k + 1, 0, first, way[k + 1, first], turn[k + 1, first])
            whole = lost - [found.way[k], found.turn[k]]
            ratio[k] = ((np.abs(whole) - np.abs(lost)) / np.maximum(usual, HELD)).sum()
    known = np.isfinite(ratio)
    intervals = np.bincount([b - a for one in changes for a, b in pairwise(one)], minlength=2 * ROWS) + RARE
    rate = np.log(intervals / intervals.sum())
    last, first = found.between[known, 0], found.between[known, 1]
    ratio[known] += rate[ROWS - last] + rate[first - ROWS] - rate[first - last]
    found.probability[known] = 1 / (1 + np.exp(-np.clip(ratio[known], -50, 50)))
    return found


def _chain(
    first: tuple[np.ndarray, ...], second: tuple[np.ndarray, ...], way: float, turn: float
) -> tuple[np.ndarray, ...]:
    """Both windows in the frame of the first, the second of which starts that far on [m, rad]."""
    x0, y0, yaw0 = (float(values[-1]) for values in first)
    x0, y0, yaw0 = x0 + way * np.cos(yaw0 + turn / 2), y0 + way * np.sin(yaw0 + turn / 2), yaw0 + turn
    x, y = turned_by(second[0], second[1], yaw0)
    return tuple(np.append(one, other) for one, other in zip(first, (x0 + x, y0 + y, yaw0 + second[2]), strict=True))


def _continuous_trials(path: Path, run: str, window: float) -> tuple[list[Trial], str]:
    """Windows of the continuous log during its calibration phases (elsewhere a joystick drove and was not logged)."""
    (columns, times, states), spec = _read_rows(path), drive_spec(run)
    t = _nanoseconds(path, times)
    for name, values in columns.items():
        if (np.abs(values) >= LARGEST).any():
            raise ValueError(f"{path}: {name} is {LARGEST:g} or more. {CONVERT}.")
    yaw = np.unwrap(yaw_of(*(columns[f"icp_quat_{axis}"] for axis in "wxyz")))
    place = np.stack([columns["icp_pos_x"], columns["icp_pos_y"], yaw])
    motion = np.stack([columns["cmd_vel_x"], columns["cmd_vel_omega"], *twist_of_wheels(
        columns["meas_left_vel"], columns["meas_right_vel"], spec.wheel_radius, spec.track),
        columns.get(YAW_RATE, np.full(len(t), np.nan))])
    usable = np.array(states) & np.isfinite([*place, *motion[:4]]).all(axis=0)
    trials = []
    for number, begin in enumerate(np.arange(0.0, t[-1] - window, window)):
        inside = np.flatnonzero((t >= begin) & (t < begin + window))
        if len(inside) < 10 or not usable[inside].all() or np.diff(t[inside]).max() > MAX_GAP:
            continue
        now, mine = t[inside] - t[inside[0]], motion[:, inside]
        truth = only_changes(now, *PoseStream(now, *place[:, inside]).seen_from(*place[:, inside[0]]).values.T)
        if len(truth.t) and np.abs(mine[2:4]).max(axis=1).sum() >= MOVING:
            trials.append(_trial(f"{run}/{number:03d}", run, now, mine, truth))
    signed, said = with_sign(trials)
    note = "; ".join([f"{run}: {len(trials)} windows of {window:g} s during calibration phases", *said])
    return list(signed), note


def _read_rows(path: Path) -> tuple[dict[str, np.ndarray], list[str], list[bool]]:
    """Numbers by column (nan where none), times and whether calibrating; the first row of such a log is filler."""
    rows = csv_rows(path, read_gzip(path, "missing. Give the file of a run.", f"{CONVERT}."))
    header = next(rows, (0, []))[1]
    for name in (*CONTINUOUS_COLUMNS, "ros_time", "calib_state"):
        if name not in header:
            raise ValueError(f"{path}: no column {name!r} (found {shown(sorted(header))}). {CONVERT}.")
    index = {name: header.index(name) for name in header}
    columns: dict[str, array] = {name: array("d") for name in (*CONTINUOUS_COLUMNS, YAW_RATE) if name in index}
    times, states = [], []
    for number, (line, row) in enumerate(rows):
        if len(row) != len(header):
            raise ValueError(f"{path}, line {line}: has {len(row)} cells, the header {len(header)}. {CONVERT}.")
        if number == 0:
            continue
        for name, values in columns.items():
            try:
                values.append(float(row[index[name]] or "nan"))
            except ValueError:
                raise ValueError(f"{path}, line {line}: {name} is {shown(row[index[name]])}; it must be a number. "
                                 f"{CONVERT}.") from None
        times.append(row[index["ros_time"]])
        states.append(row[index["calib_state"]] == "calib")
    if len(times) < 2:
        raise ValueError(f"{path}: {counted(len(times), 'row')} of data; at least 2 are needed. {CONVERT}.")
    return {name: np.array(values) for name, values in columns.items()}, times, states


def _nanoseconds(path: Path, texts: list[str]) -> np.ndarray:
    """Seconds (T,) from the first of the clock's times in nanoseconds, which do not run back."""
    try:
        time = [int(float(text)) if "e" in text else int(text.split(".")[0]) for text in texts]
    except (ValueError, OverflowError):
        raise ValueError(f"{path}: ros_time is not a number of nanoseconds in every row. {CONVERT}.") from None
    if max(time) - min(time) > MAX_NANOSECONDS:
        raise ValueError(f"{path}: ros_time spans more than a day. {CONVERT}.")
    t = np.array([one - time[0] for one in time], float) * 1e-9
    if (np.diff(t) < 0).any():
        raise ValueError(f"{path}: ros_time runs backwards. {CONVERT}.")
    return t

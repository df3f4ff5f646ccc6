"""The usual first calibration: a small robot whose wheels, track and markers are not where its owner believes.

    python -m benchmarks.calibration                     # drives and fits it
    python -m benchmarks.calibration --robot porter --file mjcf      # one of 9 kg, from a file with motors
    python -m benchmarks.calibration --parts mounts      # markers 0.2 m and 15 degrees off, on three vehicles
    python -m benchmarks.calibration --parts skids       # skid-steered robots on four and on six wheels
    python -m benchmarks.calibration --parts files --folder ROBOTS   # loads and drives each robot file of a folder

`small`: a robot of a kilogram is driven on the contact plant, which shares no code with the model, and fitted as by
`sysid.fit LOG --model robot.urdf`. `mounts`: the same of a chair, a scooter and a robot of 21 kg, by the default fit.
`skids`: robots that slide in every turn; what drives determine of their track is the effective one.
`files`: every robot file of a folder is loaded, settled and driven straight on.

Writes benchmarks/results/logs.json.
"""

from __future__ import annotations

import math
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from benchmarks.harness import figure, record
from benchmarks.logs import CLAIM
from benchmarks.plant.chair import VEHICLES
from benchmarks.plant.commands import nine
from benchmarks.plant.first_day import SMALL_ONES, Day, Wrong, make_uncalibrated, slowed, write_mjcf, write_urdf
from benchmarks.plant.skid import SKIDS, write_skid_urdf
from sysid.command_line import progress_bar
from sysid.logs.log import load_log
from sysid.pages.fit_report import effective_track
from sysid.pages.report import error_rows, summaries
from sysid.replay.robot_check import check_robot
from sysid.replay.robot_loading import load_robot
from sysid.search.fitting import expected_steps, fit_log, predict
from sysid.search.settings import FitConfig
from whill_mjx.io import command_line
from whill_mjx.vehicle.vehicle_file import ROBOT_FILES

MANOEUVRES = ("turn", "s_curve", "stop_and_go", "figure_eight")
FARTHEST = 0.2, 15.0  # m, degrees: the tracked point from where it is believed to be, in `mounts`
LENGTH = 12.0  # s of each manoeuvre
SKID_SPEEDS = 0.5, 1.3  # factors on speed and yaw rate of the chair's manoeuvres


ALL_WRONG: tuple[Literal["radius", "track", "mount", "odometry"], ...] = ("radius", "track", "mount")


@dataclass(frozen=True)
class Benchmark:
    """What to measure."""

    parts: tuple[str, ...] = ("small",)
    """Of small, mounts, skids and files."""
    robot: Literal["small", "porter"] = "small"
    """One of 1.2 kg with quick controllers, or one of 9 kg with slow ones."""
    file: Literal["urdf", "mjcf"] = "urdf"
    """What its owner has of it."""
    wrong: tuple[Literal["radius", "track", "mount", "odometry"], ...] = ALL_WRONG
    """Of `small`: what is not as its owner believes. Figures of other than the usual three have names of their own."""
    replicates: int = 3
    """Drives of each manoeuvre."""
    folder: Path = Path("robots")
    """With robot files, for `files`."""
    seed: int = 0
    quick: bool = False
    """Fewer trials and iterations."""
    elsewhere: bool = True
    """Whether the fit looks for other minima."""

    @property
    def believed(self) -> Wrong:
        """How far what is believed of the small robot is off."""
        usual = Wrong(x=0.05, y=-0.02)
        mount = (usual.x, usual.y, usual.yaw) if "mount" in self.wrong else (0.0, 0.0, 0.0)
        return Wrong(usual.radius * ("radius" in self.wrong), usual.track * ("track" in self.wrong),
                     0.02 * ("odometry" in self.wrong), *mount)


def short_drives(seed: int, names: tuple[str, ...] = MANOEUVRES) -> dict[str, np.ndarray]:
    """Command tables (T, 3) of manoeuvres for a small robot, cut to `LENGTH` and stopped at their end."""
    tables = slowed({name: table[table[:, 0] < LENGTH] for name, table in nine(seed).items() if name in names})
    for table in tables.values():
        table[-5:, 1:] = 0.0
    return tables


def small(config: Benchmark) -> dict[str, dict]:
    """Figures of the small robot."""
    wrong, chair = config.believed, SMALL_ONES[config.robot]
    write, suffix = (write_urdf, "urdf") if config.file == "urdf" else (write_mjcf, "xml")
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        make_uncalibrated(folder / "log", Day(config.robot, wrong, config.seed), config.replicates,
                          short_drives(config.seed))
        log = load_log(folder / "log")
        settings = FitConfig(model=str(write(folder / f"robot.{suffix}", chair)), quick=config.quick,
                             elsewhere=config.elsewhere)
        with progress_bar(expected_steps(settings)) as progress:
            fit = fit_log(log, settings, progress)
        rows = error_rows(log.trials, *predict(fit, log.trials))
    one = summaries(rows, log.trials)["summary"]["held_out"]["ground_truth"]["trajectory"]
    found = dict(zip(fit.space.names, fit.space.to_values(fit.u), strict=True))
    for one_value in fit.uncertainty.estimates:
        print(f"{one_value.name}: {one_value.value:.5g} ({one_value.low:.5g} to {one_value.high:.5g})")
    spec = log.spec
    away = math.hypot(found["pose_mount.x"] - wrong.x, found["pose_mount.y"] - wrong.y)
    values = {
        "small_robot_replicate_ratio": (one["fitted"] / one["noise_floor"], "ratio"),
        "small_robot_radius_error": (abs(found["wheels.radius"] / spec.wheel_radius / (1 + wrong.radius) - 1), "share"),
        "small_robot_track_error": (abs(found["wheels.track"] / spec.track / (1 + wrong.track) - 1), "share"),
        "mount_offset_mm": (1000 * away, "mm"),
        "mount_offset_deg": (abs(math.degrees(found["pose_mount.yaw"] - wrong.yaw)), "deg"),
        "small_robot_fit_s": (fit.seconds, "s"),
    }
    print(f"wrong: {', '.join(config.wrong) or 'nothing'}; as stated: {', '.join(fit.stated) or 'nothing'}")
    kind = "" if (config.robot, config.file) == ("small", "urdf") else f"_{config.robot}_{config.file}"
    kind += "" if config.wrong == ALL_WRONG else f"_wrong_{'_'.join(config.wrong) or 'nothing'}"
    return {f"{name}{kind}": figure([float(value)], unit) for name, (value, unit) in values.items()}


def mounts(config: Benchmark) -> dict[str, dict]:
    """Errors of the tracked point's place and heading, fitted to built-in kinds of vehicle; the largest counts."""
    places, turns = [], []
    for number, vehicle in enumerate(VEHICLES):
        random = np.random.default_rng([config.seed, number])
        where, yaw = random.uniform(0, 2 * np.pi), math.radians(random.choice([-1.0, 1.0]) * FARTHEST[1])
        wrong = Wrong(x=FARTHEST[0] * math.cos(where), y=FARTHEST[0] * math.sin(where), yaw=yaw)
        tables = {name: table for name, table in nine(config.seed).items() if name in MANOEUVRES}
        with tempfile.TemporaryDirectory() as temporary:
            log = load_log(make_uncalibrated(Path(temporary) / "log", Day(vehicle, wrong, config.seed),
                                             config.replicates, tables))
        fit = fit_log(log, FitConfig(quick=config.quick, elsewhere=config.elsewhere))
        found = dict(zip(fit.space.names, fit.space.to_values(fit.u), strict=True))
        places.append(1000 * math.hypot(found["pose_mount.x"] - wrong.x, found["pose_mount.y"] - wrong.y))
        turns.append(abs(math.degrees(found["pose_mount.yaw"] - wrong.yaw)))
        print(f"{vehicle}: {places[-1]:.2f} mm, {turns[-1]:.3f} deg, {fit.seconds:.0f} s", flush=True)
    return {"far_mount_offset_mm": {**figure(places, "mm"), "value": max(places)},
            "far_mount_offset_deg": {**figure(turns, "deg"), "value": max(turns)}}


def skid_drives(seed: int) -> dict[str, np.ndarray]:
    """Command tables (T, 3) of manoeuvres for a skid-steered robot, which turns half as far as its wheels ask for."""
    tables = {name: table[table[:, 0] < LENGTH] * [1.0, *SKID_SPEEDS] for name, table in nine(seed).items()
              if name in (*MANOEUVRES, "random")}
    for table in tables.values():
        table[-8:, 1:] = 0.0
    return tables


def skids(config: Benchmark) -> dict[str, dict]:
    """Figures of robots on four and on six wheels; radius and track are off by the usual 2 and 3 %."""
    figures: dict[str, dict] = {}
    wrong = Wrong(0.02, -0.03, x=0.05, y=-0.02)
    for name, robot in SKIDS.items():
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary)
            make_uncalibrated(folder / "log", Day(name, wrong, config.seed), config.replicates,
                              skid_drives(config.seed))
            settings = FitConfig(model=str(write_skid_urdf(folder / "robot.urdf", robot)), quick=config.quick,
                                 elsewhere=config.elsewhere)
            log = load_log(folder / "log")
            with progress_bar(expected_steps(settings)) as progress:
                fit = fit_log(log, settings, progress)
        before, after = predict(fit, log.trials)
        one = summaries(error_rows(log.trials, before, after), log.trials)["summary"]["held_out"]["ground_truth"]
        found = dict(zip(fit.space.names, fit.space.to_values(fit.u), strict=True))
        for known in fit.uncertainty.estimates:
            print(f"{known.name}: {known.value:.5g} ({known.low:.5g} to {known.high:.5g})")
        held_out = [k for k, trial in enumerate(log.trials) if trial.held_out]
        true = effective_track([log.trials[k] for k in held_out], log.spec.track)
        track = effective_track([after[k] for k in held_out], log.spec.track, found["odometry_scale.angular"])
        assert true is not None and track is not None  # they turn
        values = {
            "replicate_ratio": (one["trajectory"]["fitted"] / one["trajectory"]["noise_floor"], "ratio"),
            "initial_ratio": (one["trajectory"]["initial"] / one["trajectory"]["noise_floor"], "ratio"),
            "radius_error": (abs((1 + found["wheel_radius_difference.common"]) / (1 + wrong.radius) - 1), "share"),
            "track_error": (abs(track / true - 1), "share"),
            "mount_side_mm": (1000 * abs(found["pose_mount.y"] - wrong.y), "mm"),
            "mount_ahead_mm": (1000 * abs(found["pose_mount.x"] - wrong.x), "mm"),
            "mount_deg": (abs(math.degrees(found["pose_mount.yaw"] - wrong.yaw)), "deg"),
        }
        print(f"{name}: as stated: {', '.join(fit.stated) or 'nothing'}")
        figures |= {f"skid_{name}_{what}": figure([float(value)], unit) for what, (value, unit) in values.items()}
    return figures


def files(config: Benchmark) -> dict[str, dict]:
    """How many of a folder's robot files load, settle and drive straight on."""
    paths = sorted(path for path in config.folder.rglob("*") if path.suffix in ROBOT_FILES)
    good = 0
    for path in paths:
        try:
            check = check_robot(load_robot(path))
        except (ValueError, FileNotFoundError) as error:
            print(f"{path.name}: {error}")
            continue
        good += check.drives_straight
        v, omega = check.command
        print(f"{path.name}: straight {check.speed / v:.1%}, on the spot {check.rate / omega:.1%}"
              f"{'' if check.drives_straight else ' NOT STRAIGHT'}")
    return {"robot_files_loaded": figure([float(good)], "count"),
            "robot_files_tried": figure([float(len(paths))], "count")}


def main(config: Benchmark) -> None:
    """Measure and record."""
    figures: dict[str, dict] = {}
    for part in config.parts:
        figures |= {"small": small, "mounts": mounts, "skids": skids, "files": files}[part](config)
    for name, one in figures.items():
        print(f"{name}: {np.round(one['value'], 4)} {one['unit']}")
    print(record("logs", CLAIM, figures))


if __name__ == "__main__":
    command_line.run(Benchmark, main, __doc__, positional=False)

"""A robot of one's own in the closed loop: which effect is hidden in drives of a robot that came as a URDF file.

    python -m benchmarks.own_robot --part 1/5 --out runs/own_robot     # in five processes; start again what was stopped
    python -m benchmarks.own_robot --collect                           # counts, and writes the figures

A robot of 1.2 kg is driven on the contact plant, which shares no code with its model. Its wheels, track and markers are
not where its owner believes. The first day is fitted by its URDF file, as `sysid.fit LOG --model robot.urdf` does. Then
`sysid.close_loop LOG --vehicle RUN/vehicle.toml --reference DAYS` is asked about logs of other days, each with one
effect at twice the base size of the plant's table, in proportion to the robot's mass, speeds and drives. Two more logs
have no effect.

Writes benchmarks/results/logs.json.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from benchmarks import kept
from benchmarks.calibration import MANOEUVRES, short_drives
from benchmarks.fit_jobs import labels_of, on_device, read_results, run_jobs
from benchmarks.harness import figure, record
from benchmarks.logs import CLAIM
from benchmarks.plant.effects import EFFECTS, in_proportion
from benchmarks.plant.first_day import SLOWER, SMALL, Day, Wrong, make_uncalibrated, write_urdf
from benchmarks.undeclared_reference import key_of
from sysid.logs.log import load_log, of_file
from sysid.missing.fit_statistics import load_fitted
from sysid.pages.fit_report import fit_dataset
from sysid.pages.loop_report import effects as named_effects
from sysid.pages.report import code_hashes
from sysid.search.settings import FitConfig
from sysid.verdict.pipeline import find_missing
from sysid.verdict.preparation import prepare, reference_for
from sysid.verdict.result import LoopConfig, Prepared
from whill_mjx.io import command_line
from whill_mjx.io.folders import write_whole
from whill_mjx.vehicle.specs import VehicleSpec

WRONG = Wrong(x=0.05, y=-0.02)
TESTED = ("command_delay", "command_dead_zone", "acceleration_limit", "command_scale", "actuator_lag", "dry_friction",
          "wheel_radius_difference", "track_width", "odometry_scale", "sensor_delay")
"""Ten effects that the catalogue can name, of each place in the vehicle."""
TIMES = 2.0  # of the base size
SPEEDS = {"m/s": SLOWER, "s^2/m": 1 / SLOWER}
"""By unit, of a size on a vehicle that drives at other speeds."""
DRIVES = (*MANOEUVRES, "random", "reverse", "creep")
"""Creeping shows dead zones and dry friction; no wheel turns so slowly in the other drives."""
FIRST_SEED, LOG_SEED = 300, 400


@dataclass(frozen=True)
class Benchmark:
    """What to run."""

    out: Path = Path("runs/own_robot")
    """Folder for drives, the fitted robot and verdicts; several processes may share it."""
    part: str = "1/1"
    """I/N: every N-th log, from the I-th."""
    days: int = 4
    """Reference days."""
    nulls: int = 2
    """Logs without an effect."""
    only: tuple[str, ...] = ()
    """Only logs with these effects, or of these names."""
    quick: bool = False
    """Fewer iterations of the loop; the fit has few in any case."""
    collect: bool = False
    """Only count what is there."""


def size_of(name: str) -> float:
    """Size of an effect on the small robot, in its unit."""
    entry = EFFECTS[name]
    return in_proportion(name, min(TIMES * entry.base, entry.most), SMALL) * SPEEDS.get(entry.unit, 1.0)


def drive(folder: Path, seed: int, replicates: int, effects: tuple[tuple[str, float], ...] = ()) -> Path:
    """A day of the small robot; its drives are kept."""
    if not folder.exists():
        day = Day("small", WRONG, seed, effects, varies=True)
        make_uncalibrated(folder, day, replicates, short_drives(seed, DRIVES))
    return folder


@contextmanager
def alone(path: Path) -> Iterator[None]:
    """Hold a lock that ends with the process."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def ready_robot(config: Benchmark, loop: LoopConfig) -> tuple[Prepared, VehicleSpec, Path]:
    """The robot ready for verdicts, its spec, and its vehicle file. The first process drives the days, fits the robot
    and makes its reference; those that come later find each of these steps done."""
    out, began = config.out, time.perf_counter()
    fitted = out / "fit" / "vehicle.toml"
    with alone(out / ".lock"):
        days = [load_log(drive(out / f"day_{k + 1}", FIRST_SEED + k, 3 if k == 0 else 1)) for k in range(config.days)]
        if not fitted.exists():
            settings = FitConfig(model=str(write_urdf(out / "robot.urdf")), quick=True, elsewhere=False)
            fit_dataset(out / "day_1", out / "fit", config=settings)
            print(f"fitted, {time.perf_counter() - began:.0f} s", flush=True)
        spec, vehicle = load_fitted(fitted)
        days = [of_file(day, spec, str(fitted)) for day in days]
        made = out / f"reference_{key_of(days, loop, fitted.read_text())}.pickle"
        try:
            reference = kept.loads(made.read_bytes())
        except (FileNotFoundError, kept.KeptError):
            reference = reference_for(days[0], days, loop, replace(vehicle, kept=False))
            write_whole(made, kept.dumps(reference))
            print(f"reference, {time.perf_counter() - began:.0f} s", flush=True)
    ready = prepare(reference, days[0].spec, loop)
    print(f"ready, {time.perf_counter() - began:.0f} s", flush=True)
    return ready, spec, fitted


def names_of(config: Benchmark) -> tuple[str, ...]:
    """Names of all logs."""
    return (*TESTED, *(f"null_{k + 1}" for k in range(config.nulls)))


def basis(config: Benchmark) -> dict[str, Any]:
    """What a verdict depends on beside its log: code, settings and the fitted robot. One of another basis is no result
    of this run."""
    fitted = config.out / "fit" / "vehicle.toml"
    parts = (sorted(code_hashes().items()), config.days, fitted.read_text() if fitted.exists() else "")
    return {"quick": config.quick, "key": hashlib.sha256(repr(parts).encode()).hexdigest()[:16]}


def drop_others(config: Benchmark, names: Iterable[str]) -> None:
    """Remove the verdicts on these logs that are of another basis, or that failed."""
    now = basis(config)
    for path in (config.out / "verdicts" / f"{name}.json" for name in names):
        if path.exists() and json.loads(path.read_text()).get("basis") != now:
            path.unlink()
            print(f"{path}: of other code, settings or another robot; judged again", flush=True)


def judge(config: Benchmark) -> None:
    """Keep the verdict on each log of this part."""
    names = names_of(config)
    mine = [name for name in labels_of(config.part, names) if not config.only or name in config.only]
    loop = LoopConfig(quick=config.quick)
    ready, spec, fitted = ready_robot(config, loop)
    drop_others(config, mine)
    now = basis(config)

    def verdict_on(name: str) -> dict[str, Any]:
        number = names.index(name)
        effects = ((name, size_of(name)),) if name in EFFECTS else ()
        log = of_file(load_log(drive(config.out / f"log_{number}", LOG_SEED + number, 2, effects)), spec, str(fitted))
        result = find_missing(log, (), loop, reference=ready)
        verdict = result.search.verdict
        found = [[one["name"], *one["class"]] for one in named_effects(result)] if verdict == "named" else []
        print(f"{name}: {verdict} {found}", flush=True)
        return {"effect": name, "size": size_of(name) if effects else 0.0, "verdict": verdict, "named": found,
                "basis": now}

    run_jobs(config.out / "verdicts", mine, verdict_on)


def collect(config: Benchmark) -> dict[str, Any]:
    """Figures of all verdicts: right is a log whose effect is in the class of one that was named, and no other.

    Raises:
        ValueError: a log has no verdict, or one of other code, settings or another robot. The score would be of the
            others alone, or of no one thing.
    """
    folder = config.out / "verdicts"
    names = [name for name in names_of(config) if not config.only or name in config.only]
    verdicts = [one for one in read_results(folder) if one["label"] in names]
    judged = {one["label"] for one in verdicts}
    left = [f"{name} ({'failed' if (folder / f'{name}.json').exists() else 'missing'})"
            for name in names if name not in judged]
    now = basis(config)
    if others := [one["label"] for one in verdicts if one.get("basis") != now]:
        raise ValueError(f"{folder}: verdicts on {', '.join(others)} are of other code, other settings (--quick) or "
                         "another robot. Run their parts again.")
    if left:
        raise ValueError(f"{folder}: no verdict on {', '.join(left)}. Remove the files of those that failed, and "
                         "run their parts again.")
    right, false = [], []
    for one in verdicts:
        if one["effect"] in EFFECTS:
            known = EFFECTS[one["effect"]].covered or one["effect"]
            right.append(float(len(one["named"]) == 1 and known in one["named"][0]))
            print(f"{one['effect']}: {one['verdict']} {one['named']}{'' if right[-1] else ' WRONG'}")
        else:
            false.append(float(one["verdict"] != "none"))
    if not right:
        raise ValueError(f"{config.out}: no verdict on a log with an effect. Run some parts first.")
    figures = {"own_robot_loop_right": {**figure(right, "logs with the right class"), "value": sum(right)},
               "own_robot_loop_logs": {**figure(right, "logs"), "value": float(len(right))}}
    if false:
        figures["own_robot_loop_false"] = {**figure(false, "alarms of logs without an effect"), "value": sum(false)}
    return on_device(figures, verdicts)


def main(config: Benchmark) -> None:
    """Judge the logs of this part, or count."""
    if not config.collect:
        judge(config)
        if config.part != "1/1":
            return
    print(record("logs", CLAIM, collect(config)))


if __name__ == "__main__":
    command_line.run(Benchmark, main, __doc__, positional=False)

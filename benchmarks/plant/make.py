"""Writes a dataset driven by the contact plant: nine manoeuvres, three replicates, undeclared effects."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from zlib import crc32

import numpy as np

from benchmarks.plant.base import Effect
from benchmarks.plant.chair import SLOW, VEHICLES, Chair, Contact, Nominal
from benchmarks.plant.commands import nine
from benchmarks.plant.effects import EFFECTS
from benchmarks.plant.sensors import Gyro, odometry, outside_pose
from benchmarks.plant.trial import Noise, Plant
from whill_mjx.logs.dataset import COMMAND_HEADER, IMU_HEADER, ODOMETRY_HEADER, POSE_HEADER, write_csv, write_text

HELD_OUT = ("figure_eight_1", "figure_eight_2", "figure_eight_3", "s_curve_3", "random_3", "stop_and_go_3", "reverse_3")


@dataclass(frozen=True)
class Job:
    """One trial to drive."""

    name: str
    index: int
    messages: np.ndarray
    session: float
    """Time of the dataset before it [s]."""


@dataclass(frozen=True)
class Setting:
    """What all trials of a dataset share."""

    effects: tuple[tuple[str, float], ...]
    seed: int
    noise: float
    chair: Chair
    contact: Contact = SLOW
    gyro: Gyro | None = None


@dataclass(frozen=True)
class Experiment:
    """What is driven for a dataset: which vehicle, on which day, under which effects."""

    effects: Mapping[str, float] = field(default_factory=dict)
    """Sizes by name, in the units of `effects.EFFECTS`."""
    seed: int = 0
    """Of command levels, day, start headings, disturbances and sensor noise."""
    noise: float = 1.0
    """Factor on all disturbances and sensor noise."""
    day: bool = True
    """Whether gains, mass and friction differ from the nominal vehicle's."""
    manoeuvres: Mapping[str, np.ndarray] | Sequence[str] | None = None
    """Names out of the nine, or command tables (T, 3) t, v, omega by name; None drives the nine."""
    replicates: int = 3
    """Drives of each manoeuvre."""
    vehicle: str = "chair"
    """Of `chair.VEHICLES`."""
    contact: Contact = SLOW
    """How the contacts are computed."""
    gyro: Gyro | None = None
    """What is written to `imu.csv`; nothing by default."""


def make_log(
    out: Path | str, experiment: Experiment = Experiment(), ground_truth: bool = True,  # noqa: B008
    answers: Path | str | None = None, processes: int = 1,
) -> Path:  # fmt: skip
    """Drive a dataset and write it; returns its folder. The same arguments give the same files.

    Args:
        out: folder to write; it must not exist.
        experiment: what is driven.
        ground_truth: whether the outside pose is written.
        answers: file for what was driven; it must lie outside `out`.
        processes: 1 drives here, more in as many processes.

    Raises:
        ValueError, FileExistsError: naming the value, the rule and the remedy.
    """
    out = Path(out)
    setting, jobs = plan(experiment)
    if out.exists():
        raise FileExistsError(f"{out}: exists. Name a new folder, or delete this one.")
    if answers is not None and Path(answers).resolve().is_relative_to(out.resolve()):
        raise ValueError(f"answers {answers}: lies inside the dataset {out}. Put it elsewhere: the dataset is blind.")
    if processes > 1:
        with ProcessPoolExecutor(processes) as pool:
            parts = [jobs[i::processes] for i in range(processes)]
            results = [result for part in pool.map(drive_all, [setting] * processes, parts) for result in part]
    else:
        results = drive_all(setting, jobs)
    nominal = VEHICLES[experiment.vehicle].nominal
    write_dataset(out, nominal, {job.name: job.messages for job in jobs}, results, ground_truth)
    if answers is not None:
        truth = {"effects": dict(setting.effects), "seed": experiment.seed, "noise": experiment.noise,
                 "day": experiment.day, "vehicle": experiment.vehicle}
        write_text(Path(answers), json.dumps(truth, indent=1) + "\n")
    return out


def plan(experiment: Experiment) -> tuple[Setting, list[Job]]:
    """Check an experiment, draw its day, list its trials."""
    effects, seed, noise, vehicle = experiment.effects, experiment.seed, experiment.noise, experiment.vehicle
    unknown = sorted(set(effects) - set(EFFECTS))
    if unknown:
        raise ValueError(f"unknown effect {unknown[0]!r} (known: {', '.join(EFFECTS)}). Correct the name.")
    if vehicle not in VEHICLES:
        raise ValueError(f"unknown vehicle {vehicle!r} (known: {', '.join(VEHICLES)}). Correct the name.")
    active = tuple((name, float(size)) for name, size in sorted(effects.items()) if size != 0)
    bad = [f"{name}={size}" for name, size in active if not np.isfinite(size)]
    if bad or not noise >= 0:
        raise ValueError(f"{(bad or [f'noise={noise}'])[0]}: must be finite, noise not negative. Give another number.")
    backward = [f"{name}={size:g}" for name, size in active if size < 0 and not EFFECTS[name].signed]
    if backward:
        raise ValueError(f"effect {backward[0]}: must not be negative [{EFFECTS[backward[0].split('=')[0]].unit}].")
    chair = VEHICLES[vehicle].on_day(np.random.default_rng([seed, 1])) if experiment.day else VEHICLES[vehicle]
    for name, size in active:
        chair = EFFECTS[name].make.change(chair, size)
    tables: Mapping[str, np.ndarray] = nine(seed)
    manoeuvres = experiment.manoeuvres
    if isinstance(manoeuvres, Mapping):
        tables = {name: _checked(name, table) for name, table in manoeuvres.items()}
    elif manoeuvres is not None:
        missing = sorted(set(manoeuvres) - set(tables))
        if missing:
            raise ValueError(f"unknown manoeuvre {missing[0]!r} (known: {', '.join(tables)}). Correct the name.")
        tables = {name: tables[name] for name in manoeuvres}
    jobs: list[Job] = []
    session = 0.0
    for replicate in range(1, experiment.replicates + 1):
        for name, messages in tables.items():
            jobs.append(Job(f"{name}_{replicate}", len(jobs), messages, session))
            session += float(messages[-1, 0]) + 5.0
    return Setting(active, seed, noise, chair, experiment.contact, experiment.gyro), jobs


def _checked(name: str, table: np.ndarray) -> np.ndarray:
    table = np.asarray(table, float)
    if table.ndim != 2 or table.shape[1] != 3 or len(table) < 2 or not (np.diff(table[:, 0]) > 0).all():
        raise ValueError(f"manoeuvre {name!r}: shape {table.shape}, must be (T, 3) t, v, omega, t rising. Correct it.")
    return table


Result = tuple[str, np.ndarray, np.ndarray, np.ndarray | None]
"""Name of the trial, odometry (M, 6), outside pose (M, 4), gyro (M, 2)."""


def drive_all(setting: Setting, jobs: Sequence[Job]) -> list[Result]:
    """Drive trials one after the other; each has random numbers of its own."""
    plant = Plant(setting.chair, setting.contact)
    noise = Noise().of(setting.chair).scaled(setting.noise)
    results = []
    for job in jobs:
        random, reading = (np.random.default_rng([setting.seed, 2 + part, job.index]) for part in (0, 1))
        start = (0.0, 0.0, float(np.random.default_rng([setting.seed, 4, job.index]).uniform(-np.pi, np.pi)))
        effects = make_effects(setting, job.index)
        drive = plant.drive(job.messages, start, effects, noise, random, job.session)
        if not np.isfinite(drive.pose).all():
            raise ValueError(f"{job.name}: motion became non-finite with {dict(setting.effects)}. Use smaller sizes.")
        seen = odometry(drive, effects, noise, reading), outside_pose(drive, noise, reading)
        own = np.random.default_rng([setting.seed, 6, job.index])
        results.append((job.name, *seen, None if setting.gyro is None else setting.gyro.rows(drive, own)))
    return results


def make_effects(setting: Setting, index: int) -> list[Effect]:
    """Fresh effects for one trial, with random numbers that no other trial or effect uses."""
    return [
        EFFECTS[name].make(size, np.random.default_rng([setting.seed, 5, crc32(name.encode()), index]), setting.chair)
        for name, size in setting.effects
    ]


def fields(nominal: Nominal) -> str:
    """Lines of `dataset.toml` that do not depend on the drives."""
    return f"""schema = 1
vehicle = "differential-drive powered chair"
wheel_radius = {nominal.radius}      # m, nominal
track = {nominal.track}              # m, nominal, between drive wheels
wheelbase = {nominal.wheelbase}           # m, drive axle to front axle
mass = {nominal.mass}                # kg, nominal
command_limits = [1.0, 1.0]  # m/s, rad/s
reference_point = "drive axle centre"
odometry = "wheel encoders"
"""


def write_dataset(
    out: Path, nominal: Nominal, messages: Mapping[str, np.ndarray], results: Sequence[Result], ground_truth: bool
) -> None:
    """Write all trials, or nothing."""
    partial = out.with_name(f".{out.name}.partial-{os.getpid()}")
    try:
        for name, rows, pose, turn in results:
            folder = partial / "trials" / name
            write_csv(folder / "command.csv", COMMAND_HEADER, messages[name])
            write_csv(folder / "odometry.csv", ODOMETRY_HEADER, rows)
            if ground_truth:
                write_csv(folder / "ground_truth.csv", POSE_HEADER, pose)
            if turn is not None:
                write_csv(folder / "imu.csv", IMU_HEADER, turn)
        held_out = ", ".join(json.dumps(name) for name in HELD_OUT if name in messages)
        outside = 'ground_truth = "overhead motion capture"\n' if ground_truth else ""
        note = "   # trials to be predicted, never fitted"
        write_text(partial / "dataset.toml", f"{fields(nominal)}{outside}held_out = [{held_out}]{note}\n")
        out.parent.mkdir(parents=True, exist_ok=True)
        os.replace(partial, out)
    finally:
        shutil.rmtree(partial, ignore_errors=True)



"""Propose the next manoeuvre: `python -m sysid.design VEHICLE_OR_RUN --out command.csv --space 6 4`.

Of a library of manoeuvres within limits of speed and room, the one is chosen that shrinks the uncertainty of the
parameters most: A-optimal (the sum of variances, which the largest uncertainty rules) or D-optimal (the volume), both
on the subspace that driving determines.

Residuals of driving logs are autocorrelated: information is divided by INFLATION, so that planned intervals are honest.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from whill_mjx.io.command_line import NOT_NEGATIVE, POSITIVE, OptionError, Range, check_known, listen, refusing, starts
from whill_mjx.io.heartbeat import say_loading

if starts(__name__):
    listen()
    say_loading()

import numpy as np

from sysid import command_line
from sysid.intervals.design import Criterion, Subject, propose
from sysid.logs.manoeuvre_library import Limits
from sysid.logs.sources import refuse_recording
from sysid.search.thin import drives_from
from whill_mjx.io.folders import check_file, note_written
from whill_mjx.vehicle.parameters import describe
from whill_mjx.vehicle.specs import VehicleSpec


@dataclass(frozen=True)
class DesignConfig:
    vehicle: str
    """Built-in vehicle, vehicle file, or the folder of a fit."""
    out: Path = Path("runs/command.csv")
    """Command file to write: t [s], v [m/s], omega [rad/s]. Beside it a page with the reasons."""
    space: Annotated[tuple[float, float], Range(0.1, 10_000)] = (8.0, 8.0)
    """Length and width [m] of the free floor."""
    margin: Annotated[float | None, NOT_NEGATIVE] = None
    """How far the drive-axle centre stays from its edges [m]; by default the reach of the body."""
    v_max: Annotated[float | None, POSITIVE] = None
    """Greatest speed [m/s]; by default the vehicle's, 1 at most."""
    v_min: Annotated[float | None, Range(high=0)] = None
    """Least speed [m/s]; 0 forbids reversing."""
    omega_max: Annotated[float | None, POSITIVE] = None
    """Greatest yaw rate [rad/s]."""
    seconds: Annotated[float, Range(1, 3600)] = 20.0
    """Time in motion at most [s]."""
    criterion: Criterion = "a"
    """a: sum of variances, ruled by the largest uncertainty; d: volume."""
    channels: Literal["both", "odometry", "ground_truth"] = "both"
    """What will be measured."""
    parameters: tuple[str, ...] = ()
    """Parameters of interest; by default all that a log can determine."""
    count: Annotated[int, Range(1, 100)] = 1
    """Manoeuvres to propose, one after the other; further ones are written as NAME_2.csv, ..."""


def main(config: DesignConfig) -> list[Path]:
    """Propose, write the command files and the page, and print the reasons."""
    from sysid.pages.design_page import text, write_page
    from whill_mjx.logs.dataset import COMMAND_HEADER, write_csv

    with refusing():
        check_out(config)
        subject = load_subject(config.vehicle)
        for name in config.parameters:
            check_known("--parameters", name, describe(subject.params))
        spec = subject.spec
        check_limits(config, spec)
        limits = Limits(
            max(spec.v_min, -1.0) if config.v_min is None else config.v_min,
            min(spec.v_max, 1.0) if config.v_max is None else config.v_max,
            min(spec.omega_max, 1.0) if config.omega_max is None else config.omega_max, config.space,
            float(np.hypot(spec.body_length, spec.body_width)) / 2 if config.margin is None else config.margin,
            config.seconds, least=drives_from(spec))
        command_line.stage("simulating the manoeuvres of the library: half a minute, most of it compilation")
        found = propose(subject, limits, channels=config.channels, criterion=config.criterion, count=config.count,
                        names=config.parameters or None)
    paths = []
    for path, plan in zip(command_files(config), found.chosen, strict=False):
        write_csv(path, COMMAND_HEADER, plan.candidate.command.table)
        note_written(path)  # at once: the same command may follow an interrupt
        paths.append(path)
    print(text(found, config.criterion))
    paths.append(write_page(config.out.with_suffix(".html"), found, limits, config, describe(subject.params)))
    note_written(paths[-1])
    for path in paths:
        print(f"wrote {path}")
    return paths


def check_limits(config: DesignConfig, spec: VehicleSpec) -> None:
    """Refuse speeds that the vehicle does not drive: it would clip them, and drive another manoeuvre than planned."""
    for option, wanted, most, unit in (("--v-max", config.v_max, spec.v_max, "m/s"),
                                       ("--omega-max", config.omega_max, spec.omega_max, "rad/s"),
                                       ("--v-min", config.v_min, spec.v_min, "m/s")):
        if wanted is not None and abs(wanted) > abs(most):
            raise ValueError(f"{option} {wanted:g}: {config.vehicle} drives {most:g} {unit} at most. Give no more, or "
                             "correct its spec.")


def command_files(config: DesignConfig) -> list[Path]:
    """Where each manoeuvre is written: NAME.csv, NAME_2.csv, ..."""
    return [config.out, *(config.out.with_name(f"{config.out.stem}_{number}{config.out.suffix}")
                          for number in range(2, config.count + 1))]


def check_out(config: DesignConfig) -> None:
    """Raise OptionError where the command files or the page cannot be written."""
    if config.out.suffix != ".csv":
        raise OptionError(f"--out {config.out}: must end in .csv. Correct the name.")
    for path in (*command_files(config), config.out.with_suffix(".html")):
        check_file("--out", path)


def load_subject(name: str) -> Subject:
    """What is known of a built-in vehicle, of that of a vehicle file, or of that of the folder of a fit."""
    from whill_mjx.vehicle.vehicle_file import load_intervals, load_vehicle

    refuse_recording(name, "a built-in vehicle, a vehicle file, or the folder of a fit.")
    if not Path(name).is_dir():
        spec, params, _ = load_vehicle(name)
        return Subject(spec, params, load_intervals(name) if name.endswith(".toml") else {})
    from sysid.pages.report import noise_of

    file = str(Path(name) / "vehicle.toml")
    if not Path(file).exists() and (Path(name) / "model.toml").exists():
        raise ValueError(f"{name}: the fit of a model of your own, as which no vehicle of the simulator drives "
                         "(dataset.notes in its report.json say why). Drives are designed for vehicles only; take one "
                         "of similar size, or those that python -m sysid.inspect DATASET proposes.")
    noise = noise_of(Path(name))
    spec, params, _ = load_vehicle(file)
    return Subject(spec, params, load_intervals(file), noise)


def cli() -> None:
    command_line.run(DesignConfig, main, __doc__)


if __name__ == "__main__":
    cli()

r"""Drive manoeuvres with a simulated vehicle and write them as a driving-log dataset.

    python -m whill_mjx.drive --manoeuvre figure_eight --vehicle whill_cr_physical \
        --effects command_delay:delay=0.2 yaw_scrub:torque=6 --replicates 3 --noise --out DATASET

An effect is NAME, or NAME:PARAMETER=VALUE,...: a vehicle that has the effect gets the values given; any other gets the
effect added, with those values and the rest neutral, or, where no value is given, the upper usual value of each.
docs/effects.md lists them. The measurements have rates, latencies and noise; --sensors.imu-rate 104 and
--sensors.encoder-rate 50 add the chair's gyro and wheel encoders. DATASET/vehicle.toml is the vehicle that was driven:
the planted truth.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from whill_mjx.io.command_line import SEED, OptionError, Range, With, check_once, listen, refusing, run, starts
from whill_mjx.io.heartbeat import Heartbeat, say_loading

if starts(__name__):
    listen()
    say_loading()

import numpy as np

from whill_mjx.effects.texts import with_effects
from whill_mjx.io.fields import counted, in_shell
from whill_mjx.io.folders import check_place, new_folder
from whill_mjx.logs.dataset import Noise, write_fields
from whill_mjx.logs.manoeuvres import MANOEUVRES, Scenario, command_table
from whill_mjx.logs.motions import record_motion, write_streams
from whill_mjx.logs.simulated_sensors import SensorNoise, Sensors
from whill_mjx.vehicle.vehicle_file import load_vehicle, save_vehicle


@dataclass(frozen=True)
class DriveOptions:
    """Options of the command."""

    out: Path
    """Dataset folder to write; it must not exist."""
    manoeuvre: tuple[str, ...] = ("figure_eight",)
    """Of straight, turn, circle, s_curve, figure_eight, reversal, slow_sine, random_steps and standstill; or `all`."""
    vehicle: str = "whill_cr_physical"
    """Built-in vehicle (docs/howto/vehicle.md lists them), or a vehicle file."""
    effects: tuple[str, ...] = ()
    """Effects to add to the vehicle, or to change: NAME or NAME:PARAMETER=VALUE,..."""
    replicates: Annotated[int, Range(1, 10_000)] = 1
    """Drives of each manoeuvre: the same commands from another pose, with other noise."""
    noise: bool = False
    """Add white noise to the measurements."""
    noise_levels: Annotated[SensorNoise, With("noise")] = field(default_factory=SensorNoise)
    """How much, with --noise."""
    sensors: Sensors = field(default_factory=Sensors)
    """Rates and latencies of the measurements."""
    held_out: tuple[str, ...] = ()
    """Manoeuvres that the dataset declares as never to be fitted."""
    seed: Annotated[int, SEED] = 0
    """Random seed of start poses and noise."""
    scenario: Scenario = field(default_factory=Scenario)
    """How hard the manoeuvres are driven."""


def main(options: DriveOptions, stage: Callable[[str], None] = lambda text: None) -> Path:
    """Drive and write the dataset; returns its folder.

    Args:
        stage: gets a line when the driving begins.

    Raises:
        ValueError, FileNotFoundError: naming the option, its value, the rule and the remedy.
    """
    names = tuple(MANOEUVRES) if options.manoeuvre == ("all",) else options.manoeuvre
    with refusing():
        commands = [command_table(name, options.scenario) for name in names]
        _check(options, names)
        spec, params, _ = load_vehicle(options.vehicle)
        params = with_effects(params, options.effects)
    stage("compiling the vehicle, and driving")
    random = np.random.default_rng(options.seed)
    trials = [
        (f"{name}_{replicate}", command, (*random.uniform(-1.0, 1.0, 2), random.uniform(-np.pi, np.pi)))
        for name, command in zip(names, commands, strict=True)
        for replicate in range(1, options.replicates + 1)
    ]
    motions, diverged = record_motion(spec, params, [trial[1] for trial in trials], [trial[2] for trial in trials])
    if diverged.any():
        lost = ", ".join(name for (name, _, _), bad in zip(trials, diverged, strict=True) if bad)
        raise ValueError(
            f"vehicle {options.vehicle!r} with effects {' '.join(options.effects) or 'none'}: the motion became "
            f"non-finite in {lost}. Bring the effects' values closer to those in docs/effects.md."
        )
    for sensor, values in motions.items():
        if not np.isfinite(values).all():
            raise ValueError(f"vehicle {options.vehicle!r} with effects {' '.join(options.effects) or 'none'}: what "
                             f"{sensor} shows became non-finite. Correct the effect that acts on its reading.")
    with new_folder(options.out) as partial:
        noise = Noise(options.noise_levels if options.noise else None, random)
        for index, (name, command, _) in enumerate(trials):
            motion = {sensor: motions[sensor][index] for sensor in motions}
            write_streams(partial / "trials" / name, command, motion, options.sensors, noise)
        write_fields(partial, spec, [name for name, _, _ in trials if name.rsplit("_", 1)[0] in options.held_out])
        truth = {"vehicle": options.vehicle, "effects": " ".join(options.effects), "seed": options.seed}
        save_vehicle(partial / "vehicle.toml", spec, params, provenance=truth)
    return options.out


def _check(options: DriveOptions, names: tuple[str, ...]) -> None:
    if not names:
        raise OptionError("--manoeuvre: none is given. Name one, or leave the option out for figure_eight.")
    if len(set(names)) != len(names):
        raise ValueError(f"--manoeuvre {' '.join(names)}: one is given twice. Repeat a drive with --replicates.")
    check_once("--effects", [text.partition(":")[0] for text in options.effects])
    if options.replicates < 1:
        raise ValueError(f"--replicates {options.replicates}: must be at least 1. Leave it out for a single drive.")
    absent = sorted(set(options.held_out) - set(names))
    if absent:
        raise ValueError(f"--held-out {absent[0]}: not among the manoeuvres driven ({', '.join(names)}). Add it there.")
    if options.out.exists():
        raise OptionError(f"--out {options.out}: exists already; a drive never replaces another. Choose a new folder.")
    check_place("--out", options.out)


def drive_and_say(options: DriveOptions) -> None:
    """Drive, and say what to do with the dataset."""
    with Heartbeat() as heartbeat:
        folder = main(options, heartbeat.stage)
    count = len(list((folder / "trials").iterdir()))
    print(f"{folder}: {counted(count, 'trial')}; fit it with python -m sysid.fit {in_shell(folder)} --out RUN")


def cli() -> None:
    """Command line."""
    run(DriveOptions, drive_and_say, __doc__, positional=False)


if __name__ == "__main__":
    cli()

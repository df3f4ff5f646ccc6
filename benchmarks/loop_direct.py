"""The drives of the loop without topics: the same plant, commands and files, in one process and in seconds.

What `benchmarks.loop_drives` records over ROS 2 of the same plant, trial and commands agrees with this to a micrometre:
simulated time waits for its driver, and commands count from their stamps.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from benchmarks.loop_drives import SLEW, Plan, recorded
from benchmarks.plant.base import TICK
from benchmarks.plant.chair import Nominal
from benchmarks.plant.make import Experiment
from benchmarks.plant.make import plan as plan_day
from benchmarks.plant.online import OnlinePlant
from bridge.driving.command_table import PERIOD, CommandTable, make_table, read_commands
from bridge.recording.dataset_file import write_dataset_file
from bridge.recording.trial_writer import TrialWriter

LIMITS = (2.0, 4.0)
"""Of the commands [m/s, rad/s], as those of `bridge.manoeuvre`."""


def drive_directly(
    plans: Sequence[Plan], dataset: Path, effects: Mapping[str, float], seed: int, nominal: Nominal,
    held_out: Sequence[str] = (),
) -> None:
    """Drive and write manoeuvres on the plant of a day; what is there already is left.

    Args:
        plans: what is driven.
        dataset: folder to write into.
        effects: sizes by name that are built into the plant.
        seed: of the day.
        nominal: what `dataset.toml` says of the vehicle.
        held_out: trials that it names as never to be fitted.
    """
    dataset.mkdir(parents=True, exist_ok=True)
    write_dataset_file(dataset, argparse.Namespace(
        vehicle="contact plant", wheel_radius=nominal.radius, track=nominal.track, wheelbase=nominal.wheelbase,
        mass=nominal.mass, v_limit=1.0, omega_limit=1.0, odometry_topic="none", ground_truth_topic="none",
        held_out=list(held_out)))
    plant = OnlinePlant(plan_day(Experiment(effects, seed, 1.0, True))[0])
    limit, steepest = LIMITS, (float(SLEW[0]), float(SLEW[1]))
    for number, one in enumerate(plans):
        table = make_table(read_commands(one.commands), (-limit[0], -limit[1]), limit, steepest, str(one.commands))
        for replicate in range(recorded(dataset, one), one.replicates):
            start = None if one.start is None else (one.start["x"], one.start["y"], one.start["yaw"])
            plant.place(100 * (number + 1) + replicate, start)
            _drive(plant, table, TrialWriter(dataset, f"{one.name}_{replicate + 1}"))


def _drive(plant: OnlinePlant, table: CommandTable, writer: TrialWriter) -> None:
    """Drive a table from the present place, and write what is commanded and reported."""
    for row in range(len(table.v)):
        t, v, omega = row * PERIOD, float(table.v[row]), float(table.omega[row])
        plant.command(t, v, omega)
        plant.advance(round((row + 1) * PERIOD / TICK) - round(t / TICK))
    rows, poses = plant.reports()
    writer.begin(0.0)
    for row in range(len(table.v)):
        writer.command(row * PERIOD, float(table.v[row]), float(table.omega[row]))
    for t, x, y, yaw, v, omega in rows.tolist():
        writer.odometry(t, (x, y, yaw), (v, omega), t)
    for t, x, y, yaw in poses.tolist():
        writer.ground_truth(t, x, y, yaw, t)
    writer.close()


def write_answers(path: Path, effects: Mapping[str, float], seed: int) -> None:
    """Write what was built in, where nothing but the report looks."""
    path.write_text(json.dumps({"effects": dict(effects), "seed": seed}) + "\n")

"""The closed loop on two published measured sets: what it adds to a fitted vehicle, and what it falsely names.

    python -m benchmarks.measured_loop --shared ../shared --parts ladder mrclam

`ladder` (drive_norlab, skid-steered robot): the base model with a turn efficiency is fitted to steps of 6 s on asphalt,
gravel and sand; then the loop names an effect, the vehicle with it is fitted, and the loop goes on from there until it
names none. Each rung is scored on steps that were never fitted, with all parameters refitted, and as `alone` with those
of the named effect alone: the rest is gained by base parameters that moved beside it. `laws` (`measured_laws`): what
each law of skid-steered robots adds to the base, named or not. `peers` (`measured_peers`) says
what models of the commands that know nothing of the vehicle predict of the same steps. `change`: the vehicle of the
asphalt run is the reference, gravel and both sand runs are asked whether the floor is another one. Each third of a run
is then predicted by the reference vehicle with what changed fitted to the other two, and by that vehicle itself.
`floors` asks the same of gyro and wheels without a model, and of halves of one run how often that is false. `halves`
asks the whole loop that of the asphalt run. `mrclam` (five nearly ideal robots): verdicts with the base model's delay
held at 0; one with an effect of another class, or larger than such a robot has, is false.

Writes benchmarks/results/measured.json. Every loop is kept as a file under `out`, and an interrupted run goes on there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from benchmarks.fit_measured import CLAIM, thin
from benchmarks.fit_scores import show
from benchmarks.harness import figure, record
from benchmarks.measured_floors import change, floors, halves
from benchmarks.measured_laws import ablate, make_bench
from benchmarks.measured_peers import KINEMATIC, as_predictions, fit_kinematic, fit_network, fit_published, steps_of
from benchmarks.measured_verdicts import (
    MANY,
    TRAIN,
    Benchmark,
    config_of,
    drive_log,
    errors,
    gained,
    keep,
    kept,
    mean_errors,
    one_loop,
    report,
)  # fmt: skip
from sysid.logs.loaders import split
from sysid.logs.metrics import ideal_replay
from sysid.logs.published.mrclam import load_mrclam
from sysid.logs.records import Log
from sysid.missing.fit_statistics import FittedVehicle
from sysid.replay.models import with_effects
from sysid.verdict.result import LoopConfig
from whill_mjx.io import command_line
from whill_mjx.vehicle.parameters import set_values
from whill_mjx.vehicle.presets import preset_params
from whill_mjx.vehicle.vehicle_file import load_vehicle

TIMES = {"command_delay", "pose_delay", "sensor_delay", "clock_offset", "actuator_lag", "odometry_lag"}
SCALES = {"command_scale", "odometry_scale", "track_width", "turn_efficiency", "wheel_radius_difference"}
DEAD = {"command_dead_zone"}
LONGEST, LARGEST = 0.3, 0.1
"""Delay [s] and share of the speed beyond which a verdict on a nearly ideal robot is false."""


def climb(settings: Benchmark, name: str, log: Log) -> list[dict[str, Any]]:
    """Loops one after the other, each from the vehicle of the one before, until one names nothing."""
    start = with_effects(preset_params(log.spec, "physical"), ("turn_efficiency",))
    loops: list[dict[str, Any]] = []
    for number in range(settings.rounds):
        stem = f"{name}_{number + 1}"
        loops.append(one_loop(settings, stem, log, config_of(settings, start),
                              vehicle=FittedVehicle(start, kept=False)))
        if loops[-1]["verdict"] != "named":
            break
        start = load_vehicle(settings.out / f"{stem}.toml")[1]
    return loops


def of_terrain(trials: list[str], terrain: str) -> list[str]:
    return [name for name in trials if terrain in ("all", *[one for one in TRAIN if one in name])]


def ladder(settings: Benchmark) -> None:
    """Ideal, fitted base, and every vehicle that the loop made of it."""
    loops = climb(settings, "ladder", drive_log(settings, tuple(TRAIN)))
    rungs = {"ideal": loops[0]["ideal"], "base": loops[0]["before"]}
    alone = {}
    for number, loop in enumerate(loops, start=1):
        if loop["verdict"] == "named" or "unnamed" in loop:
            name = "_".join(["with", str(number), *[one["name"] for one in loop["effects"]]])
            rungs[name] = loop["after"]
            if loop["verdict"] == "named":
                alone[name] = loop["before"], loop["alone"]
    figures, trials = {}, list(loops[0]["before"])
    last = list(rungs)[-1]
    for terrain in ("all", *TRAIN):
        mine = of_terrain(trials, terrain)
        for column, (metric, unit) in enumerate((("position", "m"), ("yaw", "rad"))):
            for name, rows in rungs.items():
                value = float(np.mean([rows[trial][column] for trial in mine]))
                figures[f"ladder_{terrain}_{metric}_{name}"] = figure([value], unit)
            figures |= gained(f"ladder_gain_{terrain}_{metric}", mine, rungs["base"], rungs[last], column)
            for name, (before, after) in alone.items():
                figures |= gained(f"ladder_alone_{terrain}_{metric}_{name}", mine, before, after, column)
    figures["drive_gain_over_fitted_base"] = figures["ladder_gain_all_position"]
    show(figures)
    report(loops)
    record("measured", CLAIM, figures, replacing="ladder_")


def laws(settings: Benchmark) -> None:
    """What each law adds to the fitted base model, named or not."""
    log = drive_log(settings, tuple(TRAIN))
    bench = make_bench(log, settings.physics_dt, 7 if settings.quick else 15)

    def found(name: str, compute: Callable[[], dict[str, list[float]]]) -> dict[str, list[float]]:
        done = kept(settings, f"law_{name}")
        return (keep(settings, f"law_{name}", {"errors": compute()}) if done is None else done)["errors"]

    rows = ablate(bench, errors, found)
    figures: dict[str, Any] = {}
    trials = list(rows["base"])
    for name, one in rows.items():
        stem = f"law_{name.replace(' ', '_')}"
        figures |= mean_errors(stem, one)
        if name != "base":
            figures |= gained(f"{stem}_gain", trials, rows["base"], one, 0)
    show(figures)
    record("measured", CLAIM, figures, replacing="law_")


def peers(settings: Benchmark) -> None:
    """What models of the commands alone predict, fitted to all training steps."""
    log = drive_log(replace(settings, windows=MANY), tuple(TRAIN))
    held = log.held_out
    training, judged = (steps_of(trials, log.spec.track) for trials in (log.training, held))
    figures: dict[str, Any] = {}
    base: dict[str, float] = {}
    for count in KINEMATIC:
        base, predicted = fit_kinematic(training, count)
        print(f"{count} numbers: {', '.join(f'{name} {value:.3g}' for name, value in base.items())}", flush=True)
        figures |= mean_errors(f"peer_{count}_numbers", errors(held, as_predictions(held, judged, predicted(judged))))
    published = fit_published(log.training, training)(judged)
    figures |= mean_errors("peer_published", errors(held, as_predictions(held, judged, published)))
    predicted = fit_network(training, base)
    figures |= mean_errors("peer_network", errors(held, as_predictions(held, judged, predicted(judged))))
    figures |= mean_errors("peer_ideal", errors(held, [ideal_replay(trial) for trial in held]))
    show(figures)
    record("measured", CLAIM, figures, replacing="peer_")


def is_false(loop: dict[str, Any], fastest: float) -> bool:
    """Whether a verdict on a nearly ideal robot, whose fastest command is so many m/s, names what it cannot have."""
    for one in loop["effects"]:
        sizes = {name.partition(".")[2]: abs(value[0]) for name, value in one["parameters"].items()}
        if one["name"] in TIMES:  # a cascade is a share
            wrong = max(size for name, size in sizes.items() if name != "cascade") > LONGEST
        elif one["name"] in SCALES:
            wrong = max(min(size, abs(size - 1)) for size in sizes.values()) > LARGEST
        elif one["name"] in DEAD:
            wrong = max(sizes.get("linear", 0.0), sizes.get("wheel", 0.0)) > LARGEST * fastest
        else:
            wrong = True
        if wrong:
            return True
    return False


def mrclam(settings: Benchmark) -> None:
    """Verdicts on five nearly ideal robots: the question is what the model family, without its delay, lacks."""
    false, delays = [], []
    for robot in settings.robots:
        log = load_mrclam(settings.shared / "data" / "measured" / "mrclam", (robot,))
        log = split(log, (f"robot{robot}:0-0.667",), (f"robot{robot}:0.667-1",))
        fastest = max(float(np.abs(trial.command.v).max()) for trial in log.trials)
        start = set_values(preset_params(log.spec, "physical"), ["command_delay.delay"], jnp.zeros(1))
        config = LoopConfig(physics_dt=settings.physics_dt, held=("command_delay.delay",))
        loop = one_loop(settings, f"mrclam_{robot}", thin(log, settings.robot_windows), config, False,
                        vehicle=FittedVehicle(start, kept=False))
        report([loop])
        false.append(float(is_false(loop, fastest)))
        delays.append(float(any(TIMES & {one["name"], *one["class"]} for one in loop["effects"])))
    figures = {"mrclam_false": figure([sum(false)], f"of {len(settings.robots)} robots"),
               "mrclam_delay_found": figure([sum(delays)], f"of {len(settings.robots)} robots")}
    show(figures)
    record("measured", CLAIM, figures)


def main(settings: Benchmark) -> None:
    """Measure the parts whose data is at hand."""
    parts = {"ladder": ladder, "laws": laws, "peers": peers, "floors": floors, "halves": halves,
             "change": change, "mrclam": mrclam}
    for name in settings.parts:
        part, folder = parts[name], "mrclam" if name == "mrclam" else "drive_norlab"
        if not (settings.shared / "data" / "measured" / folder).is_dir():
            print(f"{name}: {settings.shared / 'data' / 'measured' / folder} is not there, left out")
            continue
        part(settings)


if __name__ == "__main__":
    command_line.run(Benchmark, main, __doc__, positional=False)

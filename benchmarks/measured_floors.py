"""Whether the floor of a published run is another one: the parts `floors`, `halves` and `change` of measured_loop."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any

import jax.numpy as jnp
import numpy as np

from benchmarks.fit_measured import CLAIM, thin
from benchmarks.fit_scores import show
from benchmarks.harness import figure, record
from benchmarks.measured_laws import STARTS
from benchmarks.measured_verdicts import MANY, RUNS, TENTHS, Benchmark, errors, gained, keep, kept, one_loop, report
from sysid.logs.floor import BLOCKS, FloorChange, Measured, compared, in_blocks, sums_of
from sysid.logs.metrics import ideal_replay
from sysid.logs.pose_lag import pose_lag
from sysid.logs.published.drive_norlab import load_drive
from sysid.logs.records import Log
from sysid.logs.unusable import lost
from sysid.missing.catalogue import PARAMETER, base_values
from sysid.missing.days import no_wander
from sysid.missing.drives import make_drives
from sysid.missing.fit_statistics import FittedVehicle
from sysid.pages.loop_tables import replay
from sysid.replay.models import with_effects
from sysid.replay.records import FreeVehicle
from sysid.replay.rollout import vehicle_plant
from sysid.verdict.late_pose import yaw_rates
from sysid.verdict.posterior import Thresholds
from sysid.verdict.preparation import reference_for
from sysid.verdict.result import LoopConfig, Prepared, Result
from sysid.verdict.surroundings import floor_change
from sysid.verdict.vehicles import on_other_floor
from whill_mjx.vehicle.config import VehicleConfig
from whill_mjx.vehicle.parameters import set_values
from whill_mjx.vehicle.presets import preset_params

OTHER_RUNS = ("warthog_2023", "husky_steps_000_133")


def floors(settings: Benchmark) -> None:
    """What the gyro and the wheels alone say of the floor: gravel and both sand runs against asphalt, and halves of
    each run against one another, ten cuts in turn (its tenths are consecutive)."""
    folder, alpha = settings.shared / "data" / "measured" / "drive_norlab", Thresholds().alpha
    sums = {run: [one for trial in load_drive(folder, (run,), chained=True).trials if (one := sums_of(trial))]
            for run in (*RUNS, *OTHER_RUNS)}
    asphalt = in_blocks(sums[RUNS[0]])
    figures: dict[str, Any] = {}
    named: list[bool] = []
    for run in RUNS[1:]:
        found = between(asphalt, in_blocks(sums[run]), alpha)
        print(f"{run}: {found.said() or 'the same floor'}; class {', '.join(found.classes)}", flush=True)
        named.append(found.named)
        stem = f"floor_{run.removeprefix('warthog_')}"
        figures[f"{stem}_p"] = figure([found.p], "-")
        for member in found.members:
            key = f"{stem}_{member.quantity.name.replace(' ', '_').replace(chr(39), '')}"
            figures[key] = figure([member.after], member.quantity.unit)
    figures["floor_named"] = figure([float(sum(named))], f"of {len(named)} runs")
    false = {run: 0 for run in sums}
    for run, each in sums.items():
        for cut in range(TENTHS):
            first, other = (in_blocks(half) for half in cut_at(each, cut))
            false[run] += between(first, other, alpha).named
    print(f"halves of one run taken for two floors, of 10: {false}", flush=True)
    figures["floor_false_asphalt"] = figure([float(false[RUNS[0]])], "of 10 halves of the asphalt run")
    figures["floor_false"] = figure([float(sum(false.values()))], f"of {10 * len(false)} halves of {len(false)} runs")
    show(figures)
    record("measured", CLAIM, figures, replacing="floor_")


def cut_at(drives: Sequence[Any], cut: int) -> tuple[list[Any], list[Any]]:
    """Two halves of a run, five consecutive tenths each, the first from tenth `cut` on, the last followed by the
    first."""
    second = (TENTHS * np.arange(len(drives)) // len(drives) - cut) % TENTHS >= TENTHS // 2
    return ([one for one, inside in zip(drives, second, strict=True) if not inside],
            [one for one, inside in zip(drives, second, strict=True) if inside])


def halves(settings: Benchmark) -> None:
    """What the whole loop names in one half of the asphalt run against the other, of which nothing differs."""
    log = run_log(replace(settings, windows=MANY), RUNS[0])
    loops = []
    for cut in settings.cuts:
        first, other = (replace(log, trials=tuple(half)) for half in cut_at(log.trials, cut))
        given = {"references": (first,), "vehicle": FittedVehicle(floor_start(settings, first), kept=False)}
        loops.append(one_loop(settings, f"half_{cut}", other, change_config(settings), False, **given))
    report(loops)
    named = [loop["verdict"] == "named" or bool(loop["floor"] and loop["floor"]["name"]) for loop in loops]
    figures = {"half_false": figure([float(sum(named))], f"of {len(named)} halves of the asphalt run"),
               "half_unexplained": figure([float(sum(loop["verdict"] == "unexplained" for loop in loops))],
                                          f"of {len(named)} halves of the asphalt run"),
               "half_cuts": figure([float(len(named))], "halves of the asphalt run")}
    show(figures)
    record("measured", CLAIM, figures)


def between(theirs: Measured | None, mine: Measured | None, alpha: float) -> FloorChange:
    """The change of floor from one set of blocks to another."""
    assert theirs is not None and mine is not None
    found = compared(theirs, mine, 2 * (BLOCKS - 1), alpha)
    assert found is not None
    return found


def asphalt_vehicle(settings: Benchmark) -> Prepared:
    """The vehicle of the asphalt run, whose blocks show how far it wanders, ready for the other runs; without effects
    to look for."""
    config, asphalt = change_config(settings), run_log(settings, RUNS[0])
    reference = reference_for(asphalt, (asphalt,), config, FittedVehicle(floor_start(settings, asphalt), kept=False),
                              lambda _, text: print(f"  {text}", flush=True))
    plant, vehicle = vehicle_plant(asphalt.spec, VehicleConfig(physics_dt=config.physics_dt)), reference.params
    names = tuple(base_values(vehicle))
    drives = make_drives(FreeVehicle(plant, vehicle, names), asphalt.training, reference.width, gyro=reference.gyro)
    return Prepared(reference, plant, (), vehicle, names, drives.paths, no_wander(()))


def change_config(settings: Benchmark) -> LoopConfig:
    """The delay of the outside pose is held: the gyro determines it."""
    return LoopConfig(physics_dt=settings.physics_dt, quick=settings.quick, held=(PARAMETER,))


def floor_start(settings: Benchmark, log: Log) -> Any:
    """The base model with what turns a skid-steered robot, how late, and how late its outside pose is."""
    start = with_effects(preset_params(log.spec, "physical"), settings.floor_model)
    begun = {f"{law}.{field}": value for law in settings.floor_model for field, value in STARTS.get(law, {}).items()}
    trials = log.training
    lag = pose_lag(trials, [part.tolist() for part in np.array_split(np.arange(len(trials)), 8)], yaw_rates(log))
    begun[PARAMETER] = 0.0 if lag is None else lag.delay
    return set_values(start, list(begun), jnp.array(list(begun.values())))


def one_change(settings: Benchmark, name: str, run: str, ready: Callable[[], Prepared]) -> dict[str, Any]:
    """What changed from the reference to a run, with the errors of the reference vehicle, and of it on the other floor,
    in each third of the run that was held back."""
    done = kept(settings, name)
    if done is not None:
        return done
    vehicle = ready()
    floor = floor_change(vehicle.reference, run_log(settings, run).training, Thresholds().alpha)
    assert floor is not None
    found: dict[str, Any] = {"verdict": "named" if floor.named else "none", "reason": floor.said(), "p_value": floor.p,
                             "effects": [], "floor": floor.report(), "ideal": {}, "before": {}, "after": {}}
    for third in range(3):
        log: Any = run_log(settings, run, third)
        none: Any = None
        fold = Result(log, (), change_config(settings), vehicle, none, none, {}, floor=floor)
        held = log.held_out
        found["ideal"] |= errors(held, [ideal_replay(trial) for trial in held])
        for which, params in (("before", vehicle.reference.params), ("after", on_other_floor(fold))):
            found[which] |= errors(held, replay(fold, params, held))
    return keep(settings, name, found)


def change(settings: Benchmark) -> None:
    """What changed from asphalt to gravel and to the two sand runs."""
    ready = lru_cache(maxsize=1)(partial(asphalt_vehicle, settings))
    figures: dict[str, Any] = {}
    named = 0
    for name in ("warthog_gravel", "warthog_sand_1", "warthog_sand_2"):
        loop = one_change(settings, f"from_asphalt_to_{name}", name, ready)
        report([loop])
        trials, short = list(loop["before"]), name.removeprefix("warthog_")
        for column, (metric, unit) in enumerate((("position", "m"), ("yaw", "rad"))):
            stem = f"changed_{short}_{metric}"
            for which in ("ideal", "before", "after"):
                value = float(np.mean([row[column] for row in loop[which].values()]))
                figures[f"{stem}_{which}"] = figure([value], unit)
            figures |= gained(f"{stem}_gain", trials, loop["before"], loop["after"], column)
        sure = figures[f"changed_{short}_position_gain_low"]["value"] > 0
        named += bool(loop["floor"] and loop["floor"]["name"]) and sure
    figures["changed_named"] = figure([float(named)], "of 3 runs")
    show(figures)
    record("measured", CLAIM, figures, replacing="changed_")


def run_log(settings: Benchmark, run: str, held_out: int | None = None) -> Log:
    """Steps of one run, one of its thirds held out or none. Training ones whose outside pose was lost keep their gyro
    and wheels, which show the floor."""
    log = load_drive(settings.shared / "data" / "measured" / "drive_norlab", (run,), chained=True)
    third, gone = 3 * np.arange(len(log.trials)) // len(log.trials), lost(log)
    trials = tuple(
        replace(trial, held_out=bool(k == held_out),
                ground_truth=None if trial.name in gone and k != held_out else trial.ground_truth)
        for trial, k in zip(log.trials, third, strict=True))
    return thin(replace(log, trials=trials), settings.windows)

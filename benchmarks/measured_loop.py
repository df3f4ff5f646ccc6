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

import json
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Annotated, Any, Literal

import jax.numpy as jnp
import numpy as np

from benchmarks.fit_measured import CLAIM, thin
from benchmarks.fit_scores import show
from benchmarks.harness import figure, record
from benchmarks.measured_laws import STARTS, ablate, make_bench
from benchmarks.measured_peers import KINEMATIC, as_predictions, fit_kinematic, fit_network, fit_published, steps_of
from sysid.follow_up.unnamed import find_unnamed, replay_unnamed
from sysid.logs.floor import BLOCKS, FloorChange, Measured, compared, in_blocks, sums_of
from sysid.logs.measured import load_drive, load_mrclam, split
from sysid.logs.metrics import ideal_replay, score
from sysid.logs.pose_lag import pose_lag
from sysid.logs.records import Log, Prediction, Trial
from sysid.logs.unusable import lost, without_lost
from sysid.missing.catalogue import PARAMETER, base_values
from sysid.missing.days import no_wander
from sysid.missing.drives import make_drives
from sysid.missing.fit_statistics import FittedVehicle
from sysid.pages.loop_report import base_table, effects, replay
from sysid.replay.models import with_effects
from sysid.replay.records import FreeVehicle
from sysid.replay.rollout import vehicle_plant
from sysid.verdict.floor import floor_change
from sysid.verdict.late_pose import NAME, yaw_rates
from sysid.verdict.pipeline import find_missing
from sysid.verdict.posterior import Thresholds
from sysid.verdict.preparation import reference_for
from sysid.verdict.result import LoopConfig, Prepared, Result
from sysid.verdict.vehicles import fitted_after, fitted_before, named_alone, on_other_floor, refit_poses
from whill_mjx.io import command_line
from whill_mjx.io.command_line import COUNT, NOT_NEGATIVE
from whill_mjx.vehicle.config import VehicleConfig
from whill_mjx.vehicle.parameters import set_values
from whill_mjx.vehicle.presets import preset_params
from whill_mjx.vehicle.vehicle_file import load_vehicle, save_vehicle

RUNS = ("warthog_asphalt_a", "warthog_gravel", "warthog_sand_1", "warthog_sand_2")
TRAIN = {"asphalt": "warthog_asphalt_a:0-0.667", "gravel": "warthog_gravel:0-0.667", "sand": "warthog_sand_1"}
HELD_OUT = {"asphalt": "warthog_asphalt_a:0.667-1", "gravel": "warthog_gravel:0.667-1", "sand": "warthog_sand_2"}
OTHER_RUNS = ("warthog_2023", "husky_steps_000_133")
TENTHS = 10
BLOCK = 5  # steps that follow one another and are drawn together
DRAWS = 4000
MANY = 10**6  # steps: all
TIMES = {"command_delay", "pose_delay", "sensor_delay", "clock_offset", "actuator_lag", "odometry_lag"}
SCALES = {"command_scale", "odometry_scale", "track_width", "turn_efficiency", "wheel_radius_difference"}
DEAD = {"command_dead_zone"}
LAWS = {"motor_line", "turn_lag", "turn_efficiency_speed", "turning_slip", "side_slip"}
LONGEST, LARGEST = 0.3, 0.1
"""Delay [s] and share of the speed beyond which a verdict on a nearly ideal robot is false."""


@dataclass(frozen=True)
class Benchmark:
    """What to measure."""

    shared: Path = Path(os.environ.get("WHILL_SHARED", Path(__file__).parents[2] / "shared"))
    """Folder that holds data/measured."""
    parts: tuple[Literal["ladder", "laws", "peers", "floors", "halves", "change", "mrclam"], ...] = (
        "ladder", "laws", "peers", "floors", "halves", "change", "mrclam")
    out: Path = Path("runs/measured_loop")
    """Folder that keeps each loop."""
    windows: Annotated[int, COUNT] = 96
    """Training steps of drive_norlab, spread evenly over each terrain; all held-out ones are scored."""
    robots: tuple[Literal[1, 2, 3, 4, 5], ...] = (1, 2, 3, 4, 5)
    """Robots of mrclam."""
    robot_windows: Annotated[int, COUNT] = MANY
    """Windows of 15 s of each of them."""
    cuts: tuple[int, ...] = tuple(range(TENTHS))
    """Cuts of the asphalt run into halves: each begins at one of its tenths."""
    rounds: Annotated[int, COUNT] = 5
    """Loops at most, one after the other."""
    floor_model: tuple[str, ...] = ("turn_efficiency", "turn_lag", "acceleration_limit", "pose_delay")
    """Effects that the base model of `change` has besides the physical preset."""
    physics_dt: Annotated[float, NOT_NEGATIVE] = 0.01
    """Physics step [s]."""
    quick: bool = False
    """Loops of `change` with fewer iterations and nulls."""


def drive_log(settings: Benchmark, terrains: tuple[str, ...]) -> Log:
    """Steps of 6 s; training ones without those whose outside pose was lost, and thinned."""
    log = load_drive(settings.shared / "data" / "measured" / "drive_norlab", RUNS, chained=True)
    log = split(log, tuple(TRAIN[name] for name in terrains), tuple(HELD_OUT[name] for name in terrains))
    return thin(without_lost(log), settings.windows)


def errors(trials: tuple[Trial, ...], seen: list[Prediction]) -> dict[str, list[float]]:
    """Trial -> RMSE of the outside position [m] and yaw [rad]."""
    found = {}
    for trial, one in zip(trials, seen, strict=True):
        mine = score(trial, one)["ground_truth"]
        assert mine.trajectory is not None and mine.yaw is not None
        found[trial.name] = [mine.trajectory, mine.yaw]
    return found


def kept(settings: Benchmark, name: str) -> dict[str, Any] | None:
    """What an earlier run left of a loop."""
    path = settings.out / f"{name}.json"
    return json.loads(path.read_text()) if path.exists() else None


def keep(settings: Benchmark, name: str, found: dict[str, Any]) -> dict[str, Any]:
    """Write what a loop found, whole or not at all."""
    settings.out.mkdir(parents=True, exist_ok=True)
    temporary = settings.out / f"{name}.tmp"
    temporary.write_text(json.dumps(found, indent=1) + "\n")
    os.replace(temporary, settings.out / f"{name}.json")
    return found


def verdict_of(result: Result) -> dict[str, Any]:
    """Verdict, reason, and effects with class and values."""
    found = result.search
    named = effects(result) if found.verdict == "named" else []
    late = [one.p for one in found.accepted if one.hypothesis.effect == NAME]  # has a test of its own
    return {"verdict": found.verdict, "reason": found.reason, "p_value": (late or [found.p_value])[0], "effects": [
        {"name": one["name"], "class": one["class"],
         "parameters": {name: [value["value"], *value["interval"]] for name, value in one["parameters"].items()}}
        for one in named], "seconds": result.seconds, "scan": scanned(result),
        "floor": None if result.floor is None else result.floor.report()}


def scanned(result: Result) -> dict[str, list[float]]:
    """Of each law of skid-steered robots its gain, its worth beside what days differ by, and its p-value in the scan;
    after a refit, its gain and p-value."""
    scan, out = result.search.scan, {}
    for number, one in enumerate(result.hypotheses):
        if one.effect in LAWS:
            out[one.key] = [float(scan.gain[number]), float(scan.worth[number]), float(scan.p[number])]
    for round_number, candidates in enumerate(result.search.rounds, start=1):
        out |= {f"{one.hypothesis.key}, refit {round_number}": [one.gain, one.p] for one in candidates}
    return out


def one_loop(
    settings: Benchmark, name: str, log: Log, config: LoopConfig, scored: bool = True, **given: Any
) -> dict[str, Any]:
    """One loop, or what was kept of it; if `scored` with the held-out errors of the fitted base and of what follows."""
    done = kept(settings, name)
    if done is not None:
        return done
    result = find_missing(log, config=config, progress=lambda _, text: print(f"  {name}: {text}", flush=True), **given)
    found = verdict_of(result)
    if not scored:
        return keep(settings, name, found)
    held = log.held_out
    # As often as what comes after, so that this is no reason to be better.
    before = refit_poses(result, fitted_before(result))
    after = refit_poses(result, fitted_after(result)) if found["verdict"] == "named" else before
    alone = named_alone(result, before)
    found["base"] = base_table(result)
    found["ideal"] = errors(held, [ideal_replay(trial) for trial in held])
    found["before"], found["alone"], found["after"] = (
        errors(held, replay(result, one, held)) for one in (before, alone, after))
    wrench = find_unnamed(result)
    if wrench is not None and wrench.kept:
        found["unnamed"] = wrench.table.quantity
        found["after"] = errors(held, replay_unnamed(result, wrench, held))
    save_vehicle(settings.out / f"{name}.toml", log.spec, after)
    return keep(settings, name, found)


def config_of(settings: Benchmark, vehicle: Any) -> LoopConfig:
    """A delay of the outside pose that was named is held: the gyro determines it, not the base model."""
    held = (PARAMETER,) if any(effect.name == NAME for effect in vehicle.effects) else ()
    return LoopConfig(physics_dt=settings.physics_dt, held=held)


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


def interval(trials: list[str], before: dict[str, list[float]], after: dict[str, list[float]], column: int
             ) -> tuple[float, float, float]:
    """Share of the mean RMSE removed, and its 95 % interval from blocks of steps that are drawn anew, in pairs."""
    pairs = np.array([[before[name][column], after[name][column]] for name in trials])
    runs = [name.split("/")[0] for name in trials]
    blocks: list[list[int]] = []
    for i, run in enumerate(runs):
        if blocks and runs[blocks[-1][0]] == run and len(blocks[-1]) < BLOCK:
            blocks[-1].append(i)
        else:
            blocks.append([i])
    rng = np.random.default_rng(0)
    sums = np.array([pairs[block].sum(0) for block in blocks])
    drawn = sums[rng.integers(0, len(blocks), (DRAWS, len(blocks)))].sum(1)
    low, high = np.quantile(1 - drawn[:, 1] / drawn[:, 0], [0.025, 0.975])
    total = pairs.sum(0)
    return float(1 - total[1] / total[0]), float(low), float(high)


def gained(
    stem: str, trials: list[str], before: dict[str, list[float]], after: dict[str, list[float]], column: int
) -> dict[str, dict[str, Any]]:
    """Figures of the share of the error removed, with its interval."""
    share, low, high = interval(trials, before, after, column)
    return {stem: figure([share], "share"), f"{stem}_low": figure([low], "share"),
            f"{stem}_high": figure([high], "share")}


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


def mean_errors(stem: str, rows: dict[str, list[float]]) -> dict[str, Any]:
    """Figures of the mean errors of position and yaw."""
    position, yaw = np.mean(list(rows.values()), axis=0).tolist()
    return {f"{stem}_position": figure([position], "m"), f"{stem}_yaw": figure([yaw], "rad")}


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


def report(loops: list[dict[str, Any]]) -> None:
    """Verdicts in words."""
    for loop in loops:
        print(f"{loop['verdict']} (p {loop['p_value']:.2g}): {loop['reason']}", flush=True)
        for one in loop["effects"]:
            print(f"  {one['name']} {one['parameters']}, class {', '.join(one['class'])}", flush=True)
        if loop.get("floor"):
            print(f"  floor: {loop['floor']}", flush=True)


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

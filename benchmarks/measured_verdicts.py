"""The loops of `benchmarks.measured_loop`: their options, logs, verdicts and errors, each kept as a file."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from benchmarks.fit_measured import thin
from benchmarks.harness import figure
from sysid.follow_up.unnamed import find_unnamed, replay_unnamed
from sysid.logs.loaders import split
from sysid.logs.metrics import ideal_replay, score
from sysid.logs.published.drive_norlab import load_drive
from sysid.logs.records import Log, Prediction, Trial
from sysid.logs.unusable import without_lost
from sysid.missing.catalogue import PARAMETER
from sysid.pages.loop_report import effects
from sysid.pages.loop_tables import base_table, replay
from sysid.verdict.late_pose import NAME
from sysid.verdict.pipeline import find_missing
from sysid.verdict.result import LoopConfig, Result
from sysid.verdict.vehicles import fitted_after, fitted_before, named_alone, refit_poses
from whill_mjx.io.command_line import COUNT, NOT_NEGATIVE
from whill_mjx.vehicle.vehicle_file import save_vehicle

RUNS = ("warthog_asphalt_a", "warthog_gravel", "warthog_sand_1", "warthog_sand_2")
TRAIN = {"asphalt": "warthog_asphalt_a:0-0.667", "gravel": "warthog_gravel:0-0.667", "sand": "warthog_sand_1"}
HELD_OUT = {"asphalt": "warthog_asphalt_a:0.667-1", "gravel": "warthog_gravel:0.667-1", "sand": "warthog_sand_2"}
TENTHS = 10
BLOCK = 5  # steps that follow one another and are drawn together
DRAWS = 4000
MANY = 10**6  # steps: all
LAWS = {"motor_line", "turn_lag", "turn_efficiency_speed", "turning_slip", "side_slip"}


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
        assert mine["trajectory"] is not None and mine["yaw"] is not None
        found[trial.name] = [mine["trajectory"], mine["yaw"]]
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


def mean_errors(stem: str, rows: dict[str, list[float]]) -> dict[str, Any]:
    """Figures of the mean errors of position and yaw."""
    position, yaw = np.mean(list(rows.values()), axis=0).tolist()
    return {f"{stem}_position": figure([position], "m"), f"{stem}_yaw": figure([yaw], "rad")}


def report(loops: list[dict[str, Any]]) -> None:
    """Verdicts in words."""
    for loop in loops:
        print(f"{loop['verdict']} (p {loop['p_value']:.2g}): {loop['reason']}", flush=True)
        for one in loop["effects"]:
            print(f"  {one['name']} {one['parameters']}, class {', '.join(one['class'])}", flush=True)
        if loop.get("floor"):
            print(f"  floor: {loop['floor']}", flush=True)

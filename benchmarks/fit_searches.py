"""Searches of the fit, split into jobs: starts that agree, TPE in batches against one by one, and the curves of all.

Every job finds its log by itself: `planted` is driven by the model with the preset's values, other logs are folders.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.fit_jobs import RememberedCosts, reporter, staged
from benchmarks.harness import figure
from sysid.errors.bin_objective import make_features_objective
from sysid.errors.pose_objective import HUGE, Objective
from sysid.logs.log import load_log
from sysid.logs.records import Log
from sysid.search import least_squares, starts, studies
from sysid.search.comparison import Effort, Judge, arrivals, trace
from sysid.search.fitting import Problem, choose
from sysid.search.result import Stages, Trace
from sysid.search.settings import FEATURE_ITERATIONS, FitConfig
from sysid.search.studies import BATCH
from sysid.search.valleys import from_all, gradient_search
from sysid.searches import write

STARTS = 32
SAME = 0.01
"""Starts end at the same optimum where their costs are within this share of the best one's."""
LOCKSTEP = 4
"""Searches of one candidate at a time that share a replay: as many sets as it has rows on a processor."""
CLOSE = 0.05  # by which J of the search in batches may lie above that of the search one by one


def short_log(log: Log, count: int) -> Log:
    """The log with its first `count` training trials; held-out ones are kept."""
    kept = {trial.name for trial in log.training[:count]}
    return log.select(lambda trial: trial.held_out or trial.name in kept)


def find_log(name: str, shared: Path, trials: int = 18) -> Log:
    """`planted`, `plant` (the shared plain chair) or a folder; of the latter two at most `trials` are fitted."""
    if name != "planted":
        return short_log(load_log(shared / "data" / "plant" / "plain" if name == "plant" else Path(name)), trials)
    from benchmarks.planted_logs import fitted_plant, write_dataset
    from whill_mjx.vehicle.presets import preset_params
    from whill_mjx.vehicle.specs import WHILL_CR

    with tempfile.TemporaryDirectory() as folder:
        return load_log(write_dataset(Path(folder) / "planted", WHILL_CR, preset_params(WHILL_CR, "physical"),
                                      plant=fitted_plant(WHILL_CR)))


def compile_replay(objective: Objective) -> None:
    """Compile what the searches replay: sets at once, and one derivative."""
    point = objective.space.to_unit(objective.space.initial)[None]
    objective.residuals(np.tile(point, (LOCKSTEP, 1)))
    objective.jacobian(point)


def start_job(
    problem: Problem, track: float, index: int, iterations: int, folder: Path, seed: int = 0
) -> dict[str, Any]:
    """The default search from one of STARTS starts: features, then poses with the delays profiled.

    Start 0 has the initial values; the others are drawn over the whole range of every parameter
    (`sysid.search.starts.draw`).

    Args:
        folder: for what each of its three stages gave.
    """
    label = f"start_{index:02d}"
    report = reporter(label)

    def timed(stage: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        began = time.perf_counter()
        return {**stage(), "seconds": time.perf_counter() - began}

    def draw() -> dict[str, Any]:
        return {"u": starts.draw(problem.objective, [index], track, seed, progress=report)[0].tolist()}

    def features() -> dict[str, Any]:
        found = starts.fit(problem.objective, np.array([drawn["u"]]), track, FEATURE_ITERATIONS, report)
        return {"u": found.u.tolist(), "cost": found.cost, "evaluations": found.evaluations}

    def whitened() -> dict[str, Any]:
        stages = Stages(report, 3)
        objective = choose(problem.objective, np.array(coarse["u"]), track, FitConfig(), stages)
        at = np.array([coarse["u"]])
        found, _, _ = gradient_search(objective, at, iterations, FitConfig(), stages)
        return {"u": found.u.tolist(), "cost": found.cost, "evaluations": found.evaluations}

    drawn = staged(folder / f"{label}_drawn.json", lambda: timed(draw))
    coarse = staged(folder / f"{label}_features.json", lambda: timed(features))
    fine = timed(whitened)
    return {"cost": fine["cost"], "coarse_cost": coarse["cost"], "u": fine["u"], "start": drawn["u"],
            "names": list(problem.space.names), "evaluations": coarse["evaluations"] + fine["evaluations"],
            "seconds": sum(one["seconds"] for one in (drawn, coarse, fine))}


def common_costs(problem: Problem, track: float, ends: np.ndarray) -> np.ndarray:
    """Costs (S,) of where searches ended (S, P), all in the noise that the best of them leaves.

    Motion in bins is weighed by the noise of each search's own end, in which any end costs about 1.
    """
    best = -1
    bins = make_features_objective(problem.objective, track)
    costs = np.zeros(len(ends))
    for _ in range(len(ends)):
        before, best = best, int(costs.argmin())
        if best == before:
            break
        costs = least_squares.costs_of(bins.renewed(ends[best]), ends, robust=True)
    return costs


def summarise_starts(results: Sequence[Mapping[str, Any]], prefix: str) -> dict[str, dict[str, Any]]:
    """How many starts end within SAME of the best cost, and within ten times that."""
    costs = np.array([one["cost"] for one in results])
    best = costs.min()
    return {f"{prefix}starts_agreeing_of_32": figure([float((costs <= best * (1 + SAME)).sum())], "count"),
            f"{prefix}starts_within_10_percent_of_32": figure([float((costs <= best * (1 + 10 * SAME)).sum())],
                                                              "count"),
            f"{prefix}starts_counted": figure([float(len(costs))], "count"),
            f"{prefix}seconds_of_a_start": figure([float(one["seconds"]) for one in results], "s")}


def tpe_batched(problem: Problem, evaluations: int, seed: int, kept: Path) -> dict[str, Any]:
    """J and seconds of TPE in batches; the replay is compiled before the clock starts.

    Args:
        kept: file for the costs so far.
    """
    objective, space = problem.objective, problem.space
    objective.paper_cost(np.tile(space.to_unit(space.initial), (BATCH["tpe"], 1)))
    costs: Any = RememberedCosts(objective, kept)
    search = studies.GlobalSearch(evaluations, seed, "paper")
    found = studies.global_search(costs, space, search, progress=reporter(kept.stem))
    return {"cost": found.cost, "seconds": costs.seconds}


def tpe_sequential(problem: Problem, evaluations: int, seeds: Sequence[int], kept: Path) -> list[dict[str, Any]]:
    """J of Optuna's TPE asked one candidate at a time, as the paper's search was; all seeds advance together.

    Args:
        kept: file for the costs so far.
    """
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    space, report = problem.space, reporter(kept.stem)
    costs = RememberedCosts(problem.objective, kept)
    distributions: Any = {name: optuna.distributions.FloatDistribution(0.0, 1.0) for name in space.names}
    studies = [optuna.create_study(sampler=optuna.samplers.TPESampler(seed=seed)) for seed in seeds]
    initial = dict(zip(space.names, space.to_unit(space.initial).tolist(), strict=True))
    for study in studies:
        study.enqueue_trial(initial)
    for _ in range(evaluations):
        asked = [study.ask(distributions) for study in studies]
        u = np.array([[trial.params[name] for name in space.names] for trial in asked])
        for study, trial, cost in zip(studies, asked, costs.paper_cost(u), strict=True):
            study.tell(trial, float(min(cost, HUGE)))
        report(1, f"best J {min(study.best_value for study in studies):.4g}")
    return [{"cost": float(study.best_value)} for study in studies]


def summarise_tpe(
    batched: Sequence[Mapping[str, Any]], sequential: Sequence[Mapping[str, Any]], platform: str
) -> dict[str, dict[str, Any]]:
    """Seconds of the searches in batches on a platform (cpu, gpu), and their J over that of the others."""
    figures = {}
    if batched:
        figures[f"tpe500_{platform}_seconds"] = figure([float(one["seconds"]) for one in batched], "s")
        figures["tpe500_j"] = figure([float(one["cost"]) for one in batched], "m, sum over trials")
    if sequential:
        figures["tpe500_j_sequential"] = figure([float(one["cost"]) for one in sequential], "m, sum over trials")
    if batched and sequential:
        ratio = figures["tpe500_j"]["value"] / figures["tpe500_j_sequential"]["value"]
        figures["tpe500_j_over_sequential"] = figures[f"tpe500_{platform}_j_over_sequential"] = figure([ratio], "-")
        figures["tpe500_within_5_percent"] = figure([float(ratio <= 1 + CLOSE)], "1 is yes")
    return figures


def many_starts(problem: Problem, track: float, count: int, iterations: int, whole: bool = True) -> dict[str, Any]:
    """Costs and seconds of `count` starts at once, each drawn, fitted to features, and then to what the default search
    ends on; if `whole` also of that search as a whole, which goes on from the best of them and looks elsewhere."""
    report, began = reporter(f"{count} starts"), time.perf_counter()
    starts.compile_ahead(problem.objective, track)
    points = starts.draw(problem.objective, range(count), track, 0, progress=report)
    drawn = time.perf_counter()
    coarse = starts.fit(problem.objective, points, track, FEATURE_ITERATIONS, report)
    fitted = time.perf_counter()
    stages = Stages(report, 3)
    objective = choose(problem.objective, coarse.u, track, FitConfig(), stages)
    ends = np.concatenate([coarse.u[None], coarse.starts[1:]])
    fine = from_all(objective, ends, iterations, robust=True, progress=report)
    seconds = time.perf_counter() - began
    done = {"cost": fine.cost, "costs": fine.start_costs.tolist(), "evaluations": coarse.evaluations + fine.evaluations,
            "seconds": seconds, "seconds_draw": drawn - began, "seconds_features": fitted - drawn}
    if not whole:
        return done
    found, _, _ = gradient_search(objective, fine.u[None], iterations, FitConfig(), stages)
    return {**done, "whole": time.perf_counter() - began, "whole_cost": found.cost}


def many_stem(platform: str) -> str:
    """What names of figures of `many_starts` on a platform (cpu, gpu) begin with."""
    return "gpu_seconds" if platform == "gpu" else "cpu_seconds_32_starts"


def summarise_many(results: Sequence[Mapping[str, Any]], platform: str) -> dict[str, dict[str, Any]]:
    """Seconds of the timed searches, by how much more the first one of the process took (its compilation), and how many
    starts come within SAME of what the whole search finds."""
    stem = many_stem(platform)
    seconds = [float(one["seconds"]) for one in results]
    compiling = [float(one["first"]) - float(np.median(seconds)) for one in results]
    figures = {stem: figure(seconds, "s"), f"{stem}_compile": figure(compiling, "s")}
    results = [one for one in results if "whole" in one]
    if results:
        arrived = [float((np.array(one["costs"]) <= one["whole_cost"] * (1 + SAME)).sum()) for one in results]
        figures |= {
            f"{stem}_whole": figure([float(one["whole"]) for one in results], "s, other valleys looked for as well"),
            f"{stem}_arrived": figure(arrived, f"of {len(results[0]['costs'])} starts before that")}
    return figures


def curve_job(problem: Problem, judge: Judge, method: str, seed: int, effort: Effort) -> dict[str, Any]:
    """One search of `sysid.searches` and its best point so far."""
    one = trace(problem, judge, method, seed, effort, reporter(f"{method}_{seed:02d}"))
    return {"trace": {name: value.tolist() if isinstance(value, np.ndarray) else value
                      for name, value in asdict(one).items()}, "names": list(problem.space.names)}


def write_curves(out: Path, log: Log, results: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Page, picture and table of all curves; figures: final cost, and effort to come near the best of all."""
    traces = [_trace(one["trace"]) for one in results]
    traces.sort(key=lambda one: (one.method, one.seed))
    write(out, log, traces, results[0]["names"])
    figures = {}
    for row in arrivals(traces):
        stem = f"search_{row['method']}"
        figures[f"{stem}_arrived"] = figure([row["arrived"] / row["runs"]], "share")
        figures[f"{stem}_cost"] = figure([row["cost"]], "mean square, noise scales")
        for name, unit in (("evaluations", "count"), ("seconds", "s"), ("held_out", "m")):
            if row[name] is not None:
                figures[f"{stem}_{name}"] = figure([row[name]], unit)
    return figures


def _trace(kept: dict[str, Any]) -> Trace:
    values: dict[str, Any] = {name: np.array(one) if isinstance(one, list) else one for name, one in kept.items()}
    return Trace(**values)

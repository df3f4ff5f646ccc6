"""Compares the searches of a fit: error against simulator evaluations and against time.

    python -m sysid.searches DATASET --methods features lm both tpe cmaes --seeds 0 1 2 --out RUN

writes RUN/searches.json, RUN/searches.png and the page RUN/searches.html. All searches minimise the same weighted least
squares of the training trials (`features` begins with motion in short bins). Every replay that a search asks for is
recorded with the parameter sets in it and the time until its answer; a derivative counts as one evaluation per
parameter and one for the point. Compilation is done before the clock starts, and what the record itself costs is not
counted. The error is that of the best point so far: its cost on the training trials, and its position error on the
held-out ones, replayed when the search is over.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from sysid import command_line
from sysid.errors.pose_objective import Objective, Replays
from sysid.fit import FitConfig, Problem, make_problem
from sysid.logs.log import Log
from sysid.logs.measured import load_any
from sysid.logs.metrics import score
from sysid.pages.html import Section, html_page, paragraph, png, table
from sysid.pages.plots import write_search_plot
from sysid.replay.models import make_replay
from sysid.replay.rollout import Simulated, predictions
from sysid.report import code_hashes, write_report
from sysid.search import least_squares, starts, tpe
from sysid.search.result import Progress
from sysid.search.studies import BATCH
from sysid.search.valleys import gradient_search

KIND = "sysid-searches"
METHODS = ("features", "lm", "both", "tpe", "cmaes")
NEAR = 0.05
"""A search has arrived when its cost is within this share of the best one that any of them found."""


@dataclass(frozen=True)
class Trace:
    """Best point so far of one search, whenever it got better, and at its end."""

    method: str
    seed: int
    evaluations: np.ndarray  # (K,) parameter sets simulated until then
    seconds: np.ndarray  # (K,)
    cost: np.ndarray  # (K,) mean squared residual in noise scales
    u: np.ndarray  # (K, P)
    held_out: np.ndarray  # (K,) mean position RMSE on held-out trials [m]; nan without any


class Recorder:
    """A replay that keeps what was asked of it."""

    def __init__(self, replay: Replays, objective: Objective):
        self._replay, self._objective = replay, objective
        self._began = time.perf_counter()
        self._spent = 0.0  # s of recording
        self.evaluations = 0
        self.seconds = 0.0
        self.best: list[tuple[int, float, float, np.ndarray]] = []

    def simulate(self, values: np.ndarray) -> Simulated:
        """As that of the replay."""
        found = self._replay.simulate(values)
        self._record(values, found, len(values))
        return found

    def jacobian(self, values: np.ndarray) -> tuple[Simulated, Simulated]:
        """As that of the replay, by central differences: each parameter takes two more sets."""
        found = self._replay.jacobian(values)
        self._record(values, found[0], len(values) * (1 + 2 * values.shape[1]))
        return found

    def _record(self, values: np.ndarray, found: Simulated, evaluations: int) -> None:
        now = time.perf_counter()
        self.evaluations += evaluations
        self.seconds = now - self._began - self._spent
        space = self._objective.space
        cost = self._objective.weighted_cost(space.to_unit(values), found)
        n = int(cost.argmin())
        if not self.best or cost[n] < self.best[-1][2]:
            self.best.append((self.evaluations, self.seconds, float(cost[n]), space.to_unit(values[n])))
        self._spent += time.perf_counter() - now


def trace(
    problem: Problem, judge: Judge, track: float, method: str, seed: int, *, evaluations: int = 256,
    iterations: int = 20, start_count: int = 4, progress: Progress | None = None,
) -> Trace:
    """Run one search and follow its best point.

    Args:
        track: of the vehicle [m] (`sysid.search.starts`).
        evaluations: of the global searches.
        iterations: of the gradient searches.
        start_count: starts of the gradient searches: the initial values, and random ones.
    """
    if method not in METHODS:
        raise ValueError(f"no search {method!r} (known: {', '.join(METHODS)}).")
    objective, space = problem.objective, problem.space
    _compile(objective, method, start_count)
    recorder = Recorder(objective.replay, objective)
    watched = replace(objective, replay=recorder)
    points = least_squares.random_starts(space, start_count, seed)
    if method in BATCH:
        tpe.fit(watched, space, evaluations=evaluations, seed=seed, cost="weighted", method=method, progress=progress)
    else:
        if method == "both":  # as a fit does it: from the initial values, and from the best of a short global search
            short = min(evaluations, FitConfig().trials)
            scan = tpe.fit(watched, space, evaluations=short, seed=seed, cost="weighted", best=1, progress=progress)
            points = np.concatenate([points[:1], scan.starts])
        if method == "features":
            points = starts.draw(watched, range(start_count), track, seed)
            points = starts.fit(watched, points, track, iterations, progress).u[None]
        # As a fit does it, delays included; squares for all, so that the costs are of one kind.
        gradient_search(watched, space, points, iterations, FitConfig(robust=False), progress)
    kept = list(recorder.best)
    kept.append((recorder.evaluations, recorder.seconds, *kept[-1][2:]))
    count, seconds, cost, u = (np.array(column) for column in zip(*kept, strict=True))
    return Trace(method, seed, count, seconds, cost, u, judge.error(u))


class Judge:
    """Mean position RMSE on the held-out trials; compiled once for all searches."""

    def __init__(self, problem: Problem, log: Log):
        self._space, self._trials = problem.space, log.held_out
        if self._trials:
            self._replay, _ = make_replay(problem.plant, problem.params, problem.space, self._trials)

    def error(self, u: np.ndarray) -> np.ndarray:
        """Errors (K,) [m] at points u (K, P); nan without any held-out trial."""
        if not self._trials:
            return np.full(len(u), np.nan)
        different, back = np.unique(u, axis=0, return_inverse=True)
        simulated = self._replay.simulate(self._space.to_values(different))
        errors = []
        for k in range(len(different)):
            one = predictions(self._trials, jax.tree.map(lambda leaf, k=k: leaf[k], simulated))
            channels = [score(trial, prediction) for trial, prediction in zip(self._trials, one, strict=True)]
            tables = [(found.get("ground_truth") or found["odometry"]).as_dict() for found in channels]
            known = [row["trajectory"] for row in tables if row["trajectory"] is not None]
            errors.append(np.mean(known) if known else np.nan)
        return np.array(errors)[back.reshape(-1)]


def arrivals(traces: Sequence[Trace]) -> list[dict[str, Any]]:
    """Per method: final cost and error, and how many evaluations and seconds it took to come NEAR the best cost."""
    goal = min(float(one.cost.min()) for one in traces) * (1 + NEAR)
    rows = []
    for method in dict.fromkeys(one.method for one in traces):
        mine = [one for one in traces if one.method == method]
        first = [int(np.flatnonzero(one.cost <= goal)[0]) if one.cost[-1] <= goal else None for one in mine]
        there = [(one, k) for one, k in zip(mine, first, strict=True) if k is not None]

        def median(values: Sequence[float]) -> float | None:
            return float(np.median(values)) if len(values) else None

        rows.append({"method": method, "runs": len(mine), "arrived": len(there),
                     "evaluations": median([float(one.evaluations[k]) for one, k in there]),
                     "seconds": median([float(one.seconds[k]) for one, k in there]),
                     "cost": median([float(one.cost[-1]) for one in mine]),
                     "held_out": median([float(one.held_out[-1]) for one in mine]),
                     "all_evaluations": median([float(one.evaluations[-1]) for one in mine]),
                     "all_seconds": median([float(one.seconds[-1]) for one in mine])})
    return rows


@dataclass(frozen=True, kw_only=True)
class Arguments(FitConfig):
    """Command line of `python -m sysid.searches`; what is fitted is set as for `sysid.fit`."""

    dataset: Path
    """Folder with the driving log."""
    out: Path = Path("runs/searches")
    """Folder for searches.json, .png and .html."""
    methods: tuple[str, ...] = METHODS
    """Searches to compare: features, lm, both (TPE, then lm), tpe, cmaes."""
    seeds: tuple[int, ...] = (0,)
    """One run of each search for each."""
    trials: int = 256
    """Parameter sets that the global searches try."""
    iterations: int = 20
    """Iterations of the gradient searches."""
    starts: int = 4
    """Starts of the gradient searches: the initial values, and random ones."""


def main(arguments: Arguments) -> list[Trace]:
    """Run all searches with all seeds and write the comparison."""
    log = load_any(arguments.dataset)
    config = FitConfig(**{name: getattr(arguments, name) for name in FitConfig.__dataclass_fields__})
    problem = make_problem(log, config)
    judge = Judge(problem, log)
    traces = []
    progress, close = command_line.progress_bar(len(arguments.methods) * len(arguments.seeds), "searches", "run")
    try:
        for method in arguments.methods:
            for seed in arguments.seeds:
                traces.append(trace(problem, judge, log.spec.track, method, seed, evaluations=arguments.trials,
                                    iterations=arguments.iterations, start_count=arguments.starts))
                progress(1, f"{method}: cost {traces[-1].cost[-1]:.4g}")
    finally:
        close()
    write(arguments.out, log, traces, problem.space.names)
    for row in arrivals(traces):
        print("  ".join(f"{key} {value:.4g}" if isinstance(value, float) else f"{key} {value}"
                        for key, value in row.items()))
    print(f"wrote {arguments.out / 'searches.html'}, searches.json and searches.png")
    return traces


def write(out: Path, log: Log, traces: Sequence[Trace], names: Sequence[str]) -> None:
    """Write searches.json, searches.png and searches.html."""
    out.mkdir(parents=True, exist_ok=True)
    device = jax.devices()[0]
    rows = arrivals(traces)
    write_report(out / "searches.json", {
        "schema": 1, "kind": KIND, "dataset": {"name": log.name, "sha256": log.sha256}, "parameters": list(names),
        "device": f"{device.platform} {device.device_kind}", "code": code_hashes(), "near": NEAR, "table": rows,
        "traces": [asdict(one) for one in traces]})
    picture = write_search_plot(out / "searches.png", traces)
    header = ["search", "runs", f"within {NEAR:.0%} of the best", "evaluations until then", "seconds until then",
              "final cost", "held-out position RMSE [m]", "evaluations", "seconds"]
    body = [[row[key] for key in ("method", "runs", "arrived", "evaluations", "seconds", "cost", "held_out",
                                  "all_evaluations", "all_seconds")] for row in rows]
    page = html_page(f"Searches on {log.name}", [
        Section("Error against effort", png(picture, "Best point so far; thin: each run, thick: their median.")),
        Section("Arrival", table(header, body) + paragraph(
            "Medians over runs. Times are without compilation; a derivative counts one evaluation per parameter.",
            "dim"))],
        f"{device.device_kind}, {len(names)} parameters")
    temporary = out / "searches.html.tmp"
    temporary.write_text(page, encoding="utf-8")
    temporary.replace(out / "searches.html")


def _compile(objective: Objective, method: str, start_count: int) -> None:
    """Compile what a search will call, before its clock starts."""
    u = np.tile(objective.space.to_unit(objective.space.initial), (max(BATCH.values()), 1))
    objective.simulate(u)
    if method not in BATCH:
        objective.simulate(np.tile(u[:1], (start_count * len(least_squares.DAMPINGS), 1)))
        objective.jacobian(u[:1])
        objective.jacobian(np.tile(u[:1], (start_count, 1)))


def cli() -> None:
    """Command line."""
    command_line.run(Arguments, main, __doc__)


if __name__ == "__main__":
    cli()

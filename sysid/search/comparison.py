"""Searches of one problem side by side: error against simulator evaluations and against time."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sysid.errors.pose_objective import Objective, Replays
from sysid.logs.metrics import score
from sysid.logs.records import Log
from sysid.replay.differences import make_replay
from sysid.replay.records import Simulated
from sysid.replay.rollout import predictions
from sysid.search import least_squares, starts, studies
from sysid.search.fitting import Problem
from sysid.search.result import Progress, Stages, Trace
from sysid.search.settings import BATCH, FitConfig
from sysid.search.valleys import gradient_search

METHODS = ("features", "lm", "both", "tpe", "cmaes")
NEAR = 0.05  # A search has arrived when its cost is within this share of the best one that any of them found


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


@dataclass(frozen=True)
class Effort:
    """How long searches go on."""

    evaluations: int = 256
    """Of the global searches."""
    iterations: int = 20
    """Of the gradient searches."""
    starts: int = 4
    """Of the gradient searches: the initial values, and random ones."""


def trace(
    problem: Problem, judge: Judge, method: str, seed: int, effort: Effort, progress: Progress | None = None
) -> Trace:
    """Run one search and follow its best point."""
    if method not in METHODS:
        raise ValueError(f"no search {method!r} (known: {', '.join(METHODS)}).")
    objective, space = problem.objective, problem.space
    _compile(objective, method, effort.starts)
    recorder = Recorder(objective.replay, objective)
    watched = replace(objective, replay=recorder)
    points = least_squares.random_starts(space, effort.starts, seed)
    if method in BATCH:
        search = studies.GlobalSearch(effort.evaluations, seed, method=method)
        studies.global_search(watched, space, search, progress=progress)
    else:
        if method == "both":  # as a fit does it: from the initial values, and from the best of a short global search
            short = studies.GlobalSearch(min(effort.evaluations, FitConfig().trials), seed, best=1)
            scan = studies.global_search(watched, space, short, progress=progress)
            points = np.concatenate([points[:1], scan.starts])
        if method == "features":
            points = starts.draw(watched, range(effort.starts), judge.track, seed)
            points = starts.fit(watched, points, judge.track, effort.iterations, progress).u[None]
        # As a fit does it, delays included; squares for all, so that the costs are of one kind.
        gradient_search(watched, points, effort.iterations, FitConfig(robust=False), Stages(progress, 2))
    kept = list(recorder.best)
    kept.append((recorder.evaluations, recorder.seconds, *kept[-1][2:]))
    count, seconds, cost, u = (np.array(column) for column in zip(*kept, strict=True))
    return Trace(method, seed, count, seconds, cost, u, judge.error(u))


class Judge:
    """Mean position RMSE on the held-out trials; compiled once for all searches."""

    def __init__(self, problem: Problem, log: Log):
        self._space, self._trials, self.track = problem.space, log.held_out, log.spec.track
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
            one = predictions(self._trials, simulated, k)
            channels = [score(trial, prediction) for trial, prediction in zip(self._trials, one, strict=True)]
            tables = [found.get("ground_truth") or found["odometry"] for found in channels]
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


def _compile(objective: Objective, method: str, start_count: int) -> None:
    """Compile what a search will call, before its clock starts."""
    u = np.tile(objective.space.to_unit(objective.space.initial), (max(BATCH.values()), 1))
    objective.simulate(u)
    if method not in BATCH:
        objective.simulate(np.tile(u[:1], (start_count * len(least_squares.DAMPINGS), 1)))
        objective.jacobian(u[:1])
        objective.jacobian(np.tile(u[:1], (start_count, 1)))

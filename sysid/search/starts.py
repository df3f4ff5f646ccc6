"""Where the search starts: the vehicle fitted to its motion in short bins, with noise that has no memory.

A start is the best end of searches from the best of many random points (docs/fit_method.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sysid.errors import normal_equations
from sysid.errors.bin_objective import make_features_objective
from sysid.errors.pose_objective import Objective
from sysid.search import least_squares
from sysid.search.result import FitResult, Progress

SCAN = 256  # random points that are replayed for one start
KEPT, FIRST = 8, 3  # the best of them, and iterations from each: a few nearly show which valley is deepest
FOLLOWED, STEPS = 2, 20  # how many of those are searched further, and in how many iterations at most
EDGE = 0.02  # of the range, at both ends, without random points
CHUNK = 512  # points whose residuals are kept at once
AGREE = 0.02  # starts agree where their costs differ by no more than this share of the best one
TOLERANCE = 1e-3  # share of the cost by which it must fall for a start to go on


def fit(
    objective: Objective, points: np.ndarray, track: float, iterations: int = 15, progress: Progress | None = None
) -> FitResult:
    """Fit features from all starts, unit coordinates (S, P), then from the best one with the noise that it leaves. The
    result is the best point; `start_costs` are those of the first fit, ascending. The replay is that of `objective`."""
    coarse = make_features_objective(objective, track).quicker
    found = least_squares.fit(coarse, starts=points, stop=least_squares.Stopping(iterations, TOLERANCE),
                              progress=progress)
    fine = coarse.renewed(found.u)
    if fine is coarse:
        return found
    again = least_squares.fit(fine, starts=found.u[None],
                              stop=least_squares.Stopping(max(iterations // 2, 3), TOLERANCE), progress=progress)
    return replace(found, u=again.u, evaluations=found.evaluations + again.evaluations)


def draw(
    objective: Objective, numbers: Sequence[int], track: float, seed: int, scan: int = SCAN,
    progress: Progress | None = None,
) -> np.ndarray:
    """Starts (S, P) of a search: number 0 has the initial values, any other the best of `scan` random points, whichever
    others are drawn with it. The replay is that of `objective`; `track` in m."""
    space = objective.space
    first = space.to_unit(space.initial)
    scanned = [number for number in numbers if number > 0]
    if not scanned:
        return np.array([first for _ in numbers])
    coarse = make_features_objective(objective, track).quicker
    # Close to the walls as well: of many parameters the likely values are a small share of the range.
    tried = np.concatenate([np.random.default_rng((seed, number)).uniform(EDGE, 1 - EDGE, (scan, space.size))
                            for number in scanned])
    chunk = CHUNK if coarse.equations is None else len(tried)
    costs = np.concatenate([coarse.weighted_cost(tried[i : i + chunk]) for i in range(0, len(tried), chunk)])
    costs, tried = costs.reshape(len(scanned), -1), tried.reshape(len(scanned), -1, space.size)

    def best_of(tried: np.ndarray, costs: np.ndarray, count: int, iterations: int) -> tuple[np.ndarray, np.ndarray]:
        """Where searches from the `count` cheapest of points (S, N, P) with costs (S, N) end, and what that costs."""
        kept = np.take_along_axis(tried, np.argsort(costs, axis=1)[:, :count, None], axis=1)
        found = least_squares.fit(coarse, starts=kept.reshape(-1, space.size),
                                  stop=least_squares.Stopping(iterations, TOLERANCE), progress=progress)
        ends, costs = found.as_given
        return ends.reshape(kept.shape), costs.reshape(kept.shape[:2])

    ends, costs = best_of(tried, costs, KEPT, FIRST)
    ends, costs = best_of(ends, costs, FOLLOWED, STEPS)
    ends = ends[np.arange(len(scanned)), costs.argmin(1)]
    return np.array([first if number == 0 else ends[scanned.index(number)] for number in numbers])


def compile_ahead(objective: Objective, track: float) -> None:
    """Begin to compile what the default search needs on an accelerator: bins in pieces, whole ones, and poses."""
    bins = make_features_objective(objective, track)
    normal_equations.compile_ahead((bins.quicker, objective, bins), objective.replay, objective.space.initial)


def agreeing(costs: np.ndarray) -> int:
    """How many of the costs (S,) are that of the best start."""
    return int((costs <= costs.min() * (1 + AGREE)).sum())

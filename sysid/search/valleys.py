"""The gradient search on poses, and where else it looks: costs of drives have many valleys (docs/fit_method.md)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from sysid.errors.bin_objective import FeatureObjective
from sysid.errors.pose_objective import DriveResiduals
from sysid.search import least_squares, slopes
from sysid.search.result import FitResult, Progress, Stages
from sysid.search.settings import FitConfig

VALLEY = 0.05  # share of the cost by which another delay may be worse and still be searched from
FLAT = 1.6  # factor on the cost within which an end of a range may be worse and still be searched from
DEAR, FAR = 10.0, 12  # factor on the cost within which points far along a range are searched from, and how many
FIRST, KEPT, LOOK = 1, 2, 3  # iterations from all, how many are searched further, and when one must be better
LAST = 3  # iterations on whole drives at most, after those in pieces of an accelerator
LOST = 0.5  # share of the cost below which a search from elsewhere shows that the one before was far from right
WORTH = 0.001  # share of the cost that another valley must save for the floor to be followed from there

Search = Callable[[DriveResiduals, np.ndarray, int], FitResult]  # from starts (S, P), for so many iterations


def gradient_search(
    objective: DriveResiduals, starts: np.ndarray, iterations: int, config: FitConfig, stages: Stages | None
) -> tuple[FitResult, DriveResiduals, list[tuple[str, np.ndarray, np.ndarray]]]:
    """LM from all starts, and again with the noise that it leaves, where it was not known.

    With `config.elsewhere` other valleys are tried: ends of ranges that cost little, points far along every range,
    delays on a grid. Then averaged slopes lead on (`sysid.search.slopes`), and the ends of ranges are tried again.
    """

    binned = isinstance(objective, FeatureObjective)
    progress = stages.begin("motion in bins" if binned else "whole poses to the end") if stages else None

    def search(objective: DriveResiduals, starts: np.ndarray, iterations: int) -> FitResult:
        return from_all(objective, starts, iterations, config.robust, progress)

    def renew(objective: DriveResiduals, result: FitResult, starts: np.ndarray) -> tuple[DriveResiduals, FitResult]:
        """With the noise that the result leaves, searched again from starts (S, P) where that changes it."""
        again = objective.renewed(result.u)
        return (objective, result) if again is objective else (again, search(again, starts, iterations))

    result = search(objective, starts, iterations)
    objective, result = renew(objective, result, result.starts)
    progress = stages.begin("checks from other starts") if stages else None
    if config.elsewhere:
        result = _from_ends(search, objective, result, iterations, config.robust)
    lost = config.elsewhere
    while lost:
        before = result.cost
        costs, points = least_squares.far_points(objective, result.u, robust=config.robust)
        points = points[costs < DEAR * result.cost][:FAR]
        result = _from_elsewhere(search, objective, result, points, iterations)
        lost = result.cost < LOST * before
    found = least_squares.profile_delays(objective, result.u, robust=config.robust)
    for name, _, costs, followed in found:
        index = objective.space.names.index(name)
        apart = np.abs(followed[:, index] - result.u[index]) > 1e-6
        if config.elsewhere and costs[apart].min() < result.cost * (1 + VALLEY):
            other = followed[apart][costs[apart].argmin()]
            result = _from_elsewhere(search, objective, result, other[None], iterations)
    deeper = config.elsewhere
    if deeper:
        given = result
        objective, result = renew(objective, result, result.u[None])
        result = replace(result, starts=given.starts, start_costs=given.start_costs, order=given.order)
    while deeper:
        result = slopes.descend(objective, result, config.robust, config.seed, progress)
        floor = result.cost
        result = _from_ends(search, objective, result, iterations, config.robust)
        deeper = result.cost < floor * (1 - WORTH)
    return result, objective, [(name, grid, costs) for name, grid, costs, _ in found]


def from_all(
    objective: DriveResiduals, starts: np.ndarray, iterations: int, robust: bool = False,
    progress: Progress | None = None,
) -> FitResult:
    """LM from all starts (S, P), on what is quicker as long as that leads on."""
    quicker, spent = getattr(objective, "quicker", objective), 0
    if quicker is not objective:
        way = least_squares.fit(quicker, starts=starts, stop=least_squares.Stopping(iterations), robust=robust,
                                progress=progress)
        starts, spent, iterations = way.as_given[0], way.evaluations, min(iterations, LAST)
    found = least_squares.fit(objective, starts=starts, stop=least_squares.Stopping(iterations), robust=robust,
                              progress=progress)
    return replace(found, evaluations=found.evaluations + spent)


def _from_ends(
    search: Search, objective: DriveResiduals, result: FitResult, iterations: int, robust: bool
) -> FitResult:
    """The result with where searches from ends of ranges lead that cost little, those that cost as much as here last.
    """
    costs, points = least_squares.ends_of_ranges(objective, result.u, robust=robust)
    near, level = costs < FLAT * result.cost, np.abs(costs - result.cost) <= WORTH * result.cost
    near = near & ~level if (near & ~level).any() else near
    return _from_elsewhere(search, objective, result, points[near], iterations)


def _from_elsewhere(
    search: Search, objective: DriveResiduals, result: FitResult, starts: np.ndarray, iterations: int
) -> FitResult:
    """The result with where a search from other starts (S, P) ends, if that is lower after a few iterations."""
    if not len(starts):
        return result
    spent = result.evaluations
    if len(starts) > KEPT:
        first = search(objective, starts, FIRST)
        starts, spent = first.starts[:KEPT], spent + first.evaluations
    new = search(objective, starts, min(LOOK, iterations))
    spent += new.evaluations
    if new.cost < result.cost:
        new = search(objective, new.u[None], iterations)
        result, spent = replace(result, u=new.u, cost=new.cost, history=new.history), spent + new.evaluations
    return replace(result, evaluations=spent)

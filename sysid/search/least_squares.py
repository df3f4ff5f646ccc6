"""Bounded Levenberg-Marquardt from several starts at once.

All starts advance together: each iteration is one batched Jacobian and one batched replay of several damping values per
start, of which the best is taken; starts that have converged wait. A Jacobian takes two replays for each parameter, so
a few more tries follow without a new one: shorter steps where none helped, and where one brought what it promised,
steps that learn what they can of the derivatives from those before (Broyden 1965). Steps are in unit coordinates; a
step that leaves the box is cut at its wall and the parameters at a wall whose gradient points outwards are held.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from sysid.errors.robust import huber_weight, robust_cost
from sysid.errors.space import Space, is_delay
from sysid.search.result import FitResult, Progress

DAMPINGS = (0.1, 1.0, 10.0, 1000.0)
"""Factors on each start's damping that are tried in one iteration."""
MANY_DAMPINGS = (0.1, 1.0, 10.0, 1e2, 1e3, 1e4, 1e5, 1e6)
"""The same on an accelerator, where more tries take no longer, and a second call as long as the first."""
MAX_DAMPING = 1e4
MAX_STEP = 0.3  # of the range, in one iteration
GRID, APART = 6, 0.1  # points over a range, of which those so far away may lie in another valley
PLATEAU = 0.02  # share of the cost within which they lie on the same ground
FOLLOWING = 3  # tries at most without a new Jacobian
PROMISE = 0.5  # share of the foretold fall of the cost that a step must bring, so that one follows
GOES_ON = 10.0  # tolerances by which a step that is not the last lowers the cost


@dataclass(frozen=True)
class _Points:
    """Starts that try a step."""

    starts: np.ndarray  # (G,) int
    residual: np.ndarray  # (G, B, K)
    jacobian: np.ndarray  # (G, B, K, P)
    exact: np.ndarray  # (G,) bool: the derivatives are of the very point


class Sums(Protocol):
    """Costs and normal equations that an accelerator sums up: `sysid.errors.normal_equations.NormalEquations`."""

    def costs(self, u: np.ndarray, robust: bool = False) -> np.ndarray: ...

    def quadratic(self, u: np.ndarray, robust: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray]: ...


class Residuals(Protocol):
    """What is minimised: residuals (N, B, K) of unit coordinates (N, P), and their derivatives (N, B, K, P).

    One whose `equations` are not None has them summed up there.
    """

    @property
    def space(self) -> Space: ...

    @property
    def counted(self) -> int: ...

    def residuals(self, u: np.ndarray) -> np.ndarray: ...

    def jacobian(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]: ...


def fit(
    objective: Residuals, space: Space, *, starts: np.ndarray | None = None, iterations: int = 30,
    tolerance: float = 1e-4, robust: bool = False, frozen: tuple[str, ...] = (), progress: Progress | None = None,
) -> FitResult:
    """Minimise the weighted least squares over `space`.

    Args:
        objective: residuals and Jacobians in unit coordinates of `space`.
        starts: (S, P) unit coordinates; the initial values by default.
        tolerance: a start has converged when its cost fell by less than this share twice, and not by GOES_ON times as
            much in between: where wheels skid or torques meet their limit, costs are jagged.
        robust: Huber instead of squares.
        frozen: names that keep each start's value.
    """
    u = np.array([space.to_unit(space.initial)] if starts is None else starts, float)
    free = np.array([name not in frozen for name in space.names])
    count, damping, calm = len(u), np.full(len(u), 1e-2), np.zeros(len(u), int)
    cost = np.full(count, np.inf)
    equations = getattr(objective, "equations", None)
    dampings = DAMPINGS if equations is None else MANY_DAMPINGS
    initial, evaluations = np.inf, 0
    history: list[float] = []

    def settle(n: int, tried: np.ndarray, costs: np.ndarray, exact: bool) -> tuple[float, bool]:
        """Move a start to the best of the points (D, P), if that costs less: what its cost fell by, and if that is
        little. `exact`: the derivatives that led there are of the very point."""
        best = costs.argmin()
        fallen = float(cost[n] - costs[best])
        small = fallen < tolerance * cost[n]
        if fallen > 0:
            if exact and (small or fallen > GOES_ON * tolerance * cost[n]):
                calm[n] = calm[n] + 1 if small else 0
            u[n], cost[n] = tried[best], costs[best]
            damping[n] = np.clip(damping[n] * dampings[best], 1e-7, MAX_DAMPING)
        elif exact:
            # Only when even a short step down the gradient does not help is the start at its minimum.
            calm[n] = 2 if damping[n] >= MAX_DAMPING else calm[n]
            damping[n] = min(damping[n] * 100.0, MAX_DAMPING)
        return fallen, small

    def candidates(starts: np.ndarray, gradient: np.ndarray, hessian: np.ndarray) -> np.ndarray:
        """(G, D, P) points that are tried next."""
        nonlocal evaluations
        evaluations += len(starts) * len(dampings)
        at, slopes, curvatures = (np.repeat(one, len(dampings), axis=0) for one in (u[starts], gradient, hessian))
        points = damped_steps(at, slopes, curvatures, np.outer(damping[starts], dampings).ravel(), free, space)
        return points.reshape(len(starts), len(dampings), -1)

    def step(at: _Points) -> _Points:
        """Move these starts; those of them that can try again without a new Jacobian."""
        residual, jacobian = at.residual, at.jacobian
        gradient, hessian = normal_sums(residual, jacobian, robust)
        points = candidates(at.starts, gradient, hessian)
        tried = objective.residuals(points.reshape(-1, space.size))
        tried = tried.reshape(*points.shape[:2], *residual.shape[1:])
        costs = np.stack([robust_cost(one, robust) for one in tried]) / objective.counted
        best, rows = costs.argmin(-1), np.arange(len(at.starts))
        after, moves = tried[rows, best], points[rows, best] - u[at.starts]
        again = np.zeros(len(rows), bool)
        for i, n in enumerate(at.starts):
            exact = bool(at.exact[i])
            fallen, small = settle(n, points[i], costs[i], exact)
            if fallen > 0:
                foretold = -(2 * gradient[i] + hessian[i] @ moves[i]) @ moves[i] / objective.counted
                again[i] = not small and fallen > PROMISE * foretold
            elif exact:
                after[i], moves[i], again[i] = residual[i], 0.0, calm[n] < 2
        learnt = _learnt(jacobian[again], (after - residual)[again], moves[again])
        return _Points(at.starts[again], after[again], learnt, (at.exact & ~moves.any(-1))[again])

    def step_there(
        equations: Sums, going: np.ndarray, gradient: np.ndarray, hessian: np.ndarray
    ) -> None:
        """Move these starts with sums that an accelerator makes."""
        points = candidates(going, gradient, hessian)
        costs = equations.costs(points.reshape(-1, space.size), robust).reshape(len(going), -1) / objective.counted
        for i, n in enumerate(going):
            settle(n, points[i], costs[i], True)

    for iteration in range(iterations):
        going = np.flatnonzero(calm < 2)
        evaluations += len(going)
        if equations is not None:
            values, *slopes = equations.quadratic(u[going], robust)
            cost[going] = values / objective.counted
            initial = float(cost[0]) if iteration == 0 else initial
            step_there(equations, going, *slopes)
        else:
            points = _Points(going, *objective.jacobian(u[going]), np.ones(len(going), bool))
            cost[going] = robust_cost(points.residual, robust) / objective.counted
            initial = float(cost[0]) if iteration == 0 else initial
            for _ in range(1 + FOLLOWING):
                if len(points.starts):
                    points = step(points)
        history.append(float(cost.min()))
        if progress is not None:
            progress(1, f"cost {cost.min():.4g}")
        if (calm >= 2).all():
            break
    order = np.argsort(cost)
    return FitResult(u=u[order[0]], cost=float(cost[order[0]]), initial_cost=initial,
                     evaluations=evaluations, starts=u[order], start_costs=cost[order], order=order,
                     history=np.array(history))


def ends_of_ranges(objective: Residuals, u: np.ndarray, robust: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Costs (E,) and points (E, P) with one parameter of u (P,) at an end of its range, where that is far away."""
    points = []
    for index, here in enumerate(u):
        for end in (0.0, 1.0):
            if abs(end - here) > APART:
                points.append(u.copy())
                points[-1][index] = end
    starts = np.array(points).reshape(-1, len(u))
    return costs_of(objective, starts, robust), starts


def far_points(objective: Residuals, u: np.ndarray, robust: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Costs (E,) and points (E, P) where one parameter each is far from what it is in u (P,), the promising first.

    Of a grid over the range of each parameter the best point below and the best above, the others following by one
    damped Gauss-Newton step. Points that cost what u does are left out: a search from there comes back to where it was.
    What lies behind such level ground comes first, since no derivative shows it: a limit that was never met, say.
    The rest is in the order of its costs.
    """
    linear = _linearised(objective, u)
    here = robust_cost(linear[0], robust)[0] / objective.counted
    points, held, side = [], [], []
    for index, value in enumerate(u):
        for other in np.linspace(0.0, 1.0, GRID):
            if abs(other - value) > APART:
                points.append(np.where(np.arange(len(u)) == index, other, u))
                held.append(index)
                side.append(2 * index + int(other > value))
    costs, followed = _followed(objective, linear, np.array(points), np.array(held), robust)
    sides, level = np.array(side), np.abs(costs - here) <= PLATEAU * here
    behind = np.isin(sides, sides[level])
    order = np.lexsort((costs, ~behind))
    order = order[~level[order]]
    order = order[np.sort(np.unique(sides[order], return_index=True)[1])]  # the first of each side
    return costs[order], followed[order]


_Linear = tuple[np.ndarray, np.ndarray, np.ndarray]


def _linearised(objective: Residuals, u: np.ndarray) -> _Linear:
    """Residual (1, B, K) and derivatives (B, K, P) at u (P,), and the Gauss-Newton Hessian (P, P)."""
    residual, jacobian = objective.jacobian(u[None])
    return residual, jacobian[0], np.einsum("bkp,bkq->pq", jacobian[0], jacobian[0])


def _followed(
    objective: Residuals, linear: _Linear, points: np.ndarray, held: np.ndarray, robust: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Costs (E,) and points (E, P) after a damped Gauss-Newton step of all but the `held` (E,) parameter of each, with
    the derivatives of elsewhere, where that step is better than none.
    """
    _, jacobian, hessian = linear
    index = np.arange(points.shape[1])
    residual = objective.residuals(points)
    weight = huber_weight(residual) if robust else np.ones_like(residual)
    pulls = np.einsum("bkp,nbk->np", jacobian, residual * weight, optimize=True)
    moved = damped_steps(points, pulls, hessian, 1e-3, index != held[:, None], objective.space)
    costs = np.stack([robust_cost(one, robust) for one in (residual, objective.residuals(moved))]) / objective.counted
    return costs.min(0), np.where((costs[1] < costs[0])[:, None], moved, points)


def profile_delays(
    objective: Residuals, space: Space, u: np.ndarray, points: int = 16, near: tuple[float, ...] = (0.005, 0.0003),
    robust: bool = False,
) -> list[tuple[str, np.ndarray, np.ndarray, np.ndarray]]:
    """Cost over a grid of each delay-type parameter, the others following it from u (P,).

    A delay acts in steps of the controller's clock, so a search finds the valley that it starts in. The others follow
    by one damped Gauss-Newton step, which shows whether another valley is as deep.

    Args:
        points: of an even grid over the whole range.
        near: six more on both sides of u are this far apart [s], for each: a step of the controller's clock, and what
            a step of the physics, in which wheels begin to slip or torques reach their limit, makes of it.

    Returns:
        Per delay its name, the grid (G,) of its values [s], the costs (G,) and the points (G, P) where they hold.
    """
    profiles = []
    delays = [index for index, name in enumerate(space.names) if is_delay(name)]
    if not delays:
        return []
    linear = _linearised(objective, u)
    for index in delays:
        values = space.to_values(u)
        around = np.tile(values, (13 * len(near), 1))
        around[:, index] += np.outer(near, np.arange(-6, 7)).ravel()
        grid = np.concatenate([np.linspace(0.0, 1.0, points), space.to_unit(around)[:, index]])
        grid = np.unique(grid.round(9))
        at = np.tile(u, (len(grid), 1))
        at[:, index] = grid
        costs, followed = _followed(objective, linear, at, np.full(len(at), index), robust)
        profiles.append((space.names[index], space.to_values(at)[:, index], costs, followed))
    return profiles


def random_starts(space: Space, count: int, seed: int) -> np.ndarray:
    """(S, P): the initial values, then points drawn uniformly in unit coordinates, away from the walls."""
    draws = np.random.default_rng(seed).uniform(0.05, 0.95, (count, space.size))
    draws[0] = space.to_unit(space.initial)
    return draws


def costs_of(objective: Residuals, u: np.ndarray, robust: bool = False) -> np.ndarray:
    """Mean squares (N,), or Huber losses, of unit coordinates (N, P)."""
    equations = getattr(objective, "equations", None)
    sums = robust_cost(objective.residuals(u), robust) if equations is None else equations.costs(u, robust)
    return np.asarray(sums / objective.counted)


def _learnt(jacobian: np.ndarray, change: np.ndarray, move: np.ndarray) -> np.ndarray:
    """Derivatives (N, B, K, P) that foretell how a move (N, P) changed residuals (N, B, K), and else as they were."""
    missed = change - np.einsum("nbkp,np->nbk", jacobian, move)
    direction = move / np.maximum(np.square(move).sum(-1, keepdims=True), 1e-300)
    return jacobian + missed[..., None] * direction[:, None, None, :]


def normal_sums(residual: np.ndarray, jacobian: np.ndarray, robust: bool) -> tuple[np.ndarray, np.ndarray]:
    """Gradients (N, P) and Gauss-Newton Hessians (N, P, P), by half, of squares or Huber losses of residuals (N, B, K)
    with the derivatives (N, B, K, P)."""
    weight = huber_weight(residual) if robust else np.ones_like(residual)
    gradient = np.einsum("nbkp,nbk->np", jacobian, residual * weight)
    return gradient, np.einsum("nbkp,nbkq->npq", jacobian, jacobian * weight[..., None])


def damped_steps(
    u: np.ndarray, gradient: np.ndarray, hessian: np.ndarray, damping: Any, free: np.ndarray, space: Space
) -> np.ndarray:
    """The damped Gauss-Newton points (N, P) of u (N, P) within the box, along its valleys (`Space.moved`); what is not
    `free` (P,) or (N, P) stays.

    Args:
        gradient, hessian: by half, (N, P) and (N, P, P); without N where they are the same for all.
        damping: (N,), or one for all.
    """
    count, size = u.shape
    gradient, free = (np.broadcast_to(one, u.shape) for one in (gradient, free))
    hessian, damping = np.broadcast_to(hessian, (count, size, size)), np.broadcast_to(damping, count)
    active = free & ~((u <= 0.0) & (gradient > 0)) & ~((u >= 1.0) & (gradient < 0))
    curvature = np.einsum("npp->np", hessian)
    scale = (curvature + 1e-6 * np.maximum(curvature.max(-1, keepdims=True), 1e-12)) * damping[:, None]
    new, left = u.copy(), np.arange(count)
    for _ in range(3):  # cutting at a wall may let another parameter reach its own
        moving = active[left]
        matrix = hessian[left] * (moving[:, :, None] & moving[:, None])
        matrix[:, np.arange(size), np.arange(size)] += np.where(moving, scale[left], 1.0)
        step = -np.linalg.solve(matrix, np.where(moving, gradient[left], 0.0)[..., None])[..., 0]
        moved = np.where(free[left], space.moved(u[left], np.clip(step, -MAX_STEP, MAX_STEP)), u[left])
        outside = (moved < 0.0) | (moved > 1.0)
        new[left] = np.clip(moved, 0.0, 1.0)
        # Hold what hit its wall at once; what merely reached it keeps the cut step.
        active[left] &= ~(outside & ((u[left] <= 1e-6) | (u[left] >= 1 - 1e-6)))
        left = left[outside.any(-1)]
        if not len(left):
            break
    return new

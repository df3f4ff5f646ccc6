"""Bounded Levenberg-Marquardt from several starts at once.

Each iteration is one batched Jacobian and one batched replay of several dampings per start. A few more tries follow
without a new Jacobian: shorter steps where none helped, else with derivatives updated by the step (Broyden 1965).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from sysid.errors.normal_equations import NormalEquations
from sysid.errors.space import Residuals, Space, huber_weight, robust_cost
from sysid.search.gauss_newton import BoxStep, GaussNewton, Patience, State, Try, normal_sums
from sysid.search.result import FitResult, Progress
from whill_mjx.io.steps import step

DAMPINGS = (0.1, 1.0, 10.0, 1000.0)  # factors on each start's damping that are tried in one iteration
MANY_DAMPINGS = (0.1, 1.0, 10.0, 1e2, 1e3, 1e4, 1e5, 1e6)  # on an accelerator: more tries take no longer
GRID, APART = 6, 0.1  # points over a range, of which those so far away may lie in another valley
DELAYS, NEAR = 16, (0.005, 0.0003)
"""Points over the range of a delay; six more on both sides are so far apart [s], for each: about a step of the
controller's clock, and of the physics."""
PLATEAU = 0.02  # share of the cost within which they lie on the same ground
FOLLOWING = 3  # tries at most without a new Jacobian
PROMISE = 0.5  # share of the foretold fall of the cost that a step must bring, so that one follows
GOES_ON = 10.0  # tolerances by which a step that is not the last lowers the cost


@dataclass(frozen=True)
class Stopping:
    """When a search ends."""

    iterations: int = 30  # at most
    tolerance: float = 1e-4
    """A start has converged when its cost fell by less than this share twice, and not by GOES_ON times as much in
    between: where wheels skid or torques meet their limit, costs are jagged."""


def fit(
    objective: Residuals, *, starts: np.ndarray | None = None, stop: Stopping = Stopping(),  # noqa: B008
    robust: bool = False, frozen: tuple[str, ...] = (), progress: Progress | None = None,
) -> FitResult:
    """Minimise the weighted least squares over the space of an objective.

    `starts`: (S, P) unit coordinates, by default the initial values; `robust`: Huber; `frozen`: names that keep each
    start's value.
    """
    space = objective.space
    box = BoxStep(free=np.array([name not in frozen for name in space.names]), move=space.moved)
    equations = getattr(objective, "equations", None)
    choices = tuple(Try(factor) for factor in (DAMPINGS if equations is None else MANY_DAMPINGS))
    solver = GaussNewton(box, choices, Patience(stop.tolerance, times=2, anew=GOES_ON))
    descent = _Descent(objective, solver, robust, equations)
    state = solver.init(np.array([space.to_unit(space.initial)] if starts is None else starts, float))
    initial, evaluations = np.inf, 0
    history: list[float] = []
    for iteration in range(stop.iterations):
        going = np.flatnonzero(~solver.done(state))
        part, first, spent = descent.kept(state.of(going))
        initial = float(first[0]) if iteration == 0 else initial
        state, evaluations = state.put(going, part), evaluations + spent
        history.append(float(state.cost.min()))
        if progress is not None:
            progress(1, f"cost {state.cost.min():.4g}")
        if solver.done(state).all():
            break
    order = np.argsort(state.cost)
    u, cost = state.u[order], state.cost[order]
    return FitResult(u=u[0], cost=float(cost[0]), initial_cost=initial, evaluations=evaluations, starts=u,
                     start_costs=cost, order=order, history=np.array(history))


@dataclass(frozen=True)
class _Linear:
    """Residuals of starts that try a step, and the derivatives by which they do."""

    starts: np.ndarray  # (G,) int
    residual: np.ndarray  # (G, B, K)
    jacobian: np.ndarray  # (G, B, K, P)
    exact: np.ndarray  # (G,) bool: the derivatives are of the very point


@dataclass(frozen=True)
class _Descent:
    """Iterations of a search: derivatives, and steps by them."""

    objective: Residuals
    solver: GaussNewton
    robust: bool
    equations: NormalEquations | None

    def kept(self, state: State) -> tuple[State, np.ndarray, int]:
        """As `advanced`, as a step that is kept (`whill_mjx.io.steps`)."""
        def compute() -> list[Any]:
            after, first, spent = self.advanced(state)
            return [*after, first, spent]

        *after, first, spent = step("iteration", compute, *state)
        return State(*after), first, int(spent)

    def advanced(self, state: State) -> tuple[State, np.ndarray, int]:
        """The starts after an iteration, their costs (S,) before it, and how many sets were replayed."""
        size = state.u.shape[1]
        if self.equations is not None:
            values, *slopes = self.equations.quadratic(state.u, self.robust)
            state = state._replace(cost=values / self.objective.counted)
            tried = self.solver.tries(state, *slopes)
            costs = self.equations.costs(tried.points.reshape(-1, size), self.robust) / self.objective.counted
            after = self.solver.step(state, tried, costs.reshape(tried.promised.shape))
            return after, state.cost, len(state.u) + len(costs)
        residual, jacobian = self.objective.jacobian(state.u)
        first = robust_cost(residual, self.robust) / self.objective.counted
        state, spent = state._replace(cost=first), len(state.u)
        linear = _Linear(np.arange(spent), residual, jacobian, np.ones(spent, bool))
        for _ in range(1 + FOLLOWING):
            if len(linear.starts):
                spent += len(linear.starts) * len(self.solver.choices)
                state, linear = self._stepped(state, linear)
        return state, first, spent

    def _stepped(self, state: State, at: _Linear) -> tuple[State, _Linear]:
        """All starts after some tried a step; those of them that can try again without a new Jacobian."""
        before, counted = state.of(at.starts), self.objective.counted
        weight = huber_weight(at.residual) if self.robust else None
        tried = self.solver.tries(before, *normal_sums(at.residual, at.jacobian, weight))
        found = self.objective.residuals(tried.points.reshape(-1, before.u.shape[1]))
        found = found.reshape(*tried.promised.shape, *at.residual.shape[1:])
        costs = np.stack([robust_cost(one, self.robust) for one in found]) / counted
        after = self.solver.step(before, tried, costs, at.exact)
        rows, best = np.arange(len(costs)), costs.argmin(-1)
        fallen, moves = before.cost - after.cost, after.u - before.u
        small = fallen < self.solver.patience.scale(before.cost)
        promised = ~small & (fallen > PROMISE * tried.promised[rows, best] / counted)
        again = np.where(fallen > 0, promised, at.exact & ~self.solver.done(after))
        residual = np.where((fallen > 0)[:, None, None], found[rows, best], at.residual)
        learnt = _learnt(at.jacobian[again], (residual - at.residual)[again], moves[again])
        exact = at.exact & ~moves.any(-1)
        return state.put(at.starts, after), _Linear(at.starts[again], residual[again], learnt, exact[again])


def ends_of_ranges(objective: Residuals, u: np.ndarray, robust: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Costs (E,) and points (E, P) with one parameter of u (P,) at an end of its range, where that is far away."""
    points, _ = _along_ranges(u, (0.0, 1.0))
    return costs_of(objective, points, robust), points


def _along_ranges(u: np.ndarray, values: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """Points (E, P) with one parameter of u (P,) at one of these values, where that is far away, and which (E,)."""
    places = [(index, value) for index, here in enumerate(u) for value in values if abs(value - here) > APART]
    points, held = np.tile(u, (len(places), 1)), np.array([index for index, _ in places], int)
    points[np.arange(len(held)), held] = [value for _, value in places]
    return points, held


def far_points(objective: Residuals, u: np.ndarray, robust: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Costs (E,) and points (E, P) where one parameter each is far from what it is in u (P,), the promising first.

    Of a grid over each range the best point below and above, the others following by one damped Gauss-Newton step.
    Points that cost what u does are left out. What lies behind such level ground comes first: no derivative shows it.
    """
    points, held = _along_ranges(u, np.linspace(0.0, 1.0, GRID).tolist())
    sides = 2 * held + (points > u).any(1)

    def compute() -> tuple[Any, ...]:
        tangent = _Tangent.at(objective, u, robust)
        return tangent.cost, *tangent.followed(objective, points, held, robust)

    cost, costs, followed = step("far points", compute, u)
    level = np.abs(costs - cost) <= PLATEAU * cost
    behind = np.isin(sides, sides[level])
    order = np.lexsort((costs, ~behind))
    order = order[~level[order]]
    order = order[np.sort(np.unique(sides[order], return_index=True)[1])]  # the first of each side
    return costs[order], followed[order]


@dataclass(frozen=True)
class _Tangent:
    """Derivatives of residuals at one point, by which others follow that are elsewhere."""

    cost: float
    jacobian: np.ndarray  # (B, K, P)

    @classmethod
    def at(cls, objective: Residuals, u: np.ndarray, robust: bool) -> _Tangent:
        """Those at u (P,)."""
        residual, jacobian = objective.jacobian(u[None])
        return cls(robust_cost(residual, robust)[0] / objective.counted, jacobian[0])

    def followed(self, objective: Residuals, points: np.ndarray, held: np.ndarray, robust: bool
                 ) -> tuple[np.ndarray, np.ndarray]:
        """Costs (E,) and points (E, P) after a Gauss-Newton step of all but the `held` (E,) parameter, if it is better.
        """
        residual = objective.residuals(points)
        weight = huber_weight(residual) if robust else np.ones_like(residual)
        pulls = np.einsum("bkp,nbk->np", self.jacobian, residual * weight, optimize=True)
        hessian = np.einsum("bkp,bkq->pq", self.jacobian, self.jacobian)
        box = BoxStep(free=np.arange(points.shape[1]) != held[:, None], move=objective.space.moved)
        moved = box.points(points, pulls, hessian, 1e-3)
        costs = np.stack([robust_cost(one, robust) for one in (residual, objective.residuals(moved))])
        return costs.min(0) / objective.counted, np.where((costs[1] < costs[0])[:, None], moved, points)


def profile_delays(
    objective: Residuals, u: np.ndarray, robust: bool = False
) -> list[tuple[str, np.ndarray, np.ndarray, np.ndarray]]:
    """Name, grid (G,) [s], costs (G,) and points (G, P) of each delay, the others following from u (P,).

    A delay acts in steps of the controller's clock, so a search finds the valley that it starts in. The others follow
    by one damped Gauss-Newton step, which shows whether another valley is as deep.
    """
    profiles, space = [], objective.space
    delays = [index for index, name in enumerate(space.names) if "delay" in name or "latency" in name]
    if not delays:
        return []
    tangent = cache(lambda: _Tangent.at(objective, u, robust))
    for index in delays:
        values = space.to_values(u)
        around = np.tile(values, (13 * len(NEAR), 1))
        around[:, index] += np.outer(NEAR, np.arange(-6, 7)).ravel()
        grid = np.concatenate([np.linspace(0.0, 1.0, DELAYS), space.to_unit(around)[:, index]])
        grid = np.unique(grid.round(9))
        at = np.tile(u, (len(grid), 1))
        at[:, index] = grid
        held = np.full(len(at), index)

        def compute(at: np.ndarray = at, held: np.ndarray = held) -> tuple[np.ndarray, np.ndarray]:
            return tangent().followed(objective, at, held, robust)

        costs, followed = step("delay", compute, at)
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

    def compute() -> list[Any]:
        return [robust_cost(objective.residuals(u), robust) if equations is None else equations.costs(u, robust)]

    (sums,) = step("costs", compute, u)
    return np.asarray(sums / objective.counted)


def _learnt(jacobian: np.ndarray, change: np.ndarray, move: np.ndarray) -> np.ndarray:
    """Derivatives (N, B, K, P) that foretell how a move (N, P) changed residuals (N, B, K), and else as they were."""
    missed = change - np.einsum("nbkp,np->nbk", jacobian, move)
    direction = move / np.maximum(np.square(move).sum(-1, keepdims=True), 1e-300)
    return jacobian + missed[..., None] * direction[:, None, None, :]

"""Damped Gauss-Newton steps in a box, for several starts side by side."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

AT_WALL = 1e-6


def normal_sums(
    residual: np.ndarray, jacobian: np.ndarray, weight: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Half the gradients (N, P) and Gauss-Newton Hessians (N, P, P) of weighted squares of residuals (N, ...)."""
    axes, residual = "abcd"[: jacobian.ndim - 2], residual.reshape(jacobian.shape[:-1])
    pulls, columns = (residual, jacobian) if weight is None else (residual * weight, jacobian * weight[..., None])
    return (np.einsum(f"n{axes}p,n{axes}->np", jacobian, pulls),
            np.einsum(f"n{axes}p,n{axes}q->npq", jacobian, columns))


@dataclass(frozen=True)
class BoxStep:
    """One damped step from u within a box.

    With half the gradient g and half the Hessian H, the step s solves (H + d (diag H + floor) + ridge) s = -g. What
    is at a wall and would leave the box is held, and the others are solved for again.
    """

    low: Any = 0.0  # (P,), or one for all
    high: Any = 1.0
    reach: Any = 0.3  # largest step, or a function that gives it (N, P) at u (N, P)
    free: Any = True  # (P,) or (N, P): False for parameters that keep their value
    move: Callable[[np.ndarray, np.ndarray], np.ndarray] = np.add  # where a step from u leads
    passes: int = 3  # solutions at most: cutting one parameter at its wall may lead another to its own
    adapt: bool = False  # hold whatever is cut, by its reach too, at the cut step; otherwise only what begins at a wall
    floor: float = 1e-6  # damping of parameters that do nothing, as a share of the largest curvature
    ridge: float = 0.0  # share of the largest curvature that is added whatever the damping

    def points(self, u: np.ndarray, gradient: np.ndarray, hessian: np.ndarray, damping: Any) -> np.ndarray:
        """The points (N, P) to which steps from u (N, P) lead, by half gradients (N, P) and Hessians (N, P, P)."""
        count, size = u.shape
        reach = self.reach(u) if callable(self.reach) else self.reach
        gradient, low, high, reach, free = (
            np.broadcast_to(one, u.shape) for one in (gradient, self.low, self.high, reach, self.free))
        hessian, damping = np.broadcast_to(hessian, (count, size, size)), np.broadcast_to(damping, count)
        moving = free & ~((u <= low) & (gradient > 0)) & ~((u >= high) & (gradient < 0))
        at_wall = (u <= low + AT_WALL) | (u >= high - AT_WALL)
        curvature = np.einsum("npp->np", hessian)
        most = curvature.max(-1, keepdims=True)
        added = (curvature + self.floor * np.maximum(most, 1e-12)) * damping[:, None] + self.ridge * most
        matrix = hessian + added[..., None] * np.eye(size)
        least, largest = (np.maximum(low - u, -reach), np.minimum(high - u, reach)) if self.adapt else (-reach, reach)
        end, held, left = u.copy(), np.zeros_like(u), np.arange(count)
        for _ in range(self.passes):
            going = moving[left]
            known = np.where(going, 0.0, held[left])
            right = -(gradient[left] + np.einsum("npq,nq->np", matrix[left], known))
            solved = np.where(going[:, :, None] & going[:, None], matrix[left], np.eye(size) * ~going[:, None])
            step = np.linalg.solve(solved, np.where(going, right, known)[..., None])[..., 0]
            cut = np.clip(step, least[left], largest[left])
            moved = np.where(free[left], self.move(u[left], cut), u[left])
            end[left] = np.clip(moved, low[left], high[left])
            out = going & ((cut != step) if self.adapt else (end[left] != moved) & at_wall[left])
            if self.adapt:
                held[left] = np.where(out, cut, held[left])
            moving[left] = going & ~out
            left = left[out.any(-1)]
            if not len(left):
                break
        return end


class Try(NamedTuple):
    """One of the points that are tried in a step."""

    factor: float  # on the damping of the start
    share: float = 1.0  # of the step
    easing: float | None = None  # factor on the damping after the try was the best; None takes `factor`


@dataclass(frozen=True)
class Patience:
    """When a start is at its minimum."""

    tolerance: float  # A gain below this share of the cost is small
    times: int = 1  # small gains that end the search, and none in between of `anew` tolerances or more
    anew: float = 1.0
    noise: float = 0.0  # what no step takes away of the cost: gains are compared with the rest, or with `least`
    least: float = 0.0
    failures: bool = False  # whether a step that gains nothing counts as a small gain
    first: int = 0  # steps before a small gain counts

    def scale(self, cost: np.ndarray) -> np.ndarray:
        """Gains below this are small."""
        return np.asarray(self.tolerance * np.maximum(cost - self.noise, self.least))


class State(NamedTuple):
    """S starts on their way."""

    u: np.ndarray  # (S, P)
    cost: np.ndarray  # (S,)
    damping: np.ndarray  # (S,)
    calm: np.ndarray  # (S,) small gains so far
    steps: np.ndarray  # (S,)

    def of(self, index: np.ndarray) -> State:
        """Some of the starts."""
        return State(*(values[index] for values in self))

    def put(self, index: np.ndarray, part: State) -> State:
        """With some of the starts moved on."""
        whole = State(*(values.copy() for values in self))
        for values, moved in zip(whole, part, strict=True):
            values[index] = moved
        return whole


class Tried(NamedTuple):
    """The next points of each start."""

    points: np.ndarray  # (S, D, P)
    promised: np.ndarray  # (S, D) by how much they lower the cost of a linear residual


@dataclass(frozen=True)
class GaussNewton:
    """Minimise |r(u)|^2 + (u - m)^T L (u - m) from several starts, by damped Gauss-Newton steps in a box.

    With J = dr/du, half the gradient and half the Hessian are g = J^T r + L (u - m) and H = J^T J + L. Each step tries
    several dampings and keeps the best point. Residuals are the caller's, who may keep a Jacobian for more than a step:

        state = solver.init(u)
        while not solver.done(state).all():
            tried = solver.tries(state, *solver.normal(r, J, state.u))
            state = solver.step(state, tried, costs)  # costs (S, D) of tried.points
    """

    box: BoxStep
    choices: tuple[Try, ...]
    patience: Patience
    prior: tuple[np.ndarray, np.ndarray] | None = None  # mean m (P,) and precision L (P, P)
    damping: float = 1e-2  # at first
    least: float = 1e-7
    most: float = 1e4  # A start is at its minimum when a step with this damping gains nothing
    stiffer: float = 100.0  # factor on the damping after a step that gained nothing

    def init(self, u: np.ndarray) -> State:
        """Starts u (S, P) whose cost is unknown."""
        count, none = len(u), np.zeros(len(u), int)
        return State(np.array(u, float), np.full(count, np.inf), np.full(count, self.damping), none, none)

    def cost(self, residual: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Cost (N,) of residuals (N, ...) at u (N, P)."""
        squares = np.square(residual).reshape(len(u), -1).sum(-1)
        if self.prior is None:
            return np.asarray(squares)
        away = u - self.prior[0]
        return np.asarray(squares + ((away @ self.prior[1]) * away).sum(-1))

    def normal(self, residual: np.ndarray, jacobian: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Half the gradient (N, P) and half the Hessian (N, P, P) at u (N, P)."""
        gradient, hessian = normal_sums(residual, jacobian)
        if self.prior is None:
            return gradient, hessian
        return gradient + (u - self.prior[0]) @ self.prior[1], hessian + self.prior[1]

    def tries(self, state: State, gradient: np.ndarray, hessian: np.ndarray) -> Tried:
        """What is tried next."""
        count, size = state.u.shape
        factors, shares = (np.array(each) for each in zip(*((one.factor, one.share) for one in self.choices),
                                                          strict=True))
        at, slopes, curvatures = (np.repeat(one, len(factors), axis=0) for one in (state.u, gradient, hessian))
        ends = self.box.points(at, slopes, curvatures, np.outer(state.damping, factors).ravel())
        moves = ends - at
        fall = -((2 * slopes + np.einsum("npq,nq->np", curvatures, moves)) * moves).sum(-1)
        share = np.tile(shares, count)[:, None]
        points = np.where(share == 1.0, ends, np.clip(at + share * moves, self.box.low, self.box.high))
        return Tried(points.reshape(count, -1, size), fall.reshape(count, -1) * shares * (2 - shares))

    def step(self, state: State, tried: Tried, costs: np.ndarray, exact: Any = True) -> State:
        """Move to the best of the points, by their costs (S, D), where it costs less.

        `exact`: False where derivatives were not those of the very point, so that failing says nothing.
        """
        best, rows = np.nanargmin(costs, axis=-1), np.arange(len(costs))
        fallen, easings = state.cost - costs[rows, best], np.array([
            one.factor if one.easing is None else one.easing for one in self.choices])
        better, scale, exact = fallen > 0, self.patience.scale(state.cost), np.broadcast_to(exact, len(costs))
        counted = np.where(better, fallen < scale, self.patience.failures) & (state.steps >= self.patience.first)
        large = better & (fallen > self.patience.anew * scale)
        calm = np.where(counted, state.calm + 1, np.where(large, 0, state.calm))
        calm = np.where(~better & (state.damping >= self.most), self.patience.times, calm)
        eased = np.clip(state.damping * easings[best], self.least, self.most)
        stiffer = np.where(exact, np.minimum(state.damping * self.stiffer, self.most), state.damping)
        return State(np.where(better[:, None], tried.points[rows, best], state.u),
                     np.where(better, costs[rows, best], state.cost), np.where(better, eased, stiffer),
                     np.where(exact, calm, state.calm), state.steps + 1)

    def done(self, state: State) -> np.ndarray:
        """(S,) starts that are at their minimum."""
        return np.asarray(state.calm >= self.patience.times)

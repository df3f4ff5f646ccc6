"""Joint nonlinear refits: base parameters within their day-to-day spread, and the coordinates of hypotheses."""

from __future__ import annotations

import copy
from collections.abc import Generator, Sequence
from functools import partial
from typing import Any

import numpy as np

from sysid.missing.catalogue import Hypothesis
from sysid.missing.days import Reference, difference_sizes
from sysid.missing.drives import Drives
from sysid.missing.evidence import with_values
from sysid.missing.joint_fit import Refit, Start, parts_of
from sysid.replay.arrays import Quotients
from sysid.replay.cores import on_all_cores
from sysid.search.gauss_newton import BoxStep, GaussNewton, Patience, Try
from whill_mjx.io.steps import step

CHOICES = (Try(1.0, easing=0.2), Try(1.0, 0.3, easing=0.2), Try(30.0, easing=6.0))
TOLERANCE = 2e-3  # share of what is left above the noise that a step must bring to go on
PROMISE = 0.6
"""Share of the foretold fall of the cost that a step must bring, so that the base parameters' columns are kept."""
STIFFEST = 1e4  # damping beyond which one small gain ends a fit
REACH = 4.0  # standard deviations of a day that a base parameter may be off: what lies further is an effect
STIFF = 0.25  # share of the day-to-day spread that a fit leaves base parameters which shall hardly move
ITERATIONS = 12  # of a fit, at most
WHITENED = 16  # parameter sets whose features are made white in one call
STEP_Q = 0.08  # difference quotients of a coordinate are taken over this share of its size, or of 1 where it is small


def without_each(fit: Refit, refitter: Refitter) -> list[np.ndarray]:
    """All parameters of a joint fit without one effect, for each of them."""
    return [refitter.values_at((*fit.hypotheses[:i], *fit.hypotheses[i + 1 :]), fit.u, np.delete(fit.q, part))
            for i, part in enumerate(fit.parts)]


def own_sizes(q: np.ndarray) -> np.ndarray:
    """(k,) steps of difference quotients of coordinates q (k,)."""
    return np.asarray(STEP_Q * np.maximum(np.abs(q), 1.0))


class Refitter:
    """Refits on one set of drives. The base Jacobian is kept from the reference: a day moves it by percents."""

    renews = True  # whether the base Jacobian is renewed where a step did not bring what it promised

    def __init__(self, drives: Drives, reference: Reference, values: np.ndarray, slopes: np.ndarray):
        """`values` (all parameters) at the reference; `slopes` (B, K, C, P) there."""
        self.drives, self.reference, self.values = drives, reference, values
        self.names = list(drives.names)
        self.target = self.white(reference.target_of(drives))
        self.white_slopes = self.white(slopes)
        self.precision = np.linalg.inv(reference.spread)
        away = REACH * np.sqrt(np.diag(reference.spread))
        self.low, self.high = np.maximum(reference.u - away, 0.0), np.minimum(reference.u + away, 1.0)
        self.base_index = [self.names.index(name) for name in reference.space.names]

    def aimed(self, target: np.ndarray) -> Refitter:
        """The same for other drives with these commands, of white features `target` (B, n)."""
        other = copy.copy(self)
        other.target = target
        return other

    def stiffened(self) -> Refitter:
        """The same with base parameters that hardly move."""
        other = copy.copy(self)
        other.precision = self.precision / STIFF**2
        other.low = self.reference.u + STIFF * (self.low - self.reference.u)
        other.high = self.reference.u + STIFF * (self.high - self.reference.u)
        return other

    def white_of(self, u: np.ndarray) -> np.ndarray:
        """(N, B, n) white features of the base model with parameters u (N, P)."""
        return self.white(self.drives.simulate(np.stack([self.values_at((), one, np.zeros(0)) for one in u])))

    def replayed(self, sets: np.ndarray) -> list[np.ndarray]:
        """White features (N, B, n) of parameter sets (N, all), alone in a list."""
        return [self.white(self.drives.simulate(sets))]

    def costs(self, starts: Sequence[Start]) -> np.ndarray:
        """(N,) costs of joint fits where they start; infinite where a replay is not a number."""
        if not starts:
            return np.zeros(0)
        [seen] = self.replayed(np.stack([self.values_at(one.hypotheses, one.u, one.q) for one in starts]))
        away = np.stack([one.u for one in starts]) - self.reference.u
        found = np.square(self.target - seen).sum((1, 2)) + np.einsum("ni,ij,nj->n", away, self.precision, away)
        return np.where(np.isfinite(found), found, np.inf)

    def fit(self, hypotheses: Sequence[Hypothesis], q: np.ndarray, iterations: int = ITERATIONS) -> Refit:
        """Minimise over (u, q) from a start by damped Gauss-Newton, the base parameters from the reference."""
        return self.fit_all([Start(tuple(hypotheses), self.reference.u, q)], iterations)[0]

    def stuck(self, fit: Refit) -> bool:
        """Whether a fit ended at the end of a range: there may be a better one elsewhere."""
        limits = np.array([axis.limit for one in fit.hypotheses for axis in one.axes])
        return bool((fit.u <= self.low).any() or (fit.u >= self.high).any() or (np.abs(fit.q) >= limits).any())

    def fit_all(self, starts: Sequence[Start], iterations: int) -> list[Refit]:
        """Fits from several starts, side by side."""
        return side_by_side([(self, start) for start in starts], iterations)

    def run(self, start: Start, iterations: int) -> Generator[np.ndarray, np.ndarray, Refit]:
        """One fit: yields parameter sets (N, all), is sent their white features (N, B, n).

        The coordinates' columns are renewed in every iteration, those of the base parameters, which are dearer, only
        where a step did not bring what they promised. A fit that has come to rest begins again from there, damped as at
        first and with all columns anew, as long as that promises to gain what counts and the way since the last
        beginning did.
        """
        found, size = start.hypotheses, len(start.u)
        solver = self._solver(found)
        low, high = solver.box.low[size:], solver.box.high[size:]
        state = solver.init(np.concatenate([start.u, np.clip(start.q, low, high)])[None])
        jacobian = self.white_slopes if start.slopes is None else start.slopes
        fresh, stale = start.slopes is not None or bool(np.allclose(start.u, self.reference.u)), False
        residual = self.target - (yield self._sets(found, state.u))[0]
        state = state._replace(cost=solver.cost(residual, state.u))
        begun = np.inf
        for iteration in range(iterations + 1):
            slopes = None if stale else jacobian[..., :size]
            jacobian = yield from self._derivatives(found, state.u[0], residual, slopes)
            fresh, stale = fresh or stale, False
            if iteration == iterations:
                break
            tried = solver.tries(state, *solver.normal(-residual, jacobian[None], state.u))
            left = self.target - (yield self._sets(found, tried.points[0]))
            costs = solver.cost(left, tried.points[0])
            best = int(np.nanargmin(costs))
            gained, small = float(state.cost[0] - costs[best]), solver.patience.scale(state.cost)[0]
            state, residual = solver.step(state, tried, costs[None], fresh), left[best] if gained > 0 else residual
            if not fresh:  # a small gain by old derivatives says nothing
                state = state._replace(calm=np.zeros(1, int))
            if solver.done(state).all() or (state.calm[0] and state.damping[0] > STIFFEST):
                anew = state._replace(damping=np.full(1, solver.damping), calm=np.zeros(1, int))
                promised = solver.tries(anew, *solver.normal(-residual, jacobian[None], state.u)).promised.max()
                last = not self.renews or iteration >= iterations - 1
                if last or min(begun - state.cost[0], promised) < small:
                    break
                state, begun, fresh, stale = anew, float(state.cost[0]), False, True
            elif gained > PROMISE * tried.promised[0, best] and gained >= small:
                fresh = False
            else:
                stale = self.renews and iteration < iterations - 1
        u, q = state.u[0, :size], state.u[0, size:]
        return Refit(found, u, q, float(state.cost[0]), residual, jacobian, self.values_at(found, u, q))

    def _solver(self, hypotheses: Sequence[Hypothesis]) -> GaussNewton:
        """Of base parameters, then the coordinates of hypotheses."""
        axes = [axis for one in hypotheses for axis in one.axes]
        size, count = len(self.reference.u), len(self.reference.u) + len(axes)
        low = np.concatenate([self.low, [-axis.limit if axis.signed else 0.0 for axis in axes]])
        high = np.concatenate([self.high, [axis.limit for axis in axes]])
        precision = np.zeros((count, count))
        precision[:size, :size] = self.precision

        def reach(x: np.ndarray) -> np.ndarray:
            return np.concatenate([np.full((len(x), size), 0.2), 0.7 * np.maximum(np.abs(x[:, size:]), 1.5)], axis=1)

        noise = 0.5 * float((self.drives.mask > 0).sum())
        return GaussNewton(
            BoxStep(low, high, reach, passes=4, adapt=True, floor=0.0, ridge=1e-9), CHOICES,
            Patience(TOLERANCE, times=2, noise=noise, least=1.0, failures=True),
            (np.concatenate([self.reference.u, np.zeros(len(axes))]), precision),
            damping=1e-3, least=1e-6, most=np.inf, stiffer=1e3)

    def _sets(self, hypotheses: Sequence[Hypothesis], points: np.ndarray) -> np.ndarray:
        """(N, all) parameter sets at points (N, P + k)."""
        size = len(self.reference.u)
        return np.stack([self.values_at(hypotheses, one[:size], one[size:]) for one in points])

    def _derivatives(
        self, hypotheses: Sequence[Hypothesis], x: np.ndarray, residual: np.ndarray, slopes: np.ndarray | None
    ) -> Generator[np.ndarray, np.ndarray, np.ndarray]:
        """(B, n, P + k) derivatives of the white features at x (P + k,), those by base parameters anew where `slopes`
        (B, n, P) is None."""
        size = len(self.reference.u)
        u, q = x[:size], x[size:]
        own, base = Quotients.forward(q, own_sizes(q)), Quotients.central(u, difference_sizes(self.reference.spread))
        sets = [self.values_at(hypotheses, u, point) for point in own.above]
        if slopes is None:
            sets += [self.values_at(hypotheses, point, q) for point in base.points]
        elif not sets:
            return slopes
        white = yield np.stack(sets)
        if slopes is None:
            slopes = np.asarray(base.slopes(*np.split(white[len(q) :], 2)))
        return np.concatenate([slopes, own.slopes(white[: len(q)], self.target - residual)], axis=-1)

    def white(self, series: np.ndarray) -> np.ndarray:
        """White and flat: (B, K, C, ...) -> (B, n, ...); or (N, B, K, C) -> (N, B, n)."""
        mask, filt = self.drives.mask, self.reference.whitener
        if series.shape[:3] == mask.shape:
            white = filt.apply(series, mask)
            return white.reshape(mask.shape[0], -1, *series.shape[3:])
        moved = np.moveaxis(series, 0, -1)
        parts = on_all_cores(lambda first: filt.apply(moved[..., first : first + WHITENED], mask),
                             range(0, len(series), WHITENED))
        return np.moveaxis(np.concatenate(parts, axis=-1).reshape(mask.shape[0], -1, len(series)), -1, 0)

    def values_at(self, hypotheses: Sequence[Hypothesis], u: np.ndarray, q: np.ndarray) -> np.ndarray:
        """All parameters at base coordinates u (P,) and the hypotheses' own q (k,)."""
        values = self.values.copy()
        values[self.base_index] = self.reference.space.to_values(u)
        for one, part in zip(hypotheses, parts_of(hypotheses), strict=True):
            base = dict(zip(self.names, values.tolist(), strict=True))  # two may move the same parameter
            values = with_values(values, self.names, one.values(q[part], base))
        return values


def side_by_side(fits: Sequence[tuple[Refitter, Start]], iterations: int) -> list[Refit]:
    """Fits of one vehicle to drives with the same commands (`Refitter.aimed`), each from its start: what they ask of
    the simulator at one time goes into one call."""
    if not fits:
        return []
    def compute() -> list[Any]:
        return [part for fit in _advanced_together(fits, iterations) for part in (
            fit.u, fit.q, fit.cost, fit.residual, fit.jacobian, fit.values)]

    inputs = [part for one, start in fits for part in (
        one.target, one.precision, start.u, start.q, *(() if start.slopes is None else (start.slopes,)))]
    parts = iter(step("refits", compute, *inputs))
    return [Refit(start.hypotheses, next(parts), next(parts), float(next(parts)), next(parts), next(parts),
                  next(parts)) for _, start in fits]


def _advanced_together(fits: Sequence[tuple[Refitter, Start]], iterations: int) -> list[Refit]:
    """As `side_by_side`, of one fit at least."""
    refitter = fits[0][0]
    runs = [one.run(start, iterations) for one, start in fits]
    asked = {number: next(run) for number, run in enumerate(runs)}
    done: dict[int, Refit] = {}
    while asked:
        sets = np.concatenate(list(asked.values()))
        (white,) = step("replays", partial(refitter.replayed, sets), sets)
        place, following = 0, {}
        for number, mine in asked.items():
            try:
                following[number] = runs[number].send(white[place : place + len(mine)])
            except StopIteration as end:
                done[number] = end.value
            place += len(mine)
        asked = following
    return [done[number] for number in range(len(fits))]

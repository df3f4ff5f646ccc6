"""Joint nonlinear refits: base parameters within their day-to-day spread, and the coordinates of hypotheses."""

from __future__ import annotations

import copy
from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sysid.cores import on_all_cores
from sysid.loop.catalogue import Hypothesis
from sysid.loop.drives import Drives, quotients
from sysid.loop.evidence import with_values
from sysid.loop.reference import Reference, difference_sizes

TRIES = ((1.0, 1.0), (1.0, 0.3), (30.0, 1.0))
"""Factors on the damping and shares of the step that are tried in one iteration."""
TOLERANCE = 2e-3
"""Share of what is left above the noise that a step must bring to go on."""
REACH = 4.0
"""Standard deviations of the day-to-day spread that a base parameter may be off. What lies further is an effect."""
STIFF = 0.25
"""Share of the day-to-day spread that a fit leaves base parameters which shall hardly move."""
ITERATIONS = 12
"""Of a fit, at most."""
WHITENED = 16
"""Parameter sets whose features are made white in one call."""
STEP_Q = 0.08
"""Difference quotients of a coordinate are taken over this share of its size, or of 1 where it is small."""


@dataclass(frozen=True)
class Refit:
    """A joint fit."""

    hypotheses: tuple[Hypothesis, ...]
    u: np.ndarray  # (P,) base parameters, unit coordinates
    q: np.ndarray  # (k,) coordinates of all hypotheses, one after the other
    cost: float
    """Squared white residual plus the prior's term."""
    residual: np.ndarray  # (B, n) white residual
    jacobian: np.ndarray  # (B, n, P + k) of the white features by (u, q)
    values: np.ndarray  # all parameters

    def products(self, precision: np.ndarray) -> np.ndarray:
        """(P + k, P + k) of the white columns, with the precision (P, P) of the base parameters."""
        flat = self.jacobian.reshape(-1, self.jacobian.shape[-1])
        matrix = flat.T @ flat
        size = len(precision)
        matrix[:size, :size] += precision
        return matrix

    @property
    def split(self) -> list[np.ndarray]:
        """Coordinates of each hypothesis."""
        return list(np.split(self.q, np.cumsum([len(one.axes) for one in self.hypotheses])[:-1]))

    @property
    def parts(self) -> list[slice]:
        """Where the coordinates of each hypothesis lie within q."""
        ends = np.cumsum([0, *(len(one.axes) for one in self.hypotheses)]).tolist()
        return [slice(start, stop) for start, stop in zip(ends[:-1], ends[1:], strict=True)]


def moved_last(fit: Refit, number: int) -> Refit:
    """The same joint fit with one of its hypotheses last."""
    part, size = fit.parts[number], len(fit.u)
    mine = list(range(part.start, part.stop))
    order = [*(i for i in range(len(fit.q)) if i not in mine), *mine]
    kept = (*fit.hypotheses[:number], *fit.hypotheses[number + 1 :], fit.hypotheses[number])
    columns = [*range(size), *(size + i for i in order)]
    return replace(fit, hypotheses=kept, q=fit.q[order], jacobian=fit.jacobian[..., columns])


@dataclass(frozen=True)
class Start:
    """Where a fit begins."""

    hypotheses: tuple[Hypothesis, ...]
    u: np.ndarray  # (P,)
    q: np.ndarray  # (k,)
    slopes: np.ndarray | None = None  # (B, n, P) of the white features by u there, if known

    @classmethod
    def at(cls, refit: Refit) -> Start:
        """Where a fit ended."""
        return cls(refit.hypotheses, refit.u, refit.q, refit.jacobian[..., : len(refit.u)])


class Refitter:
    """Refits on one set of drives. The base Jacobian is kept from the reference: a day moves it by percents."""

    renews = True
    """Whether the base Jacobian is renewed where a step did not bring what it promised."""

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

        The coordinates' columns are renewed in every iteration, those of the base parameters only where a step did not
        bring what they promised: a day moves them by percents, and they are the dearer ones.
        """
        found, u = start.hypotheses, start.u.copy()
        q = self._within(found, np.array(start.q, float))
        slopes = self.white_slopes if start.slopes is None else start.slopes
        fresh = start.slopes is not None or bool(np.allclose(u, self.reference.u))
        damping, calm, stale = 1e-3, 0, False
        white = yield self.values_at(found, u, q)[None]
        residual, cost = self._left(white[0], u)
        for iteration in range(iterations + 1):
            sets, steps = self._differences(found, u, q)
            points, spans = quotients(u, difference_sizes(self.reference.spread)) if stale else ([], [])
            sets += [self.values_at(found, point, q) for point in points]
            columns = np.zeros((*residual.shape, 0))
            if sets:
                white = yield np.stack(sets)
                at = self.target - residual
                columns = np.stack([(white[i] - at) / steps[i] for i in range(len(q))], axis=-1) if len(q) else columns
                if stale:
                    pairs = white[len(q) :]
                    slopes = np.stack([(pairs[2 * p] - pairs[2 * p + 1]) / span for p, span in enumerate(spans)], -1)
                    fresh, stale = True, False
            jacobian = np.concatenate([slopes, columns], axis=-1)
            if iteration == iterations:
                break
            tried, promised = [], []
            for factor, share in TRIES:
                step, promise = self._step(found, u, q, residual, jacobian, damping * factor)
                tried.append((np.clip(u + share * step[: len(u)], self.low, self.high),
                              self._within(found, q + share * step[len(u) :])))
                promised.append(promise * share * (2 - share))
            white = yield np.stack([self.values_at(found, *each) for each in tried])
            left = [self._left(one, tried[i][0]) for i, one in enumerate(white)]
            best = int(np.nanargmin([each[1] for each in left]))
            gained = cost - left[best][1]
            kept = gained > 0.6 * promised[best]
            if gained > 0:
                (u, q), (residual, cost) = tried[best], left[best]
                damping = max(damping * (0.2 if TRIES[best][0] == 1.0 else 6.0), 1e-6)
            elif fresh:
                damping *= 1e3
            small = gained < TOLERANCE * max(cost - self._floor(), 1.0)
            calm = calm + 1 if small and fresh else 0
            if calm == 2 or (calm and damping > 1e4):
                break
            if kept and not small:
                fresh = False
            elif self.renews and iteration < iterations - 1:
                stale = True
        return Refit(found, u, q, cost, residual, jacobian, self.values_at(found, u, q))

    def _left(self, white: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, float]:
        """White residual (B, n) and cost."""
        residual = self.target - white
        return residual, float(np.square(residual).sum() + self._prior(u))

    def _floor(self) -> float:
        return 0.5 * float((self.drives.mask > 0).sum())

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

    def _prior(self, u: np.ndarray) -> float:
        difference = u - self.reference.u
        return float(difference @ self.precision @ difference)

    def values_at(self, hypotheses: Sequence[Hypothesis], u: np.ndarray, q: np.ndarray) -> np.ndarray:
        """All parameters at base coordinates u (P,) and the hypotheses' own q (k,)."""
        values = self.values.copy()
        values[self.base_index] = self.reference.space.to_values(u)
        start = 0
        for one in hypotheses:
            base = dict(zip(self.names, values.tolist(), strict=True))  # two may move the same parameter
            part = q[start : start + len(one.axes)]
            values = with_values(values, self.names, one.values(part, base))
            start += len(one.axes)
        return values

    def _differences(self, hypotheses: Sequence[Hypothesis], u: np.ndarray,
                     q: np.ndarray) -> tuple[list[np.ndarray], list[float]]:
        sets: list[np.ndarray] = []
        steps: list[float] = []
        for i in range(len(q)):
            step = STEP_Q * max(abs(q[i]), 1.0)
            moved = q.copy()
            moved[i] += step
            sets.append(self.values_at(hypotheses, u, moved))
            steps.append(step)
        return sets, steps

    def _within(self, hypotheses: Sequence[Hypothesis], q: np.ndarray) -> np.ndarray:
        axes = [axis for one in hypotheses for axis in one.axes]
        low = np.array([-axis.limit if axis.signed else 0.0 for axis in axes])
        return np.clip(q, low, np.array([axis.limit for axis in axes]))

    def _step(self, hypotheses: Sequence[Hypothesis], u: np.ndarray, q: np.ndarray, residual: np.ndarray,
              jacobian: np.ndarray, damping: float) -> tuple[np.ndarray, float]:
        """Step (P + k,) within reach, and by how much it should lower the cost."""
        size = len(u)
        flat = jacobian.reshape(-1, jacobian.shape[-1])
        matrix, right = flat.T @ flat, flat.T @ residual.reshape(-1)
        matrix[:size, :size] += self.precision
        right[:size] -= self.precision @ (u - self.reference.u)
        diagonal = np.diag(matrix).copy()
        damped = matrix + np.diag(damping * diagonal + 1e-9 * diagonal.max())
        axes = [axis for one in hypotheses for axis in one.axes]
        low = np.concatenate([self.low, [-axis.limit if axis.signed else 0.0 for axis in axes]])
        high = np.concatenate([self.high, [axis.limit for axis in axes]])
        at = np.concatenate([u, q])
        free = ~((at <= low) & (right < 0)) & ~((at >= high) & (right > 0))
        reach = np.concatenate([np.full(size, 0.2), 0.7 * np.maximum(np.abs(q), 1.5)])
        step = np.zeros(len(at))
        for _ in range(4):  # what would leave its range is held at its end, and the others are solved for again
            index = np.flatnonzero(free)
            if len(index) == 0:
                break
            held = right - damped @ np.where(free, 0.0, step)
            step[index] = np.linalg.solve(damped[np.ix_(index, index)], held[index])
            cut = np.clip(step, np.maximum(low - at, -reach), np.minimum(high - at, reach))
            out = free & (cut != step)
            step = cut
            if not out.any():
                break
            free &= ~out
        return step, float(2 * right @ step - step @ matrix @ step)


def side_by_side(fits: Sequence[tuple[Refitter, Start]], iterations: int) -> list[Refit]:
    """Fits of one vehicle to drives with the same commands (`Refitter.aimed`), each from its start: what they ask of
    the simulator at one time goes into one call."""
    if not fits:
        return []
    refitter = fits[0][0]
    runs = [one.run(start, iterations) for one, start in fits]
    asked = {number: next(run) for number, run in enumerate(runs)}
    done: dict[int, Refit] = {}
    while asked:
        white = refitter.white(refitter.drives.simulate(np.concatenate(list(asked.values()))))
        place, following = 0, {}
        for number, sets in asked.items():
            try:
                following[number] = runs[number].send(white[place : place + len(sets)])
            except StopIteration as end:
                done[number] = end.value
            place += len(sets)
        asked = following
    return [done[number] for number in range(len(fits))]


def without_each(fit: Refit, refitter: Refitter) -> list[np.ndarray]:
    """All parameters of a joint fit without one effect, for each of them."""
    return [refitter.values_at((*fit.hypotheses[:i], *fit.hypotheses[i + 1 :]), fit.u, np.delete(fit.q, part))
            for i, part in enumerate(fit.parts)]

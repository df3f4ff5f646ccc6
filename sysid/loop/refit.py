"""Joint nonlinear refits: base parameters within their day-to-day spread, and the coordinates of hypotheses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sysid.loop.catalogue import Hypothesis
from sysid.loop.drives import Drives
from sysid.loop.evidence import with_values
from sysid.loop.reference import Reference, difference_sizes

TRIES = ((1.0, 1.0), (1.0, 0.3), (30.0, 1.0))
"""Factors on the damping and shares of the step that are tried in one iteration."""
REACH = 4.0
"""Standard deviations of the day-to-day spread that a base parameter may be off. What lies further is an effect."""
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

    @property
    def split(self) -> list[np.ndarray]:
        """Coordinates of each hypothesis."""
        return list(np.split(self.q, np.cumsum([len(one.axes) for one in self.hypotheses])[:-1]))


class Refitter:
    """Refits on one set of drives. The base Jacobian is kept from the reference: a day moves it by percents."""

    def __init__(self, drives: Drives, reference: Reference, values: np.ndarray, slopes: np.ndarray):
        """`values` (all parameters) at the reference; `slopes` (B, K, C, P) there."""
        self.drives, self.reference, self.values = drives, reference, values
        self.names = list(drives.names)
        self.target = self._white(reference.target_of(drives))
        self.white_slopes = self._white(slopes)
        self.precision = np.linalg.inv(reference.spread)
        away = REACH * np.sqrt(np.diag(reference.spread))
        self.low, self.high = np.maximum(reference.u - away, 0.0), np.minimum(reference.u + away, 1.0)
        self.base_index = [self.names.index(name) for name in reference.space.names]

    def fit(self, hypotheses: Sequence[Hypothesis], q: np.ndarray, iterations: int = 12,
            u: np.ndarray | None = None, tolerance: float = 2e-3) -> Refit:
        """Minimise over (u, q) from a start by damped Gauss-Newton.

        The coordinates' columns are renewed in every iteration, those of the base parameters only where a step did not
        bring what they promised: a day moves them by percents, and they are the dearer ones.
        """
        u = self.reference.u.copy() if u is None else u.copy()
        q = self._within(hypotheses, np.array(q, float))
        slopes, fresh, damping, calm = self.white_slopes, bool(np.allclose(u, self.reference.u)), 1e-3, 0
        residual, cost = self._cost(hypotheses, u, q)
        for iteration in range(iterations):
            jacobian = np.concatenate([slopes, self._coordinate_columns(hypotheses, u, q, residual)], axis=-1)
            tried, promised = [], []
            for factor, share in TRIES:
                step, promise = self._step(hypotheses, u, q, residual, jacobian, damping * factor)
                tried.append((np.clip(u + share * step[: len(u)], self.low, self.high),
                              self._within(hypotheses, q + share * step[len(u) :])))
                promised.append(promise * share * (2 - share))
            white = self._white(self.drives.simulate(np.stack([self._set(hypotheses, *each) for each in tried])))
            left = [self.target - one for one in white]
            costs = np.array([np.square(left[i]).sum() + self._prior(tried[i][0]) for i in range(len(tried))])
            best = int(np.nanargmin(costs))
            gained = cost - float(costs[best])
            kept = gained > 0.6 * promised[best]
            if gained > 0:
                (u, q), residual, cost = tried[best], left[best], float(costs[best])
                damping = max(damping * (0.2 if TRIES[best][0] == 1.0 else 6.0), 1e-6)
            elif fresh:
                damping *= 1e3
            small = gained < tolerance * max(cost - self._floor(), 1.0)
            if small and fresh:
                calm += 1
                if calm == 2 or damping > 1e4:
                    break
            else:
                calm = 0
            if kept and not small:
                fresh = False
            elif iteration < iterations - 1:
                slopes, fresh = self._base_columns(hypotheses, u, q), True
        jacobian = np.concatenate([slopes, self._coordinate_columns(hypotheses, u, q, residual)], axis=-1)
        return Refit(tuple(hypotheses), u, q, cost, residual, jacobian, self._set(hypotheses, u, q))

    def _cost(self, hypotheses: Sequence[Hypothesis], u: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, float]:
        at = self._white(self.drives.simulate(self._set(hypotheses, u, q)[None]))[0]
        residual = self.target - at
        return residual, float(np.square(residual).sum() + self._prior(u))

    def _coordinate_columns(
        self, hypotheses: Sequence[Hypothesis], u: np.ndarray, q: np.ndarray, residual: np.ndarray
    ) -> np.ndarray:
        """(B, n, k) derivative of the white features by the coordinates, by differences."""
        if len(q) == 0:
            return np.zeros((*residual.shape, 0))
        sets, steps = self._differences(hypotheses, u, q)
        seen = self._white(self.drives.simulate(np.stack(sets[1:])))
        at = self.target - residual
        return np.stack([(seen[i] - at) / steps[i] for i in range(len(q))], axis=-1)

    def _base_columns(self, hypotheses: Sequence[Hypothesis], u: np.ndarray, q: np.ndarray) -> np.ndarray:
        """(B, n, P) derivative by the base parameters at (u, q)."""
        slopes = self.drives.differences(lambda point: self._set(hypotheses, point, q), u,
                                         difference_sizes(self.reference.spread))
        return self._white(slopes)

    def _floor(self) -> float:
        return 0.5 * float((self.drives.mask > 0).sum())

    def _white(self, series: np.ndarray) -> np.ndarray:
        """White and flat: (B, K, C, ...) -> (B, n, ...); or (N, B, K, C) -> (N, B, n)."""
        mask, filt = self.drives.mask, self.reference.whitener
        if series.shape[:3] == mask.shape:
            white = filt.apply(series, mask)
            return white.reshape(mask.shape[0], -1, *series.shape[3:])
        moved = filt.apply(np.moveaxis(series, 0, -1), mask)
        return np.moveaxis(moved.reshape(mask.shape[0], -1, series.shape[0]), -1, 0)

    def _prior(self, u: np.ndarray) -> float:
        difference = u - self.reference.u
        return float(difference @ self.precision @ difference)

    def _set(self, hypotheses: Sequence[Hypothesis], u: np.ndarray, q: np.ndarray) -> np.ndarray:
        values = self.values.copy()
        values[self.base_index] = self.reference.space.to_values(u)
        start = 0
        base = dict(zip(self.names, values.tolist(), strict=True))
        for one in hypotheses:
            part = q[start : start + len(one.axes)]
            values = with_values(values, self.names, one.values(part, base))
            start += len(one.axes)
        return values

    def _differences(self, hypotheses: Sequence[Hypothesis], u: np.ndarray,
                     q: np.ndarray) -> tuple[list[np.ndarray], list[float]]:
        sets, steps = [self._set(hypotheses, u, q)], []
        for i in range(len(q)):
            step = STEP_Q * max(abs(q[i]), 1.0)
            moved = q.copy()
            moved[i] += step
            sets.append(self._set(hypotheses, u, moved))
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

"""How much each hypothesis explains, and how much it would explain if nothing were missing.

The gain of a hypothesis is by how much its columns lower the sum of squares below what base parameters, held by their
day-to-day spread, can reach. Its null distribution is that of the same number on simulated days: parameters drawn from
the spread, noise drawn as whole drives from what the reference leaves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sysid.loop.catalogue import Hypothesis
from sysid.loop.evidence import Columns, Evidence

RIDGE = 1e-6
REACH = 1.6
"""How far beyond a level its columns are trusted, as a factor on the level."""


@dataclass(frozen=True)
class Scan:
    """Gains of H hypotheses."""

    gain: np.ndarray  # (H,) best over levels
    q: tuple[np.ndarray, ...]  # per hypothesis the coordinates of that best
    null: np.ndarray  # (N, H) gains on simulated nulls
    p: np.ndarray  # (H,) p-value of each by itself
    p_family: float
    """p-value of the smallest of them."""


class Solver:
    """Ridge fits of base and chosen columns over chosen trials."""

    def __init__(self, evidence: Evidence, trials: Sequence[int] | None = None):
        chosen = list(range(len(evidence.residual))) if trials is None else list(trials)
        self.evidence, self.trials = evidence, chosen
        self.products = evidence.products[chosen].sum(0)
        self.moments = evidence.moments[chosen].sum(0)

    def fit(self, index: Sequence[int], moments: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Explained sum of squares (...,) and coefficients (..., P + k) for moments (..., all)."""
        size = self.evidence.base_size
        order = [*range(size), *index]
        matrix = self.products[np.ix_(order, order)].copy()
        matrix[:size, :size] += self.evidence.precision
        diagonal = np.diag(matrix).copy()
        matrix[np.diag_indices(len(order))] += RIDGE * np.maximum(diagonal, 1e-12)
        right = (self.moments if moments is None else moments)[..., order]
        solution = np.linalg.solve(matrix, right.T).T if right.ndim > 1 else np.linalg.solve(matrix, right)
        return (right * solution).sum(-1), solution


def gains(
    solver: Solver, hypotheses: Sequence[Hypothesis], moments: np.ndarray | None = None
) -> tuple[np.ndarray, list[list[np.ndarray]]]:
    """Gain (..., H) of each hypothesis, best over its levels, and the coordinates found at each level."""
    size = solver.evidence.base_size
    base, _ = solver.fit((), moments)
    best = np.zeros((*base.shape, len(hypotheses)))
    found: list[list[np.ndarray]] = [[] for _ in hypotheses]
    for columns in solver.evidence.columns:
        one = hypotheses[columns.hypothesis]
        gain, q = _one_gain(solver, columns, one, moments, base, size)
        best[..., columns.hypothesis] = np.maximum(best[..., columns.hypothesis], gain)
        found[columns.hypothesis].append(np.concatenate([np.atleast_1d(gain)[..., None], np.atleast_2d(q)], axis=-1))
    return best, found


def _one_gain(
    solver: Solver, columns: Columns, one: Hypothesis, moments: np.ndarray | None, base: np.ndarray, size: int
) -> tuple[np.ndarray, np.ndarray]:
    """Gain (...,) and coordinates (..., k); axes that would go below 0 where only more is possible are left out."""
    explained, solution = solver.fit(columns.index, moments)
    q = solution[..., size:].copy()
    gain = explained - base
    one_sided = np.array([not axis.signed for axis in one.axes])
    upper = np.array([axis.limit if axis.signed else REACH * columns.level for axis in one.axes])
    low = np.array([-axis.limit if axis.signed else 0.0 for axis in one.axes])
    wrong = ((q < low) & one_sided).any(-1)
    if np.any(wrong):
        if len(columns.index) == 1:
            return np.where(wrong, 0.0, gain * _kept(q, upper)), np.where(wrong[..., None], 0.0, q)
        best, best_q = np.zeros_like(gain), np.zeros_like(q)
        for position in range(len(columns.index)):
            explained, solution = solver.fit((columns.index[position],), moments)
            single = solution[..., size]
            right = single >= low[position]
            part = np.where(right, explained - base, 0.0)
            better = part > best
            best = np.where(better, part, best)
            row = np.zeros_like(q)
            row[..., position] = single
            best_q = np.where(better[..., None], row, best_q)
        gain, q = np.where(wrong, best, gain), np.where(wrong[..., None], best_q, q)
    return gain * _kept(q, upper), q


def _kept(q: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Share of a gain that counts: a column found at one size says little of one many times as large."""
    over = np.max(np.abs(q) / upper, axis=-1)
    return np.where(over <= 1.0, 1.0, np.maximum(0.0, 1.0 - (1.0 - 1.0 / np.maximum(over, 1.0)) ** 2))


def run(
    evidence: Evidence, hypotheses: Sequence[Hypothesis], spread: np.ndarray, draws: int = 1000, seed: int = 0
) -> Scan:
    """Scan all hypotheses and calibrate on simulated nulls."""
    rng = np.random.default_rng(seed)
    solver = Solver(evidence)
    gain, found = gains(solver, hypotheses)
    null, _ = gains(solver, hypotheses, null_moments(evidence, spread, draws, rng))
    q = best_levels(found, hypotheses)
    p = np.array([tail(null[:, h], gain[h]) for h in range(len(hypotheses))])
    each = np.stack([tail(null[:, h], null[:, h]) for h in range(len(hypotheses))], axis=-1)
    smallest = each.min(1)
    return Scan(gain, tuple(q), null, p, family(smallest, float(p.min())))


def best_levels(found: list[list[np.ndarray]], hypotheses: Sequence[Hypothesis]) -> list[np.ndarray]:
    """Per hypothesis the coordinates (k,) of the level that gains most, of what `gains` found."""
    best = []
    for each, one in zip(found, hypotheses, strict=True):
        levels = np.concatenate(each) if each else np.zeros((1, 1 + len(one.axes)))
        best.append(levels[np.argmax(levels[:, 0]), 1:])
    return best


def null_moments(
    evidence: Evidence, spread: np.ndarray, draws: int, rng: np.random.Generator
) -> np.ndarray:
    """Moments (N, P + S) of simulated drives in which nothing is missing."""
    size = evidence.base_size
    factor = np.linalg.cholesky(spread + 1e-14 * np.eye(size))
    products = evidence.products.sum(0)[:, :size]
    moments = np.zeros((draws, evidence.products.shape[1]))
    for n in range(draws):
        # Student's t: the spread itself is known from a few days only.
        scale = np.sqrt(8 / rng.chisquare(8))
        moments[n] = products @ (scale * factor @ rng.standard_normal(size))
        for group in evidence.groups:
            sign = rng.choice((-1.0, 1.0))
            order = rng.permutation(len(evidence.pool_moments[group[0]]))
            for place, trial in enumerate(group):
                pick = int(order[place % len(order)]) % len(evidence.pool_moments[trial])
                moments[n] += sign * evidence.pool_moments[trial][pick]
    return moments


def tail(null: np.ndarray, value: np.ndarray | float) -> np.ndarray | float:
    """P(null >= value), beyond the draws by an exponential tail through their upper tenth."""
    from scipy import stats

    value = np.asarray(value, float)
    ordered = np.sort(null)
    count = len(ordered)
    empirical = (count - np.searchsorted(ordered, value, side="left") + 1) / (count + 1)
    top = ordered[int(0.9 * count) :]
    start = top[0]
    excess = np.maximum(top - start, 0.0)
    scale = max(float(excess.mean()), 1e-9)
    far = 0.1 * stats.expon.sf(value - start, scale=scale)
    return np.where(value > top[len(top) // 2], np.maximum(far, 1e-300), empirical)


def family(smallest: np.ndarray, p: float) -> float:
    """p-value of the smallest p among dependent tests, from its null sample; extrapolated as p x effective number."""
    count = len(smallest)
    if p >= np.quantile(smallest, 0.05):
        return float((np.sum(smallest <= p) + 1) / (count + 1))
    number = 0.05 / np.quantile(smallest, 0.05)
    return float(min(1.0, number * p))

"""How much each hypothesis explains, and how much it would explain if nothing were missing.

The gain of a hypothesis is by how much its columns lower the sum of squares below what base parameters, held by their
day-to-day spread, can reach. Its worth is that gain in units in which days without the effect count too: a coordinate
that wanders from day to day must be found larger than it wanders. The null distribution of the worth is that of
simulated days: parameters drawn from the spread, noise drawn as whole drives from what the reference leaves, and the
reference days' own apparent effects in random proportion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sysid.missing.catalogue import Axis, Hypothesis
from sysid.missing.days import Wander
from sysid.missing.evidence import Columns, Evidence, Solver
from sysid.verdict.found import Scan, tail

REACH = 1.6
"""How far beyond a level its columns are trusted, as a factor on the level."""
SPREAD_FREEDOM = 8  # degrees of freedom that the day-to-day spread rests on


@dataclass(frozen=True)
class ScanPoint:
    """One hypothesis at one level; leading axes are those of the moments."""

    gain: np.ndarray  # (...,)
    worth: np.ndarray  # (...,)
    q: np.ndarray  # (..., k)


def look(
    solver: Solver, columns: Columns, axes: Sequence[Axis], wander: np.ndarray, moments: np.ndarray | None = None,
    away: np.ndarray | float = 0.0,
) -> ScanPoint:
    """Fit of one hypothesis at one level; axes that would go below 0 where only more is possible are left out.

    Args:
        wander: (k, k) covariance of the coordinates from day to day.
        moments: (..., P + S); the evidence's own if not given.
        away: (..., k) by how much to shift the coordinates.
    """
    low = np.array([-axis.limit if axis.signed else 0.0 for axis in axes])
    upper = np.array([axis.limit if axis.signed else REACH * columns.level for axis in axes])
    one_sided = np.array([not axis.signed for axis in axes])
    found = _fit(solver, columns.index, wander, moments, away)
    wrong = ((found.q < low) & one_sided).any(-1)
    if np.any(wrong):
        gain, worth, q = (np.where(wrong if leaf.ndim == wrong.ndim else wrong[..., None], 0.0, leaf)
                          for leaf in (found.gain, found.worth, found.q))
        for position, axis in enumerate(axes) if len(axes) > 1 else ():
            if axis.dependent:
                continue
            part = [position]
            shift = away[..., part] if isinstance(away, np.ndarray) else away
            alone = _fit(solver, (columns.index[position],), wander[np.ix_(part, part)], moments, shift)
            better = wrong & (alone.q[..., 0] >= low[position]) & (alone.worth > worth)
            gain, worth = np.where(better, alone.gain, gain), np.where(better, alone.worth, worth)
            row = np.zeros_like(q)
            row[..., position] = alone.q[..., 0]
            q = np.where(better[..., None], row, q)
        found = ScanPoint(gain, worth, q)
    kept = _kept(found.q, upper)
    return ScanPoint(found.gain * kept, found.worth * kept, found.q)


def _fit(solver: Solver, index: Sequence[int], wander: np.ndarray, moments: np.ndarray | None,
         away: np.ndarray | float) -> ScanPoint:
    information = solver.information(index)
    q = np.linalg.solve(information, solver.score(index, moments)[..., None])[..., 0] + away
    whole = np.linalg.inv(np.linalg.inv(information) + wander)
    return ScanPoint(np.einsum("...i,ij,...j->...", q, information, q), np.einsum("...i,ij,...j->...", q, whole, q), q)


def _kept(q: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Share of a gain that counts: a column found at one size says little of one many times as large."""
    over = np.max(np.abs(q) / upper, axis=-1)
    return np.where(over <= 1.0, 1.0, np.maximum(0.0, 1.0 - (1.0 - 1.0 / np.maximum(over, 1.0)) ** 2))


def best(
    solver: Solver, hypotheses: Sequence[Hypothesis], wander: Wander
) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, ...]]:
    """Gain (H,), worth (H,) and coordinates of each hypothesis at the level of its highest worth."""
    top: list[ScanPoint | None] = [None] * len(hypotheses)
    for columns, covariance in zip(solver.evidence.columns, wander.covariance, strict=True):
        found = look(solver, columns, hypotheses[columns.hypothesis].axes, covariance)
        so_far = top[columns.hypothesis]
        if so_far is None or found.worth > so_far.worth:
            top[columns.hypothesis] = found
    chosen = [one or ScanPoint(np.zeros(()), np.zeros(()), np.zeros(len(hypotheses[h].axes)))
              for h, one in enumerate(top)]
    return (np.array([float(one.gain) for one in chosen]), np.array([float(one.worth) for one in chosen]),
            tuple(one.q for one in chosen))


def run(
    evidence: Evidence, hypotheses: Sequence[Hypothesis], spread: np.ndarray, wander: Wander, draws: int = 1000,
    seed: int = 0,
) -> Scan:
    """Scan all hypotheses and calibrate on simulated nulls."""
    rng = np.random.default_rng(seed)
    solver = Solver(evidence)
    gain, worth, q = best(solver, hypotheses, wander)
    days = null_days(evidence, spread, wander, draws, rng)
    null = np.zeros((draws, len(hypotheses)))
    for number, (columns, covariance) in enumerate(zip(evidence.columns, wander.covariance, strict=True)):
        away = wander.away(number, days.share)
        found = look(solver, columns, hypotheses[columns.hypothesis].axes, covariance, days.moments, away)
        null[:, columns.hypothesis] = np.maximum(null[:, columns.hypothesis], found.worth)
    p = np.array([tail(null[:, h], worth[h]) for h in range(len(hypotheses))])
    each = np.stack([tail(null[:, h], null[:, h]) for h in range(len(hypotheses))], axis=-1)
    return Scan(gain, worth, q, null, p, each.min(1))


@dataclass(frozen=True)
class NullDays:
    """Simulated days on which nothing is missing."""

    moments: np.ndarray  # (N, P + S)
    share: np.ndarray  # (N, D) of the reference days' apparent effects in each


def null_days(
    evidence: Evidence, spread: np.ndarray, wander: Wander, draws: int, rng: np.random.Generator
) -> NullDays:
    """Draw days with the noise and commands of some drives; `spread` (P, P) is the day-to-day covariance of the base
    parameters."""
    size = evidence.base_size
    factor = np.linalg.cholesky(spread + 1e-14 * np.eye(size))
    products = evidence.products.sum(0)[:, :size]
    moments = np.zeros((draws, evidence.products.shape[1]))
    for n in range(draws):
        moments[n] = products @ drawn_away(factor, rng)
        for group in evidence.groups:
            moments[n] += drawn_noise([evidence.pool_moments[trial] for trial in group], evidence.shared, rng)
    return NullDays(moments, wander.draw_shares(draws, rng))


def drawn_noise(pools: Sequence[np.ndarray], shared: float, rng: np.random.Generator) -> np.ndarray:
    """(P + S,) moments of noise in drives of one manoeuvre: each has a share of its own and one that all have.

    Drives of one day have more in common than those of different days, from which they are drawn: what the model lacks
    that day, and the error of what the reference days expect.

    Args:
        pools: (J, P + S) moments that the noise of J reference drives would have in each of the drives.
        shared: part of the variance that all have.
    """
    sign = rng.choice((-1.0, 1.0))
    order = rng.permutation(len(pools[0]))
    own = sign * np.sum([pool[int(order[place % len(order)]) % len(pool)] for place, pool in enumerate(pools)], axis=0)
    if shared == 0.0 or len(pools) == 1:
        return own
    pick, sign = int(rng.integers(len(pools[0]))), rng.choice((-1.0, 1.0))
    common = sign * np.sum([pool[pick % len(pool)] for pool in pools], axis=0)
    return np.sqrt(1.0 - shared) * own + np.sqrt(shared) * common


def drawn_away(factor: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(P,) how far a day's base parameters are from the reference; `factor` (P, P) is the Cholesky factor of their
    spread. Student's t: the spread itself is known from a few days only."""
    scale = np.sqrt(SPREAD_FREEDOM / rng.chisquare(SPREAD_FREEDOM))
    return scale * factor @ rng.standard_normal(len(factor))


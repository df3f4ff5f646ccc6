"""How much hypotheses and pairs of them explain, how much if nothing were missing, and which look alike.

The gain of a hypothesis is by how much its columns lower the sum of squares below what base parameters can reach within
their spread. Its worth is that gain with the wander of its coordinates counted as noise. Nulls are simulated days:
parameters drawn from the spread, whole drives of reference noise, and the reference days' own apparent effects.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from sysid.missing.catalogue import Axis, Hypothesis
from sysid.missing.days import Wander
from sysid.missing.evidence import Columns, Evidence, Solver
from sysid.verdict.search_record import PairScan, Scan, tails

REACH = 1.6  # how far beyond a level its columns are trusted, as a factor on the level
SPREAD_FREEDOM = 8  # degrees of freedom that the day-to-day spread rests on
LEVEL = 2.0  # size at which effects are compared
DRAWS = 300  # simulated nulls for the p-values of pairs: each is asked of some ten thousand columns
TOGETHER = 256  # pairs of columns that are solved in one call
CHI_SQUARED = 2.0  # worth over which the tail of chi-squared falls by e; that of a pair is no steeper


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
    `wander`: (k, k) covariance of the coordinates from day to day; `moments`: (..., P + S), by default the evidence's
    own; `away`: (..., k) by how much to shift the coordinates."""
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
    return ScanPoint(found.gain * kept, found.worth * kept, _as_simulated(found.q, columns, axes))


def _fit(solver: Solver, index: Sequence[int], wander: np.ndarray, moments: np.ndarray | None,
         away: np.ndarray | float) -> ScanPoint:
    information = solver.information(index)
    q = np.linalg.solve(information, solver.score(index, moments)[..., None])[..., 0] + away
    whole = np.linalg.inv(np.linalg.inv(information) + wander)
    return ScanPoint(np.einsum("...i,ij,...j->...", q, information, q), np.einsum("...i,ij,...j->...", q, whole, q), q)


def _as_simulated(q: np.ndarray, columns: Columns, axes: Sequence[Axis]) -> np.ndarray:
    """Coordinates (..., k) found at a level, with the size beside which axes that only act through others were
    simulated. Where those others do nothing by themselves, as a limit that is not reached, they are found at 0: the
    whole effect would be gone."""
    dependent = np.array([axis.dependent for axis in axes])
    through = (q[..., ~dependent] == 0).all(-1) & (q[..., dependent] != 0).any(-1)
    return np.where(through[..., None] & ~dependent, columns.level, q)


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
    null = worth_on(days, solver, hypotheses, wander)
    return Scan(gain, worth, q, null, tails(null, worth), tails(null, null).min(1))


def worth_on(days: NullDays, solver: Solver, hypotheses: Sequence[Hypothesis], wander: Wander) -> np.ndarray:
    """(N, H) worth of each hypothesis on simulated days, at the level of its highest."""
    worth = np.zeros((len(days.moments), len(hypotheses)))
    for number, (columns, covariance) in enumerate(zip(solver.evidence.columns, wander.covariance, strict=True)):
        away = wander.away(number, days.share)
        found = look(solver, columns, hypotheses[columns.hypothesis].axes, covariance, days.moments, away)
        worth[:, columns.hypothesis] = np.maximum(worth[:, columns.hypothesis], found.worth)
    return worth


@dataclass(frozen=True)
class NullDays:
    """Simulated days on which nothing is missing."""

    moments: np.ndarray  # (N, P + S)
    share: np.ndarray  # (N, D) of the reference days' apparent effects in each


def null_days(evidence: Evidence, spread: np.ndarray, wander: Wander, draws: int, rng: np.random.Generator) -> NullDays:
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
    """(P + S,) moments of noise in drives of one manoeuvre, from `pools` (J, P + S) of the moments that the noise of J
    reference drives would have in each. Drives of one day have more in common than those of different days, from which
    they are drawn: a `shared` part of the variance is that of one draw."""
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


def imitation(evidence: Evidence, hypotheses: Sequence[Hypothesis]) -> np.ndarray:
    """(H, H) |cos| between what hypothesis i changes and the best that hypothesis j does instead, at its best size.

    Base parameters may move within their spread on both sides. An effect of several axes counts by the axis that the
    other imitates worst, but not by one-sided ones that only change what the others do.
    """
    size = evidence.base_size
    products = evidence.products.sum(0)
    inner = np.linalg.inv(products[:size, :size] + evidence.precision)
    left = products[size:, size:] - products[size:, :size] @ inner @ products[:size, size:]
    groups: list[list[Columns]] = [[] for _ in hypotheses]
    for columns in evidence.columns:
        groups[columns.hypothesis].append(columns)
    out = np.eye(len(hypotheses))
    for i in range(len(hypotheses)):
        mine = min(groups[i], key=lambda one: abs(one.level - LEVEL))
        own = [column for column, axis in zip(mine.index, hypotheses[i].axes, strict=True)
               if axis.signed or not axis.dependent]
        for j in range(len(hypotheses)):
            if i != j:
                out[i, j] = max(_cosine(left, own, other, size) for other in groups[j])
    return out


def _cosine(left: np.ndarray, mine: Sequence[int], other: Columns, size: int) -> float:
    index = [i - size for i in other.index]
    inside = left[np.ix_(index, index)]
    inverse = np.linalg.pinv(inside, rcond=1e-8)
    cosines = []
    for column in mine:
        cross = left[column - size, index]
        own = left[column - size, column - size]
        if own > 1e-9:
            cosines.append(np.sqrt(max(float(cross @ inverse @ cross), 0.0) / own))
    return float(min(min(cosines), 1.0)) if cosines else 0.0


class PairSolver:
    """Scores and information of all columns beside the base, of the drives (row 0) and of simulated nulls."""

    def __init__(self, evidence: Evidence, hypotheses: Sequence[Hypothesis], wander: Wander, nulls: NullDays):
        solver, self.size = Solver(evidence), evidence.base_size
        index = range(self.size, len(solver.products))
        self.left = solver.information(index)
        self.score = solver.score(index, np.concatenate([solver.moments[None], nulls.moments]))  # (1 + N, S)
        self.columns, self.wander = evidence.columns, wander.covariance
        away = [wander.away(number, nulls.share) for number in range(len(wander.shapes))]
        self.away = [np.concatenate([np.zeros((1, one.shape[1])), one]) for one in away]  # the drives' own is 0
        self.ends = [_ends(one, hypotheses[one.hypothesis]) for one in evidence.columns]

    def look(self, first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Gain (M, 1 + N), worth (M, 1 + N) and coordinates (M, 1 + N, k) of M pairs of columns' hypotheses together; 0
        where one of them would go where it cannot. The `first` (M,) all have as many coordinates, the `second` too."""
        sides = (first, second)
        index = np.concatenate([np.array([self.columns[i].index for i in one]) for one in sides], axis=1) - self.size
        information = self.left[index[:, :, None], index[:, None, :]]  # (M, k, k)
        q = np.linalg.solve(information, np.moveaxis(self.score[:, index], 0, -1)).swapaxes(1, 2)
        q = q + np.concatenate([np.stack([self.away[i] for i in one]) for one in sides], axis=2)
        wide, cut = np.zeros_like(information), len(self.columns[first[0]].index)
        for one, part in zip(sides, (slice(cut), slice(cut, None)), strict=True):
            wide[:, part, part] = np.stack([self.wander[i] for i in one])
        low, upper = (np.concatenate([np.stack([self.ends[i][end] for i in one]) for one in sides], axis=1)[:, None]
                      for end in (0, 1))
        kept = ((q >= low) & (np.abs(q) <= upper)).all(2)
        whole = np.linalg.inv(np.linalg.inv(information) + wide)
        return ((q @ information * q).sum(2) * kept, (q @ whole * q).sum(2) * kept, q)


def _ends(columns: Columns, hypothesis: Hypothesis) -> tuple[np.ndarray, np.ndarray]:
    """(k,) least coordinates, and largest sizes at which columns found at their level are trusted."""
    low = np.array([-axis.limit if axis.signed else 0.0 for axis in hypothesis.axes])
    return low - 1e-9, np.array([axis.limit if axis.signed else REACH * columns.level for axis in hypothesis.axes])


def scan_pairs(
    evidence: Evidence, hypotheses: Sequence[Hypothesis], wander: Wander, nulls: NullDays, similar: np.ndarray,
    alike: float,
) -> PairScan:
    """Scan all pairs of different effects that these drives separate; days without any effect, `nulls`, calibrate it.
    Pairs of signatures with a |cos| (H, H) above `alike` are one class, not two effects."""
    members = tuple((i, j) for i, j in combinations(range(len(hypotheses)), 2)
                    if hypotheses[i].effect != hypotheses[j].effect and max(similar[i, j], similar[j, i]) <= alike)
    gain, worth, found, null = _looked(PairSolver(evidence, hypotheses, wander, nulls), hypotheses, members)
    smallest = tails(null, null, CHI_SQUARED).min(1, initial=1.0)
    return PairScan(members, gain, worth, found, tails(null, worth, CHI_SQUARED), smallest, null)


def scan_again(first: PairScan, evidence: Evidence, hypotheses: Sequence[Hypothesis], wander: Wander) -> PairScan:
    """The same pairs on other drives of the same commands, held against the nulls of a scan made before."""
    nothing = NullDays(np.zeros((0, evidence.products.shape[1])), np.zeros((0, len(wander.shapes[0]))))
    gain, worth, found, _ = _looked(PairSolver(evidence, hypotheses, wander, nothing), hypotheses, first.members)
    return replace(first, gain=gain, worth=worth, q=found, p=tails(first.null, worth, CHI_SQUARED))


def _looked(
    bench: PairSolver, hypotheses: Sequence[Hypothesis], members: Sequence[tuple[int, int]]
) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, ...], np.ndarray]:
    """Gain (M,), worth (M,) and coordinates of pairs at the levels of their highest worth; worth (N, M) on nulls."""
    placed: list[list[int]] = [[] for _ in hypotheses]
    for number, one in enumerate(bench.columns):
        placed[one.hypothesis].append(number)
    gain, worth = np.zeros(len(members)), np.zeros(len(members))
    found = [np.zeros(len(hypotheses[i].axes) + len(hypotheses[j].axes)) for i, j in members]
    null = np.zeros((len(bench.score) - 1, len(members)))
    alike: dict[tuple[int, int], list[tuple[int, int, int]]] = {}
    for number, (i, j) in enumerate(members):
        sizes = len(hypotheses[i].axes), len(hypotheses[j].axes)
        alike.setdefault(sizes, []).extend((number, a, b) for a in placed[i] for b in placed[j])
    for tried in alike.values():
        for begin in range(0, len(tried), TOGETHER):
            numbers, first, second = np.array(tried[begin : begin + TOGETHER]).T
            gains, worths, q = bench.look(first, second)
            np.maximum.at(null.T, numbers, worths[:, 1:])
            for m, number in enumerate(numbers):
                if worths[m, 0] > worth[number]:
                    gain[number], worth[number] = gains[m, 0], worths[m, 0]
                    sides = bench.columns[first[m]], bench.columns[second[m]]
                    parts = np.split(q[m, 0], [len(sides[0].index)])
                    found[number] = np.concatenate([_as_simulated(part, one, hypotheses[one.hypothesis].axes)
                                                    for part, one in zip(parts, sides, strict=True)])
    return gain, worth, tuple(found), null

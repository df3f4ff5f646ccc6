"""Two effects at once: how much each pair of hypotheses explains that neither explains alone.

Effects may hide one another: where two change the same motion in opposite ways, neither stands out, or a third one that
resembles their sum does. The scan therefore asks pairs as it asks single hypotheses: gain of both together beside the
base model, worth with what each wanders from day to day, and p-values from the same simulated nulls.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from sysid.missing.catalogue import Hypothesis
from sysid.missing.days import Wander
from sysid.missing.evidence import RIDGE, Columns, Evidence, Solver
from sysid.verdict.found import PairScan, tail
from sysid.verdict.scan import REACH, NullDays

DRAWS = 300
"""Simulated nulls for the p-values of pairs: each is asked of some ten thousand columns."""
TOGETHER = 256
"""Pairs of columns that are solved in one call."""
CHI_SQUARED = 2.0
"""Worth over which the tail of chi-squared falls by e. That of a pair is no steeper: many are 0 on nearly all nulls."""


class PairSolver:
    """Scores and information of all columns beside the base, of the drives (row 0) and of simulated nulls."""

    def __init__(self, evidence: Evidence, hypotheses: Sequence[Hypothesis], wander: Wander, nulls: NullDays):
        solver, self.size = Solver(evidence), evidence.base_size
        size = self.size
        self.left = solver.products[size:, size:] - solver.products[:size, size:].T @ solver.project[:, size:]
        self.left[np.diag_indices(len(self.left))] += RIDGE * np.maximum(np.diag(solver.products)[size:], 1e-12)
        every = np.concatenate([solver.moments[None], nulls.moments])
        self.score = every[:, size:] - every[:, :size] @ solver.project[:, size:]  # (1 + N, S)
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
    """Scan all pairs of different effects that these drives separate, and calibrate on simulated nulls.

    Args:
        nulls: days without any effect, which calibrate the p-values.
        similar: (H, H) |cos| of signatures; pairs above `alike` are one class, not two effects.
    """
    members = tuple((i, j) for i, j in combinations(range(len(hypotheses)), 2)
                    if hypotheses[i].effect != hypotheses[j].effect and max(similar[i, j], similar[j, i]) <= alike)
    gain, worth, found, null = _looked(PairSolver(evidence, hypotheses, wander, nulls), hypotheses, members)
    p, smallest = np.ones(len(members)), np.ones(len(null))
    for m in range(len(members)):
        p[m] = float(tail(null[:, m], worth[m], CHI_SQUARED))
        smallest = np.minimum(smallest, tail(null[:, m], null[:, m], CHI_SQUARED))
    return PairScan(members, gain, worth, found, p, smallest, null)


def scan_again(first: PairScan, evidence: Evidence, hypotheses: Sequence[Hypothesis], wander: Wander) -> PairScan:
    """The same pairs on other drives of the same commands, held against the nulls of a scan made before."""
    nothing = NullDays(np.zeros((0, evidence.products.shape[1])), np.zeros((0, len(wander.shapes[0]))))
    gain, worth, found, _ = _looked(PairSolver(evidence, hypotheses, wander, nothing), hypotheses, first.members)
    p = np.array([float(tail(first.null[:, m], worth[m], CHI_SQUARED)) for m in range(len(first.members))])
    return replace(first, gain=gain, worth=worth, q=found, p=p)


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
                    gain[number], worth[number], found[number] = gains[m, 0], worths[m, 0], q[m, 0]
    return gain, worth, tuple(found), null

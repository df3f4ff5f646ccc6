"""Everything the verdict needs from the simulator, as small matrices.

The white residual of the drives, the columns by which base parameters change it and those by which each hypothesis
does are multiplied with each other once, trial by trial. Fits, tests between trials, held-back manoeuvres and
thousands of simulated nulls are then algebra on these products.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sysid.missing.catalogue import LEVELS, Hypothesis

RIDGE = 1e-6


@dataclass(frozen=True)
class Columns:
    """Where the columns of one hypothesis at one level are."""

    hypothesis: int
    level: float
    index: tuple[int, ...]


@dataclass(frozen=True)
class Evidence:
    """White residual d and columns X = [base | hypotheses] of B trials, and their products."""

    residual: np.ndarray  # (B, n)
    design: np.ndarray  # (B, n, P + S)
    base_size: int
    columns: tuple[Columns, ...]
    precision: np.ndarray  # (P, P) of the base parameters, in unit coordinates
    products: np.ndarray  # (B, P + S, P + S)
    moments: np.ndarray  # (B, P + S)
    pool_moments: tuple[np.ndarray, ...]  # per trial (J, P + S) of white noise of J drives like it
    groups: tuple[tuple[int, ...], ...]  # trials of one manoeuvre
    shared: float = 0.0  # share of a drive's noise that the others of its manoeuvre have as well (`Reference.shared`)


def column_layout(hypotheses: Sequence[Hypothesis], offset: int) -> tuple[Columns, ...]:
    """Which columns `gather` makes, behind those of `offset` base parameters."""
    found = []
    for number, one in enumerate(hypotheses):
        for level in (1.0,) if one.signed else LEVELS:
            found.append(Columns(number, level, tuple(range(offset, offset + len(one.axes)))))
            offset += len(one.axes)
    return tuple(found)


def with_values(values: np.ndarray, names: Sequence[str], changes: dict[str, float]) -> np.ndarray:
    """Values (P,) with some of them replaced."""
    out = values.copy()
    for name, value in changes.items():
        out[names.index(name)] = value
    return out


def at_fit(evidence: Evidence, residual: np.ndarray, jacobian: np.ndarray, moved: np.ndarray,
           held: np.ndarray | float = 0.0) -> Evidence:
    """The evidence after a fit of the base and of some coordinates, which join the base.

    Args:
        residual: (B, n) white residual there.
        jacobian: (B, n, P + k) of the white features there.
        moved: (P,) how far the base parameters are from the reference.
        held: (k,) prior precision of the coordinates.
    """
    size, extra = evidence.base_size, jacobian.shape[-1] - evidence.base_size
    residual = residual + jacobian[..., :size] @ moved
    design = np.concatenate([jacobian, evidence.design[..., size:]], axis=-1)
    precision = np.zeros((size + extra, size + extra))
    precision[:size, :size] = evidence.precision
    precision[range(size, size + extra), range(size, size + extra)] = held
    columns = tuple(replace(c, index=tuple(i + extra for i in c.index)) for c in evidence.columns)
    return replace(evidence, residual=residual, design=design, base_size=size + extra, columns=columns,
                   precision=precision, products=np.einsum("bni,bnj->bij", design, design, optimize=True),
                   moments=np.einsum("bni,bn->bi", design, residual))


class Solver:
    """Ridge fits of base and chosen columns over chosen trials."""

    def __init__(self, evidence: Evidence, trials: Sequence[int] | None = None):
        chosen = list(range(len(evidence.residual))) if trials is None else list(trials)
        self.evidence, self.trials = evidence, chosen
        self.products = evidence.products[chosen].sum(0)
        self.moments = evidence.moments[chosen].sum(0)
        size = evidence.base_size
        matrix = self.products[:size, :size] + evidence.precision
        matrix = matrix + np.diag(RIDGE * np.maximum(np.diag(matrix), 1e-12))
        self.project = np.linalg.solve(matrix, self.products[:size, :])  # (P, P + S)

    def information(self, index: Sequence[int]) -> np.ndarray:
        """(k, k) information on the coordinates of columns, beside the base."""
        size, chosen = self.evidence.base_size, list(index)
        matrix = self.products[np.ix_(chosen, chosen)] - self.products[:size, chosen].T @ self.project[:, chosen]
        diagonal = np.maximum(np.diag(self.products)[chosen], 1e-12)
        return matrix + np.diag(RIDGE * diagonal)

    def score(self, index: Sequence[int], moments: np.ndarray | None = None) -> np.ndarray:
        """(..., k) what is left of moments (..., P + S) for columns, beside the base."""
        right = self.moments if moments is None else moments
        size, chosen = self.evidence.base_size, list(index)
        return right[..., chosen] - right[..., :size] @ self.project[:, chosen]

"""Ridge fits of chosen columns beside the base, from the evidence's products."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sysid.missing.evidence import Evidence

RIDGE = 1e-6


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

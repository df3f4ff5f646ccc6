"""Which effects look alike on a set of drives: what one changes, base parameters and the other can imitate."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sysid.missing.catalogue import Hypothesis
from sysid.missing.evidence import Columns, Evidence

LEVEL = 2.0  # size at which effects are compared


def imitation(evidence: Evidence, hypotheses: Sequence[Hypothesis]) -> np.ndarray:
    """(H, H) |cos| between what hypothesis i changes and the best that hypothesis j does instead.

    Base parameters may move within their spread on both sides. An effect of several axes counts by the axis that the
    other imitates worst, but not by one-sided ones that only change what the others do: it is the same effect without
    them. Of several sizes of j the best.
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

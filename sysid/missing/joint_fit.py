"""A joint fit of base parameters and effects, and where one starts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from sysid.missing.catalogue import Hypothesis


@dataclass(frozen=True)
class Refit:
    hypotheses: tuple[Hypothesis, ...]
    u: np.ndarray  # (P,) base parameters, unit coordinates
    q: np.ndarray  # (k,) coordinates of all hypotheses, one after the other
    cost: float  # squared white residual plus the prior's term
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
        return [self.q[part] for part in self.parts]

    @property
    def parts(self) -> list[slice]:
        """Where the coordinates of each hypothesis lie within q."""
        return parts_of(self.hypotheses)


def parts_of(hypotheses: Sequence[Hypothesis]) -> list[slice]:
    """Where the coordinates of each of some hypotheses lie, one after the other."""
    ends = np.cumsum([0, *(len(one.axes) for one in hypotheses)]).tolist()
    return [slice(start, stop) for start, stop in pairwise(ends)]


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
    hypotheses: tuple[Hypothesis, ...]
    u: np.ndarray  # (P,)
    q: np.ndarray  # (k,)
    slopes: np.ndarray | None = None  # (B, n, P) of the white features by u there, if known

    @classmethod
    def at(cls, refit: Refit) -> Start:
        return cls(refit.hypotheses, refit.u, refit.q, refit.jacobian[..., : len(refit.u)])

"""What a search returns, and how it reports its progress."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

Progress = Callable[[int, str], None]  # called with the number of evaluations just done and a short remark


class Stages:
    """Numbered stages of a search: costs of two stages are of two objectives, so a reader must know which one runs."""

    def __init__(self, progress: Progress | None, count: int) -> None:
        """Take where the progress goes, and the number of stages."""
        self._progress, self._count, self._number = progress, count, 0

    def begin(self, name: str) -> Progress | None:
        self._number += 1
        progress, title = self._progress, f"stage {self._number} of {self._count}, {name}"
        if progress is None:
            return None
        progress(0, title)
        return lambda count, remark: progress(count, f"{title}: {remark}")


@dataclass(frozen=True)
class FitResult:
    """Best point of a search, in unit coordinates."""

    u: np.ndarray  # (P,)
    cost: float
    initial_cost: float  # cost of the first candidate, the initial values
    evaluations: int
    starts: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))  # (S, P) ends, or best candidates
    start_costs: np.ndarray = field(default_factory=lambda: np.zeros(0))  # (S,) cost of each of them, where known
    order: np.ndarray = field(default_factory=lambda: np.zeros(0, int))  # (S,) which given starts they are of
    history: np.ndarray = field(default_factory=lambda: np.zeros(0))  # best cost after each

    @property
    def as_given(self) -> tuple[np.ndarray, np.ndarray]:
        """End points (S, P) and costs (S,) of a gradient search in the order of the given starts."""
        place = np.argsort(self.order)
        return self.starts[place], self.start_costs[place]


@dataclass(frozen=True)
class Trace:
    """Best point so far of one search, whenever it got better, and at its end."""

    method: str
    seed: int
    evaluations: np.ndarray  # (K,) parameter sets simulated until then
    seconds: np.ndarray  # (K,)
    cost: np.ndarray  # (K,) mean squared residual in noise scales
    u: np.ndarray  # (K, P)
    held_out: np.ndarray  # (K,) mean position RMSE on held-out trials [m]; nan without any

"""Fits of a vehicle with effects to whole poses, through the replay that the search has compiled."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from sysid import gradient
from sysid.log import Trial
from sysid.loop.drives import Drives
from sysid.loop.evidence import with_values
from sysid.loop.reference import difference_sizes
from sysid.objective import Objective, estimate_noise
from sysid.rollout import Simulated
from sysid.space import Space


@dataclass(frozen=True)
class PoseReplay:
    """What `sysid.objective.Objective` replays: some of the parameters of drives free, the others held."""

    drives: Drives
    held: np.ndarray  # (all,) values of all parameters
    free: tuple[str, ...]
    steps: np.ndarray  # (P,) of difference quotients, in the parameters' own units

    def simulate(self, values: np.ndarray) -> Simulated:
        """Replays with values (N, P) of the free parameters."""
        return self.drives.replay(np.stack([self._set(row) for row in values]))

    def jacobian(self, values: np.ndarray) -> tuple[Simulated, Simulated]:
        """Replays (N, B, ...) and their derivatives (N, B, ..., P) by central differences."""
        sets = []
        for row in values:
            sets.append(row)
            for p, step in enumerate(self.steps):
                for sign in (1, -1):
                    moved = row.copy()
                    moved[p] += sign * step
                    sets.append(moved)
        each = 1 + 2 * len(self.steps)
        seen = self.simulate(np.stack(sets))

        def slope(leaf: np.ndarray) -> np.ndarray:
            pairs = leaf.reshape(len(values), each, *leaf.shape[1:])[:, 1:]
            spans = 2 * self.steps.reshape(1, -1, *(1,) * (leaf.ndim - 1))
            return np.moveaxis((pairs[:, ::2] - pairs[:, 1::2]) / spans, 1, -1)

        return jax.tree.map(lambda leaf: leaf[::each], seen), jax.tree.map(slope, seen)

    def _set(self, values: np.ndarray) -> np.ndarray:
        return with_values(self.held, self.drives.names, dict(zip(self.free, values.tolist(), strict=True)))


def fit_poses(
    drives: Drives, trials: Sequence[Trial], space: Space, held: np.ndarray, spread: np.ndarray, iterations: int,
    others: np.ndarray | None = None,
) -> np.ndarray | None:
    """Unit coordinates (P,) of the least error in whole poses and speeds; None where the start is best.

    Args:
        space: the free parameters, from where to start.
        held: (all,) values of all parameters of the drives.
        spread: (P, P) covariance over which derivatives are taken, in unit coordinates.
        others: (S, P) further starts, in unit coordinates.
    """
    start = space.to_unit(space.initial)
    noise = estimate_noise(tuple(trials))

    def objective(at: np.ndarray) -> Objective:
        replay: Any = PoseReplay(drives, held, tuple(space.names), difference_sizes(spread) * space.slope(at))
        return Objective(replay, space, tuple(trials), drives.measured, noise)

    if noise.source == "defaults":
        noise = objective(start).residual_noise(start)
    starts = [start] if others is None else [start, *others]
    fits = [gradient.fit(objective(one), space, starts=one[None], iterations=iterations) for one in starts]
    best = min(fits, key=lambda fit: fit.cost)
    return best.u if best.cost < fits[0].initial_cost else None

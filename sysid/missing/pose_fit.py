"""Fits of a vehicle with effects to whole poses, through the replay that the search has compiled."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sysid.errors.pose_objective import Objective, estimate_noise
from sysid.errors.space import Residuals, Space
from sysid.logs.metrics import replicate_noise
from sysid.logs.records import Trial
from sysid.missing.days import difference_sizes
from sysid.missing.drives import Drives
from sysid.missing.evidence import with_values
from sysid.replay.arrays import Quotients
from sysid.replay.records import Measured, Simulated
from sysid.search import least_squares


@dataclass(frozen=True)
class PoseReplay:
    """What `sysid.errors.pose_objective.Objective` replays: some of the parameters of drives free, the others held."""

    drives: Drives
    held: np.ndarray  # (all,) values of all parameters
    free: tuple[str, ...]
    steps: np.ndarray  # (P,) of difference quotients, in the parameters' own units

    def simulate(self, values: np.ndarray) -> Simulated:
        """Replays with values (N, P) of the free parameters."""
        return self.drives.replay(np.stack([
            with_values(self.held, self.drives.names, dict(zip(self.free, row, strict=True)))
            for row in values.tolist()]))

    def jacobian(self, values: np.ndarray) -> tuple[Simulated, Simulated]:
        """Replays (N, B, ...) and their derivatives (N, B, ..., P) by central differences."""
        return Quotients.central(values, self.steps, -np.inf, np.inf).along(values, self.simulate)


SEARCHES, WORTH = 6, 1e-3  # searches at most, and the share of the cost that one must gain for another to follow
POOLED = 1.0  # degrees of freedom that the noise of all replicates counts as, beside those of a manoeuvre's own


def by_own_noise(trials: Sequence[Trial], measured: Measured) -> Measured:
    """The measurements with masks that weigh each trial by what replicates of its manoeuvre differ by.

    Replicates that skid part by ten times as much as others: with one noise for all, the fit would follow their chance.
    Variances of few replicates are drawn towards that of all, which manoeuvres without any have.
    """
    pooled = replicate_noise(tuple(trials))
    if pooled is None:
        return measured
    weights: dict[str, list[np.ndarray]] = {channel: [] for channel in pooled}
    for trial in trials:
        mine = tuple(other for other in trials if other.manoeuvre == trial.manoeuvre)
        own = replicate_noise(mine)
        for channel, scale in pooled.items():
            common = np.square(scale)
            variance = common if own is None else (
                POOLED * common + (len(mine) - 1) * np.square(own[channel])) / (POOLED + len(mine) - 1)
            variance, common = (np.concatenate([[each[:2].mean()] * 2, each[2:]]) for each in (variance, common))
            ratio = np.sqrt(common / np.maximum(variance, 1e-12))
            weights[channel].append(np.where(np.isfinite(ratio) & (ratio > 0), ratio, 1.0))
    return replace(measured, pose_mask=measured.pose_mask * np.stack(weights["ground_truth"])[:, None],
                   odometry_mask=measured.odometry_mask * np.stack(weights["odometry"])[:, None])


def fit_poses(
    drives: Drives, space: Space, held: np.ndarray, spread: np.ndarray, iterations: int,
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
    noise, measured = estimate_noise(drives.trials), by_own_noise(drives.trials, drives.measured)

    def objective(at: np.ndarray) -> Objective:
        replay: Any = PoseReplay(drives, held, tuple(space.names), difference_sizes(spread) * space.slope(at))
        return Objective(replay, space, drives.trials, measured, noise).renewed(at)

    ends = [to_its_end(objective, one, iterations) for one in ([start] if others is None else [start, *others])]
    best = int(least_squares.costs_of(objective(ends[0]), np.stack([start, *ends])).argmin())
    return ends[best - 1] if best else None


def to_its_end(objective: Callable[[np.ndarray], Residuals], u: np.ndarray, iterations: int) -> np.ndarray:
    """Where searches of so many iterations at most end, each begun where the one before ended, until one gains nothing
    that counts: costs are jagged, and rounding decides where a single one ends.

    `objective`: around unit coordinates (P,), with the noise that is left there; `u`: (P,) where the first one begins.
    """
    for _ in range(SEARCHES):
        found = least_squares.fit(objective(u), starts=u[None], stop=least_squares.Stopping(iterations))
        u = found.u
        if found.initial_cost - found.cost <= WORTH * found.cost:
            break
    return u

"""Where the search on poses starts: the vehicle fitted to its motion in short bins.

A pose adds up all motion before it, so that far from the truth its error has folds in which a search stays. The motion
within a bin of a quarter of a second has not, and what differs between replicates is nearly the same in every bin. A
search there needs few steps; poses then tell what adds up over a whole drive. Searches from random points within the
full bounds of the physical model still end in valleys of a wrong delay or torque limit: a start is therefore the best
end of searches from the best of many random points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from sysid import gradient
from sysid.arrays import namespace
from sysid.cores import on_processor
from sysid.loop.features import Features, bin_width, make_features
from sysid.loop.noise import Whitener, first_scales, fit_roughness, fit_whitener, replicate_groups, roughness
from sysid.normal_equations import NormalEquations, make_equations
from sysid.objective import HUGE, Objective, Replays
from sysid.result import FitResult, Progress
from sysid.rollout import Simulated
from sysid.space import Space

SCAN = 256
"""Random points that are replayed for one start; a search from a random point itself ends in the nearest valley."""
KEPT = 3
"""The best of them, from each of which is searched: a few steps do not tell yet which valley is the deepest."""
STEPS = 20
"""Iterations of those searches, at most."""
EDGE = 0.02  # of the range, at both ends, without random points
CHUNK, ACCELERATED = 512, 4096  # points replayed together, on a processor and on an accelerator
AGREE = 0.02
"""Starts agree where their costs differ by no more than this share of the best one."""
TOLERANCE = 1e-3  # share of the cost by which it must fall for a start to go on
NEAR = 1e-3  # step of the features' derivative, in metres or radians of the samples


@dataclass(frozen=True)
class FeatureObjective:
    """Whitened errors in features, in unit coordinates of `space`: what `gradient.fit` minimises."""

    replay: Replays
    space: Space
    features: Features
    target: np.ndarray  # (B, K, C) measured features
    mask: np.ndarray  # (B, K, C) weights of the bins
    whitener: Whitener

    @property
    def counted(self) -> int:
        """Number of measured values."""
        return int((self.mask > 0).sum())

    def simulate(self, u: np.ndarray) -> np.ndarray:
        """Features (N, B, K, C) at unit coordinates (N, P)."""
        return self.features.of(self.replay.simulate(self.space.to_values(u)))

    def weighted_cost(self, u: np.ndarray) -> np.ndarray:
        """Mean squared residual (N,)."""
        return gradient.costs_of(self, u)

    def residuals(self, u: np.ndarray, simulated: Simulated | None = None) -> np.ndarray:
        """(N, B, K C) white residuals of unit coordinates (N, P); those of a drive that diverged are huge."""
        return self._white(self.simulate(u) if simulated is None else self.features.of(simulated))

    def bad(self, simulated: Simulated) -> Any:
        """(N, B) replays that diverged."""
        return _bad(self.features.of(simulated))[..., 0]

    @property
    def arrays(self) -> tuple[Any, ...]:
        """What it may differ in from others of the same replay."""
        return self.target, self.mask, self.whitener.scale, self.whitener.coefficients, self.whitener.inverse

    @property
    def kind(self) -> Any:
        """As in `sysid.normal_equations`."""
        return FeatureObjective

    def with_arrays(self, arrays: tuple[Any, ...]) -> FeatureObjective:
        """The same with other `arrays`."""
        return replace(self, target=arrays[0], mask=arrays[1], whitener=Whitener(*arrays[2:]))

    @cached_property
    def equations(self) -> NormalEquations | None:
        """What an accelerator computes of the residuals by itself."""
        return make_equations(self)

    def jacobian(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Residuals (N, B, K C) and their derivatives by u (N, B, K C, P)."""
        of, scale = self.features.of, self.space.slope(u)
        value, slope = self.replay.jacobian(self.space.to_values(u))
        at = of(value)
        samples: list[Any] = [np.asarray(one, float) for one in (value.pose, value.odometry)]
        columns = []
        for p in range(u.shape[1]):  # features are a smooth map of the samples: differences suffice
            steps = [np.nan_to_num(np.asarray(one[..., p], float), posinf=0.0, neginf=0.0)
                     for one in (slope.pose, slope.odometry)]
            largest = np.maximum(*(np.abs(step).max((1, 2, 3), initial=0.0) for step in steps))  # (N,)
            size = (NEAR / np.maximum(largest, 1e-12))[:, None, None, None]
            ends = [of(Simulated(samples[0] + sign * size * steps[0], samples[1] + sign * size * steps[1],
                                 value.diverged)) for sign in (1, -1)]
            columns.append(self._apply((ends[0] - ends[1]) / (2 * size)))
        jacobian = np.where(_bad(at)[..., None], 0.0, np.stack(columns, axis=-1))
        return self._white(at), jacobian * scale[:, None, None, :]

    def _white(self, at: np.ndarray) -> np.ndarray:
        xp = namespace(at)
        white = self._apply(xp.where(xp.isfinite(at), at, 0.0) - self.target)
        return xp.where(_bad(at), HUGE * (self.mask > 0).reshape(len(self.mask), -1), white)

    def _apply(self, series: np.ndarray) -> np.ndarray:
        """White series (N, B, K C) of (N, B, K, C)."""
        xp = namespace(series)
        white = xp.moveaxis(self.whitener.apply(xp.moveaxis(series, 0, -1), self.mask), -1, 0)
        return white.reshape(*white.shape[:2], -1)


def _bad(at: np.ndarray) -> np.ndarray:
    """(N, B, 1) drives that diverged, of features (N, B, K, C)."""
    return ~namespace(at).isfinite(at).all((-1, -2))[..., None]


def fit(
    objective: Objective, points: np.ndarray, track: float, iterations: int = 15, progress: Progress | None = None
) -> FitResult:
    """Fit features from all starts, then from the best one with the noise that it leaves.

    Args:
        objective: that of the poses; its replay is used.
        points: (S, P) unit coordinates of the starts.
        track: of the vehicle [m]; tells how hard its wheels are pulled.

    Returns:
        The best point; `start_costs` are those of the first fit, ascending.
    """
    coarse = make_features_objective(objective)
    found = gradient.fit(coarse, coarse.space, starts=points, iterations=iterations, tolerance=TOLERANCE,
                         progress=progress)
    at = coarse.simulate(found.u[None])[0]
    if not np.isfinite(at).all():
        return found
    left, level = coarse.target - at, roughness(at, coarse.features.width, track)
    mask = coarse.mask / fit_roughness(left, coarse.mask, level)[level]
    fine = replace(coarse, mask=mask, whitener=fit_whitener(left, mask))
    again = gradient.fit(fine, fine.space, starts=found.u[None], iterations=max(iterations // 2, 3),
                         tolerance=TOLERANCE, progress=progress)
    return replace(found, u=again.u, evaluations=found.evaluations + again.evaluations)


def draw(
    objective: Objective, numbers: Sequence[int], seed: int, scan: int = SCAN, progress: Progress | None = None
) -> np.ndarray:
    """Starts (S, P) of a search: number 0 has the initial values, any other the best of `scan` random points.

    A start is the same whichever others are drawn with it.

    Args:
        objective: that of the poses; its replay is used.
        numbers: of the starts.
    """
    space = objective.space
    first = space.to_unit(space.initial)
    scanned = [number for number in numbers if number > 0]
    if not scanned:
        return np.array([first for _ in numbers])
    coarse = make_features_objective(objective)
    # Close to the walls as well: of many parameters the likely values are a small share of the range.
    tried = np.concatenate([np.random.default_rng((seed, number)).uniform(EDGE, 1 - EDGE, (scan, space.size))
                            for number in scanned])
    chunk = CHUNK if on_processor() else ACCELERATED
    costs = np.concatenate([coarse.weighted_cost(tried[i : i + chunk]) for i in range(0, len(tried), chunk)])
    costs, tried = costs.reshape(len(scanned), -1), tried.reshape(len(scanned), -1, space.size)
    kept = np.take_along_axis(tried, np.argsort(costs, axis=1)[:, :KEPT, None], axis=1)  # (S, KEPT, P)
    found = gradient.fit(coarse, space, starts=kept.reshape(-1, space.size), iterations=STEPS, tolerance=TOLERANCE,
                         progress=progress)
    ends, costs = np.empty_like(found.starts), np.empty_like(found.start_costs)
    ends[found.order], costs[found.order] = found.starts, found.start_costs
    best = costs.reshape(len(scanned), -1).argmin(1)
    ends = ends.reshape(kept.shape)[np.arange(len(scanned)), best]
    return np.array([first if number == 0 else ends[scanned.index(number)] for number in numbers])


def make_features_objective(objective: Objective) -> FeatureObjective:
    """Errors in features of what an objective of poses compares, in the noise that replicates show."""
    features = make_features(objective.trials, bin_width(objective.trials))
    target = features.of(objective.measured)
    groups = replicate_groups(objective.trials)
    return FeatureObjective(objective.replay, objective.space, features, target, features.mask,
                            first_scales(target, features.mask, groups))


def agreeing(costs: np.ndarray) -> int:
    """How many of the costs (S,) are that of the best start."""
    return int((costs <= costs.min() * (1 + AGREE)).sum())

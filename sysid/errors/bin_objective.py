"""Errors of motion in short bins, whitened by the noise that replicates or the fit itself leave (docs/fit_method.md).

A vector autoregression makes them white (`sysid.errors.noise`): generalised least squares, Aitken (1936).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from sysid.errors.features import ENOUGH, Features, bin_width, make_features
from sysid.errors.noise import ORDER, Whitener, first_scales, fit_roughness, fit_whitener, replicate_groups, roughness
from sysid.errors.normal_equations import NormalEquations, make_equations
from sysid.errors.pose_objective import HUGE, Objective, Replays, append_prior, linear_with_prior
from sysid.errors.prior import Prior
from sysid.errors.space import STEP, Space
from sysid.logs.records import Trial
from sysid.replay.arrays import Quotients, namespace
from sysid.replay.cores import cores, on_processor
from sysid.replay.records import Simulated
from sysid.search import least_squares
from whill_mjx.io.steps import steps_of_rows

LONG = 8
"""Bins of memory of the filter: the noise of a pose cancels from bin to bin, which a short memory takes for a drift."""
SETS = 64  # that a core replays between two saves: seconds for minutes of driving
ROWS = 10  # times as many bins as the filter has coefficients in each row


@dataclass(frozen=True)
class FeatureObjective:
    """Whitened errors in features, in unit coordinates of `space`: what `least_squares.fit` minimises."""

    replay: Replays
    space: Space
    trials: tuple[Trial, ...]
    track: float  # of the vehicle [m]; shows how hard its wheels are pulled
    features: Features
    target: np.ndarray  # (B, K, C) measured features
    mask: np.ndarray  # (B, K, C) weights of the bins
    whitener: Whitener
    prior: Prior | None = None  # its P residuals are the last ones of the first trial

    @property
    def enough(self) -> bool:
        """Whether bins show most of what was measured: a pose that comes every other second is in none."""
        for column, streams in ((0, [t.odometry for t in self.trials]), (2, [t.ground_truth for t in self.trials])):
            has = np.array([stream is not None for stream in streams])
            bins = np.array([trial.duration for trial in self.trials])[has].sum() / self.features.width
            if has.any() and (self.features.mask[has, :, column] > 0).sum() < ENOUGH * bins:
                return False
        return True

    @cached_property
    def quicker(self) -> FeatureObjective:
        """For a search on its way: the same on a processor; an accelerator replays long drives in pieces."""
        replay = self.replay if on_processor() else getattr(self.replay, "in_pieces", self.replay)
        return self if replay is self.replay else replace(self, replay=replay)

    @property
    def counted(self) -> int:
        """Number of measured values."""
        return int((self.mask > 0).sum())

    def simulate(self, u: np.ndarray) -> np.ndarray:
        """Features (N, B, K, C) at unit coordinates (N, P)."""
        def compute(u: np.ndarray) -> list[np.ndarray]:
            return [self.features.of(self.replay.simulate(self.space.to_values(u)))]

        [found] = steps_of_rows("features", compute, u, SETS * cores() if on_processor() else len(u))
        return found

    def weighted_cost(self, u: np.ndarray) -> np.ndarray:
        """Mean squared residual (N,)."""
        return least_squares.costs_of(self, u)

    def residuals(self, u: np.ndarray, simulated: Simulated | None = None) -> np.ndarray:
        """(N, B, K C) white residuals of unit coordinates (N, P); those of a drive that diverged are huge."""
        white = self._white(self.simulate(u) if simulated is None else self.features.of(simulated))
        return white if self.prior is None else append_prior(white, self.prior.residual(u))

    def bad(self, simulated: Simulated) -> Any:
        """(N, B) replays that diverged."""
        return _bad(self.features.of(simulated))[..., 0]

    @property
    def arrays(self) -> tuple[Any, ...]:
        """What it may differ in from others of the same replay."""
        filters = self.whitener
        lags = len(filters.coefficients)  # filters of any memory have one shape, so that they share what is compiled
        coefficients = np.pad(filters.coefficients, ((0, max(LONG - lags, 0)), (0, 0), (0, 0)))
        return self.target, self.mask, filters.scale, coefficients, filters.inverse, self.prior

    def with_arrays(self, arrays: tuple[Any, ...]) -> FeatureObjective:
        return replace(self, target=arrays[0], mask=arrays[1], whitener=Whitener(*arrays[2:5]), prior=arrays[5])

    @cached_property
    def equations(self) -> NormalEquations | None:
        """What an accelerator computes of the residuals by itself."""
        return make_equations(self)

    def jacobian(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Residuals (N, B, K C) and their derivatives by u (N, B, K C, P): differences over a share of each range."""
        count, size = u.shape
        pairs = Quotients.central(u, STEP)
        at = self.simulate(np.concatenate([u, pairs.above.reshape(-1, size), pairs.below.reshape(-1, size)]))
        white = self._white(at)
        high, low = white[count:].reshape(2, count, size, *white.shape[1:])
        lost = _bad(at[:count])[:, None] | _bad(at[count:]).reshape(2, count, size, -1, 1).any(0)
        slope = np.where(np.moveaxis(lost, 1, -1), 0.0, pairs.slopes(high, low))
        return linear_with_prior(self.prior, u, white[:count], slope)

    def renewed(self, u: np.ndarray) -> FeatureObjective:
        """The same with the noise that u (P,) leaves: its memory, and how much larger it is where wheels are pulled."""
        at = self.simulate(u[None])[0]
        if not np.isfinite(at).all():
            return self
        shown = (self.features.mask > 0).astype(float)
        left, level = self.target - at, roughness(at, self.features.width, self.track)
        mask = shown / fit_roughness(left, shown, level)[level]
        bins, channels = left.shape[1:]
        enough_rows = len(left) * max(bins - LONG, 0) >= ROWS * LONG * channels
        return replace(self, mask=mask, whitener=fit_whitener(left, mask, LONG if enough_rows else ORDER))

    def pieces(self, count: int) -> np.ndarray:
        """(K C,) in which of so many pieces of its drive each residual is."""
        bins, channels = self.target.shape[1:]
        return np.repeat(np.arange(bins) * count // bins, channels)

    def own_frame(self, residual: np.ndarray) -> np.ndarray:
        """Residuals (B, K C) as the vehicle sees them: as they are."""
        return residual

    def _white(self, at: np.ndarray) -> np.ndarray:
        xp = namespace(at)
        off = xp.where(xp.isfinite(at), at, 0.0) - self.target
        white = xp.moveaxis(self.whitener.apply(xp.moveaxis(off, 0, -1), self.mask), -1, 0).reshape(*off.shape[:2], -1)
        return xp.where(_bad(at), HUGE * (self.mask > 0).reshape(len(self.mask), -1), white)


def _bad(at: np.ndarray) -> np.ndarray:
    """(N, B, 1) drives that diverged, of features (N, B, K, C)."""
    return ~namespace(at).isfinite(at).all((-1, -2))[..., None]


def make_features_objective(objective: Objective, track: float) -> FeatureObjective:
    """Errors in features of what an objective of poses compares, in the noise that replicates show; `track` in m."""
    features = make_features(objective.trials, bin_width(objective.trials))
    target = features.of(objective.measured)
    groups = replicate_groups(objective.trials)
    return FeatureObjective(objective.replay, objective.space, objective.trials, track, features, target, features.mask,
                            first_scales(target, features.mask, groups), objective.prior)

"""A set of drives in features: the measured ones, and replays of them with any parameters."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sysid.log import Trial
from sysid.loop.features import BIN, Features, make_features
from sysid.loop.noise import roughness
from sysid.rollout import Measured, Plant, Replay, Simulated, make_batch
from whill_mjx.parameters import set_values

CHUNK = 80  # instances of one replay call: one compilation, and a working set that fits the cache


@dataclass(frozen=True)
class Drives:
    """Trials with their features and a compiled replay over named parameters."""

    trials: tuple[Trial, ...]
    names: tuple[str, ...]
    replay: Replay
    measured: Measured
    features: Features
    target: np.ndarray  # (B, K, 5) measured features
    weight: np.ndarray | None = None
    """(B, K, 5) weights of the bins where not all have the same noise."""

    @property
    def mask(self) -> np.ndarray:
        """(B, K, 5) weights of the bins, 0 where nothing was measured."""
        return self.features.mask if self.weight is None else self.weight

    def weighted(self, simulated: np.ndarray, factors: np.ndarray, track: float) -> Drives:
        """The same drives with rough bins, as `simulated` (B, K, 5) shows them, weighted by noise `factors` (4, 5)."""
        level = roughness(simulated, self.features.width, track)
        return replace(self, weight=self.features.mask / factors[level])

    def simulate(self, values: np.ndarray) -> np.ndarray:
        """Features (N, B, K, 5) of replays with values (N, P)."""
        rows = max(CHUNK // len(self.trials), 1)
        count = len(values)
        padded = np.concatenate([values, np.repeat(values[-1:], -count % rows, axis=0)])
        parts = [self.features.of(self.replay.simulate(padded[i : i + rows])) for i in range(0, count, rows)]
        return np.concatenate(parts)[:count]

    def jacobian(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Features (B, K, 5) and their derivatives (B, K, 5, P) at values (P,): exact, from one forward-mode replay."""
        value, slope = (_first(one) for one in self.replay.jacobian(values[None]))
        at = self.features.of(value)
        size = 1e-3
        columns = []
        for p in range(slope.pose.shape[-1]):  # features are a smooth map of the samples: differences suffice
            scale = size / max(np.abs(slope.pose[..., p]).max(), np.abs(slope.odometry[..., p]).max(), 1e-12)
            both = [self.features.of(Simulated(
                np.asarray(value.pose, float) + sign * scale * slope.pose[..., p],
                np.asarray(value.odometry, float) + sign * scale * slope.odometry[..., p], value.diverged))
                for sign in (1, -1)]
            columns.append((both[0] - both[1]) / (2 * scale))
        return at, np.stack(columns, axis=-1)

    def differences(self, sets: Callable[[np.ndarray], np.ndarray], u: np.ndarray, sizes: np.ndarray) -> np.ndarray:
        """(B, K, 5, P) derivative by unit coordinates u (P,), by central differences of the given sizes.

        Skidding wheels make the motion rough in its parameters: over the size of a day's change the mean slope counts.
        `sets` turns unit coordinates (P,) into values of all replayed parameters.
        """
        ends, rows = [], []
        for p in range(len(u)):
            for sign in (1, -1):
                point = u.copy()
                point[p] = np.clip(point[p] + sign * sizes[p], 0.0, 1.0)
                ends.append(float(point[p]))
                rows.append(sets(point))
        seen = self.simulate(np.stack(rows))
        return np.stack([(seen[2 * p] - seen[2 * p + 1]) / (ends[2 * p] - ends[2 * p + 1]) for p in range(len(u))],
                        axis=-1)

    def of(self, trials: tuple[Trial, ...], dt: float) -> Drives:
        """Other trials through the same compiled replay."""
        batch, measured = make_batch(trials, dt)
        features = make_features(trials, self.features.width)
        return Drives(trials, self.names, self.replay.on(batch), measured, features, features.of(measured))


def make_drives(plant: Plant, params: Any, names: Sequence[str], trials: tuple[Trial, ...],
                width: float = BIN) -> Drives:
    """Drives of trials, replayed with the named parameters of `params` free."""
    batch, measured = make_batch(trials, plant.dt)
    replay = Replay(plant, batch, lambda values: set_values(params, names, values))
    features = make_features(trials, width)
    return Drives(trials, tuple(names), replay, measured, features, features.of(measured))


def _first(simulated: Simulated) -> Simulated:
    return Simulated(*(np.asarray(leaf)[0] for leaf in (simulated.pose, simulated.odometry, simulated.diverged)))

"""How noisy each channel is beside the reference days: the median of second differences in time.

A missing effect is smooth and hardly shows in them, and lost commands or a soft patch do not move a median. With
replicates, differences are of their deviations from one another, else of what the model leaves at constant commands.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import special

from sysid.errors.noise import deviations
from sysid.logs.records import Trial

SETTLED = 2.0  # s of constant commands after which a motion counts as steady
BLOCKS = 3  # independent parts of the drives that an error needs at least
BINS = 40  # of a channel that a size needs at least
CONFIDENCE = 0.95
SPOKEN = {"odometry.v": "reported speed", "odometry.omega": "reported yaw rate",
          "pose.forward": "outside pose, forward", "pose.left": "outside pose, sideways",
          "pose.yaw": "outside pose, heading", "gyro.omega": "gyro"}


@dataclass(frozen=True)
class NoisyDrives:
    """What the model leaves of some drives."""

    series: np.ndarray  # (B, K, C)
    weight: np.ndarray  # (B, K, C) that makes the noise of all bins alike; 0 where nothing was measured
    replicates: Sequence[Sequence[int]]  # trials that repeat one another on the same day
    steady: np.ndarray  # (B, K) bool


@dataclass(frozen=True)
class NoiseLevels:
    """The noise of each channel over that of the reference days."""

    channels: tuple[str, ...]
    factor: np.ndarray  # (C,) nan where one of the two was not measured
    error: float  # standard error of the factors' logarithms
    freedom: float  # degrees of freedom of that error
    changed: np.ndarray  # (C,) bool: surely another than on the reference days

    @property
    def louder(self) -> np.ndarray:
        """(C,) factors of the channels that surely are noisier, 1 of the others."""
        return np.where(self.changed & (np.nan_to_num(self.factor) > 1), self.factor, 1.0)

    @property
    def quieter(self) -> np.ndarray:
        """(C,) factors of the channels that surely are less noisy, 1 of the others."""
        return np.where(self.changed & ~(np.nan_to_num(self.factor) > 1), self.factor, 1.0)

    def interval(self, channel: int) -> tuple[float, float]:
        """95 % interval of a factor."""
        reach = np.exp(special.stdtrit(self.freedom, (1 + CONFIDENCE) / 2) * self.error)
        return float(self.factor[channel] / reach), float(self.factor[channel] * reach)

    def report(self) -> dict[str, dict[str, Any]]:
        """Channel -> factor, 95 % interval, and whether it surely is another than on the reference days."""
        return {name: {"factor": float(self.factor[c]), "interval": list(self.interval(c)),
                       "changed": bool(self.changed[c])}
                for c, name in enumerate(self.channels) if np.isfinite(self.factor[c])}


def noise_levels(ours: NoisyDrives, theirs: NoisyDrives, channels: Sequence[str], alpha: float) -> NoiseLevels | None:
    """Noise of some drives beside that of the reference's; None where too little was measured.

    `alpha`: probability that any channel counts as changed where the noise is as usual.
    """
    for parts in (_between_replicates, _in_steady_motion):
        mine, usual = _size(parts(ours)), _size(parts(theirs))
        if mine is None or usual is None:
            continue
        apart = mine.log - usual.log
        measured = np.isfinite(apart)
        if measured.any():
            error = float(np.hypot(mine.error, usual.error))
            freedom = float((min(mine.parts, usual.parts) - 1) * measured.sum())
            limit = special.stdtrit(freedom, 1 - alpha / (2 * len(channels))) * error
            return NoiseLevels(tuple(channels), np.exp(apart), error, freedom, np.nan_to_num(np.abs(apart)) > limit)
    return None


def steady_bins(trial: Trial, bins: int, width: float) -> np.ndarray:
    """(K,) bool: bins in which the commands have been constant for a while."""
    table = trial.command.table
    moved = np.abs(np.diff(table[:, 1:], axis=0)).max(1, initial=0.0) > 0
    changes = np.concatenate([[0.0], table[1:, 0][moved]])
    end = (np.arange(bins) + 1) * width
    last = changes[np.maximum(np.searchsorted(changes, end - 1e-6) - 1, 0)]
    return np.asarray(end - width - last >= SETTLED - 1e-6)


def said(levels: Mapping[str, Mapping[str, Any]], alone: bool) -> str:
    """The channels that changed in a sentence without its full stop, "" without any; `alone`: nothing else changed."""
    parts = []
    for name, one in levels.items():
        low, high = one["interval"]
        if one["changed"]:
            parts.append(f"the {SPOKEN.get(name, name)} is {one['factor']:.2g} times as noisy as on the reference days "
                         f"({low:.2g} to {high:.2g})")
    return "; ".join([*parts, *["nothing else has changed"] * (alone and bool(parts))])


Parts = list[tuple[np.ndarray, np.ndarray]]
"""Independent parts of some drives: series (n, K, C), and which bins count (n, K, C)."""


def _between_replicates(drives: NoisyDrives) -> Parts:
    parts = []
    apart = deviations(drives.series * drives.weight, [list(group) for group in drives.replicates])
    for group in (list(each) for each in drives.replicates if len(each) > 1):
        measured = (drives.weight[group] > 0).all(0)  # by all of them: else they differ by what was not measured
        parts.append((apart[group], np.broadcast_to(measured, apart[group].shape)))
    return parts


def _in_steady_motion(drives: NoisyDrives) -> Parts:
    seen = (drives.weight > 0) & drives.steady[..., None]
    return [(one[None], inside[None]) for one, inside in zip(drives.series * drives.weight, seen, strict=True)
            if inside.any()]


@dataclass(frozen=True)
class _Size:
    """Noise of some drives."""

    log: np.ndarray  # (C,) logarithm of its size, up to a constant; nan where not measured
    error: float  # standard error of all channels together: a few parts show it of one badly
    parts: int


def _size(parts: Parts) -> _Size | None:
    """Size of the noise, with its error by leaving out each part in turn; None where there are too few."""
    changes = [_changes(*one) for one in parts]
    if len(changes) < BLOCKS:
        return None
    size = _log_median(changes)
    if not np.isfinite(size).any():
        return None
    without = np.stack([_log_median([*changes[:i], *changes[i + 1 :]]) for i in range(len(changes))])
    count = len(without)
    variance = (count - 1) * np.square(without - without.mean(0)).mean(0)
    known = variance[np.isfinite(variance)]
    return _Size(size, float(np.sqrt(known.mean())), count) if len(known) else None


def _changes(series: np.ndarray, seen: np.ndarray) -> list[np.ndarray]:
    """Sizes of the second differences in time, channel by channel."""
    second = np.abs(np.diff(series, 2, axis=1))
    inside = seen[:, 2:] & seen[:, 1:-1] & seen[:, :-2]
    return [second[..., c][inside[..., c]] for c in range(series.shape[-1])]


def _log_median(parts: Sequence[list[np.ndarray]]) -> np.ndarray:
    values = [np.concatenate(each) for each in zip(*parts, strict=True)]
    middle = [np.median(each) if len(each) >= BINS else np.nan for each in values]
    return np.log(np.where(np.array(middle) > 0, middle, np.nan))

"""Motion in short bins, in the frame that the vehicle had at the bin's start.

It needs no start pose, its noise is nearly stationary, and an effect shows in it at the time and place where it acts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sysid.logs.records import Trial
from sysid.replay.arrays import namespace
from sysid.replay.records import Measured, Simulated

BIN = 0.25  # s
CHANNELS = ("odometry.v", "odometry.omega", "pose.forward", "pose.left", "pose.yaw")
"""Mean reported speeds, and displacement over a bin divided by its length [m/s, rad/s]; without the pose that the
odometry adds up, whose updates come in steps of its own clock (docs/fit.md)."""
GYRO = "gyro.omega"  # mean yaw rate of a gyro in a bin [rad/s]: a channel where a log has one
MAX_GAP = 0.6  # of a bin: a longer gap between samples leaves the bins it touches unmeasured
LONG_AGO = -1e6  # s
MAX_WIDE_GAP = 1.0  # the same of wider bins, where the outside pose comes seldom anyway
WIDER = (2.0, 4.0)  # how many times wider bins may be where an outside pose comes too seldom for them
ENOUGH = 0.7  # least share of the bins between its first and last sample that an outside pose must measure


@dataclass(frozen=True)
class _Edges:
    """Interpolation of a stream's samples to the edges of the bins."""

    index: np.ndarray  # (B, K + 1) sample before each edge
    weight: np.ndarray  # (B, K + 1) share of the sample after it
    known: np.ndarray  # (B, K) bool, bins between known edges

    def at(self, values: np.ndarray) -> np.ndarray:
        """Values (..., B, K + 1, C) at the edges, from samples (..., B, M, C)."""
        row = np.arange(len(self.index))[:, None]
        weight = self.weight[..., None]
        last = np.minimum(self.index + 1, values.shape[-2] - 1)
        return (1 - weight) * values[..., row, self.index, :] + weight * values[..., row, last, :]


@dataclass(frozen=True)
class Features:
    """The map from measured or simulated samples of B trials to K bins of C channels, 5 or with a gyro 6."""

    width: float
    pose: _Edges
    first: np.ndarray  # (B, K) first odometry sample of each bin
    last: np.ndarray  # (B, K) first sample after it
    start: np.ndarray  # (B, 3) pose at t = 0, the sample before the first one where it is a measurement
    mask: np.ndarray  # (B, K, C) 1 where measured
    middle: np.ndarray  # (K,) time of each bin's middle [s]
    gyro: _Edges | None = None  # none where no gyro is a channel

    def of(self, values: Measured | Simulated) -> np.ndarray:
        """Features (..., B, K, C); what was not measured is 0."""
        xp = namespace(values.pose)
        pose, odometry = xp.asarray(values.pose, float), xp.asarray(values.odometry, float)
        total = xp.concatenate([xp.zeros_like(odometry[..., :1, 3:]), xp.cumsum(odometry[..., 3:], axis=-2)], axis=-2)
        row = np.arange(len(self.first))[:, None]
        count = np.maximum(self.last - self.first, 1)[..., None]
        speeds = (total[..., row, self.last, :] - total[..., row, self.first, :]) / count
        start = np.broadcast_to(self.start[:, None], (*pose.shape[:-2], 1, 3))
        pose = xp.concatenate([start, pose], axis=-2)
        seen = [speeds, _motion(self.pose.at(pose)) / self.width]
        if self.gyro is not None:
            if values.gyro is None:  # no trial of these has one
                seen.append(xp.zeros_like(speeds[..., :1]))
            else:
                seen.append(xp.diff(self.gyro.at(xp.asarray(values.gyro, float)), axis=-2) / self.width)
        return xp.concatenate(seen, axis=-1) * self.mask


def channel_names(count: int) -> tuple[str, ...]:
    return (*CHANNELS, GYRO)[:count]


def bin_width(trials: Sequence[Trial]) -> float:
    """Width of the bins [s]: the least in which the trials' outside poses measure enough of them."""
    seen = [pose_times(trial)[1:] for trial in trials if trial.ground_truth is not None]

    def measured(width: float) -> float:
        inside = total = 0
        for t in seen:
            edge = np.arange(np.ceil(t[0] / width), np.floor(t[-1] / width) + 1) * width if len(t) > 1 else np.zeros(0)
            if len(edge) > 1:
                known = _edges([t], edge).known
                inside, total = inside + int(known.sum()), total + known.size
        return inside / total if total else 0.0

    widths = [BIN * factor for factor in (1.0, *WIDER)]
    share = [measured(width) for width in widths]
    enough = [width for width, one in zip(widths, share, strict=True) if one >= ENOUGH]
    return enough[0] if enough else widths[int(np.argmax(share))]


def check_length(name: str, trials: Sequence[Trial], width: float | None = None) -> None:
    """Raise ValueError for a log by name whose trials are all shorter than a bin of a width [s], by default their own.
    """
    width, longest = width or bin_width(trials), max(trial.duration for trial in trials)
    if longest < width:
        raise ValueError(f"log {name!r}: its training trials last {longest:.2g} s at most, and motion is looked at "
                         f"over {width:g} s. Record longer drives.")


def pose_times(trial: Trial) -> np.ndarray:
    """(M + 1,) times of the start pose, long ago where it is no measurement, and of the outside poses."""
    if trial.ground_truth is None:
        return np.zeros(0)
    t = trial.ground_truth.t
    return np.concatenate([[0.0 if trial.start.measured and len(t) and t[0] > 0 else LONG_AGO], t])


def make_features(trials: tuple[Trial, ...], width: float = BIN, gyro: bool | None = None) -> Features:
    """Feature map of trials padded as by `make_batch`; with a gyro channel by default where a trial has one."""
    bins = max(int(np.floor(trial.duration / width + 1e-6)) for trial in trials)
    edge = np.arange(bins + 1) * width
    start = np.array([[t.start.x, t.start.y, t.start.yaw] for t in trials])
    pose_t = [pose_times(trial) for trial in trials]
    odometry_t = [np.zeros(0) if t.odometry is None else t.odometry.t for t in trials]
    pose = _edges(pose_t, edge)
    for i, trial in enumerate(trials):
        for begin, end in trial.breaks:
            pose.known[i] &= (edge[1:] <= begin) | (edge[:-1] >= end)
    first = np.stack([np.searchsorted(t, edge[:-1] - 1e-9) for t in odometry_t])
    last = np.stack([np.searchsorted(t, edge[1:] - 1e-9) for t in odometry_t])
    sampled = last > first
    mask = np.stack([sampled, sampled, pose.known, pose.known, pose.known], axis=-1).astype(float)
    turn = None
    if gyro if gyro is not None else any(trial.gyro is not None for trial in trials):
        turn = _edges([np.zeros(0) if trial.gyro is None else trial.gyro.t for trial in trials], edge)
        mask = np.concatenate([mask, turn.known[..., None]], axis=-1)
    return Features(width, pose, first, last, start, mask, (edge[:-1] + edge[1:]) / 2, turn)


def _edges(times: list[np.ndarray], edge: np.ndarray) -> _Edges:
    index = np.zeros((len(times), len(edge)), int)
    weight = np.zeros((len(times), len(edge)))
    known = np.zeros((len(times), len(edge) - 1), bool)
    for i, t in enumerate(times):
        if len(t) < 2:
            continue
        index[i] = np.clip(np.searchsorted(t, edge + 1e-9) - 1, 0, len(t) - 2)
        gap = t[index[i] + 1] - t[index[i]]
        weight[i] = np.clip((edge - t[index[i]]) / gap, 0.0, 1.0)
        width = edge[1] - edge[0]
        longest = (MAX_GAP if width < 1.5 * BIN else MAX_WIDE_GAP) * width
        near = (edge >= t[0] - 1e-6) & (edge <= t[-1] + gap[-1]) & (gap <= longest)
        known[i] = near[:-1] & near[1:]
    return _Edges(index, weight, known)


def _motion(pose: np.ndarray) -> np.ndarray:
    """Displacement (..., K, 3) forward, left and in yaw between edges (..., K + 1, 3), in the frame of the earlier."""
    xp = namespace(pose)
    step = xp.diff(pose, axis=-2)
    cos, sin = xp.cos(pose[..., :-1, 2]), xp.sin(pose[..., :-1, 2])
    return xp.stack([cos * step[..., 0] + sin * step[..., 1], -sin * step[..., 0] + cos * step[..., 1], step[..., 2]],
                    axis=-1)

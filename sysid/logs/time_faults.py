"""Signs that the time of a log went wrong: rows in bursts, and a clock that was set forward in the drive."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sysid.logs.log import OdometryStream, Trial

BURST = 0.2  # of the mean interval, below which the median interval shows bursts
PAUSE = (0.5, 5.0)  # s and mean intervals: the least gap that is looked at
MOVED = 0.5  # share of the way that a speed gives over a gap, below which the gap was none
LEAST = 0.1  # m or rad of that way


def time_faults(trials: Sequence[Trial]) -> list[str]:
    """Sentences on streams in bursts and on times that jump ahead of the motion."""
    found = []
    for name in ("odometry", "ground_truth"):
        streams = [stream for trial in trials if (stream := getattr(trial, name)) is not None and len(stream.t) > 20]
        bursts = [float(np.percentile(np.diff(one.t), 95)) for one in streams if _in_bursts(one.t)]
        if bursts and len(bursts) >= len(streams) / 2:
            found.append(f"{name}: its rows come in bursts, up to {max(bursts):.2g} s apart, while most follow one "
                         "another at once: t is a time of receipt. Use the times of measurement; sysid.convert takes "
                         "them with --stamp header.")
    jumps = [(trial.name, *jump) for trial in trials if (jump := forward_jump(trial)) is not None]
    if jumps:
        name, at, seconds = jumps[0]
        found.append(f"time: in {len(jumps)} of {len(trials)} trials ({name}, at {at:.1f} s) t jumps ahead by "
                     f"{seconds:.2g} s in which the vehicle hardly moved, though it drives before and after: the clock "
                     "was set forward. Split the trial there, or take the jump out of all of its streams.")
    return found


def forward_jump(trial: Trial) -> tuple[float, float] | None:
    """Time and size [s] of the longest gap in which a pose did not move as its speeds say; None without one.

    Rows that are only lost leave a gap too, but the vehicle drives on in it.
    """
    stream = trial.odometry
    if not isinstance(stream, OdometryStream) or stream.x is None or stream.y is None or stream.yaw is None:
        return None
    gaps = np.diff(stream.t)
    if len(gaps) < 20:
        return None
    expected = np.stack([np.minimum(np.abs(one[1:]), np.abs(one[:-1])) * gaps for one in (stream.v, stream.omega)])
    moved = np.stack([np.hypot(np.diff(stream.x), np.diff(stream.y)), np.abs(np.diff(stream.yaw))])
    long = gaps > max(PAUSE[0], PAUSE[1] * float(gaps.mean()))
    still = (expected > LEAST).any(axis=0) & ((moved < MOVED * expected) | (expected <= LEAST)).all(axis=0)
    other = trial.ground_truth
    for k in np.flatnonzero(long & still)[np.argsort(-gaps[long & still])]:
        middle = (stream.t[k] + stream.t[k + 1]) / 2
        if other is None or not (np.abs(other.t - middle) < gaps[k] / 4).any():  # the outside pose has the gap as well
            return float(stream.t[k]), float(gaps[k])
    return None


def _in_bursts(t: np.ndarray) -> bool:
    steps = np.diff(t)
    return bool(np.median(steps) < BURST * steps.mean() and np.percentile(steps, 95) > 2 * steps.mean())

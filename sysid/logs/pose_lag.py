"""How late the outside pose is, found without a vehicle model.

The outside yaw follows the integral of a rate measured on the vehicle, its path that of the speed; how much later is
found from whole drives. A gyro settles it. The odometry shows the wheels, and a body that lags behind them looks like a
late pose: the delay then has to beat a first-order lag. Before a drive the vehicle went on as in its first instant.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy import stats

from sysid.logs.records import Trial
from sysid.logs.stream_quality import added_up

GRID = np.linspace(0.0, 1.0, 41)  # s
FLIPS = 20000
TINY = 1e-12

Rates = Mapping[str, tuple[np.ndarray, np.ndarray]]  # trial -> times (T,) [s] and yaw rates (T,) [rad/s] of the body


@dataclass(frozen=True)
class PoseLag:
    delay: float  # of all drives [s]
    low: float
    high: float  # 95 % interval of it, from blocks left out in turn [s]
    p: float  # of so much better a prediction of held-back blocks if the delay meant nothing, by the signs of blocks
    share: float  # share of the held-back error that it removes


def pose_lag(trials: Sequence[Trial], blocks: Sequence[Sequence[int]], rates: Rates | None = None) -> PoseLag | None:
    """Delay of the outside pose, chosen on every second block and judged on the others, and the other way round.

    `blocks`: indices of trials near one another; `rates`: yaw rates of the body, else the odometry's. None where the
    drives show nothing: no odometry, no turns, fewer than two blocks.
    """
    sums = {i: one for i, trial in enumerate(trials) if (one := _sums(trial, rates)) is not None}
    usable = [block for block in ([i for i in block if i in sums] for block in blocks) if block]
    if len(usable) < 2:
        return None
    gains, before = np.zeros(len(usable)), 0.0
    for half in (0, 1):
        other = list(range(1 - half, len(usable), 2))
        fitted, judged = sum(usable[half::2], []), sum((usable[b] for b in other), [])
        null, late = (_foretold([sums[i][which] for i in fitted], [sums[i][which] for i in judged]) for which in (0, 1))
        each = dict(zip(judged, null - late, strict=True))
        gains[other] = [sum(each[i] for i in usable[b]) for b in other]
        before += float(null.sum())
    delay = _best([sums[i][1] for i in sum(usable, [])])
    left = [_best([sums[i][1] for block in usable[:b] + usable[b + 1 :] for i in block]) for b in range(len(usable))]
    spread = float(np.sqrt((len(left) - 1) * np.var(left)))
    reach = float(stats.t.ppf(0.975, len(left) - 1)) * max(spread, float(GRID[1]) / 2)
    return PoseLag(delay, max(delay - reach, 0.0), delay + reach, sign_flips(gains),
                   float(gains.sum() / max(before, TINY)))


def sign_flips(gains: np.ndarray) -> float:
    """Probability (one-sided) of so large a sum of gains (B,) if each were as likely to be a loss."""
    if len(gains) <= 12:
        signs = np.array(list(product((1.0, -1.0), repeat=len(gains))))
        return float(np.mean(signs @ gains >= gains.sum() - TINY))
    signs = np.random.default_rng(0).choice((-1.0, 1.0), (FLIPS, len(gains)))
    return (1 + int((signs @ gains >= gains.sum()).sum())) / (1 + FLIPS)


def _best(sums: Sequence[np.ndarray]) -> float:
    """The delay [s] of least error of some drives."""
    every = np.stack(sums)
    return float(GRID[_errors(every, every).sum(0).argmin()])


def _foretold(fitted: Sequence[np.ndarray], judged: Sequence[np.ndarray]) -> np.ndarray:
    """Errors (B,) of drives with what is best for others: sums (B, C, G, 3) of both."""
    one, other = np.stack(fitted), np.stack(judged)
    return _errors(one, other)[:, _errors(one, one).sum(0).argmin()]


def _errors(fitted: np.ndarray, judged: np.ndarray) -> np.ndarray:
    """Errors (B, G) of drives, all channels C together, with the factors of other drives: sums (A or B, C, G, 3)."""
    total = fitted.sum(0)  # (C, G, 3)
    factor = total[..., 1] / np.maximum(total[..., 0], TINY)
    xx, xy, yy = np.moveaxis(judged, -1, 0)
    error = np.sqrt(np.maximum(yy - 2 * factor * xy + factor**2 * xx, 0.0))
    size = np.sqrt(total[..., 2].max(-1) / len(fitted))  # of each channel
    return np.asarray((error / np.maximum(size, TINY)[:, None]).sum(1))


def _sums(trial: Trial, rates: Rates | None) -> tuple[np.ndarray, np.ndarray] | None:
    """Sums (C, G, 3) of squares of a drive, over what a delay has to beat and over the delays."""
    pose, odometry = trial.ground_truth, trial.odometry
    if pose is None or rates is None and odometry is None or rates is not None and trial.name not in rates:
        return None
    start = trial.start
    t = np.append(0.0, pose.t)
    x, y, yaw = np.vstack([[start.x, start.y, start.yaw], pose.values]).T
    signals = [(*rates[trial.name], yaw)] if rates is not None else [
        (odometry.t, odometry.omega, yaw), (odometry.t, odometry.v, _forward(x, y, yaw))]  # type: ignore[union-attr]
    piece = np.zeros(len(t), int)  # between breaks
    for begin, end in trial.breaks:
        piece += t >= (begin + end) / 2
    late = np.array([[_moments(when, rate, delay, t, seen, piece) for delay in GRID] for when, rate, seen in signals])
    if rates is not None:
        return late[:, :1], late
    null = np.array([[_moments(when, _lagged(when, rate, constant), 0.0, t, seen, piece) for constant in GRID]
                     for when, rate, seen in signals])
    return null, late


def _moments(
    when: np.ndarray, rate: np.ndarray, delay: float, t: np.ndarray, seen: np.ndarray, piece: np.ndarray
) -> tuple[float, float, float]:
    """Mean xx, xy and yy of what a rate adds up to, x, and what was seen, y, from the start of each piece."""
    x, y = added_up(when, rate, t - delay), seen.astype(float)
    first = np.searchsorted(piece, np.arange(piece[-1] + 1))[piece]
    x, y = x - x[first], y - y[first]
    return float(np.mean(x * x)), float(np.mean(x * y)), float(np.mean(y * y))


def _forward(x: np.ndarray, y: np.ndarray, yaw: np.ndarray) -> np.ndarray:
    """Way (M,) along the heading [m]."""
    middle = (yaw[1:] + yaw[:-1]) / 2
    return np.append(0.0, np.cumsum(np.diff(x) * np.cos(middle) + np.diff(y) * np.sin(middle)))


def _lagged(t: np.ndarray, rate: np.ndarray, constant: float) -> np.ndarray:
    """A rate (T,) behind a first-order lag [s]."""
    if constant <= 0:
        return rate
    out, keep = rate.copy(), np.exp(-np.diff(t) / constant)
    for k, share in enumerate(keep):
        out[k + 1] = share * out[k] + (1 - share) * rate[k + 1]
    return out

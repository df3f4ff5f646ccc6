"""Where a residual lives that no effect of the catalogue explains.

For each quantity that a motion has (time, speed, place, heading, wheel angle, command, rest), smooth functions of it
are fitted to the white residual of some drives and asked to predict that of the others. What predicts best tells where
to look: a residual that repeats with the wheel's angle is something round, one that repeats with the place, the floor.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from sysid.log import Trial
from sysid.loop.features import BIN, CHANNELS
from sysid.metrics import command_in_force

if TYPE_CHECKING:
    from sysid.close_loop import Result

TERMS = 8  # smooth functions of one quantity
LAGS = 3  # bins over which the motion answers
RIDGE = 3.0
REST = 0.02  # m/s and rad/s below which a vehicle rests


def where_it_lives(result: Result) -> list[dict[str, Any]]:
    """Quantities by the share of the systematic residual that they predict on other drives, best first."""
    trials = result.log.training
    channels = len(CHANNELS)
    bins = result.evidence.residual.shape[1] // channels
    residual = result.search.final.residual.reshape(len(trials), bins, channels)
    found = [quantities(trial, bins, BIN, result.log.spec) for trial in trials]
    count = np.square(result.search.final.residual).sum() / (1 + result.search.excess[1])
    excess = max(result.search.excess[1] * count, 1.0)
    fold = np.arange(len(trials)) % 3
    out = []
    for name in found[0]:
        if any(name not in one for one in found):
            continue
        design = np.stack([with_lags(one[name]) for one in found])  # (B, K, F)
        gain = 0.0
        for part in range(3):
            fit, test = fold != part, fold == part
            x, y = design[fit].reshape(-1, design.shape[-1]), residual[fit].reshape(-1, channels)
            solution = np.linalg.solve(x.T @ x + RIDGE * np.eye(x.shape[1]), x.T @ y)
            left = residual[test] - design[test] @ solution
            gain += float(np.square(residual[test]).sum() - np.square(left).sum())
        out.append({"quantity": name, "share": float(np.clip(gain / excess, 0.0, 1.0))})
    return sorted(out, key=lambda one: -one["share"])


def quantities(trial: Trial, bins: int, width: float, spec: Any) -> dict[str, np.ndarray]:
    """Smooth functions (K, F) of each quantity at the middle of each bin."""
    t = (np.arange(bins) + 0.5) * width
    held = np.maximum(command_in_force(trial.command, t), 0)
    command = np.stack([trial.command.v[held], trial.command.omega[held]], axis=-1)
    if trial.odometry is not None:
        v, omega = (np.interp(t, trial.odometry.t, series) for series in (trial.odometry.v, trial.odometry.omega))
    else:
        v, omega = command.T
    inside = (t <= trial.duration)[:, None]
    still = np.hypot(v, omega * spec.track / 2) < REST
    turned = np.sign(v) != np.sign(np.concatenate([v[:1], v[:-1]]))
    since = np.zeros(bins)
    for k in range(1, bins):
        since[k] = 0.0 if still[k] or turned[k] else since[k - 1] + width
    moving = (~still)[:, None]
    wheel = np.cumsum(np.stack([v - omega * spec.track / 2, v + omega * spec.track / 2], axis=-1), axis=0) * width
    found = {
        "time in the drive": bumps(t, 0.0, 25.0),
        "time in the drive, while moving": bumps(t, 0.0, 25.0) * np.sign(v)[:, None] * moving,
        "speed": bumps(v, -1.0, 1.0),
        "yaw rate": bumps(omega, -1.0, 1.0),
        "speed and yaw rate together": (bumps(v, -1.0, 1.0, 5)[:, :, None] * bumps(omega, -1.0, 1.0, 5)[:, None]
                                        ).reshape(bins, -1),
        "command and its changes": np.concatenate(
            [command, np.diff(command, axis=0, prepend=command[:1]), np.abs(command), command[:, :1] * command[:, 1:]],
            axis=1),
        "time since rest or reversal": bumps(since, 0.0, 4.0) * np.sign(v)[:, None],
        "left wheel's angle": waves(wheel[:, 0] / spec.wheel_radius) * moving,
        "right wheel's angle": waves(wheel[:, 1] / spec.wheel_radius) * moving,
    }
    if trial.ground_truth is not None:
        truth = trial.ground_truth
        x, y, yaw = (np.interp(t, truth.t, series) for series in (truth.x, truth.y, truth.yaw))
        across = np.concatenate([bumps(x, -4.0, 4.0), bumps(y, -4.0, 4.0)], axis=1)
        found["place in the room"] = across * np.sign(v)[:, None] * moving
        found["heading in the room"] = waves(yaw) * np.concatenate([np.ones((bins, 1)), np.sign(v)[:, None]],
                                                                   axis=1).repeat(2, axis=1)
    return {name: np.where(inside, each, 0.0) for name, each in found.items()}


def bumps(z: np.ndarray, low: float, high: float, terms: int = TERMS) -> np.ndarray:
    """(K, F) smooth bumps that cover a range."""
    centre = np.linspace(low, high, terms)
    return np.exp(-0.5 * ((z[:, None] - centre) / ((high - low) / (terms - 1))) ** 2)


def waves(angle: np.ndarray) -> np.ndarray:
    """(K, 4) first two harmonics of an angle."""
    return np.stack([np.cos(angle), np.sin(angle), np.cos(2 * angle), np.sin(2 * angle)], axis=-1)


def with_lags(design: np.ndarray) -> np.ndarray:
    """(K, F LAGS) the functions now and in the bins before."""
    parts = [design]
    for lag in range(1, LAGS):
        parts.append(np.concatenate([np.zeros_like(design[:lag]), design[:-lag]]))
    return np.concatenate(parts, axis=1)

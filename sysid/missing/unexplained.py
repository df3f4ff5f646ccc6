"""Where a residual lives that no effect of the catalogue explains.

For each quantity that a motion has (time, speed, place, heading, wheel angle, command, rest), smooth functions of it
are fitted to the white residual of some drives and asked to predict that of the others. What predicts best shows where
to look: a residual that repeats with the wheel's angle is something round, one that repeats with the place, the floor.
How far a wheel is turned when a drive begins is not known: each drive may start at its own angle.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sysid.errors.features import CHANNELS
from sysid.logs.records import Trial, command_in_force

TERMS = 8  # smooth functions of one quantity
MEMORY = (0.5, 2.0)  # time constants [s] of what the motion remembers: a controller answers a force for a second or two
WAVES = 2  # harmonics of an angle
PHASES = np.arange(24) * 2 * np.pi / 24  # start angles of a wheel that are tried
ANGLE_PRICE = 4.0  # what fitting its start angle brings a trial in noise; taken off
ALIGNINGS = 20  # rounds of fitting one shape and each drive's start angle to it
RIDGE = 3.0
WHEELS = ("left wheel's angle", "right wheel's angle")
REST = 0.02  # m/s and rad/s below which a vehicle rests


def held_back_gains(trials: Sequence[Trial], spec: Any, residual: np.ndarray, width: float,
                    channels: int = len(CHANNELS)) -> dict[str, float]:
    """By how much smooth functions of each quantity, fitted to two thirds of the trials, lower the sum of squares of
    the white residual (B, n) of the others, in bins of a width [s] with so many channels; 0 where one trial is all."""
    bins = residual.shape[1] // channels
    residual = residual.reshape(len(trials), bins, channels)
    found = [quantities(trial, bins, width, spec) for trial in trials]
    fold = np.arange(len(trials)) % 3
    out = {}
    for name in found[0]:
        if any(name not in one for one in found):
            continue
        design = np.stack([with_memory(one[name], width) for one in found])  # (B, K, F)
        x, y = (np.einsum("bkf,bkg->bfg", design, each, optimize=True) for each in (design, residual))
        turns, gain = np.eye(x.shape[1])[None], 0.0
        if name in WHEELS:
            turns = np.kron(np.eye(1 + len(MEMORY)), wave_turns(WAVES, False))
        for part in range(3):
            fit, test = fold != part, fold == part
            if not fit.any() or not test.any():  # one drive alone predicts none
                continue
            solution, _ = align(x[fit], y[fit], turns, RIDGE * np.eye(x.shape[1]))
            gain += float(gains_at(solution, x[test], y[test], turns).max(1).sum())
        if name in WHEELS and len(trials) > 1:
            gain -= ANGLE_PRICE * len(trials)
        out[name] = gain
    return out


def best_gain(trials: Sequence[Trial], spec: Any, residual: np.ndarray, width: float,
              channels: int = len(CHANNELS)) -> float:
    """What the best of the quantities gains; 0 where none does."""
    return max(0.0, *held_back_gains(trials, spec, residual, width, channels).values())


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
    wheel = _rolled(trial, t, spec.track)
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
        turn = np.stack([np.sin(yaw), np.cos(yaw)], axis=-1)
        way = np.sign(v)[:, None] * moving
        found["heading in the room"] = np.concatenate([turn, turn * way, way], axis=1)
    return {name: np.where(inside, each, 0.0) for name, each in found.items()}


def _rolled(trial: Trial, t: np.ndarray, track: float) -> np.ndarray:
    """(K, 2) m that the left and the right wheel rolled until times t (K,)."""
    speeds = trial.odometry or trial.command
    sides = np.stack([speeds.v - speeds.omega * track / 2, speeds.v + speeds.omega * track / 2], axis=-1)
    rolled = np.concatenate([np.zeros((1, 2)), np.cumsum(np.diff(speeds.t)[:, None] * sides[:-1], axis=0)])
    return np.stack([np.interp(t, speeds.t, rolled[:, k]) for k in range(2)], axis=-1)


def align(products: np.ndarray, moments: np.ndarray, turns: np.ndarray, penalty: np.ndarray
          ) -> tuple[np.ndarray, np.ndarray]:
    """One shape for many drives, each turned by an angle of its own: coefficients (F, C), and the turn (B,) of each
    drive.

    Args:
        products: (B, F, F) of each drive's columns; moments: (B, F, C) of its columns with the residual.
        turns: (G, F, F) what coefficients become when the angle starts elsewhere; one identity for no freedom.
        penalty: (F, F) prior of the coefficients.
    """
    best: tuple[float, np.ndarray, np.ndarray] | None = None
    alone = [np.linalg.solve(a + penalty, b) for a, b in zip(products, moments, strict=True)]
    strength = [float((b * one).sum()) for b, one in zip(moments, alone, strict=True)]
    for first in np.argsort(strength)[::-1][: 3 if len(turns) > 1 else 1]:
        solution, chosen = alone[first], np.full(len(products), -1)
        for _ in range(ALIGNINGS):
            new = gains_at(solution, products, moments, turns).argmax(1)
            if (new == chosen).all():
                break
            chosen = new
            turn = turns[chosen]
            matrix = np.einsum("bji,bjk,bkl->il", turn, products, turn, optimize=True) + penalty
            right = np.einsum("bji,bjc->ic", turn, moments, optimize=True)
            solution = np.linalg.solve(matrix, right)
        explained = float(gains_at(solution, products, moments, turns).max(1).sum())
        if best is None or explained > best[0]:
            best = explained, solution, chosen
    assert best is not None
    return best[1], best[2]


def gains_at(solution: np.ndarray, products: np.ndarray, moments: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """(B, G) by how much coefficients (F, C), turned each way, lower the squared residual of each drive."""
    turned = turns @ solution  # (G, F, C)
    cross = np.einsum("bfc,gfc->bg", moments, turned, optimize=True)
    own = np.einsum("gfc,bfh,ghc->bg", turned, products, turned, optimize=True)
    return np.asarray(2 * cross - own)


def wave_turns(harmonics: int, constant: bool) -> np.ndarray:
    """(G, F, F) coefficients of sin z, cos z, sin 2z, ... (after those of 1, if `constant`) when z starts at PHASES."""
    size = 2 * harmonics + constant
    out = np.zeros((len(PHASES), size, size))
    out[:, :1, :1] = 1.0
    for k in range(harmonics):
        at = 2 * k + constant
        cos, sin = np.cos((k + 1) * PHASES), np.sin((k + 1) * PHASES)
        out[:, at, at], out[:, at, at + 1] = cos, -sin
        out[:, at + 1, at], out[:, at + 1, at + 1] = sin, cos
    return out


def bumps(z: np.ndarray, low: float, high: float, terms: int = TERMS) -> np.ndarray:
    """(K, F) smooth bumps that cover a range."""
    centre = np.linspace(low, high, terms)
    return np.exp(-0.5 * ((z[:, None] - centre) / ((high - low) / (terms - 1))) ** 2)


def waves(angle: np.ndarray) -> np.ndarray:
    """(K, 4) first two harmonics of an angle."""
    return np.stack([wave(k * angle) for k in range(1, WAVES + 1) for wave in (np.sin, np.cos)], axis=-1)


def with_memory(design: np.ndarray, width: float) -> np.ndarray:
    """(K, F (1 + M)) functions (K, F) now, and their low-passed past, in bins of a width [s]."""
    from scipy.signal import lfilter

    kept = np.exp(-width / np.array(MEMORY))
    return np.concatenate([design, *(lfilter([1 - one], [1.0, -one], design, axis=0) for one in kept)], axis=1)

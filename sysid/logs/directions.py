"""Which way a pose travels in its own frame, beside the speeds that it should have.

It moves forward by v, and to the left and ahead by what a turn adds at a point beside the axle: a regression on v and
omega shows the angle between the pose's x axis and the way it travels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sysid.logs.planar import differenced, half_span, turned_by
from sysid.logs.records import Trial, logged_pose
from sysid.logs.stream_quality import GRID_DT

RESPONSE = 0.3  # s that a vehicle takes to follow its command, where nothing else is known
NONE = 0.02  # m/s, below which a speed is none
VARIED = 0.03  # m/s of standard deviation of a speed that shows a direction
MOVING = 0.05  # m/s or rad/s of a pose that moves
WHOLE = 0.8  # share of the motion that a direction, or another clock, must explain
ALIKE = 0.7  # correlation of a speed with one that it follows
UNLIKE = 0.3  # of what something does not explain, that may be left with something else
APART = 0.4  # s between samples whose errors are independent: steps are taken over half of it
SURE = 4.0  # standard errors that an angle or a place must have
PLAINER = 0.03  # share of the motion that speeds along the vehicle do not explain, where another frame counts


def likeness(one: np.ndarray, other: np.ndarray, still: float = MOVING) -> float:
    """Correlation of two signals (T,); 0 where one changes by no more than `still` (standard deviation)."""
    return float(np.corrcoef(one, other)[0, 1]) if min(one.std(), other.std()) > still else 0.0


@dataclass(frozen=True)
class Motion:
    """A pose's own motion beside the speeds it should have, every GRID_DT."""

    t: np.ndarray  # (G,) s
    steps: np.ndarray  # (G, 2) m/s, in the fixed frame
    place: np.ndarray  # (G, 2) m
    yaw: np.ndarray  # (G,)
    turn: np.ndarray  # (G,) rad/s
    v: np.ndarray  # (G,) m/s that it should have
    omega: np.ndarray  # (G,) rad/s


@dataclass(frozen=True)
class Direction:
    """Which way a pose travels in its own frame."""

    angle: float  # to the left of its own heading [rad]
    error: float
    explained: float  # share of the motion that this explains
    gain: float = 1.0  # speed of the pose over the one it should have
    gain_error: float = 0.0  # infinite where the tracked point would be too far off


def motion_of(trial: Trial, name: str) -> Motion | None:
    """Motion of a stream's pose beside the odometry's speeds, or the commands where there are none that move."""
    pose, odometry = logged_pose(getattr(trial, name), 20), trial.odometry
    if pose is None:
        return None
    half = half_span(pose.t)
    t = np.arange(pose.t[0] + half, pose.t[-1] - half, GRID_DT)
    if len(t) < 50:
        return None
    x, y, turn = (differenced(pose.t, one, t, half) for one in pose.values.T)
    v, omega = trial.command.at(t - RESPONSE, (0.0, 0.0))
    if odometry is not None and odometry.v.std() > NONE:
        shifts = np.linspace(-half, half, 5)
        v, omega = (np.mean([np.interp(t + shift, odometry.t, one) for shift in shifts], axis=0)
                    for one in (odometry.v, odometry.omega))
    if v.std() < VARIED:
        return None
    place = [np.interp(t, pose.t, one) for one in pose.values.T]
    return Motion(t, np.column_stack([x, y]), np.column_stack(place[:2]), place[2], turn, v, omega)


def direction(motion: Motion, reach: float, mirrored: bool = False) -> Direction:
    """Direction in which a pose travels, whose point is at most `reach` off the axle's centre [m]; `mirrored`: -y."""
    x, y = motion.steps.T
    along = np.exp(-1j * motion.yaw) * (x + 1j * (-y if mirrored else y))
    design = np.column_stack([motion.v, motion.omega])
    gains = np.linalg.lstsq(design, along, rcond=None)[0]
    too_far = abs(gains[1]) > reach
    if too_far:
        gains[1] *= reach / abs(gains[1])
        gains[0] = motion.v @ (along - gains[1] * motion.omega) / max(motion.v @ motion.v, 1e-12)
    left = along - design @ gains
    power = float(np.square(np.abs(along)).sum())
    explained = 1 - float(np.square(np.abs(left)).sum()) / max(power, 1e-12)
    # What v alone shows: on a circle a turned axis and a point before the axle move alike.
    alone = motion.v - motion.omega * (motion.v @ motion.omega) / max(motion.omega @ motion.omega, 1e-12)
    independent = max(len(left) * GRID_DT / APART, 1.0)  # samples
    power_alone, size = independent * max(float(np.mean(np.square(alone))), 1e-12), float(abs(gains[0]))
    across, ahead = (float(np.sqrt(np.mean(np.square(one)) / power_alone)) for one in (left.imag, left.real))
    return Direction(float(np.angle(gains[0])), across / max(size, 1e-9), explained, size,
                     float("inf") if too_far else ahead)


def inverted(motion: Motion) -> Motion:
    """The same motion if the pose is that of the fixed frame in the vehicle's."""
    back = -np.column_stack(turned_by(motion.place[:, 0], motion.place[:, 1], -motion.yaw))
    return replace(motion, steps=np.gradient(back, GRID_DT, axis=0), place=back, yaw=-motion.yaw, turn=-motion.turn)


def far_point(trials: Sequence[Trial], reach: float) -> str:
    """A sentence on a tracked point that surely is farther from the axle's centre than a vehicle reaches, or none."""
    motions = [motion for trial in trials if (motion := motion_of(trial, "ground_truth")) is not None]
    if not motions:
        return ""
    design = np.concatenate([np.column_stack([one.v, one.omega]) for one in motions])
    along = np.concatenate([np.exp(-1j * one.yaw) * (one.steps[:, 0] + 1j * one.steps[:, 1]) for one in motions])
    gains = np.linalg.lstsq(design, along, rcond=None)[0]
    left = along - design @ gains
    v, omega = design.T
    alone = omega - v * (v @ omega) / max(v @ v, 1e-12)  # on a circle nothing shows the place
    spread = np.square(np.abs(left)).mean() * APART / GRID_DT / max(alone @ alone, 1e-12)
    if alone @ alone < PLAINER * (omega @ omega):
        return ""
    explained = 1 - float(np.square(np.abs(left)).sum() / max(np.square(np.abs(along)).sum(), 1e-12))
    if explained < WHOLE or abs(gains[1]) - SURE * np.sqrt(spread) < reach or abs(gains[0]) < 1e-9:
        return ""
    place = -1j * gains[1] * abs(gains[0]) / gains[0]  # a turn moves a point ahead to the left
    ways = (f"{abs(place.real):.2f} m {'ahead of' if place.real > 0 else 'behind'}",
            f"{abs(place.imag):.2f} m to the {'left' if place.imag > 0 else 'right'} of")
    return (f"ground_truth: its point is {ways[0]} and {ways[1]} the drive-axle centre, farther than the vehicle "
            f"reaches ({reach:.2f} m). If that is so, state it: sysid.convert takes --truth-ahead {place.real:.2f} "
            f"--truth-left {place.imag:.2f}; else take the body that is on the vehicle.")


def in_fixed_frame(motions: Sequence[Motion]) -> bool:
    """Whether v follows the motion along one fixed direction, and not that along the vehicle."""
    fixed, own = [], []
    for one in motions:
        fixed.append(_explained(one.v, one.steps))
        ahead, across = turned_by(one.steps[:, 0], one.steps[:, 1], -one.yaw)
        own.append(_explained(one.v, np.column_stack([ahead, across, one.turn])))
    left, other = 1 - float(np.median(fixed)), 1 - float(np.median(own))
    return left < min(1 - WHOLE, UNLIKE * other) and other > PLAINER


def _explained(signal: np.ndarray, design: np.ndarray) -> float:
    """Share of a signal's (T,) square that columns (T, C) explain."""
    left = signal - design @ np.linalg.lstsq(design, signal, rcond=None)[0]
    return 1 - float(left @ left) / max(float(signal @ signal), 1e-12)


def pooled(found: Sequence[Direction]) -> Direction:
    """The direction of all trials together, each by how well it shows one."""
    weights = np.array([1 / max(one.error, 1e-4) ** 2 for one in found])
    each = np.exp(1j * np.array([one.angle for one in found]))
    angle = float(np.angle((weights * each).sum()))
    apart = np.angle(each * np.exp(-1j * angle))
    scatter = float((weights * apart**2).sum() / weights.sum() / max(len(found) - 1, 1))
    return Direction(angle, float(np.sqrt(max(1 / weights.sum(), scatter))),
                     float(np.median([one.explained for one in found])))

"""Poses that contradict the speeds beside them: another axis, frame or clock, a reset, or speeds that are none.

In the vehicle's own frame a pose moves forward by v, and to the left and ahead by what a turn adds at a point beside
the axle. A regression of both on v and omega shows the angle between the pose's x axis and the way it travels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sysid.logs.clocks import NONE, RESPONSE, VARIED, WHOLE, another_clock, running_fast
from sysid.logs.pose_jumps import constant_columns, frozen, jumps
from sysid.logs.records import Trial, command_in_force
from sysid.logs.streams import GRID_DT, SMOOTHING

MOVING = 0.05  # m/s or rad/s of a pose that moves
APART = 0.4  # s between samples whose errors are independent: steps are taken over half of it
LITTLE = 0.75  # the same, below which something is wrong
ANGLE = np.deg2rad(3.0)  # between an axis and the way of travel, that is named
SURE = 4.0  # standard errors that such an angle must have
BACKWARDS = np.deg2rad(150.0)  # beyond which the sign of v says it already
FASTER = 0.3  # share of a pose's usual speed, above which it counts as moving
EMPTY = 0.15  # share of the time in which a pose moves, for which speeds of exactly zero are no standstill
PLAINER = 0.1  # share of the motion that another explanation must explain more of


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

    angle: float
    """To the left of its own heading [rad]."""
    error: float
    explained: float
    """Share of the motion that this explains."""
    gain: float = 1.0
    """Speed of the pose over the one it should have."""
    gain_error: float = 0.0
    """Infinite where the tracked point would be too far off."""


def contradictions(trials: Sequence[Trial], reach: float = 1.0) -> dict[str, list[str]]:
    """Sentences for "odometry" and "ground_truth" on what contradicts the speeds beside it.

    Args:
        reach: how far from the axle's centre a tracked point may be [m]. That of the odometry is the centre.
    """
    found: dict[str, list[str]] = {}
    for name in ("odometry", "ground_truth"):
        alone = name == "odometry" or bool(found["odometry"]) or any(trial.odometry is None for trial in trials)
        found[name] = _of_stream(name, trials, reach if name == "ground_truth" else 0.0,
                                 "commands" if alone else "odometry")
    if not any(found.values()) and (far := _far_point(trials, reach)):
        found["ground_truth"] = [far]
    return found


def _of_stream(name: str, trials: Sequence[Trial], reach: float, beside: str) -> list[str]:
    empty = _empty_speeds(trials) if name == "odometry" else []
    if found := constant_columns(name, trials) or frozen(name, trials) or [*jumps(name, trials), *empty]:
        return found
    if said := running_fast(name, trials, beside) or another_clock(name, trials):
        return [said]
    motions = [motion for trial in trials if (motion := motion_of(trial, name)) is not None]
    if not motions:
        return []
    plain = _pooled([direction(one, reach) for one in motions])
    against = float(np.median([_likeness(one.turn, one.omega) for one in motions]))
    if against < -WHOLE and _pooled([direction(_inverted(one), reach) for one in motions]).explained > max(
            WHOLE, plain.explained):
        return [f"{name}: its pose is that of the fixed frame as the vehicle sees it: parent and child are exchanged. "
                "Invert the transform: (x, y) = -R(-yaw) (x, y), then yaw = -yaw."]
    if plain.explained < LITTLE:
        mirrored = _pooled([direction(one, reach, mirrored=True) for one in motions])
        if mirrored.explained > WHOLE:
            return [f"{name}: x and y turn against yaw: the frame is left-handed (y mirrored, or x and y exchanged), "
                    "or yaw is a compass heading. Counter-clockwise is positive yaw; negate y, exchange the axes, or "
                    "take 90 deg - heading."]
        if name == "odometry" and _in_fixed_frame(motions):
            return [f"{name}: v is the speed along the fixed x axis, not along the vehicle: the twist is in the frame "
                    "odom. Its pose agrees with the commands; turn the twist by -yaw, into the vehicle's frame."]
        if name == "odometry" and plain.explained < LITTLE / 2:
            return [f"{name}: its pose and its speeds contradict each other: v explains {plain.explained:.0%} of how "
                    "the pose moves. Check that both are of one vehicle, frame and clock."]
        return []
    if name == "odometry" and against < -WHOLE and _obeys(trials):
        return ["odometry: its yaw turns against its own omega, which follows the commands: yaw has the wrong sign. "
                "Counter-clockwise is positive; negate yaw, and y if that turns with it."]
    if plain.explained > WHOLE and ANGLE < abs(plain.angle) < BACKWARDS and abs(plain.angle) > SURE * plain.error:
        degrees = np.rad2deg(plain.angle)
        side = "left" if degrees > 0 else "right"
        what = "the outside pose" if name == "ground_truth" else "its pose"
        remedy = (f"add {degrees:.0f} deg to its yaw (sysid.convert takes --truth-turned {-degrees:.0f})"
                  if name == "ground_truth" else "its speeds agree with the commands; turn x and y")
        return [f"{name}: {what} moves {abs(degrees):.0f} deg to the {side} of its own heading: its axes are not "
                f"the vehicle's. Correct them: {remedy}."]
    return []



def motion_of(trial: Trial, name: str) -> Motion | None:
    """Motion of a stream's pose beside the odometry's speeds, or the commands where there are none that move."""
    source, odometry = getattr(trial, name), trial.odometry
    if source is None or source.x is None or source.y is None or source.yaw is None or len(source.t) < 20:
        return None
    half = max(SMOOTHING / 2, float(np.median(np.diff(source.t))))
    t = np.arange(source.t[0] + half, source.t[-1] - half, GRID_DT)
    if len(t) < 50:
        return None

    def at(when: np.ndarray, column: np.ndarray) -> np.ndarray:
        return np.asarray(np.interp(when, source.t, column))

    steps, turn = (np.stack([at(t + half, one) - at(t - half, one) for one in columns], axis=-1) / (2 * half)
                   for columns in ((source.x, source.y), (source.yaw,)))
    held = command_in_force(trial.command, t - RESPONSE)
    v, omega = (np.where(held >= 0, one[np.maximum(held, 0)], 0.0) for one in (trial.command.v, trial.command.omega))
    if odometry is not None and odometry.v.std() > NONE:
        shifts = np.linspace(-half, half, 5)
        v, omega = (np.mean([np.interp(t + shift, odometry.t, one) for shift in shifts], axis=0)
                    for one in (odometry.v, odometry.omega))
    if v.std() < VARIED:
        return None
    place = np.stack([at(t, source.x), at(t, source.y)], axis=-1)
    return Motion(t, steps, place, at(t, source.yaw), turn[:, 0], v, omega)


def direction(motion: Motion, reach: float, mirrored: bool = False) -> Direction:
    """Direction in which a pose travels.

    Args:
        reach: how far from the axle's centre its point may be [m].
        mirrored: with y negated.
    """
    x, y = motion.steps.T * np.array([[1.0], [-1.0 if mirrored else 1.0]])
    cos, sin = np.cos(motion.yaw), np.sin(motion.yaw)
    along = (cos * x + sin * y) + 1j * (-sin * x + cos * y)
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


def _inverted(motion: Motion) -> Motion:
    """The same motion if the pose is that of the fixed frame in the vehicle's."""
    cos, sin, half = np.cos(motion.yaw), np.sin(motion.yaw), GRID_DT / 2
    x, y = motion.place.T
    back = -np.stack([cos * x + sin * y, -sin * x + cos * y], axis=-1)
    return replace(motion, steps=np.gradient(back, 2 * half, axis=0), place=back, yaw=-motion.yaw, turn=-motion.turn)


def _obeys(trials: Sequence[Trial]) -> bool:
    """Whether the odometry's yaw rate has the sign of the commanded one."""
    found = [_likeness(one.odometry.omega, one.command.omega[np.maximum(
        command_in_force(one.command, one.odometry.t - RESPONSE), 0)]) for one in trials if one.odometry is not None]
    return bool(np.median(found) > 0)


def _likeness(one: np.ndarray, other: np.ndarray) -> float:
    """Correlation of two signals (T,), 0 where one hardly changes."""
    return float(np.corrcoef(one, other)[0, 1]) if min(one.std(), other.std()) > MOVING else 0.0


def _far_point(trials: Sequence[Trial], reach: float) -> str:
    """A sentence on a tracked point that surely is farther from the axle's centre than a vehicle reaches, or none."""
    motions = [motion for trial in trials if (motion := motion_of(trial, "ground_truth")) is not None]
    if not motions:
        return ""
    design = np.concatenate([np.column_stack([one.v, one.omega]) for one in motions])
    along = np.concatenate([np.exp(-1j * one.yaw) * (one.steps[:, 0] + 1j * one.steps[:, 1]) for one in motions])
    gains = np.linalg.lstsq(design, along, rcond=None)[0]
    left = along - design @ gains
    spread = np.linalg.pinv(design.T @ design) * np.square(np.abs(left)).mean() * APART / GRID_DT
    explained = 1 - float(np.square(np.abs(left)).sum() / max(np.square(np.abs(along)).sum(), 1e-12))
    if explained < WHOLE or abs(gains[1]) - SURE * np.sqrt(spread[1, 1]) < reach or abs(gains[0]) < 1e-9:
        return ""
    place = -1j * gains[1] * abs(gains[0]) / gains[0]  # a turn moves a point ahead to the left
    ways = (f"{abs(place.real):.2f} m {'ahead of' if place.real > 0 else 'behind'}",
            f"{abs(place.imag):.2f} m to the {'left' if place.imag > 0 else 'right'} of")
    return (f"ground_truth: its point is {ways[0]} and {ways[1]} the drive-axle centre, farther than the vehicle "
            f"reaches ({reach:.2f} m). If that is so, state it: sysid.convert takes --truth-ahead {place.real:.2f} "
            f"--truth-left {place.imag:.2f}; else take the body that is on the vehicle.")


def _in_fixed_frame(motions: Sequence[Motion]) -> bool:
    """Whether v follows the motion along one fixed direction, and not that along the vehicle."""
    fixed, own = [], []
    for one in motions:
        cos, sin = np.cos(one.yaw), np.sin(one.yaw)
        x, y = one.steps.T
        fixed.append(_explained(one.v, np.column_stack([x, y])))
        own.append(_explained(one.v, np.column_stack([cos * x + sin * y, -sin * x + cos * y, one.turn])))
    return bool(np.median(fixed) > max(WHOLE, float(np.median(own)) + PLAINER))


def _explained(signal: np.ndarray, design: np.ndarray) -> float:
    """Share of a signal's (T,) square that columns (T, C) explain."""
    left = signal - design @ np.linalg.lstsq(design, signal, rcond=None)[0]
    return 1 - float(left @ left) / max(float(signal @ signal), 1e-12)




def _empty_speeds(trials: Sequence[Trial]) -> list[str]:
    """Odometry whose pose moves, or turns, while the speed of it is exactly zero."""
    found = [shares for trial in trials if (shares := _empty_shares(trial)) is not None]
    if not found:
        return []
    usual = [float(np.median(known)) if (known := [one[k] for one in found if np.isfinite(one[k])]) else 0.0
             for k in (0, 1)]
    empty = [name for name, share in zip(("v", "omega"), usual, strict=True) if share > EMPTY]
    if not empty:
        return []
    how = "all zero" if max(usual) > 0.95 else f"zero in {max(usual):.0%} of that time"
    return [f"odometry: its pose moves with the commands, but its speeds {' and '.join(empty)} are {how}: the driver "
            "does not fill the twist. Compute v and omega from the pose, or record a topic that has them."]


def _empty_shares(trial: Trial) -> tuple[float, float] | None:
    """Shares of the time in which the pose travels and v is exactly zero, and in which it turns and omega is; nan where
    it does not."""
    stream = trial.odometry
    if stream is None or stream.x is None or stream.y is None or stream.yaw is None or len(stream.t) < 20:
        return None
    half = max(SMOOTHING, float(np.median(np.diff(stream.t))))
    x, y, turn = (np.abs(np.interp(stream.t + half, stream.t, one) - np.interp(stream.t - half, stream.t, one))
                  / (2 * half) for one in (stream.x, stream.y, stream.yaw))
    shares = []
    for rate, speed in ((np.hypot(x, y), stream.v), (turn, stream.omega)):
        faster = rate > max(MOVING, FASTER * float(np.percentile(rate, 95)))
        shares.append(float((speed == 0)[faster].mean()) if faster.sum() > 10 else float("nan"))
    return shares[0], shares[1]


def _pooled(found: Sequence[Direction]) -> Direction:
    """The direction of all trials together, each by how well it shows one."""
    weights = np.array([1 / max(one.error, 1e-4) ** 2 for one in found])
    each = np.exp(1j * np.array([one.angle for one in found]))
    angle = float(np.angle((weights * each).sum()))
    apart = np.angle(each * np.exp(-1j * angle))
    scatter = float((weights * apart**2).sum() / weights.sum() / max(len(found) - 1, 1))
    return Direction(angle, float(np.sqrt(max(1 / weights.sum(), scatter))),
                     float(np.median([one.explained for one in found])))

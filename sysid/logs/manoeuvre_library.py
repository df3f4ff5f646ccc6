"""Manoeuvres that an experiment can be chosen from, within limits of speed and room.

All begin and end with a second of standstill. Those of `whill_mjx.logs.manoeuvres` are driven at two sizes; added are
pseudo-random steps, chirps, ladders of step sizes, stop and go, slow yaw, and a square along four headings.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sysid.logs.metrics import integrate
from sysid.logs.planar import turned_by
from sysid.logs.records import Command, OdometryStream, PoseStream, Start, Trial
from whill_mjx.logs.manoeuvres import MANOEUVRES, STANDSTILL, Pieces, Scenario

SAMPLE_DT = 0.05  # s between the measurements that are planned with
REST_SAMPLES = 20  # of the standstill second, which the start pose is the mean of
FRACTIONS = (1.0, 0.75, 0.5, 0.35, 0.2)  # of the time in motion that are tried where the room is too small
CLEARANCE = 1.05  # of an ideal vehicle's path, for what the real one adds


@dataclass(frozen=True)
class Limits:
    """What a manoeuvre may use."""

    v_min: float = -1.0
    v_max: float = 1.0  # speeds [m/s]; a vehicle that must not reverse has v_min = 0
    omega_max: float = 1.0  # yaw rate [rad/s]
    room: tuple[float, float] = (8.0, 8.0)  # length and width [m] of the free floor
    margin: float = 0.6  # how far the drive-axle centre stays from its edges [m]: the reach of the body
    seconds: float = 20.0  # time in motion at most [s]
    dt: float = 0.1  # command period [s]
    least: float = 0.05  # speed [m/s] below which reversing shows nothing: of the chair

    def __post_init__(self) -> None:
        if not (self.v_max > 0 and self.v_min <= 0 and self.omega_max > 0):
            raise ValueError(f"limits v {self.v_min:g} to {self.v_max:g} m/s, omega {self.omega_max:g} rad/s: v_max "
                             "and omega_max must be positive and v_min not. Correct --v-max, --v-min or --omega-max.")
        if min(self.room) <= 2 * self.margin:
            raise ValueError(f"a room of {self.room[0]:g} x {self.room[1]:g} m leaves nothing within a margin of "
                             f"{self.margin:g} m. Give a larger --space or a smaller --margin.")


@dataclass(frozen=True)
class Candidate:
    """A manoeuvre that could be driven next."""

    name: str
    command: Command


Generator = Callable[[float, float, float, float], Pieces]
"""(v [m/s], omega [rad/s], seconds in motion, command period [s]) -> pieces of (seconds, v, omega)."""


def prbs(v: float, omega: float, seconds: float, dt: float) -> Pieces:
    """Steps every 0.3 s between -v and v and between -omega and omega, always the same: delays and lags."""
    random = np.random.default_rng(11)
    count = math.ceil(seconds / 0.3)
    return [(0.3, v * float(a), omega * float(b)) for a, b in zip(random.choice([-1.0, 1.0], count),
                                                                  random.choice([-1.0, 1.0], count), strict=True)]


def chirp(v: float, omega: float, seconds: float, dt: float) -> Pieces:
    """Speed and, a quarter period later, yaw rate swept from 0.1 to 1.5 Hz: lags, jerk and limits."""
    t = np.arange(0.0, seconds, dt)
    phase = 2 * np.pi * (0.1 * t + 1.4 * t**2 / (2 * seconds))
    return [(dt, v * math.sin(p), omega * math.cos(p)) for p in phase]


def yaw_sine(v: float, omega: float, seconds: float, dt: float) -> Pieces:
    """A slow sine of the yaw rate on the spot, 0.2 Hz at a quarter of the rate: dead zone and scrub."""
    t = np.arange(0.0, seconds, dt)
    return [(dt, 0.0, 0.25 * omega * math.sin(2 * math.pi * 0.2 * float(one))) for one in t]


def step_ladder(v: float, omega: float, seconds: float, dt: float) -> Pieces:
    """Forward and back by steps of growing size: delay, lag and acceleration limit scale differently with it."""
    sizes = (0.15, 0.3, 0.5, 0.75, 1.0)
    part = seconds / (4 * len(sizes))
    return [piece for size in sizes for piece in ((part, size * v, 0.0), (part, 0.0, 0.0), (part, -size * v, 0.0),
                                                  (part, 0.0, 0.0))]


def turn_ladder(v: float, omega: float, seconds: float, dt: float) -> Pieces:
    """Turns on the spot to both sides by rates of growing size."""
    return [(length, 0.0, speed * omega / v) for length, speed, _ in step_ladder(v, omega, seconds, dt)]


def stop_and_go(v: float, omega: float, seconds: float, dt: float) -> Pieces:
    """Full speed and stop, forward and back: torque and friction limits, load transfer."""
    part = seconds / 8
    return [(part, v, 0.0), (part, 0.0, 0.0), (part, -v, 0.0), (part, 0.0, 0.0)] * 2


def square(v: float, omega: float, seconds: float, dt: float) -> Pieces:
    """Four sides with quarter turns to the left, back along four to the right: all headings, both turns."""
    quarter = math.pi / 2 / omega
    side = max(seconds / 8 - quarter, 0.3)
    return [(side, v, 0.0), (quarter, 0.0, omega)] * 4 + [(side, v, 0.0), (quarter, 0.0, -omega)] * 4


def arcs(v: float, omega: float, seconds: float, dt: float) -> Pieces:
    """Arcs forward and back to both sides: every sign of speed with every sign of yaw rate."""
    part = seconds / 8
    return [(part, v, omega), (part, -v, omega), (part, v, -omega), (part, -v, -omega)] * 2


OWN: dict[str, Generator] = {
    "prbs": prbs, "chirp": chirp, "yaw_sine": yaw_sine, "step_ladder": step_ladder, "turn_ladder": turn_ladder,
    "stop_and_go": stop_and_go, "square": square, "arcs": arcs,
}  # fmt: skip
REVERSING = ("prbs", "chirp", "step_ladder", "stop_and_go", "arcs", "reversal")
"""Those that drive back as fast as forward: v_min bounds them as well."""
SIZES = (1.0, 0.5)


def library(limits: Limits | None = None) -> tuple[Candidate, ...]:
    """Manoeuvres at two sizes that an ideal vehicle drives within the limits, shortened where the room asks for it."""
    limits = limits or Limits()
    found = []
    for name in (*MANOEUVRES, *OWN):
        for size in SIZES if name != "standstill" else ():  # shows noise and bias, no parameter of the vehicle
            v, omega = size * limits.v_max, size * limits.omega_max
            if name in REVERSING:
                v = min(v, -size * limits.v_min)
                if v < limits.least:
                    continue
            command = _longest(name, v, omega, limits)
            if command is not None:
                found.append(Candidate(name if size == 1.0 else f"{name}_{round(100 * size)}", command))
    if not found:
        raise ValueError(f"no manoeuvre fits into {limits.room[0]:g} x {limits.room[1]:g} m. Give a larger --space.")
    return tuple(found)


def _longest(name: str, v: float, omega: float, limits: Limits) -> Command | None:
    for fraction in FRACTIONS:
        command = make_command(name, v, omega, fraction * limits.seconds, limits.dt)
        if command.v.min() < limits.v_min - 1e-9:
            return None
        t = np.arange(0.0, command.t[-1] + 1e-9, SAMPLE_DT)
        path = CLEARANCE * np.column_stack(integrate(command, Start(), t)[:2])
        if command.t[-1] <= limits.seconds + 2 * STANDSTILL + 1e-9 and placement(path, limits) is not None:
            return command
    return None


def make_command(name: str, v: float, omega: float, seconds: float, dt: float = 0.1) -> Command:
    """Commands of a manoeuvre every dt, with a second of standstill before and after."""
    drive = OWN[name](v, omega, seconds, dt) if name in OWN else MANOEUVRES[name](Scenario(v, omega, seconds, dt))
    pieces = [(STANDSTILL, 0.0, 0.0), *drive, (STANDSTILL, 0.0, 0.0)]
    ends = np.cumsum([length for length, _, _ in pieces])
    t = np.arange(round(float(ends[-1]) / dt)) * dt
    table = np.array(pieces)[np.minimum(np.searchsorted(ends, t + 1e-9, side="right"), len(pieces) - 1), 1:]
    return Command(t, table[:, 0], table[:, 1])


def as_trial(candidate: Candidate, channels: str = "both", sigma: tuple[float, float] = (0, 0)) -> Trial:
    """A trial yet to be measured, in "both" `channels`, "odometry" or "ground_truth".

    `sigma`: noise of the outside pose [m], [rad], which the start pose is known by after a second of standstill.
    """
    t = np.arange(0.0, candidate.command.t[-1] + 1e-9, SAMPLE_DT)
    blank = np.zeros_like(t)
    start = Start(position_sigma=sigma[0] / math.sqrt(REST_SAMPLES), yaw_sigma=sigma[1] / math.sqrt(REST_SAMPLES))
    trial = Trial(candidate.name, candidate.name, candidate.command,
                  OdometryStream(t, blank, blank, blank, blank, blank), PoseStream(t, blank, blank, blank), start)
    if channels == "odometry":
        return replace(trial, ground_truth=None, start=replace(start, position_sigma=0.0, yaw_sigma=0.0))
    return replace(trial, odometry=None) if channels == "ground_truth" else trial


def placement(path: np.ndarray, limits: Limits) -> tuple[float, float, float] | None:
    """Start pose (x, y [m] from a corner of the room, heading [rad]) that keeps a path (T, 2) [m] inside, or None."""
    length, width = (side - 2 * limits.margin for side in limits.room)
    best: tuple[float, tuple[float, float, float]] | None = None
    for yaw in np.deg2rad(np.arange(0.0, 180.0, 5.0)):
        x, y = turned_by(path[:, 0], path[:, 1], yaw)
        spare = min(length - float(np.ptp(x)), width - float(np.ptp(y)))
        if spare >= 0 and (best is None or spare > best[0] + 1e-9):
            place = (limits.room[0] / 2 - float(x.max() + x.min()) / 2, limits.room[1] / 2 - float(
                y.max() + y.min()) / 2, float(yaw))
            best = spare, place
    return None if best is None else best[1]

"""Manoeuvres as command sequences: the paper's five, and four that separate effects which those five confuse.

The paper publishes neither speeds nor durations; those here are our choice. Every manoeuvre starts with a second of
standstill, which shows the start pose, and ends with one.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from whill_mjx.io.command_line import OptionError, Range, check_options

STANDSTILL = 1.0  # s before and after the drive
Pieces = list[tuple[float, float, float]]
"""Parts of a drive: seconds, v [m/s], omega [rad/s]."""


@dataclass(frozen=True)
class Scenario:
    """How hard the manoeuvres are driven."""

    v: Annotated[float, Range(-10, 10)] = 0.6
    """Forward speed [m/s]."""
    omega: Annotated[float, Range(-10, 10)] = 0.6
    """Yaw rate in turns [rad/s]."""
    length: Annotated[float, Range(0, 3600, above=True)] = 8.0
    """Time in motion [s]."""
    dt: Annotated[float, Range(0.001, 1)] = 0.1
    """Command period [s]."""

    def __post_init__(self) -> None:
        check_options(self, "scenario.")


def straight(scenario: Scenario) -> Pieces:
    """Forward, stop, forward at half speed."""
    part = scenario.length / 4
    return [(2 * part, scenario.v, 0.0), (part / 2, 0.0, 0.0), (1.5 * part, scenario.v / 2, 0.0)]


def turn(scenario: Scenario) -> Pieces:
    """On the spot to the left, then to the right."""
    return [(scenario.length / 2, 0.0, scenario.omega), (scenario.length / 2, 0.0, -scenario.omega)]


def circle(scenario: Scenario) -> Pieces:
    """A circle to the left."""
    return [(scenario.length, scenario.v, scenario.omega)]


def s_curve(scenario: Scenario) -> Pieces:
    """Left, then right, twice as often as the figure-eight."""
    part = scenario.length / 4
    return [(part, scenario.v, sign * scenario.omega) for sign in (1.0, -1.0, 1.0, -1.0)]


def figure_eight(scenario: Scenario) -> Pieces:
    """A full circle to the left, then one to the right."""
    if scenario.omega < 0.01:
        raise OptionError(f"--scenario.omega {scenario.omega}: a figure-eight needs at least 0.01 rad/s. Correct it.")
    lap = 2 * math.pi / scenario.omega
    return [(lap, scenario.v, scenario.omega), (lap, scenario.v, -scenario.omega)]


def reversal(scenario: Scenario) -> Pieces:
    """Forward, back, forward: backlash, casters and static friction show where the direction changes."""
    part = scenario.length / 4
    return [(part, scenario.v, 0.0), (2 * part, -scenario.v, 0.0), (part, scenario.v, 0.0)]


def slow_sine(scenario: Scenario) -> Pieces:
    """A fifth of the speed, then of the yaw rate, slowly through zero: a dead zone shows nowhere else."""
    steps = np.arange(round(scenario.length / 2 / scenario.dt))
    wave = [0.2 * math.sin(2 * math.pi * float(step) / len(steps)) for step in steps]
    forward = [(scenario.dt, scenario.v * value, 0.0) for value in wave]
    return forward + [(scenario.dt, 0.0, scenario.omega * value) for value in wave]


def random_steps(scenario: Scenario) -> Pieces:
    """Steps of speed and yaw rate between two levels each, every 0.3 s, always the same: delays, lags and limits."""
    random = np.random.default_rng(7)
    levels = random.choice([1 / 3, 1.0], math.ceil(scenario.length / 0.3)), random.choice([-1.0, 1.0], 1000)
    return [(0.3, scenario.v * float(a), scenario.omega * float(b)) for a, b in zip(*levels, strict=False)]


def standstill(scenario: Scenario) -> Pieces:
    """No motion at all: what is left is noise, bias and drift."""
    return [(scenario.length, 0.0, 0.0)]


Manoeuvre = Callable[[Scenario], Pieces]
PAPER_MANOEUVRES: dict[str, Manoeuvre] = {
    "straight": straight, "turn": turn, "circle": circle, "s_curve": s_curve, "figure_eight": figure_eight,
}  # fmt: skip
MANOEUVRES: dict[str, Manoeuvre] = {
    **PAPER_MANOEUVRES,
    "reversal": reversal, "slow_sine": slow_sine, "random_steps": random_steps, "standstill": standstill,
}  # fmt: skip


def command_table(name: str, scenario: Scenario | None = None) -> np.ndarray:
    """Commands of a manoeuvre (T, 3): t [s], v [m/s] and omega [rad/s] every `dt`; ValueError names the known ones."""
    if name not in MANOEUVRES:
        raise ValueError(f"unknown manoeuvre {name!r} (known: {', '.join(MANOEUVRES)}). Correct the name.")
    scenario = scenario or Scenario()
    pieces = [(STANDSTILL, 0.0, 0.0), *MANOEUVRES[name](scenario), (STANDSTILL, 0.0, 0.0)]
    ends = np.cumsum([seconds for seconds, _, _ in pieces])
    t = np.arange(round(float(ends[-1]) / scenario.dt)) * scenario.dt
    piece = np.searchsorted(ends, t + 1e-9, side="right")
    return np.column_stack([t, np.array(pieces)[piece, 1:]])


def held_commands(table: np.ndarray, dt: float) -> np.ndarray:
    """Commands (S, 2) in force in the middle of each step, of a table (T, 3) of t, v, omega."""
    t = (np.arange(math.ceil(table[-1, 0] / dt)) + 0.5) * dt
    return np.asarray(table[np.searchsorted(table[:, 0], t, side="right") - 1, 1:], float)

"""The five manoeuvres of the paper as command sequences, parameterised.

The paper publishes neither speeds nor durations; those here are our choice. Every manoeuvre starts with a second of
standstill, which tells the start pose, and ends with one.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sysid.log import Command

STANDSTILL = 1.0  # s before and after the drive


@dataclass(frozen=True)
class Scenario:
    """How hard the manoeuvres are driven."""

    v: float = 0.6
    """Forward speed [m/s]."""
    omega: float = 0.6
    """Yaw rate in turns [rad/s]."""
    length: float = 8.0
    """Time in motion [s]."""
    dt: float = 0.1
    """Command period [s]."""


def straight(scenario: Scenario) -> list[tuple[float, float, float]]:
    """Forward, stop, forward at half speed: pieces (seconds, v, omega)."""
    part = scenario.length / 4
    return [(2 * part, scenario.v, 0.0), (part / 2, 0.0, 0.0), (1.5 * part, scenario.v / 2, 0.0)]


def turn(scenario: Scenario) -> list[tuple[float, float, float]]:
    """On the spot to the left, then to the right."""
    return [(scenario.length / 2, 0.0, scenario.omega), (scenario.length / 2, 0.0, -scenario.omega)]


def circle(scenario: Scenario) -> list[tuple[float, float, float]]:
    """A circle to the left."""
    return [(scenario.length, scenario.v, scenario.omega)]


def s_curve(scenario: Scenario) -> list[tuple[float, float, float]]:
    """Left, then right, twice as often as the figure-eight."""
    part = scenario.length / 4
    return [(part, scenario.v, sign * scenario.omega) for sign in (1.0, -1.0, 1.0, -1.0)]


def figure_eight(scenario: Scenario) -> list[tuple[float, float, float]]:
    """A full circle to the left, then one to the right."""
    lap = 2 * math.pi / scenario.omega
    return [(lap, scenario.v, scenario.omega), (lap, scenario.v, -scenario.omega)]


SCENARIOS: dict[str, Callable[[Scenario], list[tuple[float, float, float]]]] = {
    "straight": straight, "turn": turn, "circle": circle, "s_curve": s_curve, "figure_eight": figure_eight,
}


def command_sequence(name: str, scenario: Scenario | None = None) -> Command:
    """Commands of a manoeuvre every `dt`; ValueError names the known ones."""
    if name not in SCENARIOS:
        raise ValueError(f"unknown manoeuvre {name!r} (known: {', '.join(SCENARIOS)}).")
    scenario = scenario or Scenario()
    pieces = [(STANDSTILL, 0.0, 0.0), *SCENARIOS[name](scenario), (STANDSTILL, 0.0, 0.0)]
    ends = np.cumsum([seconds for seconds, _, _ in pieces])
    t = np.arange(round(float(ends[-1]) / scenario.dt)) * scenario.dt
    piece = np.searchsorted(ends, t + 1e-9, side="right")
    return Command(t, np.array([pieces[i][1] for i in piece]), np.array([pieces[i][2] for i in piece]))

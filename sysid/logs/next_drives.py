"""The next three drives of a log: manoeuvres that show what it lacks, slow, ramped and within a stated space.

They are scripts, `t,v,omega` as in command.csv, for `bridge.manoeuvre`. No vehicle model is asked.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from sysid.logs.coverage import Blind
from sysid.logs.manoeuvre_library import FRACTIONS, REVERSING, make_command
from sysid.logs.records import Command, Log

COUNT = 3
RAMPS = (0.5, 1.0)  # m/s^2 and rad/s^2 that no script exceeds
SIZES = (1.0, 0.7, 0.5, 0.35)  # of the speeds that are tried where the floor is too small
LONGEST = 20.0  # s of motion
DT = 0.1  # s between commands
UNCERTAINTY, REACTION = 0.15, 0.25
"""How much faster or slower than commanded, and how long [s] after a stop, it may drive, as `bridge.manoeuvre`."""
STEP = 0.05  # s of the floor that is needed
SHARE = 0.5  # of the vehicle's limits that a script uses
FASTEST = (0.5, 0.8)  # m/s and rad/s that no script exceeds by default
CURES = {
    "no straight motion": "straight", "no turn": "arcs", "turns to one side only": "square", "no reversal": "reversal",
    "one speed": "step_ladder", "steps of hardly any different size": "step_ladder",
    "no slow crossing of zero": "slow_sine", "one heading of the room": "square",
}  # cause of a blind spot -> manoeuvre that removes it, in order of what it hides
OTHERS = ("random_steps", "figure_eight", "stop_and_go", "circle", "turn_ladder")
"""What is driven where nothing is missing: manoeuvres that the log does not have yet come first."""


@dataclass(frozen=True)
class NextDrive:
    name: str
    why: str
    command: Command
    floor: tuple[float, float]  # free floor that it needs [m], along its first heading and across it, margins included
    radius: float  # of the vehicle around its drive-axle centre [m], as the floor was reckoned


def next_drives(
    log: Log, blind: Sequence[Blind], space: tuple[float, float] = (4.0, 4.0), v_max: float | None = None,
    radius: float | None = None,
) -> list[NextDrive]:
    """Up to three drives that show the `blind` spots of a log, each within the space.

    Args:
        space: length and width of the free floor [m].
        v_max: fastest speed [m/s]; by default half of the vehicle's limit, at most 0.5 m/s.
        radius: of the vehicle around its drive-axle centre [m]; by default that of its nominal body.
    """
    v = v_max or min(SHARE * log.spec.v_max, FASTEST[0])
    speeds = v, min(SHARE * log.spec.omega_max, FASTEST[1])
    body = math.hypot(log.spec.body_length, log.spec.body_width / 2)  # wherever the axle is
    radius = radius or math.ceil(20 * body) / 20
    causes = {one.cause for one in blind}
    wanted = {name: cause for cause, name in reversed(CURES.items()) if cause in causes}
    order = [(name, wanted[name]) for name in dict.fromkeys(CURES.values()) if name in wanted]
    named = " ".join(trial.manoeuvre.lower() for trial in log.trials)  # a name may say more, as monday_circle
    driven = [name for name in OTHERS if name in named]
    order += [(name, "no drive of the log has this name") for name in OTHERS if name not in driven]
    order += [(name, "one more repeat") for name in OTHERS if name in driven]
    found: list[NextDrive] = []
    for name, why in order:
        if name in REVERSING and log.spec.v_min >= 0:
            continue
        drive = _largest(name, why, speeds, space, radius)
        if drive is not None and len(found) < COUNT:
            found.append(drive)
    return found


def needed_floor(command: Command, radius: float) -> tuple[float, float]:
    """Length and width of the floor that a vehicle may need for commands, along its first heading and across it [m]:
    with errors of UNCERTAINTY, the body's radius, and what is driven until a stop takes effect."""
    t = np.arange(0.0, command.t[-1] + STEP, STEP)
    v, omega = command.at(t)
    low, high = np.full(2, -radius), np.full(2, radius)
    for faster, sharper in product((-UNCERTAINTY, 0.0, UNCERTAINTY), repeat=2):
        speed, rate = (1 + faster) * v, (1 + sharper) * omega
        heading = np.cumsum(rate) * STEP - rate * STEP / 2
        place = np.cumsum(speed[:, None] * np.column_stack([np.cos(heading), np.sin(heading)]), axis=0) * STEP
        margin = radius + np.abs(speed)[:, None] * REACTION
        low, high = np.minimum(low, (place - margin).min(0)), np.maximum(high, (place + margin).max(0))
    return float(high[0] - low[0]), float(high[1] - low[1])


def _largest(
    name: str, why: str, speeds: tuple[float, float], space: tuple[float, float], radius: float
) -> NextDrive | None:
    """The manoeuvre as fast, then as long, as the space allows; None where it does not fit."""
    for size, fraction in product(SIZES, FRACTIONS):
        v, omega = (size * one for one in speeds)
        command = _ramped(make_command(name, v, omega, fraction * LONGEST, DT))
        length, width = needed_floor(command, radius)
        if command.t[-1] <= LONGEST + 10.0 and (
                length <= space[0] and width <= space[1] or length <= space[1] and width <= space[0]):
            return NextDrive(name, why, command, (length, width), radius)
    return None


def _ramped(command: Command) -> Command:
    """The commands with ramps, and time to come to rest in."""
    rest = np.arange(1, round(2.0 / DT) + 1) * DT
    v, omega = (_slew(np.append(one, 0.0 * rest), step * DT)
                for one, step in zip((command.v, command.omega), RAMPS, strict=True))
    return Command(np.concatenate([command.t, command.t[-1] + rest]), v, omega)


def _slew(values: np.ndarray, step: float) -> np.ndarray:
    """Values (T,) that follow others by at most a step from row to row, from 0."""
    found, now = np.empty_like(values), 0.0
    for k, value in enumerate(values):
        now += float(np.clip(value - now, -step, step))
        found[k] = now
    return found

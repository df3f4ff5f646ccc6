"""The next three drives of a log: manoeuvres that show what it lacks, slow, ramped and within a stated space.

They are scripts, `t,v,omega` as in command.csv. No vehicle model is asked; `sysid.design` plans with a fitted one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sysid.logs.coverage import Blind
from sysid.logs.log import Command, Log
from sysid.logs.manoeuvre_library import CLEARANCE, Candidate, Limits, as_trial, library, placement
from sysid.logs.metrics import ideal_replay

COUNT = 3
RAMPS = (0.5, 1.0)  # m/s^2 and rad/s^2 that no script exceeds
SHARE = 0.5  # of the vehicle's limits that a script uses
FASTEST = (0.5, 0.8)  # m/s and rad/s that no script exceeds by default
CURES = {
    "no straight motion": "straight", "no turn": "arcs", "turns to one side only": "square", "no reversal": "reversal",
    "one speed": "step_ladder", "steps of hardly any different size": "step_ladder",
    "no slow crossing of zero": "slow_sine", "one heading of the room": "square",
}
"""Cause of a blind spot -> manoeuvre that removes it, in order of what it hides."""
OTHERS = ("random_steps", "figure_eight", "stop_and_go", "circle", "turn_ladder")
"""What is driven where nothing is missing: manoeuvres that the log does not have yet come first."""


@dataclass(frozen=True)
class NextDrive:
    """A drive to record next."""

    name: str
    why: str
    command: Command
    start: tuple[float, float, float]
    """Where it starts in the space: x, y [m] from a corner, heading [rad]."""
    size: tuple[float, float]
    """Length and width that its path takes, seen from the start [m]."""


def next_drives(
    log: Log, blind: Sequence[Blind], space: tuple[float, float] = (4.0, 4.0), v_max: float | None = None
) -> list[NextDrive]:
    """Up to three drives that show what a log lacks, each within the space.

    Args:
        blind: its blind spots.
        space: length and width of the free floor [m]; the axle's centre stays a track away from its edges.
        v_max: fastest speed [m/s]; by default half of the vehicle's limit, at most 0.5 m/s.
    """
    v = v_max or min(SHARE * log.spec.v_max, FASTEST[0])
    omega = min(SHARE * log.spec.omega_max, FASTEST[1])
    limits = Limits(max(-v, min(log.spec.v_min, 0.0)), v, omega, space, min(log.spec.track, 0.45 * min(space)))
    try:
        known = {candidate.name: candidate for candidate in library(limits)}
    except ValueError:  # nothing fits
        return []
    causes = {one.cause for one in blind}
    wanted = {name: cause for cause, name in reversed(CURES.items()) if cause in causes}
    order = [(name, wanted[name]) for name in dict.fromkeys(CURES.values()) if name in wanted]
    driven = {trial.manoeuvre for trial in log.trials}
    order += [(name, "a manoeuvre that the log does not have") for name in OTHERS if name not in driven]
    order += [(name, "one more repeat") for name in OTHERS if name in driven]
    found: list[NextDrive] = []
    for name, why in order:
        candidate = known.get(name) or known.get(f"{name}_50")
        drive = None if candidate is None else _ramped(candidate, why, limits)
        if drive is not None and len(found) < COUNT:
            found.append(drive)
    return found


def _ramped(candidate: Candidate, why: str, limits: Limits) -> NextDrive | None:
    """The manoeuvre with ramps, a second of standstill after it, and a place in the space; None where it has none."""
    command = candidate.command
    rest = np.arange(1, round(2.0 / limits.dt) + 1) * limits.dt
    t = np.concatenate([command.t, command.t[-1] + rest])
    v, omega = (_slew(np.append(one, 0.0 * rest), step * limits.dt)
                for one, step in zip((command.v, command.omega), RAMPS, strict=True))
    ramped = Command(t, v, omega)
    ideal = ideal_replay(as_trial(Candidate(candidate.name, ramped))).ground_truth
    assert ideal is not None
    path = CLEARANCE * np.column_stack([ideal.x, ideal.y])
    start = placement(path, limits)
    if start is None:
        return None
    return NextDrive(candidate.name, why, ramped, start, (float(np.ptp(path[:, 0])), float(np.ptp(path[:, 1]))))


def _slew(values: np.ndarray, step: float) -> np.ndarray:
    """Values (T,) that follow others by at most a step from row to row, from 0."""
    found, now = np.empty_like(values), 0.0
    for k, value in enumerate(values):
        now += float(np.clip(value - now, -step, step))
        found[k] = now
    return found

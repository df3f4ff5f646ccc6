"""What each effect of the catalogue forbids, and whether the drives do it.

An effect that was refitted has one size. Its law says that this size is the same whatever the speed, the heading or the
size of a step, and that it does nothing at some times: what merely resembles it there is caught elsewhere. Dry friction
does not depend on speed, a slope changes sign with the heading, a delay does not show while the command is constant.

Two kinds of prediction are tested after the refit:

    same    what the effect changes is split by a quantity into two parts, whose sizes are fitted each for itself,
            beside base parameters and other effects. It is contradicted where the weaker part is surely less than
            `least` of the stronger one; drives that would not show with 80 % power what else it could be tell nothing
    absent  where the effect does nothing, no more may be left, beyond what a day leaves there anyway, than `LEFT` of
            what it gains, together with other effects that were found: they may act there, in another form
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

PRESENT = 0.25
"""Share of the stronger part's size below which the weaker part counts as without the effect: how an effect goes with
speed, turning or steps is never quite as the catalogue says."""
LASTING = 2 / 3
"""The same share of early and late in a drive. No law of the catalogue has the time in it, so that its size must not
change; what warms up or wears off meanwhile does not go to zero."""
SETTLED = 1.5
"""Time after the last change of the command from which it counts as constant [s]."""
STRAIGHT = 0.02
"""Yaw rate [rad/s] below which a vehicle drives straight."""
MOVING = 0.02
"""Speed [m/s], and yaw rate times half the track, below which motion has no direction."""


@dataclass(frozen=True)
class Course:
    """What B trials do in K bins, as the refitted model drives them."""

    t: np.ndarray  # (K,) s, middle of the bins
    v: np.ndarray  # (B, K) m/s
    turn: np.ndarray  # (B, K) m/s, yaw rate times half the track
    omega: np.ndarray  # (B, K) rad/s
    heading: np.ndarray  # (B, K) rad, in the room
    asked: np.ndarray  # (B, K) m/s, yaw rate that is commanded times half the track
    step: np.ndarray  # (B, K) m/s, size of the command's last change
    rising: np.ndarray  # (B, K) whether that change went away from rest: 1, or -1; 0 before any
    since: np.ndarray  # (B, K) s since that change


@dataclass(frozen=True)
class Falsifier:
    """One prediction of an effect."""

    says: str
    """The prediction in words."""
    by: str
    """Quantity that drives are split by (`SPLITS`), or state in which the effect does nothing (`QUIET`)."""
    else_: float = 0.0
    """Size of the weaker part over that of the stronger one where the prediction is wrong: 0 gone, -1 the other way."""
    least: float = PRESENT
    """Share of the stronger part's size that the weaker part must have."""

    @property
    def kind(self) -> str:
        return "absent" if self.by in QUIET else "same"


@dataclass(frozen=True)
class Tested:
    """A prediction and what the drives say of it."""

    effect: str
    falsifier: Falsifier
    outcome: str
    """holds, falsified, or untold: the drives would not have shown the opposite."""
    sizes: tuple[float, ...]
    """same: size in each part over that of the joint fit. absent: what is left there over what all effects gain."""
    error: float
    """Standard error of the difference that is tested."""
    p: float
    power: float


def side(values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """-1 and 1 below and above the median of values (B, K) where weights (B, K) count."""
    order = np.argsort(values, axis=None)
    total = np.cumsum(weight.reshape(-1)[order])
    middle = values.reshape(-1)[order][min(int(np.searchsorted(total, total[-1] / 2)), len(order) - 1)]
    return np.where(values > middle, 1.0, -1.0)


def way(values: np.ndarray, least: float) -> np.ndarray:
    """Sign of values (B, K); 0 where they are small."""
    return np.where(np.abs(values) < least, 0.0, np.sign(values))


SPLITS: Mapping[str, Callable[[Course, np.ndarray], np.ndarray]] = {
    "speed": lambda course, energy: side(np.abs(course.v), energy),
    "yaw rate": lambda course, energy: side(np.abs(course.omega), energy),
    "direction of travel": lambda course, energy: way(course.v, MOVING),
    "direction of turning": lambda course, energy: way(course.turn, MOVING),
    "command to turn": lambda course, energy: np.where(np.abs(course.asked) < MOVING, -1.0, 1.0),
    "heading along x": lambda course, energy: np.sign(np.cos(course.heading)),
    "heading along y": lambda course, energy: np.sign(np.sin(course.heading)),
    "size of the step": lambda course, energy: side(course.step, energy),
    "starting or stopping": lambda course, energy: course.rising,
    "time in the drive": lambda course, energy: side(np.broadcast_to(course.t, course.v.shape), energy),
}
"""Sides (B, K) -1 and 1 of a quantity, 0 where it has none, from the course and the effect's energy (B, K)."""

QUIET: Mapping[str, Callable[[Course], np.ndarray]] = {
    "constant command": lambda course: course.since >= SETTLED,
    "straight": lambda course: (np.abs(course.omega) < STRAIGHT) & (course.since >= SETTLED),
}
"""Bins (B, K) in which some effects do nothing."""

_STEP = Falsifier("lasts as long whatever the size of the command's step", "size of the step")
_EDGES = Falsifier("shows when the vehicle starts and when it stops", "starting or stopping")
_SETTLED = Falsifier("does not show while the command is constant", "constant command")
_STRAIGHT = Falsifier("does not show while the vehicle drives straight on", "straight")
_FRICTION = Falsifier("does not depend on the speed", "speed")
_SPEED = Falsifier("grows with the speed as its law says", "speed")
_RATE = Falsifier("grows with the yaw rate as its law says", "yaw rate")
_TRAVEL = Falsifier("is the same forward and backward", "direction of travel", -1.0)
_TURN = Falsifier("is the same in turns to the left and to the right", "direction of turning", -1.0)
_COMMAND = Falsifier("is the same whether the command is to drive straight on or to turn", "command to turn")
_TIME = Falsifier("is the same early and late in a drive", "time in the drive", least=LASTING)
_ROOM_X = Falsifier("changes sign with the heading: it is fixed in the room", "heading along x", -1.0)
_ROOM_Y = Falsifier("changes sign with the heading: it is fixed in the room", "heading along y", -1.0)
_BODY_X = Falsifier("keeps its side whatever the heading: it turns with the vehicle", "heading along x", -1.0)
_BODY_Y = Falsifier("keeps its side whatever the heading: it turns with the vehicle", "heading along y", -1.0)

FALSIFIERS: Mapping[str, tuple[Falsifier, ...]] = {
    "command_delay": (_STEP, _EDGES, _SETTLED),
    "command_dead_zone": (_TRAVEL, _TURN, _COMMAND, _TIME),
    "acceleration_limit": (Falsifier("lasts in proportion to the command's step", "size of the step"), _SETTLED, _TIME),
    "jerk_limit": (Falsifier("lasts as the root of the command's step", "size of the step"), _SETTLED, _TIME),
    "command_scale": (_SPEED, _TRAVEL, _TIME),
    "actuator_lag": (_STEP, _EDGES, _SETTLED),
    "torque_saturation": (_TRAVEL, _TURN, _TIME),
    "supply_sag": (_TRAVEL, _TURN),
    "drive_gain_difference": (_TRAVEL, _TIME),
    "dry_friction": (_FRICTION, _TRAVEL, _TIME),
    "wheel_radius_difference": (_SPEED, _TRAVEL, _TIME),
    "track_width": (_RATE, _TURN, _TIME),
    "payload_shift": (_EDGES, _TRAVEL, _TIME),
    "yaw_scrub": (_TURN, _STRAIGHT, _TIME),
    "omni_roller_friction": (_TURN, _STRAIGHT, _TIME),
    "caster_kick": (_TURN, _STRAIGHT, _TIME),
    "traction_limit": (_TURN, _SETTLED, _TIME),
    "rolling_resistance_speed": (_SPEED, _TRAVEL, _TIME),
    "quadratic_drag": (_SPEED, _TRAVEL, _TIME),
    "side_force": (_BODY_X, _BODY_Y, _TIME),
    "slope": (_ROOM_X, _ROOM_Y, _TRAVEL),
    "wind": (_ROOM_X, _ROOM_Y, _TRAVEL),
    "backlash": (_SETTLED, _TRAVEL, _TIME),
    "odometry_scale": (_SPEED, _TRAVEL, _TIME),
    "sensor_delay": (_STEP, _EDGES, _SETTLED),
    "clock_offset": (_STEP, _EDGES, _SETTLED),
    "turn_efficiency": (_RATE, _TURN, _TIME),
    "pose_delay": (_EDGES, _TIME),
}
"""Effect -> its predictions."""


def as_report(tested: Sequence[Tested]) -> list[dict[str, Any]]:
    """The predictions of one effect for report.json."""
    return [{"says": one.falsifier.says, "kind": one.falsifier.kind, "by": one.falsifier.by, "outcome": one.outcome,
             "sizes": list(one.sizes), "standard_error": one.error, "p_value": one.p, "power": one.power}
            for one in tested]


def in_words(one: Tested) -> str:
    """A prediction that the drives contradict."""
    if one.falsifier.kind == "absent":
        return (f"{one.effect} {one.falsifier.says}, but {one.sizes[0]:.0%} of what is gained is left there "
                f"(p = {one.p:.1g})")
    return (f"{one.effect} {one.falsifier.says}, but split by {one.falsifier.by} its size is {one.sizes[0]:.2f} and "
            f"{one.sizes[1]:.2f} of that fitted (p = {one.p:.1g})")

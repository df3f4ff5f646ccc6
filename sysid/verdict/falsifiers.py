"""Test whether the drives contradict what the law of an effect forbids; the predictions stand on the effects' cards.

An effect that was refitted has one size. Its law says that this size is the same at any speed, heading or step size,
and that the effect does nothing at some times. Something that only resembles the effect fails one of these predictions:
dry friction does not depend on speed, a slope changes sign with the heading, a delay needs a changing command.

Two kinds of prediction are tested after the refit:

    same    The change by the effect is split by a quantity into two parts. Their sizes are fitted separately, beside
            base parameters and other effects. The prediction is contradicted if the weaker part is surely below `least`
            of the stronger one. Drives that would not show the opposite with 80 % power leave it untested.
    absent  Where the effect does nothing, the error beyond that of a usual day must not exceed `LEFT` times the gain of
            all effects that were found: these may act there, in another form.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from whill_mjx.effects.card import Falsifier

SETTLED = 1.5  # time after the last change of the command from which it counts as constant [s]
STRAIGHT = 0.02  # yaw rate [rad/s] below which a vehicle drives straight
MOVING = 0.02  # speed [m/s], and yaw rate times half the track, below which motion has no direction


@dataclass(frozen=True)
class BinnedCourse:
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
class Tested:
    """A prediction and what the drives say of it."""

    effect: str
    falsifier: Falsifier
    outcome: str  # holds, falsified, or untold: the drives would not have shown the opposite
    sizes: tuple[float, ...]  # same: of each part over the joint fit; absent: what is left over what all gain
    error: float  # standard error of the difference that is tested
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


SPLITS: Mapping[str, Callable[[BinnedCourse, np.ndarray], np.ndarray]] = {
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

QUIET: Mapping[str, Callable[[BinnedCourse], np.ndarray]] = {
    "constant command": lambda course: course.since >= SETTLED,
    "straight": lambda course: (np.abs(course.omega) < STRAIGHT) & (course.since >= SETTLED),
}
"""Bins (B, K) in which some effects do nothing."""


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

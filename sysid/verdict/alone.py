"""What may be said of drives that stand alone: no reference days, and no manoeuvre driven twice.

The noise is then only what the base model leaves of the drives themselves, so nothing shows whether that is too much.
Simulated nulls deal it out anew to other drives: an effect that stands out of them is real in these drives, but it may
be a lucky correlate of something else. It is named where blocks of drives speak for it: they agree on its size, and
the gain of each is foretold by the others. Of effects that are not separated the simplest is.

Where there is no odometry either, nothing shows whether wheels fell short of the command or the vehicle of its wheels,
while all base parameters of drive and tyres are free. Effects of those have no name then: a dead zone, a limit of
acceleration and drag bend to the same few speeds.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sysid.errors.noise import repeated
from sysid.logs.records import Trial
from sysid.verdict.agreement import disagreement, foretold
from sysid.verdict.found import Search, Thresholds
from whill_mjx.effects import card_of

UNTOLD = "neither replicates nor reference drives show the noise, so whether anything else is missing is unknown"


def stands_alone(trials: Sequence[Trial], known: bool) -> bool:
    """Whether neither a reference nor replicates show the noise of some trials."""
    return not known and not repeated(trials)


def judged(
    found: Search, groups: Sequence[Sequence[int]], precision: np.ndarray, thresholds: Thresholds,
    wheels: bool = True,
) -> Search:
    """The search with a verdict that needs no noise level.

    Args:
        groups: blocks of trials.
        precision: (P, P) of the base parameters, in unit coordinates.
        wheels: whether any trial has an odometry.
    """
    if found.verdict == "named":
        simplest(found)
        against = doubts(found, groups, precision, thresholds) + ([] if wheels else of_wheels(found))
        if against:
            found.verdict, found.reason = "unexplained", f"{'; '.join(against)}; {UNTOLD}"
        else:
            found.reason = f"stands out of what the base model leaves, and blocks of drives agree on it; {UNTOLD}"
    else:
        found.reason = f"{found.reason}; {UNTOLD}"
    return found


def of_wheels(found: Search) -> list[str]:
    """What speaks against each named effect that an outside pose alone does not show, in words."""
    return [f"{one.effect} stands out, but without odometry nothing shows what the wheels did: log their speeds"
            for one in found.final.hypotheses if not card_of(one.effect).shown_by_pose]


def simplest(found: Search) -> None:
    """Of effects that the drives do not separate, name the one with the fewest parameters: by how much better another
    one fits means nothing where the noise is not known."""
    if len(found.accepted) != 1:
        return
    best, members = found.accepted[0], found.classes[0]
    near = [one for one in found.rounds[0] if one.hypothesis.effect in members]
    chosen = min([best, *near], key=lambda one: (len(one.hypothesis.axes), -one.gain))
    if len(chosen.hypothesis.axes) < len(best.hypothesis.axes):
        mine = chosen.hypothesis.effect
        found.accepted, found.final, found.share = [chosen], chosen.refit, chosen.share
        found.classes = [[mine, *(name for name in members if name != mine)]]


def doubts(
    found: Search, groups: Sequence[Sequence[int]], precision: np.ndarray, thresholds: Thresholds
) -> list[str]:
    """What speaks against each named effect, in words."""
    fit, out = found.final, []
    for one, part in zip(fit.hypotheses, fit.parts, strict=True):
        differ = disagreement(fit, part, groups, precision)
        gains = foretold(fit, part, groups, precision)
        lost = float(-gains[gains < 0].sum())
        if differ > thresholds.differ:
            out.append(f"{one.effect} stands out, but blocks of drives differ by {differ:.0%} on its size")
        elif gains.sum() <= 0 or lost > thresholds.loss * (gains.sum() + lost):
            out.append(f"{one.effect} stands out, but is wrong about blocks of drives that were held back")
    return out

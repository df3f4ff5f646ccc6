"""What may be said of drives that stand alone: no reference days, and no manoeuvre driven twice.

The noise is then only what the base model leaves of the drives themselves, so nothing shows whether that is too much.
Simulated nulls deal it out anew to other drives: an effect that stands out of them is real in these drives, but it may
be a lucky correlate of something else. It is named where it predicts blocks of drives that were held back: the 95 %
interval of its gain there lies above 0. Effects are added one after the other as long as that holds. Of effects that
predict these blocks as well as the best, the one with the fewest parameters is named.

Where there is no odometry either, nothing shows whether wheels fell short of the command or the vehicle of its wheels,
while all base parameters of drive and tyres are free. Effects of those have no name of their own then: a dead zone, a
limit of acceleration and drag bend to the same few speeds. Where a pose shows another effect that these drives do not
separate from the best one, and that one predicts the blocks too, it is named, with the best one in its class. Otherwise
the best one stays in the fit without a name, and what still stands out beside it may have one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from sysid.errors.noise import repeated
from sysid.logs.records import Trial
from sysid.verdict.agreement import interval_of_sum
from sysid.verdict.posterior import NOTHING
from sysid.verdict.rounds import Asked, candidates_of, class_of, held_back
from sysid.verdict.search_record import LARGEST, ROUNDS, PairScan, Search
from whill_mjx.effects import card_of

SURE = 1e-10
"""p-value of the search below which something without a name is missing; small ones come too often."""
UNTOLD = "neither replicates nor reference drives show the noise, so whether anything else is missing is unknown"


def stands_alone(trials: Sequence[Trial], known: bool) -> bool:
    """Whether neither a reference nor replicates show the noise of some trials."""
    return not known and not repeated(trials)


def search_alone(asked: Asked, pairs: PairScan | None = None, wheels: bool = True) -> Search:
    """The verdict on drives that stand alone: effects are added one after the other, as long as they make the rest of
    the drives better predicted.

    Args:
        pairs: not asked, since nothing shows their noise.
        wheels: whether any trial has an odometry.
    """
    thresholds = asked.thresholds
    asked = asked if wheels else replace(asked, named=_shown_by_pose)
    found = Search("none", asked.base, asked.base, asked.scan)
    if asked.scan.p_family >= thresholds.alpha:
        return _said(asked, found, NOTHING)
    against, unseen, hidden = "what stands out in a linear scan does not hold in a refit", "", 0.0
    while len(found.accepted) < ROUNDS and len(found.rounds) < 2 * ROUNDS:
        candidates = candidates_of(asked, found, found.final)
        likely = [(one, held_back(asked, one.refit)) for one in candidates if one.p < thresholds.alpha]
        standing = [(one, gains) for one, gains in likely if interval_of_sum(gains)[0] > 0]
        if not standing:
            if likely:
                first = likely[0][0].hypothesis.effect
                against = f"{first} stands out, but does not predict blocks of drives that were held back"
            break
        best, most = max(standing, key=lambda one: float(one[1].sum()))
        as_good = [one for one, gains in standing if one is best or interval_of_sum(most - gains)[0] <= 0]
        alike = class_of(asked, best, candidates)
        shown = as_good if wheels else [
            one for one in candidates if _shown_by_pose(one.hypothesis.effect)
            and (any(one is good for good in as_good)
                 or one.hypothesis.effect in alike and interval_of_sum(held_back(asked, one.refit))[0] > 0)]
        if not shown:
            unseen = unseen or best.hypothesis.effect
            hidden += best.share - asked.explained(found.final)  # what has no name is no part of what names explain
            found.final = best.refit
            continue
        taken_on = min(shown, key=lambda one: len(one.hypothesis.axes))
        mine = taken_on.hypothesis.effect
        members = [*(one.hypothesis.effect for one in as_good), *alike]
        found.accepted.append(taken_on)
        taken = {one.hypothesis.effect for one in found.accepted}
        found.classes.append([mine, *(name for name in dict.fromkeys(members) if name not in taken)][:LARGEST])
        found.final, found.share = taken_on.refit, taken_on.share - hidden
    lacking = unseen and f"{unseen} stands out, but without odometry nothing shows what wheels did: log their speeds"
    if found.accepted:
        found.verdict = "named"
        return _said(asked, found, "; ".join(filter(None, ("predicts blocks of drives that were held back", lacking))))
    found.final = found.base
    if unseen or found.p_value < SURE:
        found.verdict = "unexplained"
    return _said(asked, found, lacking or against)


def _shown_by_pose(effect: str) -> bool:
    """Whether an outside pose shows an effect without odometry."""
    return card_of(effect).shown_by_pose


def _said(asked: Asked, found: Search, reason: str) -> Search:
    """The search with its reason, and what exceeds the noise before and after."""
    found.excess = asked.excess(asked.base.residual), asked.excess(found.final.residual)
    found.reason = f"{reason}; {UNTOLD}"
    return found

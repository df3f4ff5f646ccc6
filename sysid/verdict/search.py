"""From the residual to effects: scan, refit the best, accept, scan again; and what speaks for the result."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sysid.missing.joint_fit import Start, moved_last
from sysid.verdict.found import EFFORT, LARGEST, PairScan, Search, missing
from sysid.verdict.pairs import scan_pairs
from sysid.verdict.rounds import NOTHING, POLISH, Asked, candidates_of, class_of, pair_round


def pairs_of(asked: Asked, seed: int = 0) -> PairScan:
    """A scan of all pairs of effects beside the base."""
    pairs = scan_pairs(asked.evidence, asked.hypotheses, asked.refitter.reference.spread, asked.wander, asked.similar,
                       asked.thresholds.alike, seed=seed)
    asked.report("scan of pairs")
    return pairs


def settle(asked: Asked, pairs: PairScan | None) -> Search:
    """The verdict on one set of drives whose noise other drives show, from a scan of effects and of pairs."""
    thresholds, base = asked.thresholds, asked.base
    found = Search("none", base, base, asked.scan, excess=(asked.excess(base.residual),) * 2, pairs=pairs,
                   steps=asked.steps, reason=NOTHING)
    looks = [asked.scan.p_family, asked.p_left(base.residual)] + ([] if pairs is None else [pairs.p_family])
    if min(looks) >= thresholds.alpha:
        return found
    _one_by_one(asked, found)
    _drop_stand_ins(asked, found)
    alone = len(found.accepted) == 1
    calm = alone and asked.calm(found.accepted[-1].refit)
    share = _share(asked, found)
    if pairs is not None and not (calm and share >= thresholds.share):
        # A single effect had its chance with every other one as a further effect.
        pair_round(asked, found, {found.accepted[0].hypothesis.effect} if alone and not calm else set())
        asked.report("refits of pairs")
        share = _share(asked, found)
    _decide(asked, found, share)
    return found


def _one_by_one(asked: Asked, found: Search) -> None:
    """Accept effects one after the other, as long as more is left than other forms of them explain."""
    current = asked.base
    for _ in range(EFFORT.rounds):
        candidates = candidates_of(asked, found, current)
        likely = (one for one in candidates if one.p < asked.thresholds.alpha)
        taken_on = next((one for one in likely if not found.accepted or asked.own(one.refit)), None)
        if taken_on is None:
            return
        found.accepted.append(taken_on)
        found.classes.append(class_of(asked, taken_on, candidates))
        current = taken_on.refit
        if asked.calm(current):
            return


def _drop_stand_ins(asked: Asked, found: Search) -> None:
    """Drop what was accepted early because it resembles others together, and is worth nothing beside them.

    Of three effects one may have been the first guess at the other two; the last one was accepted beside the others.
    """
    if len(found.accepted) < 3:
        return
    final = found.accepted[-1].refit
    for number, one in enumerate(found.accepted[:-1]):
        place = final.hypotheses.index(one.hypothesis)
        if not asked.own(moved_last(final, place)):
            q = np.concatenate([part for i, part in enumerate(final.split) if i != place])
            kept = (*final.hypotheses[:place], *final.hypotheses[place + 1 :])
            [without] = asked.refitter.fit_all([Start(kept, final.u, q)], POLISH)
            del found.accepted[number], found.classes[number]
            found.accepted[-1] = replace(found.accepted[-1], refit=without, share=asked.explained(without))
            found.rounds.append([found.accepted[-1]])
            return


def _share(asked: Asked, found: Search) -> float:
    return asked.named(found.accepted[-1].refit) if found.accepted else 0.0


def _decide(asked: Asked, found: Search, share: float) -> None:
    """The verdict on what was accepted, which explains such a share."""
    thresholds, named = asked.thresholds, {one.hypothesis.effect for one in found.accepted}
    classes = [[name for name in members if name == members[0] or name not in named] for members in found.classes]
    found.classes = [members[:LARGEST] for members in classes]
    found.crowd = [name for members in classes for name in members[LARGEST:]]
    p_excess = asked.p_left(asked.base.residual)
    if found.accepted:
        found.final, found.share = found.accepted[-1].refit, share
    before, after = asked.excess(asked.base.residual), asked.excess(found.final.residual)
    found.excess = (before, after)
    if not named and p_excess >= thresholds.alpha:
        found.reason = "what stands out in a linear scan does not hold in a refit"
    elif named and share >= thresholds.share:
        found.verdict = "named"
        found.reason = f"explains {share:.0%} of what can be explained"
    elif not missing(found.p_value, p_excess, thresholds):
        found.accepted, found.classes, found.crowd = [], [], []
        found.final, found.share, found.excess = found.base, 0.0, (before, before)
        found.reason = "what stands out has no name, and days with nothing missing differ by as much"
    else:
        found.verdict = "unexplained"
        found.reason = (f"the best of the catalogue explains {share:.0%} of what can be explained, and {after:.0%} "
                        "above the noise is left")

"""From the residual to effects: scan, refit the best, accept, scan again; and what speaks for the result."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from sysid.missing.catalogue import Hypothesis
from sysid.missing.days import Wander
from sysid.missing.evidence import Evidence
from sysid.missing.joint_fit import Refit, Start, moved_last
from sysid.missing.refit import Refitter
from sysid.search.result import Progress
from sysid.verdict.agreement import disagreement
from sysid.verdict.forms import beside_forms
from sysid.verdict.found import LARGEST, Search, Thresholds, missing
from sysid.verdict.pairs import scan_pairs
from sysid.verdict.rounds import (
    NOTHING,
    POLISH,
    Asked,
    Looked,
    begin,
    candidates_of,
    class_of,
    pair_round,
)


def search(
    evidence: Evidence, hypotheses: Sequence[Hypothesis], refitter: Refitter, wander: Wander, thresholds: Thresholds,
    anything: Callable[[np.ndarray], float], draws: int = 1000, seed: int = 0, progress: Progress | None = None,
) -> Search:
    """The verdict on one set of drives whose noise other drives show.

    Args:
        anything: by how much the best of the smooth functions that know no physics lowers the sum of squares of a white
            residual (B, n), on drives held back from it.
    """
    asked, far = begin(evidence, hypotheses, refitter, wander, thresholds, draws, seed, progress)
    pairs = scan_pairs(asked.evidence, hypotheses, refitter.reference.spread, wander, asked.similar, thresholds.alike,
                       seed=seed)
    asked.report("scan of pairs")
    found = Search("none", asked.base, asked.base, asked.scan, excess=(asked.excess(asked.base),) * 2, pairs=pairs)
    if min(asked.scan.p_family, asked.p_left(asked.base), pairs.p_family) >= thresholds.alpha:
        found.reason = NOTHING
        return found
    _one_by_one(asked, found, far)
    _drop_stand_ins(asked, found)
    calm = bool(found.accepted) and asked.p_left(found.accepted[-1].refit) > thresholds.quiet
    if not calm or found.accepted[-1].share < thresholds.share:
        pair_round(asked, found, set() if calm else {one.hypothesis.effect for one in found.accepted})
        asked.report("refits of pairs")
    _decide(asked, found, anything)
    return found


def _one_by_one(asked: Asked, found: Search, far: Looked) -> None:
    """Accept effects one after the other, each beside those before it."""
    thresholds, current = asked.thresholds, asked.base
    for _ in range(thresholds.rounds):
        candidates = candidates_of(asked, found, current, far)
        taken_on = next((one for one in candidates if one.p < thresholds.alpha and _own(asked, one.refit)), None)
        if taken_on is None:
            break
        found.accepted.append(taken_on)
        found.classes.append(class_of(asked, taken_on, candidates))
        current = taken_on.refit
        if asked.p_left(current) > thresholds.quiet:
            break


def _own(asked: Asked, fit: Refit) -> bool:
    """Whether the last effect of a joint fit does more than to mend the form of those before it."""
    return len(fit.hypotheses) < 2 or beside_forms(asked.refitter, fit, asked.evidence.groups)[0] > 0


def _drop_stand_ins(asked: Asked, found: Search) -> None:
    """Drop what was accepted early because it resembles others together, and is worth nothing beside them.

    Of three effects one may have been the first guess at the other two; the last one was accepted beside the others.
    """
    if len(found.accepted) < 3:
        return
    final = found.accepted[-1].refit
    for one in list(found.accepted[:-1]):
        place = final.hypotheses.index(one.hypothesis)
        if not _own(asked, moved_last(final, place)):
            q = np.concatenate([part for i, part in enumerate(final.split) if i != place])
            kept = (*final.hypotheses[:place], *final.hypotheses[place + 1 :])
            [without] = asked.refitter.fit_all([Start(kept, final.u, q)], POLISH)
            number = found.accepted.index(one)
            del found.accepted[number], found.classes[number]
            found.accepted[-1] = replace(found.accepted[-1], refit=without, share=asked.explained(without))
            found.rounds.append([found.accepted[-1]])
            return


def _most_apart(asked: Asked, fit: Refit) -> float:
    """Largest disagreement of manoeuvres on the size of an effect in a fit."""
    return max((disagreement(fit, part, asked.evidence.groups, asked.refitter.precision) for part in fit.parts),
               default=0.0)


def _of_what_lasts(found: Search, wander: Wander, anything: Callable[[np.ndarray], float]) -> float:
    """Share of what the effects gain in that and what smooth functions gain after them, beyond a day's own."""
    gain = found.base.cost - found.final.cost
    more = max(anything(found.final.residual) - wander.usual * len(found.final.residual), 0.0)
    return gain / max(gain + more, 1e-9)


def _decide(asked: Asked, found: Search, anything: Callable[[np.ndarray], float]) -> None:
    """The verdict on what was accepted. An effect is kept for its own sake, not to mend the form of another one.

    Where manoeuvres agree on the sizes, half of it is enough.
    Where little stands out, shares of it say little, and what replicates do not share (gusts, say) nothing can explain:
    an effect must then leave little to functions without physics.
    """
    thresholds, wander, courses = asked.thresholds, asked.wander, asked.refitter.drives.repeats
    keep = found.accepted
    named = {one.hypothesis.effect for one in keep}
    classes = [[name for name in members if name == members[0] or name not in named]
               for members in found.classes[: len(keep)]]
    found.classes = [members[:LARGEST] for members in classes]
    found.crowd = [name for members in classes for name in members[LARGEST:]]
    if keep:
        found.final, found.share = keep[-1].refit, keep[-1].share
    before, after = asked.excess(found.base), asked.excess(found.final)
    found.excess = (before, after)
    if not keep and wander.p_excess(before) >= thresholds.alpha:
        found.reason = "what stands out in a linear scan does not hold in a refit"
    elif keep and (found.share >= thresholds.share or (
            found.share >= thresholds.most and _most_apart(asked, found.final) <= thresholds.same) or (
            found.share >= thresholds.share / 2 or wander.p_excess(after) > thresholds.quiet)
            and wander.p_excess(after - wander.unshared(found.final.residual, courses)) > thresholds.quiet
            and _of_what_lasts(found, wander, anything) >= thresholds.share):
        found.verdict = "named"
        found.reason = f"explains {found.share:.0%} of what exceeds the noise"
    elif not missing(found.p_value, wander.p_excess(before), thresholds):
        found.accepted, found.classes, found.crowd = [], [], []
        found.final, found.share, found.excess = found.base, 0.0, (before, before)
        found.reason = "what stands out has no name, and days with nothing missing differ by as much"
    else:
        found.verdict = "unexplained"
        found.reason = (f"the best of the catalogue explains {max(found.share, 0):.0%} of what exceeds the noise, and "
                        f"{after:.0%} above the noise is left")


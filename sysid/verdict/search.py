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
from sysid.verdict.agreement import beside, disagreement, foretold
from sysid.verdict.forms import other_forms
from sysid.verdict.found import LARGEST, Candidate, Search, Thresholds, missing
from sysid.verdict.pairs import scan_pairs
from sysid.verdict.rounds import (
    NOTHING,
    POLISH,
    Asked,
    Looked,
    begin,
    candidate_of,
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
        likely = [one for one in candidates if one.p < thresholds.alpha]
        if not likely:
            break
        taken_on = likely[0]
        if found.accepted:
            for one in likely:
                one.own = _own(asked, one, found, asked.explained(current))
                if one.own:
                    taken_on = one
                    break
            if not taken_on.own and taken_on.gain < thresholds.second * found.accepted[0].gain:
                break  # it mends the form of what was found before, and so would what comes after it
        found.accepted.append(taken_on)
        found.classes.append(class_of(asked, taken_on, candidates))
        current = taken_on.refit
        if asked.p_left(current) > thresholds.quiet:
            break


def _drop_stand_ins(asked: Asked, found: Search) -> None:
    """Drop what was accepted early because it resembles others together, and is worth nothing beside them.

    Of three effects one may have been the first guess at the other two; the last one was accepted beside the others.
    """
    if len(found.accepted) < 3:
        return
    final = found.accepted[-1].refit
    for one in list(found.accepted[:-1]):
        place = final.hypotheses.index(one.hypothesis)
        q = np.concatenate([part for i, part in enumerate(final.split) if i != place])
        kept = (*final.hypotheses[:place], *final.hypotheses[place + 1 :])
        [without] = asked.refitter.fit_all([Start(kept, final.u, q)], POLISH)
        if asked.explained(final) - asked.explained(without) >= asked.thresholds.step:
            continue
        worth = candidate_of(asked, asked.hypotheses.index(one.hypothesis), moved_last(final, place), without)
        if worth.p >= asked.thresholds.alpha:
            number = found.accepted.index(one)
            del found.accepted[number], found.classes[number]
            found.accepted[-1] = replace(found.accepted[-1], refit=without, share=asked.explained(without), own=True)
            found.rounds.append([found.accepted[-1]])
            return


def _own(asked: Asked, one: Candidate, found: Search, share: float) -> bool:
    """Whether a further effect is there for its own sake, however small it is beside the first.

    What mends the form of another effect leaves a rest, for it is no part of that form; and it depends on it: each
    manoeuvre asks for a size of its own, or alone it is of another size, or gains far more or less. Or another form of
    that effect would do as well. `share` is what the effects before it explain.
    """
    refitter, groups, thresholds = asked.refitter, asked.evidence.groups, asked.thresholds
    q, left = one.refit.split[-1], 1 - share
    part = slice(len(one.refit.q) - len(q), len(one.refit.q))
    if one.share - share < thresholds.little * left:
        return False
    if one.share - share >= thresholds.rest * left:  # as long as it does not stand for those before it too
        return one.share - asked.explained(_alone(one, found, refitter)) >= thresholds.step
    differ = disagreement(one.refit, part, groups, refitter.precision)
    if (one.share - share >= thresholds.half * left and differ <= thresholds.differ
            and one.gain >= thresholds.slight * found.accepted[0].gain):
        forms = other_forms(refitter, one.refit, groups)
        if forms.own >= thresholds.unlike and forms.instead <= thresholds.instead:
            return True
    inside = beside(one.refit.products(refitter.precision), len(q))
    size = float(q @ inside @ q)
    if differ <= thresholds.same and _within(size / one.gain, 1 / thresholds.foretold):
        gains = foretold(one.refit, part, groups, refitter.precision)
        lost = float(-gains[gains < 0].sum())
        if _within(float(gains.sum()) / one.gain, 1 / thresholds.foretold) and lost <= thresholds.loss * (
                gains.sum() + lost):
            return True
    if one.share - share < thresholds.own * left or differ > thresholds.differ:
        return False
    alone = _alone(one, found, refitter)
    change = alone.q - q
    return (float(change @ inside @ change) <= thresholds.agree**2 * size
            and _within((found.base.cost - alone.cost) / one.gain, thresholds.alone))


def _alone(one: Candidate, found: Search, refitter: Refitter) -> Refit:
    """The fit of an effect without those before it."""
    alone = next((other.refit for other in found.rounds[0] if other.hypothesis.key == one.hypothesis.key), None)
    if alone is None:
        [alone] = refitter.fit_all([Start((one.hypothesis,), found.base.u, one.refit.split[-1])], POLISH)
    return alone


def _most_apart(asked: Asked, fit: Refit) -> float:
    """Largest disagreement of manoeuvres on the size of an effect in a fit."""
    return max((disagreement(fit, part, asked.evidence.groups, asked.refitter.precision) for part in fit.parts),
               default=0.0)


def _within(ratio: float, factor: float) -> bool:
    return 1 / factor <= ratio <= factor


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
    keep = found.accepted[:1]
    for one in found.accepted[1:]:
        if not one.own and one.share - keep[-1].share <= thresholds.step:
            break  # what came after was fitted beside it
        keep.append(one)
    named = {one.hypothesis.effect for one in keep}
    found.accepted = keep  # what is named beside an effect is told apart from it
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


"""From the residual to effects: scan, refit the best, accept, scan again; and what speaks for the result."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from sysid.missing.catalogue import Hypothesis
from sysid.missing.days import Wander
from sysid.missing.evidence import Evidence, Solver, at_fit
from sysid.missing.joint_fit import Refit, Start, moved_last
from sysid.missing.refit import Refitter
from sysid.search.result import Progress
from sysid.verdict.agreement import beside, disagreement, foretold
from sysid.verdict.classes import imitation
from sysid.verdict.forms import other_forms
from sysid.verdict.found import LARGEST, Candidate, Search, Thresholds, excess_of, explained_share, missing
from sysid.verdict.pairs import scan_pairs
from sysid.verdict.rounds import POLISH, _class_of, candidate_of, pair_round, refitted, rescan
from sysid.verdict.scan import best, run


def search(
    evidence: Evidence, hypotheses: Sequence[Hypothesis], refitter: Refitter, wander: Wander, thresholds: Thresholds,
    anything: Callable[[np.ndarray], float], draws: int = 1000, seed: int = 0, progress: Progress | None = None,
) -> Search:
    """The verdict on one set of drives.

    Args:
        anything: by how much the best of the smooth functions that know no physics lowers the sum of squares of a white
            residual (B, n), on drives held back from it.
    """
    def report(text: str) -> None:
        if progress is not None:
            progress(1, text)

    base = refitter.fit((), np.zeros(0))
    report("base refit")
    far = best(Solver(evidence), hypotheses, wander)
    evidence = at_fit(evidence, base.residual, base.jacobian, base.u - refitter.reference.u)
    first = run(evidence, hypotheses, refitter.reference.spread, wander, draws, seed)
    report("scan")
    count = float((refitter.drives.mask > 0).sum()) * wander.level
    excess = partial(excess_of, count=count)
    explained = partial(explained_share, base, count, thresholds)
    similar = imitation(evidence, hypotheses)
    pairs = scan_pairs(evidence, hypotheses, refitter.reference.spread, wander, similar, thresholds.alike, seed=seed)
    report("scan of pairs")
    found = Search("none", base, base, first, excess=(excess(base), excess(base)), pairs=pairs)
    if (first.p_family >= thresholds.alpha and wander.p_excess(excess(base)) >= thresholds.alpha
            and pairs.p_family >= thresholds.alpha):
        found.reason = "nothing stands out of the noise and the day-to-day spread"
        return found
    current = base
    for number in range(thresholds.rounds):
        scans = [far, (first.gain, first.worth, first.q)] if number == 0 else [
            rescan(evidence, hypotheses, current, refitter, wander)]
        candidates = refitted(refitter, current, evidence, hypotheses, wander, first, scans, thresholds, similar,
                              explained, lambda text: report(f"{text}, round {len(found.rounds) + 1}"))
        found.rounds.append(candidates)
        likely = [one for one in candidates if one.p < thresholds.alpha]
        if not likely:
            break
        taken_on = likely[0]
        if found.accepted:
            for one in likely:
                one.own = _own(one, found, explained(current), explained, refitter, evidence.groups, thresholds)
                if one.own:
                    taken_on = one
                    break
            if not taken_on.own and taken_on.gain < thresholds.second * found.accepted[0].gain:
                break  # it mends the form of what was found before, and so would what comes after it
        found.accepted.append(taken_on)
        found.classes.append(_class_of(taken_on, candidates, hypotheses, similar, thresholds))
        current = taken_on.refit
        if wander.p_excess(excess(current)) > thresholds.quiet:
            break
    _drop_stand_ins(found, evidence, hypotheses, refitter, wander, thresholds, explained)
    calm = bool(found.accepted) and wander.p_excess(excess(found.accepted[-1].refit)) > thresholds.quiet
    if not calm or found.accepted[-1].share < thresholds.share:
        tried = set() if calm else {one.hypothesis.effect for one in found.accepted}
        pair_round(found, evidence, hypotheses, refitter, wander, similar, thresholds, explained, tried)
        report("refits of pairs")
    _decide(found, thresholds, wander, excess, anything, refitter.drives.repeats,
            lambda fit: _most_apart(fit, evidence.groups, refitter.precision))
    return found


def _drop_stand_ins(
    found: Search, evidence: Evidence, hypotheses: Sequence[Hypothesis], refitter: Refitter, wander: Wander,
    thresholds: Thresholds, explained: Callable[[Refit], float],
) -> None:
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
        [without] = refitter.fit_all([Start(kept, final.u, q)], POLISH)
        if explained(final) - explained(without) >= thresholds.step:
            continue
        worth = candidate_of(hypotheses.index(one.hypothesis), moved_last(final, place), without, evidence, hypotheses,
                           wander, found.scan, 0.0)
        if worth.p >= thresholds.alpha:
            number = found.accepted.index(one)
            del found.accepted[number], found.classes[number]
            found.accepted[-1] = replace(found.accepted[-1], refit=without, share=explained(without), own=True)
            found.rounds.append([found.accepted[-1]])
            return


def _own(
    one: Candidate, found: Search, share: float, explained: Callable[[Refit], float], refitter: Refitter,
    groups: Sequence[Sequence[int]], thresholds: Thresholds,
) -> bool:
    """Whether a further effect is there for its own sake, however small it is beside the first.

    What mends the form of another effect leaves a rest, for it is no part of that form; and it depends on it: each
    manoeuvre asks for a size of its own, or alone it is of another size, or gains far more or less. Or another form of
    that effect would do as well. `share` is what the effects before it explain.
    """
    q, left = one.refit.split[-1], 1 - share
    part = slice(len(one.refit.q) - len(q), len(one.refit.q))
    if one.share - share < thresholds.little * left:
        return False
    if one.share - share >= thresholds.rest * left:  # as long as it does not stand for those before it too
        return one.share - explained(_alone(one, found, refitter)) >= thresholds.step
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


def _most_apart(fit: Refit, groups: Sequence[Sequence[int]], precision: np.ndarray) -> float:
    """Largest disagreement of manoeuvres on the size of an effect in a fit."""
    return max((disagreement(fit, part, groups, precision) for part in fit.parts), default=0.0)


def _within(ratio: float, factor: float) -> bool:
    return 1 / factor <= ratio <= factor


def _of_what_lasts(found: Search, wander: Wander, anything: Callable[[np.ndarray], float]) -> float:
    """Share of what the effects gain in that and what smooth functions gain after them, beyond a day's own."""
    gain = found.base.cost - found.final.cost
    more = max(anything(found.final.residual) - wander.usual * len(found.final.residual), 0.0)
    return gain / max(gain + more, 1e-9)


def _decide(
    found: Search, thresholds: Thresholds, wander: Wander, excess: Callable[[Refit], float],
    anything: Callable[[np.ndarray], float], courses: np.ndarray, apart: Callable[[Refit], float],
) -> None:
    """The verdict on what was accepted. An effect is kept for its own sake, not to mend the form of another one.

    Where manoeuvres agree on the sizes (`apart` is the largest disagreement), half of it is enough.
    Where little stands out, shares of it say little, and what replicates do not share (gusts, say) nothing can explain:
    an effect must then leave little to functions without physics.
    """
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
    before, after = excess(found.base), excess(found.final)
    found.excess = (before, after)
    if not keep and wander.p_excess(before) >= thresholds.alpha:
        found.reason = "what stands out in a linear scan does not hold in a refit"
    elif keep and (found.share >= thresholds.share or (
            found.share >= thresholds.most and apart(found.final) <= thresholds.same) or (
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


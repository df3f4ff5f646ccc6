"""From the residual to effects: scan, refit the best, scan again, refit pairs; and the verdict on what was tried."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from sysid.missing.joint_fit import Refit, Start, moved_last
from sysid.verdict.agreement import errors_of_sizes, half_width
from sysid.verdict.forms import forms_of
from sysid.verdict.posterior import NOTHING, Findings, Left, TriedSet
from sysid.verdict.rounds import (
    POLISH,
    TO_ITS_END,
    Asked,
    candidate_of,
    candidates_of,
    class_of,
    nearer,
    p_of_last,
    pair_round,
)  # fmt: skip
from sysid.verdict.scan import DRAWS, null_days, scan_pairs
from sysid.verdict.search_record import ROUNDS, WEIGHED, Candidate, PairScan, Search, Weighed


def pairs_of(asked: Asked, seed: int = 0) -> PairScan:
    """A scan of all pairs of effects beside the base."""
    nulls = null_days(asked.evidence, asked.refitter.reference.spread, asked.wander, DRAWS,
                      np.random.default_rng((seed, 2)))
    pairs = scan_pairs(asked.evidence, asked.hypotheses, asked.wander, nulls, asked.similar, asked.thresholds.same)
    asked.report("scan of pairs")
    return pairs


def settle(asked: Asked, pairs: PairScan | None) -> Search:
    """The verdict on one set of drives whose noise other drives show, from a scan of effects and of pairs."""
    base, wander = asked.base, asked.wander
    excess = asked.excess(base.residual)
    found = Search("none", base, base, asked.scan, excess=(excess, excess), pairs=pairs, reason=NOTHING)
    findings = Findings(excess, asked.scan.p_family, None if pairs is None else pairs.p_family, asked.count,
                        len(base.residual), wander.excess, wander.freedom, wander.usual)
    weighed: list[Weighed] = []
    if findings.something(asked.thresholds):
        weighed = _one_by_one(asked, found, findings)
        weighed = _in_their_place(asked, found, findings, weighed)
        findings = replace(findings, sets=tuple(one.numbers for one in weighed))
        if pairs is not None and not findings.settled(asked.thresholds):
            # A single effect had its chance with every other one as a further effect.
            first = {weighed[0].numbers.effects[0]} if len(found.rounds) > 1 else set()
            weighed += [_weighed(asked, members, [[one] for one in members], together)
                        for members, together in pair_round(asked, pairs, first)]
    found.weighed = weighed
    return found.judged(replace(findings, sets=tuple(one.numbers for one in weighed)), asked.thresholds)


def _one_by_one(asked: Asked, found: Search, findings: Findings) -> list[Weighed]:
    """Effects one after the other, as long as a further one may be named beside those before it."""
    current, members, rivals = asked.base, tuple[Candidate, ...](), tuple[Sequence[Candidate], ...]()
    out: list[Weighed] = []
    for _ in range(ROUNDS):
        candidates = candidates_of(asked, found, current)
        apart = {one.hypothesis.effect: one for one in reversed(candidates) if one.p < asked.thresholds.alpha}
        likely = sorted(apart.values(), key=lambda one: -one.gain)  # of several forms of an effect the best one
        new = [_weighed(asked, (*members, one), (*rivals, candidates)) for one in likely[:WEIGHED]]
        out += new
        able = [one for one in new if findings.able(one.numbers, asked.thresholds)]
        if len(members) == 2:
            out += [each for one in new[:1] for each in _without_stand_ins(asked, one)]
        if not able:
            break
        members, rivals, current = able[0].members, able[0].rivals, able[0].members[-1].refit
    return out


def _in_their_place(asked: Asked, found: Search, findings: Findings, weighed: Sequence[Weighed]) -> list[Weighed]:
    """All sets, with those that one effect after the other does not come by, where the best pair so far leaves more
    than days differ by: its first effect was the best one alone, and may stand in for another. So what is best beside
    the second one alone is tried, and what is best beside the runner-up of the first round. What the drives do not
    separate from the first effect shows beside the second one too."""
    able = [one for one in weighed if findings.able(one.numbers, asked.thresholds)]
    pairs = [one for one in able if len(one.members) == 2]
    best = max(pairs, key=lambda one: one.numbers.gain, default=None)
    if best is None or asked.wander.p_excess(best.numbers.left.excess) >= asked.thresholds.alpha:
        return list(weighed)
    starts = [one.members[0] for one in [one for one in able if len(one.members) == 1][1:2]]
    last = best.members[-1]
    starts = [*(one for one in starts if one.hypothesis.effect != last.hypothesis.effect), _alone(asked, found, last)]
    out, tried, beside = list(weighed), {frozenset(one.numbers.effects) for one in weighed}, {}
    for first in starts:
        beside[first.hypothesis.effect] = candidates = candidates_of(asked, found, first.refit)
        likely = {one.hypothesis.effect: one for one in reversed(candidates) if one.p < asked.thresholds.alpha}
        fresh = [one for name, one in likely.items() if frozenset((first.hypothesis.effect, name)) not in tried]
        new = sorted(fresh, key=lambda one: -one.gain)[:WEIGHED]
        tried |= {frozenset((first.hypothesis.effect, one.hypothesis.effect)) for one in new}
        out += [_weighed(asked, (first, one), (found.rounds[0], candidates)) for one in new]
    alone = {one.hypothesis.effect: one.gain for one in (*reversed(found.rounds[0]), *starts)}
    return [_with_classes(asked, one, out, alone, beside) if len(one.members) == 2 else one for one in out]


def _alone(asked: Asked, found: Search, last: Candidate) -> Candidate:
    """The last effect of a set fitted alone, to its end: from its best fit of the first round, if there is one."""
    start = Start((last.hypothesis,), asked.base.u, last.refit.split[-1])
    before = next((one for one in found.rounds[0] if one.hypothesis.effect == last.hypothesis.effect), None)
    [begun] = nearer(asked.refitter, [start], asked.base) if before is None else [Start.at(before.refit)]
    [fit] = asked.refitter.fit_all([begun], TO_ITS_END)
    return candidate_of(asked, asked.hypotheses.index(begun.hypotheses[-1]), fit, asked.base)


def _with_classes(asked: Asked, pair: Weighed, sets: Sequence[Weighed], alone: Mapping[str, float],
                  beside: Mapping[str, Sequence[Candidate]]) -> Weighed:
    """A pair whose classes hold what may stand in the place of either effect, by all that was refitted beside the other
    one: in `sets`, and as candidates of a round. `alone` are the gains of single effects. What the first effect was not
    separated from when it was alone does not count."""
    classes = list(pair.numbers.classes)
    for place, name in enumerate(pair.numbers.effects):
        other = pair.numbers.effects[1 - place]
        if other not in alone:
            continue
        there = [replace(next(each for each in one.members if each.hypothesis.effect != other),
                         gain=one.numbers.gain - alone[other])
                 for one in sets if len(one.members) == 2 and other in one.numbers.effects]
        there += beside.get(other, ())
        mine = max((one for one in there if one.hypothesis.effect == name), key=lambda one: one.gain)
        found = class_of(asked, mine, there)
        classes[place] = (*found, *(one for one in classes[place] if place and one not in found))
    return replace(pair, numbers=replace(pair.numbers, classes=tuple(map(tuple, classes))))


def _without_stand_ins(asked: Asked, one: Weighed) -> list[Weighed]:
    """Two of three effects where the third was accepted early because it resembles both together."""
    final, out = one.members[-1].refit, []
    for number in range(len(one.members) - 1):
        place = final.hypotheses.index(one.members[number].hypothesis)
        q = np.delete(final.q, final.parts[place])
        kept = (*final.hypotheses[:place], *final.hypotheses[place + 1 :])
        [without] = asked.refitter.fit_all([Start(kept, final.u, q)], POLISH)
        members = tuple(each for i, each in enumerate(one.members) if i != number)
        members = (*members[:-1], replace(members[-1], refit=without, share=asked.explained(without)))
        rivals = tuple(each for i, each in enumerate(one.rivals) if i != number)
        out.append(_weighed(asked, members, (*rivals[:-1], [members[-1]])))
    return out


def _weighed(asked: Asked, members: Sequence[Candidate], rivals: Sequence[Sequence[Candidate]],
             together: float | None = None) -> Weighed:
    """The numbers of a set of effects."""
    fit = members[-1].refit
    forms = forms_of(asked.refitter, fit, asked.evidence.groups)
    form, count = asked.thresholds.form, range(len(members))
    bent = _left(asked, forms.left(form))
    noise = 1 + max(bent.excess, 0.0)
    own = [forms.gain(form, i, asked.evidence.groups, noise) for i in count]
    p = [p_of_last(asked, moved_last(fit, i), gain / noise) for i, (gain, _) in enumerate(own)]
    numbers = TriedSet(
        tuple(one.effect for one in fit.hypotheses), tuple(one.key for one in fit.hypotheses), tuple(fit.q.tolist()),
        asked.base.cost - fit.cost, tuple(p) if len(p) > 1 else (members[0].p,),
        _left(asked, fit.residual), tuple(gain for gain, _ in own), tuple(tuple(each.tolist()) for _, each in own),
        bent,
        tuple(tuple(class_of(asked, one, each)) for one, each in zip(members, rivals, strict=True)),
        tuple(_surely(asked, fit)))
    return Weighed(numbers, tuple(members), tuple(rivals), together)


def _surely(asked: Asked, fit: Refit) -> list[float]:
    """Of each effect of a joint fit: its size that is furthest from absence, in half widths of its 95 % interval."""
    evidence = asked.evidence
    numbers = [asked.hypotheses.index(one) for one in fit.hypotheses]
    variance = asked.wander.variances(evidence.columns, numbers, fit.split)
    errors = errors_of_sizes(fit, evidence.groups, asked.refitter.precision, variance)
    away = np.abs(fit.q) / (half_width(evidence.groups) * np.maximum(errors, 1e-12))
    return [float(away[part].max()) for part in fit.parts]


def _left(asked: Asked, residual: np.ndarray) -> Left:
    excess = asked.excess(residual)
    return Left(excess, excess - asked.wander.unshared(residual, asked.refitter.drives.repeats),
                asked.anything(residual))

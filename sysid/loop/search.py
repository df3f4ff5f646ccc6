"""From the residual to effects: scan, refit the best, accept, scan again; and what speaks for the result."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sysid.loop.agreement import beside, disagreement, foretold, interval_of_sum
from sysid.loop.catalogue import Hypothesis
from sysid.loop.classes import imitation
from sysid.loop.evidence import Evidence, at_fit
from sysid.loop.pairs import PairScan, scan_pairs
from sysid.loop.refit import Refit, Refitter, Start, moved_last
from sysid.loop.scan import Scan, best, run
from sysid.loop.solver import Solver
from sysid.loop.wander import Wander
from sysid.result import Progress

LARGEST = 4  # members of a class
FIRST_LOOK, POLISH = 4, 8  # iterations of a refit for every candidate, and more for the best
ELSEWHERE = (1.0, 3.0)
"""Factors on an effect's size from which a fit that ended at the end of a range starts anew."""


@dataclass(frozen=True)
class Thresholds:
    """When the search takes something for real. Frozen before any drive is looked at; part of the manifest."""

    alpha: float = 0.005
    """Family-wise p-value below which something is missing, and below which an effect is it: of the excess, of each of
    the three rounds and of the scan of pairs alike, so that the five together raise at most five times as many false
    alarms."""
    share: float = 0.6
    """Least share of the excess residual that named effects explain together."""
    most: float = 0.5
    """The same where manoeuvres agree on the size of each: then it is the form, or another effect, that is missing."""
    excess: float = 0.06
    """Excess of the squared residual over the noise, as a share of the noise, below which shares mean nothing."""
    quiet: float = 0.05
    """p-value of the excess that is left from which it passes for a day's own."""
    second: float = 0.25
    """Least gain of a further effect, as a share of the first one's: less may only mend the form of the first."""
    step: float = 0.15
    """Least further share of the excess that it explains."""
    own: float = 0.3
    """Least share of what the effects before it left that a smaller one must explain."""
    agree: float = 0.6
    """Largest change of its size from a fit without the others, as a share of it in the measure of what the drives tell
    of it, at which it is there for its own sake."""
    alone: float = 1.8
    """Largest factor by which its gain may then change."""
    differ: float = 0.35
    """Largest disagreement of manoeuvres on its size."""
    little: float = 0.1
    """What one must explain of it that manoeuvres tell of each other."""
    foretold: float = 0.7
    """Least share of its gain that the other manoeuvres foretell of each; at most its inverse."""
    same: float = 0.2
    """Largest disagreement of manoeuvres on the size of such an effect, and of one that explains `most` only."""
    loss: float = 0.1
    """Largest loss in manoeuvres where that goes wrong, as a share of the gain in the others."""
    scatter: float = 1.0
    """What manoeuvres that excite an effect may differ by on its size, as a share of it, with 95 % confidence: with
    more one in six would find the opposite."""
    rounds: int = 3
    pairs: int = 3
    """Pairs of effects that are refitted."""
    worthwhile: float = 0.15
    """Least scanned gain of an effect that is refitted, as a share of the best one's."""
    candidates: int = 4
    """Effects refitted in a round, of each scan."""
    close: float = 0.5
    """Share of the best refit's gain from which another one is polished too."""
    rival: float = 0.5
    """|cos| of two effects' signatures above which one is not named before the other was refitted."""
    between: float = 0.5
    """Share of the best gain, beyond what imitating the best brings, from which another effect stays in its class."""
    alike: float = 0.9
    """|cos| of two effects' signatures above which they are not told apart."""


@dataclass
class Candidate:
    """One refitted hypothesis of a round."""

    hypothesis: Hypothesis
    gain: float
    """By how much it lowers the cost, refitted."""
    p: float
    """Family-wise, of that gain."""
    share: float
    refit: Refit
    own: bool = False
    """Small beside the first, but as large and as useful without it, and most of what the others left."""


@dataclass
class Search:
    """What the search found."""

    verdict: str
    base: Refit
    final: Refit
    scan: Scan
    rounds: list[list[Candidate]] = field(default_factory=list)
    accepted: list[Candidate] = field(default_factory=list)
    classes: list[list[str]] = field(default_factory=list)
    crowd: list[str] = field(default_factory=list)
    """Effects that look alike too, beyond the `LARGEST` nearest of a class."""
    share: float = 0.0
    excess: tuple[float, float] = (0.0, 0.0)
    """Squared white residual over its number, less 1: before and after."""
    reason: str = ""
    pairs: PairScan | None = None
    together: float | None = None
    """Where two effects were accepted as a pair: the p-value of the scan of pairs, or of the weaker one's refit."""

    @property
    def p_value(self) -> float:
        """Of "nothing is missing": that of the scan and, where refits were tried, of the best of them."""
        if self.together is not None:
            return self.together
        refitted = min((one.p for one in self.rounds[0]), default=0.0) if self.rounds else 0.0
        return max(self.scan.p_family, refitted)


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
    count = float((refitter.drives.mask > 0).sum())

    def excess(fit: Refit) -> float:
        return float(np.square(fit.residual).sum()) / count - 1

    def explained(fit: Refit) -> float:
        """Share of the excess that a fit removes; where there is hardly any, of one that would be worth a word."""
        return float(np.clip((excess(base) - excess(fit)) / max(excess(base), thresholds.excess), 0.0, 1.0))

    similar = imitation(evidence, hypotheses)
    pairs = scan_pairs(evidence, hypotheses, refitter.reference.spread, wander, similar, thresholds.alike, seed=seed)
    report("scan of pairs")
    found = Search("none", base, base, first, excess=(excess(base), excess(base)), pairs=pairs)
    if (first.p_family >= thresholds.alpha and wander.p_excess(excess(base)) >= thresholds.alpha
            and pairs.p_family >= thresholds.alpha):
        found.reason = "nothing stands out of the noise and the day-to-day spread"
        return found
    current = base
    mended = False
    for number in range(thresholds.rounds + 1):
        if len(found.accepted) == thresholds.rounds:
            break
        scans = [far, (first.gain, first.worth, first.q)] if number == 0 else [
            _rescan(evidence, hypotheses, current, refitter, wander)]
        candidates = refitted(refitter, current, evidence, hypotheses, wander, first, scans, thresholds, similar,
                              explained, lambda text: report(f"{text}, round {len(found.rounds) + 1}"))
        found.rounds.append(candidates)
        likely = [one for one in candidates if one.p < thresholds.alpha]
        if not likely:
            break
        taken_on = likely[0]
        if found.accepted:
            for one in likely:
                one.own = _own(one, found, explained(current), refitter, evidence.groups, thresholds)
                if one.own:
                    taken_on = one
                    break
            if not taken_on.own and taken_on.gain < thresholds.second * found.accepted[0].gain:
                if mended or taken_on.share - explained(current) < thresholds.own * (1 - explained(current)):
                    break
                mended, current = True, taken_on.refit  # it may hide what comes after; it is named by no one
                continue
        found.accepted.append(taken_on)
        found.classes.append(_class_of(taken_on, candidates, hypotheses, similar, thresholds))
        current = taken_on.refit
        if wander.p_excess(excess(current)) > thresholds.quiet:
            break
    _drop_stand_ins(found, evidence, hypotheses, refitter, wander, thresholds, explained)
    calm = bool(found.accepted) and wander.p_excess(excess(current)) > thresholds.quiet
    if not calm or found.accepted[-1].share < thresholds.share:
        tried = set() if calm else {one.hypothesis.effect for one in found.accepted}
        pair_round(found, evidence, hypotheses, refitter, wander, similar, thresholds, explained, tried)
        report("refits of pairs")
    _decide(found, thresholds, wander, excess, anything, refitter.drives.courses.of_trial,
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
        worth = _candidate(hypotheses.index(one.hypothesis), moved_last(final, place), without, evidence, hypotheses,
                           wander, found.scan, 0.0)
        if worth.p >= thresholds.alpha:
            number = found.accepted.index(one)
            del found.accepted[number], found.classes[number]
            found.accepted[-1] = replace(found.accepted[-1], refit=without, share=explained(without), own=True)
            found.rounds.append([found.accepted[-1]])
            return


def pair_round(
    found: Search, evidence: Evidence, hypotheses: Sequence[Hypothesis], refitter: Refitter, wander: Wander,
    similar: np.ndarray, thresholds: Thresholds, explained: Callable[[Refit], float], tried: set[str],
) -> None:
    """Two effects instead of what was accepted, where only together they explain the drives.

    Each must be significant and worth a name beside the other, manoeuvres must agree on its size and foretell one
    another, and together they must explain more than what was accepted one by one.

    Args:
        tried: effects whose pairs had their chance, with the other one as a further effect.
    """
    pairs = found.pairs
    assert pairs is not None
    least = float(found.scan.gain.max()) if len(found.scan.gain) else 0.0
    order, seen = [], set()
    for m in np.argsort(-pairs.gain):
        names = frozenset(hypotheses[h].effect for h in pairs.members[m])
        if (names not in seen and not names & tried and pairs.gain[m] > least
                and pairs.p_of(float(pairs.p[m])) < thresholds.alpha):
            seen.add(names)
            order.append(int(m))
    starts = [Start(tuple(hypotheses[h] for h in pairs.members[m]), found.base.u, pairs.q[m])
              for m in order[: thresholds.pairs]]
    if not starts:
        return
    fits = refitter.fit_all(starts, FIRST_LOOK + POLISH)
    both = min(fits, key=lambda fit: fit.cost)
    alone = refitter.fit_all([Start((one,), both.u, q) for one, q in zip(both.hypotheses, both.split, strict=True)],
                             POLISH)
    if alone[0].cost > alone[1].cost:  # the one that explains more by itself comes first
        both, alone = moved_last(both, 0), alone[::-1]
    if explained(both) - (found.accepted[-1].share if found.accepted else 0.0) < thresholds.step:
        return
    members = []
    for fit, other in ((moved_last(both, 0), alone[1]), (both, alone[0])):
        h = hypotheses.index(fit.hypotheses[-1])
        one = _candidate(h, fit, other, evidence, hypotheses, wander, found.scan, explained(fit))
        part = slice(len(fit.q) - len(fit.hypotheses[-1].axes), len(fit.q))
        told = foretold(fit, part, evidence.groups, refitter.precision)
        if (one.p >= thresholds.alpha or explained(fit) - explained(other) < thresholds.step
                or disagreement(fit, part, evidence.groups, refitter.precision) > thresholds.differ
                or interval_of_sum(told)[0] <= 0):
            return
        members.append(replace(one, own=True))
    members[0] = replace(members[0], refit=alone[0], share=explained(alone[0]))
    found.accepted = members
    found.classes = [_class_of(one, [one], hypotheses, similar, thresholds) for one in members]
    found.rounds += [[one] for one in members]
    found.together = max(pairs.p_family, *(one.p for one in members))


def _own(
    one: Candidate, found: Search, share: float, refitter: Refitter, groups: Sequence[Sequence[int]],
    thresholds: Thresholds,
) -> bool:
    """Whether a further effect is there for its own sake, however small it is beside the first.

    What mends the form of another effect depends on it: each manoeuvre asks for a size of its own, or alone it is of
    another size, or gains far more or less. `share` is what the effects before it explain.
    """
    q, left = one.refit.split[-1], 1 - share
    part = slice(len(one.refit.q) - len(q), len(one.refit.q))
    if one.share - share < thresholds.little * left:
        return False
    differ = disagreement(one.refit, part, groups, refitter.precision)
    inside = beside(one.refit.products(refitter.precision), len(q))
    size = float(q @ inside @ q)
    if differ <= thresholds.same and _within(size / one.gain, 1 / thresholds.foretold):
        told = foretold(one.refit, part, groups, refitter.precision)
        lost = float(-told[told < 0].sum())
        if _within(float(told.sum()) / one.gain, 1 / thresholds.foretold) and lost <= thresholds.loss * (
                told.sum() + lost):
            return True
    if one.share - share < thresholds.own * left or differ > thresholds.differ:
        return False
    alone = next((other.refit for other in found.rounds[0] if other.hypothesis.key == one.hypothesis.key), None)
    if alone is None:
        [alone] = refitter.fit_all([Start((one.hypothesis,), found.base.u, q)], POLISH)
    change = alone.q - q
    return (float(change @ inside @ change) <= thresholds.agree**2 * size
            and _within((found.base.cost - alone.cost) / one.gain, thresholds.alone))


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
    else:
        found.verdict = "unexplained"
        found.reason = (f"the best of the catalogue explains {max(found.share, 0):.0%} of what exceeds the noise, and "
                        f"{after:.0%} above the noise is left")


Looked = tuple[np.ndarray, np.ndarray, tuple[np.ndarray, ...]]
"""Gain (H,), worth (H,) and coordinates of every hypothesis."""


def refitted(
    refitter: Refitter, current: Refit, evidence: Evidence, hypotheses: Sequence[Hypothesis], wander: Wander,
    first: Scan, scans: Sequence[Looked], thresholds: Thresholds, similar: np.ndarray,
    explained: Callable[[Refit], float], report: Callable[[str], None],
) -> list[Candidate]:
    """One round: what looks best in the scans is refitted jointly with `current`, the best of it to its end, and so is
    what might imitate the best; in order of gain."""
    taken = {one.effect for one in current.hypotheses}
    chosen = _starts(hypotheses, scans, first, taken, thresholds)
    at = Start.at(current)

    def starts(listed: Sequence[tuple[int, np.ndarray]]) -> list[Start]:
        return [Start((*at.hypotheses, hypotheses[h]), at.u, np.concatenate([at.q, q]), at.slopes) for h, q in listed]

    fits = refitter.fit_all(starts(chosen), FIRST_LOOK)
    report("refits")
    least = current.cost - thresholds.close * max((current.cost - fit.cost for fit in fits), default=0.0)
    best_of = [i for i, fit in enumerate(fits) if fit.cost < min(least, current.cost)]
    for i, fit in zip(best_of, refitter.fit_all([Start.at(fits[i]) for i in best_of], POLISH), strict=True):
        fits[i] = fit
    for i in (i for i in best_of if len(fits[i].hypotheses[-1].axes) > 1 and refitter.stuck(fits[i])):
        again = refitter.fit_all(_elsewhere(refitter, fits[i], len(current.q)), FIRST_LOOK + POLISH)
        fits[i] = min([fits[i], *again], key=lambda fit: fit.cost)
    report("polish")
    rivals = _rivals(hypotheses, similar, [h for h, _ in chosen], fits, taken, thresholds)
    chosen += [(h, _best_start(scans, h)) for h in rivals]
    fits += refitter.fit_all(starts(chosen[len(fits) :]), POLISH)
    report("rivals")
    candidates = [_candidate(h, fit, current, evidence, hypotheses, wander, first, explained(fit))
                  for (h, _), fit in zip(chosen, fits, strict=True)]
    return sorted(candidates, key=lambda one: -one.gain)


def _rescan(
    evidence: Evidence, hypotheses: Sequence[Hypothesis], current: Refit, refitter: Refitter, wander: Wander
) -> Looked:
    """Of every hypothesis given what is accepted so far."""
    return best(Solver(at_fit(evidence, current.residual, current.jacobian, current.u - refitter.reference.u)),
                hypotheses, wander)


def _starts(
    hypotheses: Sequence[Hypothesis], scans: Sequence[Looked], first: Scan, taken: set[str], thresholds: Thresholds
) -> list[tuple[int, np.ndarray]]:
    """Hypotheses to refit and where to start.

    Of each scan those that gain most, and of the last the one that stands out most. A large effect shows best in the
    scan around the reference, a small one in that around the base refitted to these drives.
    """
    left = [h for h in range(len(hypotheses)) if hypotheses[h].effect not in taken]
    order: dict[str, tuple[int, np.ndarray]] = {}
    for number, (gain, worth, q) in enumerate(scans):
        standing = [h for h in left if worth[h] > 0 and first.p_of(h, float(worth[h])) < thresholds.alpha]
        chosen = sorted(standing, key=lambda h: -gain[h])
        chosen = [h for h in chosen if gain[h] >= thresholds.worthwhile * gain[chosen[0]]]
        if number == len(scans) - 1:
            chosen = [*chosen[: thresholds.candidates], *sorted(left, key=lambda h: -worth[h])[:1]]
        new = 0
        for h in chosen:
            wide, start = _widest(hypotheses, h, q, standing)
            if hypotheses[wide].key not in order and new < thresholds.candidates:
                order[hypotheses[wide].key] = (wide, start)
                new += 1
    return list(order.values())


def _rivals(
    hypotheses: Sequence[Hypothesis], similar: np.ndarray, tried: Sequence[int], fits: Sequence[Refit], taken: set[str],
    thresholds: Thresholds,
) -> list[int]:
    """What might imitate the best fit and was not tried: it must have had its chance before another is named."""
    if not fits:
        return []
    winner = tried[int(np.argmin([fit.cost for fit in fits]))]
    done = {hypotheses[h].effect for h in tried} | taken
    out: list[int] = []
    for h in np.argsort(-similar[winner]):
        if similar[winner, h] > thresholds.rival and hypotheses[h].effect not in done:
            done.add(hypotheses[h].effect)
            out.append(int(h))
    return out[: thresholds.candidates]


def _elsewhere(refitter: Refitter, fit: Refit, before: int) -> list[Start]:
    """Other starts of a fit whose last effect comes behind `before` coordinates: the base parameters as they were, and
    what only changes the effect at 0, so that the effect itself has the first chance."""
    q = fit.q.copy()
    axes = fit.hypotheses[-1].axes
    q[before:] = [0.0 if axis.dependent else size for axis, size in zip(axes, q[before:], strict=True)]
    limits = np.array([axis.limit for axis in axes])
    out = []
    for factor in ELSEWHERE:
        start = q.copy()
        start[before:] = np.clip(factor * q[before:], -limits, limits)
        out.append(Start(fit.hypotheses, refitter.reference.u, start))
    return out


def _best_start(scans: Sequence[Looked], h: int) -> np.ndarray:
    """Coordinates from the scan in which a hypothesis gains most; a small size where it gains nothing."""
    gain, _, q = max(scans, key=lambda scan: scan[0][h])
    return q[h] if gain[h] > 0 else np.full(len(q[h]), 0.5)


def _widest(
    hypotheses: Sequence[Hypothesis], h: int, q: Sequence[np.ndarray], standing: Sequence[int]
) -> tuple[int, np.ndarray]:
    """The hypothesis of the same effect that has all axes of h and more, started where those alone were found."""
    mine = {axis.parameter for axis in hypotheses[h].axes}
    wider = [i for i, one in enumerate(hypotheses) if one.effect == hypotheses[h].effect
             and mine < {axis.parameter for axis in one.axes}]
    if not wider:
        return h, q[h]
    most = max(wider, key=lambda i: len(hypotheses[i].axes))
    alone = {hypotheses[i].axes[0].parameter: float(q[i][0]) for i in standing
             if hypotheses[i].effect == hypotheses[h].effect and len(hypotheses[i].axes) == 1}
    return most, np.array([alone.get(axis.parameter, 0.0) for axis in hypotheses[most].axes])


def _candidate(
    h: int, fit: Refit, current: Refit, evidence: Evidence, hypotheses: Sequence[Hypothesis], wander: Wander,
    first: Scan, share: float,
) -> Candidate:
    """A refitted hypothesis with the p-value of its gain, less what such an effect gains on a day without it."""
    one = hypotheses[h]
    gain = max(current.cost - fit.cost, 0.0)
    q = fit.q[-len(one.axes) :]
    inside = beside(fit.products(evidence.precision), len(q))
    moved = np.abs(q) > 1e-9
    inside, wide = (matrix[np.ix_(moved, moved)] for matrix in (inside, wander.at(evidence.columns, h, q)))
    alone = float(q[moved] @ inside @ q[moved])
    whole = float(q[moved] @ np.linalg.pinv(np.linalg.pinv(inside) + wide) @ q[moved])
    worth = gain * min(whole / alone, 1.0) if alone > 0 else 0.0
    return Candidate(one, gain, first.p_of(h, worth), share, fit)


def _class_of(
    best: Candidate, candidates: Sequence[Candidate], hypotheses: Sequence[Hypothesis], similar: np.ndarray,
    thresholds: Thresholds,
) -> list[str]:
    """Effects that these drives do not tell from the best: nearly as good a fit, alike signatures, or a
    fit so much better than imitating the best would bring that the truth may lie between the two."""
    mine = hypotheses.index(best.hypothesis)
    near: dict[str, float] = {}
    for other in candidates:
        imitated = float(similar[mine, hypotheses.index(other.hypothesis)]) ** 2
        ratio = other.gain / best.gain
        own = (ratio - imitated) / max(1 - imitated, 1e-9)
        if best.gain - other.gain < max(12.0, 0.1 * best.gain) or own > thresholds.between:
            near[other.hypothesis.effect] = ratio
    for j, one in enumerate(hypotheses):
        if similar[mine, j] > thresholds.alike:
            near[one.effect] = max(near.get(one.effect, 0.0), float(similar[mine, j]))
    near.pop(best.hypothesis.effect, None)
    return [best.hypothesis.effect, *sorted(near, key=lambda name: -near[name])]

"""One round of the search: what looks best is refitted jointly with what is accepted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from sysid.missing.catalogue import Hypothesis
from sysid.missing.days import Wander
from sysid.missing.evidence import Evidence, Solver, at_fit
from sysid.missing.joint_fit import Refit, Start, moved_last
from sysid.missing.refit import Refitter
from sysid.search.result import Progress
from sysid.verdict.agreement import beside, foretold
from sysid.verdict.posterior import Thresholds
from sysid.verdict.result import LoopConfig, Prepared
from sysid.verdict.scan import best, imitation, run
from sysid.verdict.search_record import CANDIDATES, WEIGHED, Candidate, PairScan, Scan, Search

FIRST_LOOK, POLISH, TO_ITS_END = 4, 8, 60
"""Iterations at most of a refit for every candidate, of one that starts again, and of what is compared or built on: cut
short, the next effect would be credited with what the fit before it had not yet found."""
ELSEWHERE = (1.0, 3.0)  # factors on an effect's size from which a fit that ended at the end of a range starts anew
NEARER = (0.3, 0.1, 0.03)
"""Shares of an effect's coordinates from which a fit starts where the whole of them fit no better than none."""
SIDE = 2.0  # coordinate from which such a fit starts on either side of what only changes the effect
Looked = tuple[np.ndarray, np.ndarray, tuple[np.ndarray, ...]]  # gain (H,), worth (H,), coordinates


@dataclass(frozen=True)
class Asked:
    """What a search asks of some drives, and the base fit that it begins with."""

    evidence: Evidence  # around the base fit
    hypotheses: Sequence[Hypothesis]
    refitter: Refitter
    wander: Wander
    thresholds: Thresholds
    base: Refit
    scan: Scan  # of all hypotheses beside the base
    similar: np.ndarray  # (H, H) |cos| of signatures
    anything: Callable[[np.ndarray], float] = lambda _: 0.0
    """By how much the best of the smooth functions that know no physics lowers the sum of squares of a white residual
    (B, n), on drives held back from it."""
    report: Callable[[str], None] = lambda _: None  # says what was just done
    far: Looked | None = None  # a scan around the reference: a large effect shows best there
    named: Callable[[str], bool] = lambda _: True
    """Whether these drives could show an effect to be what it is. Others are looked for beside, not in their place."""

    @cached_property
    def count(self) -> float:
        """Squared white residual where nothing is missing."""
        return float((self.refitter.drives.mask > 0).sum()) * self.wander.level

    def excess(self, residual: np.ndarray) -> float:
        """Squared white residual (B, n) over its number of values, less 1."""
        return float(np.square(residual).sum()) / self.count - 1

    def explained(self, fit: Refit) -> float:
        """Share of the base fit's excess that a fit removes; where there is hardly any, of what a day's varies by."""
        before = self.excess(self.base.residual)
        return float(np.clip((before - self.excess(fit.residual)) / max(before, self.wander.excess), 0.0, 1.0))


def begin(
    evidence: Evidence, ready: Prepared, refitter: Refitter, config: LoopConfig,
    anything: Callable[[np.ndarray], float] = lambda _: 0.0, progress: Progress | None = None,
) -> Asked:
    """What a search asks about a prepared vehicle, around the base refitted to the drives; `anything` as of `Asked`."""
    hypotheses, wander = ready.hypotheses, ready.wander

    def report(text: str) -> None:
        if progress is not None:
            progress(1, text)

    base = refitter.fit((), np.zeros(0), TO_ITS_END)
    report("base refit")
    far = best(Solver(evidence), hypotheses, wander)
    evidence = at_fit(evidence, base.residual, base.jacobian, base.u - refitter.reference.u)
    scan = run(evidence, hypotheses, refitter.reference.spread, wander, config.nulls, config.seed)
    report("scan")
    return Asked(evidence, hypotheses, refitter, wander, config.thresholds, base, scan,
                 imitation(evidence, hypotheses), anything, report, far)


def candidates_of(asked: Asked, found: Search, current: Refit) -> list[Candidate]:
    """The next round of a search, which is kept."""
    near = (asked.scan.gain, asked.scan.worth, asked.scan.q)
    scans = [rescan(asked, current)] if found.rounds else [near] if asked.far is None else [asked.far, near]
    found.rounds.append(refitted(asked, current, scans, len(found.rounds) + 1))
    return found.rounds[-1]


def refitted(asked: Asked, current: Refit, scans: Sequence[Looked], number: int = 1) -> list[Candidate]:
    """Round `number`: what looks best in the scans is refitted, the best of it to its end, and so is what might imitate
    the best; in order of gain. A scan knows what effects look like beside the base alone, and beside a limit they look
    different: in the place of one, every effect beside accepted ones takes a step of such a refit."""
    refitter, hypotheses = asked.refitter, asked.hypotheses
    taken = {one.effect for one in current.hypotheses}
    left = [h for h in range(len(hypotheses)) if hypotheses[h].effect not in taken]
    kinds = [[h for h in left if asked.named(hypotheses[h].effect) == able] for able in (True, False)]
    at = Start.at(current)

    def starts(listed: Sequence[tuple[int, np.ndarray]]) -> list[Start]:
        return nearer(refitter, [Start((*at.hypotheses, hypotheses[h]), at.u, np.concatenate([at.q, q]), at.slopes)
                                 for h, q in listed], current)

    if taken:
        each = [_of_each(hypotheses, scans[-1], kind) for kind in kinds]
        looks = [[*zip(listed, refitter.fit_all(starts(listed), 1), strict=True)] for listed in each]
        likely = [one for look in looks for one in sorted(look, key=lambda one: one[1].cost)[:CANDIDATES]]
        chosen, begun = [one for one, _ in likely], [Start.at(fit) for _, fit in likely]
    else:
        chosen = [one for kind in kinds for one in _starts(hypotheses, scans, asked.scan, kind, asked.thresholds)]
        begun = starts(chosen)
    fits = refitter.fit_all(begun, FIRST_LOOK)
    asked.report(f"refits, round {number}")
    best_of = _nearly_best(asked, fits, current)
    for i, fit in zip(best_of, refitter.fit_all([Start.at(fits[i]) for i in best_of], TO_ITS_END), strict=True):
        fits[i] = fit
    for i in (i for i in best_of if len(fits[i].hypotheses[-1].axes) > 1 and refitter.stuck(fits[i])):
        again = min(refitter.fit_all(elsewhere(refitter, fits[i], len(current.q)), FIRST_LOOK + POLISH),
                    key=lambda fit: fit.cost)
        if again.cost < fits[i].cost:
            [fits[i]] = refitter.fit_all([Start.at(again)], TO_ITS_END)
    asked.report(f"polish, round {number}")
    similar = np.where(asked.similar > asked.thresholds.form, asked.similar, 0.0)
    rivals = _rivals(hypotheses, similar, [h for h, _ in chosen], fits, taken)
    chosen += [(h, _best_start(scans, h)) for h in rivals]
    fits += refitter.fit_all(starts(chosen[len(fits) :]), POLISH)
    asked.report(f"rivals, round {number}")
    candidates = [candidate_of(asked, h, fit, current) for (h, _), fit in zip(chosen, fits, strict=True)]
    return sorted(candidates, key=lambda one: -one.gain)


def _nearly_best(asked: Asked, fits: Sequence[Refit], current: Refit) -> list[int]:
    """Which fits gain enough beside the best one of their kind to be followed to their end."""
    gains, able = [current.cost - fit.cost for fit in fits], [asked.named(fit.hypotheses[-1].effect) for fit in fits]
    most = [max(gain for gain, kind in zip(gains, able, strict=True) if kind == mine) for mine in able]
    return [i for i, gain in enumerate(gains) if gain > max(asked.thresholds.form * most[i], 0.0)]


def nearer(refitter: Refitter, starts: Sequence[Start], current: Refit) -> list[Start]:
    """Starts of joint fits with one more effect than `current`. Where the drives fit no better with it, its coordinates
    are shortened to where they fit best: a linear scan says little of the way to a large effect, and a fit that starts
    beyond a ridge would look as if there were nothing to gain."""
    out = list(starts)
    for i in np.flatnonzero(refitter.costs(out) >= current.cost):
        q, size = out[i].q, len(current.q)
        ways = [replace(out[i], q=np.append(q[:size], share * q[size:])) for share in (1.0, *NEARER)]
        out[i] = ways[int(np.argmin(refitter.costs(ways)))]
    return out


def rescan(asked: Asked, current: Refit) -> Looked:
    """Of every hypothesis given what is accepted so far."""
    moved = current.u - asked.refitter.reference.u
    return best(Solver(at_fit(asked.evidence, current.residual, current.jacobian, moved)), asked.hypotheses,
                asked.wander)


def _starts(
    hypotheses: Sequence[Hypothesis], scans: Sequence[Looked], first: Scan, left: Sequence[int], thresholds: Thresholds
) -> list[tuple[int, np.ndarray]]:
    """Hypotheses out of `left` to refit and where to start.

    Of each scan those that gain most of what stands out, what gains most whether it does or not, and of the last the
    one that stands out most. A large effect shows best in the scan around the reference, a small one around the base
    refitted to these drives.
    """
    order: dict[str, tuple[int, np.ndarray]] = {}
    for number, (gain, worth, q) in enumerate(scans):
        standing = [h for h in left if worth[h] > 0 and first.p_of(h, float(worth[h])) < thresholds.alpha]
        chosen = sorted(standing, key=lambda h: -gain[h])
        if number == len(scans) - 1:
            chosen = [*chosen[:CANDIDATES], *sorted(left, key=lambda h: -worth[h])[:1]]
        new = 0
        most = [h for h in sorted(left, key=lambda h: -gain[h])[:1] if gain[h] > 0]
        for h in [*chosen, *most]:
            wide, start = _widest(hypotheses, h, q, standing)
            if hypotheses[wide].key not in order and (new < CANDIDATES or h not in chosen):
                order[hypotheses[wide].key] = (wide, start)
                new += 1
    return list(order.values())


def _of_each(hypotheses: Sequence[Hypothesis], scan: Looked, left: Sequence[int]) -> list[tuple[int, np.ndarray]]:
    """Of each effect out of `left` the hypothesis that gains most in a scan, with all axes, and where to start it."""
    gain, _, q = scan
    most = {hypotheses[h].effect: h for h in sorted(left, key=lambda h: gain[h])}
    gaining = [h for h in left if gain[h] > 0]
    widest = [_widest(hypotheses, h, q, gaining) for h in most.values()]
    return [(h, start if np.any(start) else _best_start([scan], h)) for h, start in widest]


def _rivals(
    hypotheses: Sequence[Hypothesis], similar: np.ndarray, tried: Sequence[int], fits: Sequence[Refit], taken: set[str]
) -> list[int]:
    """What is most like the best fit, and was not tried: it must have had its chance before another is named."""
    if not fits:
        return []
    winner = tried[int(np.argmin([fit.cost for fit in fits]))]
    done = {hypotheses[h].effect for h in tried} | taken
    out: list[int] = []
    alike = np.maximum(similar[winner], similar[:, winner])
    for h in np.argsort(-alike):
        if alike[h] > 0 and hypotheses[h].effect not in done:
            done.add(hypotheses[h].effect)
            out.append(int(h))
    return out[:CANDIDATES]


def elsewhere(refitter: Refitter, fit: Refit, before: int) -> list[Start]:
    """Other starts of a fit whose last effect comes behind `before` coordinates: the base parameters as they were, and
    what only changes the effect at 0, so that the effect itself has the first chance; then each of these that has a
    sign on either side, since there may be a ridge between."""
    q = fit.q.copy()
    axes = fit.hypotheses[-1].axes
    q[before:] = [0.0 if axis.dependent else size for axis, size in zip(axes, q[before:], strict=True)]
    limits = np.array([axis.limit for axis in axes])
    out = []
    for factor in ELSEWHERE:
        start = q.copy()
        start[before:] = np.clip(factor * q[before:], -limits, limits)
        out.append(Start(fit.hypotheses, refitter.reference.u, start))
    for i, axis in enumerate(axes, before):
        for side in (-SIDE, SIDE) if axis.dependent and axis.signed else ():
            start = q.copy()
            start[i] = side
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


def candidate_of(asked: Asked, h: int, fit: Refit, current: Refit) -> Candidate:
    """A refitted hypothesis with the p-value of its gain."""
    gain = max(current.cost - fit.cost, 0.0)
    return Candidate(asked.hypotheses[h], gain, p_of_last(asked, fit, gain), asked.explained(fit), fit)


def p_of_last(asked: Asked, fit: Refit, gain: float) -> float:
    """Family-wise p-value of a gain by the last effect of a joint fit, less what it gains on a day without it."""
    one, evidence = fit.hypotheses[-1], asked.evidence
    h, q = asked.hypotheses.index(one), fit.q[-len(one.axes) :]
    inside = beside(fit.products(evidence.precision), len(q))
    moved = np.abs(q) > 1e-9
    inside, wide = (matrix[np.ix_(moved, moved)] for matrix in (inside, asked.wander.at(evidence.columns, h, q)))
    alone = float(q[moved] @ inside @ q[moved])
    whole = float(q[moved] @ np.linalg.pinv(np.linalg.pinv(inside) + wide) @ q[moved])
    return asked.scan.p_of(h, gain * min(whole / alone, 1.0) if alone > 0 else 0.0)


def pair_round(asked: Asked, pairs: PairScan, tried: set[str]) -> list[tuple[list[Candidate], float]]:
    """Pairs that gain more together than any effect alone, refitted; the best first. Pairs of effects that were `tried`
    had their chance.

    Returns:
        Of each pair its two effects, the one that explains more by itself first and the refit of both last; and the
        p-value of "nothing is missing".
    """
    hypotheses, refitter, thresholds = asked.hypotheses, asked.refitter, asked.thresholds
    least = float(asked.scan.gain.max()) if len(asked.scan.gain) else 0.0
    order, seen = [], set()
    for m in np.argsort(-pairs.gain):
        names = frozenset(hypotheses[h].effect for h in pairs.members[m])
        if (names not in seen and not names & tried and pairs.gain[m] > least
                and pairs.p_of(float(pairs.p[m])) < thresholds.alpha):
            seen.add(names)
            order.append(int(m))
    starts = [Start(tuple(hypotheses[h] for h in pairs.members[m]), asked.base.u, pairs.q[m])
              for m in order[:CANDIDATES]]
    out = []
    for both in sorted(refitter.fit_all(starts, FIRST_LOOK + POLISH), key=lambda fit: fit.cost)[:WEIGHED]:
        alone = refitter.fit_all([Start((one,), both.u, q) for one, q in zip(both.hypotheses, both.split, strict=True)],
                                 POLISH)
        if alone[0].cost > alone[1].cost:  # the one that explains more by itself comes first
            both, alone = moved_last(both, 0), alone[::-1]
        members = [candidate_of(asked, hypotheses.index(fit.hypotheses[-1]), fit, other)
                   for fit, other in ((moved_last(both, 0), alone[1]), (both, alone[0]))]
        members[0] = replace(members[0], refit=alone[0], share=asked.explained(alone[0]))
        out.append((members, max(pairs.p_family, *(one.p for one in members))))
    asked.report("refits of pairs")
    return out


def held_back(asked: Asked, fit: Refit) -> np.ndarray:
    """(G,) what the last effect of a joint fit gains in each manoeuvre, fitted to the others."""
    return foretold(fit, fit.parts[-1], asked.evidence.groups, asked.refitter.precision)


def class_of(asked: Asked, best: Candidate, candidates: Sequence[Candidate]) -> list[str]:
    """Effects that these drives do not separate from the best, nearest first.

    Another form of the best could be such an effect (`Thresholds.alike`), or its posterior weight is not a negligible
    share of the best one's, or it gains so much more than imitating the best would bring that the truth may lie between
    the two.
    """
    hypotheses, similar, thresholds = asked.hypotheses, asked.similar, asked.thresholds
    mine = hypotheses.index(best.hypothesis)
    near: dict[str, float] = {}
    for other in candidates:
        imitated = float(similar[mine, hypotheses.index(other.hypothesis)]) ** 2
        ratio = other.gain / max(best.gain, 1e-9)
        own = (ratio - imitated) / max(1 - imitated, 1e-9)
        if best.gain - other.gain < -2 * np.log(thresholds.alpha) or own > thresholds.form:
            near[other.hypothesis.effect] = ratio
    for j, one in enumerate(hypotheses):
        if similar[mine, j] > thresholds.alike:
            near[one.effect] = max(near.get(one.effect, 0.0), float(similar[mine, j]))
    near.pop(best.hypothesis.effect, None)
    return [best.hypothesis.effect, *sorted(near, key=lambda name: -near[name])]

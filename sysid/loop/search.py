"""From the residual to effects: scan, refit the best, accept, scan again; and what speaks for the result."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sysid.loop.catalogue import Hypothesis
from sysid.loop.classes import imitation
from sysid.loop.evidence import Evidence
from sysid.loop.refit import Refit, Refitter
from sysid.loop.scan import Scan, Solver, best_levels, gains, run, tail
from sysid.result import Progress

FIRST_LOOK, POLISH = 4, 8  # iterations of a refit for every candidate, and more for the two best


@dataclass(frozen=True)
class Thresholds:
    """When the search takes something for real. Frozen before any drive is looked at; part of the manifest."""

    alpha: float = 1e-3
    """Family-wise p-value below which something is missing."""
    margin: float = 2.0
    """Least gain of the best hypothesis, as a multiple of the largest gains of simulated nulls (their 99 % point): days
    differ in more than the spread of base parameters."""
    share: float = 0.6
    """Least share of the excess residual that named effects explain together."""
    excess: float = 0.06
    """Excess of the squared residual over the noise, as a share of the noise, that counts as nothing: what reference
    days differ by among themselves."""
    missing: float = 0.15
    """Excess above which something is missing even where no hypothesis gains."""
    second: float = 0.25
    """Least gain of a further effect, as a share of the first one's: less may only mend the form of the first."""
    step: float = 0.15
    """Least further share of the excess that it explains."""
    rounds: int = 3
    worthwhile: float = 0.15
    """Least scanned gain of an effect that is refitted, as a share of the best one's."""
    candidates: int = 4
    """Effects refitted in a round."""
    alike: float = 0.9
    """|cos| of two effects' signatures above which they are not told apart."""


@dataclass
class Candidate:
    """One refitted hypothesis of a round."""

    hypothesis: Hypothesis
    gain: float
    """By how much it lowers the cost, refitted."""
    p: float
    share: float
    refit: Refit


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
    share: float = 0.0
    excess: tuple[float, float] = (0.0, 0.0)
    """Squared white residual over its number, less 1: before and after."""
    reason: str = ""


def search(
    evidence: Evidence, hypotheses: Sequence[Hypothesis], refitter: Refitter, thresholds: Thresholds,
    draws: int = 1000, seed: int = 0, progress: Progress | None = None,
) -> Search:
    """The verdict on one set of drives."""
    def report(text: str) -> None:
        if progress is not None:
            progress(1, text)

    first = run(evidence, hypotheses, refitter.reference.spread, draws, seed)
    report("scan")
    base = refitter.fit((), np.zeros(0))
    report("base refit")
    count = float((refitter.drives.mask > 0).sum())

    def excess(fit: Refit) -> float:
        return float(np.square(fit.residual).sum()) / count - 1

    def explained(fit: Refit) -> float:
        """Share of the excess that a fit removes; none where there is no excess to speak of."""
        return (excess(base) - max(excess(fit), 0.0)) / max(excess(base), thresholds.excess)

    found = Search("none", base, base, first, excess=(excess(base), excess(base)))
    limit = thresholds.margin * float(np.quantile(first.null.max(1), 0.99))
    missing_gain = first.p_family < thresholds.alpha and float(first.gain.max()) > limit
    if not (missing_gain or excess(base) > thresholds.missing):
        found.reason = "nothing stands out of the noise and the day-to-day spread"
        return found
    current = base
    similar = imitation(evidence, hypotheses)
    for number in range(thresholds.rounds):
        scan_gain, starts, p = _rescan(evidence, hypotheses, current, refitter, first)
        order = _distinct(hypotheses, scan_gain, [one.hypothesis for one in found.accepted], thresholds.candidates)
        candidates: list[Candidate] = []
        for h in order:
            if candidates and scan_gain[h] < max(0.3 * limit, thresholds.worthwhile * scan_gain[order[0]]):
                continue
            fit = refitter.fit((*current.hypotheses, hypotheses[h]), np.concatenate([current.q, starts[h]]),
                               FIRST_LOOK, current.u)
            candidates.append(Candidate(hypotheses[h], current.cost - fit.cost, float(p[h]), explained(fit), fit))
            report(f"refit {hypotheses[h].key}")
        candidates.sort(key=lambda one: -one.gain)
        for place, one in enumerate(candidates[:2]):
            if one.gain > max(0.3 * limit, 0.5 * candidates[0].gain):
                fit = refitter.fit(one.refit.hypotheses, one.refit.q, POLISH, one.refit.u)
                candidates[place] = Candidate(one.hypothesis, current.cost - fit.cost, one.p, explained(fit), fit)
                report(f"polish {one.hypothesis.key}")
        candidates.sort(key=lambda one: -one.gain)
        found.rounds.append(candidates)
        if not candidates:
            break
        best = candidates[0]
        needed = limit if number == 0 else max(limit, thresholds.second * found.accepted[0].gain)
        if best.gain < needed:
            break
        found.accepted.append(best)
        found.classes.append(_class_of(best, candidates, hypotheses, similar, thresholds))
        current = best.refit
        if excess(current) < thresholds.excess:
            break
    _decide(found, thresholds, excess)
    return found


def _decide(found: Search, thresholds: Thresholds, excess: Callable[[Refit], float]) -> None:
    """The verdict on what was accepted. An effect is kept for its own sake, not to mend the form of another one."""
    keep = found.accepted[:1]
    for one in found.accepted[1:]:
        if one.share - keep[-1].share <= thresholds.step:
            break  # what came after was fitted beside it
        keep.append(one)
    found.accepted, found.classes = keep, found.classes[: len(keep)]
    if keep:
        found.final, found.share = keep[-1].refit, keep[-1].share
    before, after = excess(found.base), excess(found.final)
    found.excess = (before, after)
    if not keep and before < thresholds.missing:
        found.reason = "what stands out in a linear scan does not hold in a refit"
    elif keep and (found.share >= thresholds.share or after < thresholds.excess):
        found.verdict = "named"
        found.reason = f"explains {found.share:.0%} of what exceeds the noise"
    else:
        found.verdict = "unexplained"
        found.reason = (f"the best of the catalogue explains {max(found.share, 0):.0%} of what exceeds the noise, and "
                        f"{after:.0%} above the noise is left")


def _rescan(
    evidence: Evidence, hypotheses: Sequence[Hypothesis], current: Refit, refitter: Refitter, first: Scan
) -> tuple[np.ndarray, list[np.ndarray], np.ndarray]:
    """Gains, starting coordinates and p-values given what is accepted so far."""
    if not current.hypotheses:
        return first.gain, list(first.q), first.p
    size, extra = evidence.base_size, len(current.q)
    moved = current.u - refitter.reference.u
    residual = current.residual + current.jacobian[..., :size] @ moved
    design = np.concatenate([current.jacobian, evidence.design[..., size:]], axis=-1)
    precision = np.zeros((size + extra, size + extra))
    precision[:size, :size] = evidence.precision
    columns = tuple(replace(c, index=tuple(i + extra for i in c.index)) for c in evidence.columns)
    later = replace(evidence, residual=residual, design=design, base_size=size + extra, columns=columns,
                    precision=precision, products=np.einsum("bni,bnj->bij", design, design, optimize=True),
                    moments=np.einsum("bni,bn->bi", design, residual), pool_moments=())
    gain, found = gains(Solver(later), hypotheses)
    p = np.array([tail(first.null[:, h], gain[h]) for h in range(len(hypotheses))])
    return gain, best_levels(found, hypotheses), p


def _distinct(
    hypotheses: Sequence[Hypothesis], gain: np.ndarray, taken: Sequence[Hypothesis], count: int
) -> list[int]:
    """The best hypotheses by scanned gain, one per effect."""
    names = {one.effect for one in taken}
    order = []
    for h in np.argsort(-gain):
        if hypotheses[h].effect not in names and gain[h] > 0:
            names.add(hypotheses[h].effect)
            order.append(int(h))
        if len(order) == count:
            break
    return order


def _class_of(
    best: Candidate, candidates: Sequence[Candidate], hypotheses: Sequence[Hypothesis], similar: np.ndarray,
    thresholds: Thresholds,
) -> list[str]:
    """Effects that these drives do not tell from the best: nearly as good a fit, or alike signatures, at most four."""
    near = {other.hypothesis.effect: other.gain / best.gain for other in candidates[1:]
            if best.gain - other.gain < max(12.0, 0.1 * best.gain)}
    mine = list(hypotheses).index(best.hypothesis)
    for j, other in enumerate(hypotheses):
        if similar[mine, j] > thresholds.alike:
            near[other.effect] = max(near.get(other.effect, 0.0), float(similar[mine, j]))
    near.pop(best.hypothesis.effect, None)
    return [best.hypothesis.effect, *sorted(near, key=lambda name: -near[name])][:4]

"""How far a name and its size may be trusted: warnings, what speaks against it, and intervals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from sysid.missing.joint_fit import Refit, Start
from sysid.missing.unexplained import held_back_gains
from sysid.verdict.agreement import errors_of_sizes, half_width, interval_of_sum
from sysid.verdict.result import Result
from sysid.verdict.vehicles import refitter_of

NEARLY = 0.9  # share of the largest size that is looked for from which a size is at its end
MOVED = 0.01  # p-value of how far base parameters went, below which they went further than from day to day
LAW = ("speed", "yaw rate", "size of the step")  # by which effects that act at the same times differ
UNDONE = 0.5  # what two effects change together, as a share of what each does, below which one may stand for both


def contradicted(result: Result) -> list[str]:
    """What speaks against effects that would else have been named."""
    if result.search.findings is not None:
        return [f"{names.replace('+', ' and ')}: {each}" for names, against in result.search.findings.against.items()
                for each in against]
    if result.search.verdict == "named":
        return []
    return [each for one in result.stood for each in one.against(result.config.thresholds)]


@dataclass(frozen=True)
class Doubt:
    """What speaks against taking a name as certain, and what to do about it."""

    text: str
    remedy: str
    about_rest: bool = False  # whether it is about what is left, which does not matter where drives are predicted well


def warnings(result: Result) -> list[str]:
    """What speaks against taking the names as certain."""
    return [one.text for one in doubts(result)]


def advice(result: Result, as_good_as_repeats: bool) -> list[str]:
    """The doubts that change what a reader should do, each with what that is. `as_good_as_repeats`: with the named
    effects, drives are predicted to within what repeats differ by."""
    return [f"{one.text[0].upper()}{one.text[1:]}. {one.remedy}" for one in doubts(result)
            if not (one.about_rest and as_good_as_repeats)]


def as_good_as_repeats(errors: np.ndarray, floor: float | None) -> bool:
    """Whether errors of drives (B,) are, as far as so few show, no larger than what repeats differ by."""
    if floor is None or len(errors) == 0:
        return False
    return interval_of_sum(errors)[0] <= floor * len(errors)


def doubts(result: Result) -> list[Doubt]:
    """All doubts about the names of a result."""
    found, alpha = result.search, result.config.thresholds.alpha
    if found.verdict != "named":
        return []
    said = [Doubt(f"{', '.join(found.crowd)} cannot be separated from it either: more than a class may have for a name "
                  "to be worth much", "Drive other manoeuvres before you rely on the name.")] if found.crowd else []
    said += [Doubt(f"{first} and {second} undo most of what the other does ({1 - left:.0%} of it): one effect that the "
                   "catalogue does not have may do what is left of both",
                   "Use them together only, and for drives like these.")
             for first, second, left in undone(found.final) if left < UNDONE]
    said += [Doubt(f"{name} is nearly as large as is looked for: another effect may do it with less",
                   "Check on the vehicle whether it can be so large.") for name in at_the_end(result)]
    named = {one.hypothesis.effect for one in found.accepted}
    said += [Doubt(f"these drives do not show whether {one.effect} {each.falsifier.says}: an effect of another law may "
                   "do it", f"Drive the same manoeuvres with another {each.falsifier.by} to find out.")
             for one in result.stood if one.effect in named for each in one.falsifiers
             if each.falsifier.by in LAW and each.outcome == "untold"]
    gains = held_back_gains(result.log.training, result.log.spec, found.final.residual, result.reference.width,
                            result.reference.channels)
    quantity = max(gains, key=lambda name: gains[name])
    if gains[quantity] > result.prepared.wander.smooth_limit(alpha) * len(found.final.residual):
        said.append(Doubt(f"what is left is a smooth function of {quantity} more than on reference days: the form is "
                          "another one, or another effect", f"Do not trust predictions at another {quantity} than "
                          "these drives have.", True))
    if found.excess[1] > result.prepared.wander.excess_limit(alpha):
        names = " and ".join(one.hypothesis.effect for one in found.accepted)
        said.append(Doubt(f"what is left is {found.excess[1]:.0%} above the noise, more than days differ by: {names} "
                          "has another form here than in the catalogue, or is imitated by an effect that the catalogue "
                          "does not have", "Take the name as a hint, and the prediction below as what it is.", True))
    return said


def undone(final: Refit) -> list[tuple[str, str, float]]:
    """Of every two effects of a joint fit: what both change in the features together, squared, over the sum of what
    each does by itself. Two effects that have nothing to do with one another leave about 1."""
    columns = final.jacobian[..., len(final.u) :]
    changes = [columns[..., part] @ q for part, q in zip(final.parts, final.split, strict=True)]
    out = []
    for j, second in enumerate(changes):
        for i, first in enumerate(changes[:j]):
            alone = float(np.square(first).sum() + np.square(second).sum())
            out.append((final.hypotheses[i].effect, final.hypotheses[j].effect,
                        float(np.square(first + second).sum()) / max(alone, 1e-12)))
    return out


def at_the_end(result: Result) -> list[str]:
    """Parameters of the final fit that are nearly as large as they may be."""
    final = result.search.final
    axes = [axis for one in final.hypotheses for axis in one.axes]
    return [axis.parameter for axis, q in zip(axes, final.q, strict=True)
            if not axis.dependent and abs(q) >= NEARLY * axis.limit]


def beside_still_base(result: Result, iterations: int = 8) -> list[Refit]:
    """The final effects fitted beside base parameters that hardly move; nothing where these moved as days do. Between
    this fit and the final one lies how much of the effect base parameters take along or give it."""
    final, reference = result.search.final, result.reference
    away = final.u - reference.u
    if not reference.known or away @ result.evidence.precision @ away < stats.chi2.isf(MOVED, len(away)):
        return []
    refitter = refitter_of(result).stiffened()
    return refitter.fit_all([Start(final.hypotheses, reference.u, final.q)], iterations)


def intervals(final: Refit, result: Result) -> tuple[np.ndarray, np.ndarray]:
    """Ends (k,), (k,) of the coordinates' confidence intervals."""
    reach = half_width(result.evidence.groups) * deviations(final, result)
    axes = [axis for one in final.hypotheses for axis in one.axes]
    ends = np.stack([final.q - reach, final.q + reach])
    factors = np.array([[axis.open[end] for axis in axes] for end in (0, 1)]).reshape(2, -1)
    every = np.concatenate([ends, *(ends[i] * factors for i in (0, 1))])  # what one size could be taken for
    return every.min(0), every.max(0)


def deviations(final: Refit, result: Result) -> np.ndarray:
    """(k,) standard errors of the coordinates (`errors_of_sizes`)."""
    evidence = result.evidence
    numbers = [result.hypotheses.index(one) for one in final.hypotheses]
    variance = result.prepared.wander.variances(evidence.columns, numbers, final.split)
    return errors_of_sizes(final, evidence.groups, evidence.precision, variance)

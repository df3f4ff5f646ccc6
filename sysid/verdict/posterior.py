"""The verdict as a pure function of what was tried: sets of effects, each with what it explains and what it leaves.

`Findings` has all numbers that the verdict rests on. `posterior` weighs them without drives and without a simulator, so
a saved file can be judged again, with other priors too (`python -m sysid.verdict FILE`).
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from whill_mjx.io.fields import record, shown
from whill_mjx.io.folders import write_whole
from whill_mjx.io.formats import FORMATS, stamp, upgraded
from whill_mjx.io.reading import read_json

NOTHING = "nothing stands out of the noise and the day-to-day spread"
KIND = "sysid-evidence"
AGAIN = "Give evidence.json of a run of sysid.close_loop."
MOST = 2
"""Effects that are named together. A third one is only tried to see whether the first stood in for two."""


@dataclass(frozen=True)
class Thresholds:
    """What decides. Frozen before any drive is looked at; part of the manifest."""

    alpha: float = 0.005
    """Family-wise p-value below which something is missing, and below which an effect is it: of the excess, of each of
    the three rounds and of the scan of pairs alike, so that the five together raise at most five times as many false
    alarms. Of two effects the one whose posterior weight is a smaller share of the other's is not in its class."""
    form: float = 0.5
    """Standard deviation of an effect's form from the catalogue's law, as a share of its size."""
    share: float = 0.6
    """Least share that effects explain of what they explain and what is then left that replicates share, or that smooth
    functions predict."""
    doubt: float = 1e-10
    """p-value of the search below which something without a name is missing, whatever the excess. Small p-values come
    more often than they should: on 420 days with nothing missing the least one without such an excess was 8e-10."""

    @property
    def alike(self) -> float:
        """|cos| of two effects' signatures above which another form of one may be the other."""
        return (1 + self.form**2) ** -0.5

    @property
    def same(self) -> float:
        """|cos| above which they differ by less than half of what the form of one may be off: they are no pair."""
        return (1 + self.form**2 / 4) ** -0.5


@dataclass(frozen=True)
class Left:
    """What a fit leaves, in squares of the white residual."""

    excess: float
    """Over what days with nothing missing leave, less 1."""
    common: float
    """The same of what replicates have in common."""
    smooth: float
    """By how much the best smooth functions lower the sum on drives that were held back from them."""


@dataclass(frozen=True)
class TriedSet:
    """Effects that were refitted together with the base parameters, in numbers."""

    effects: tuple[str, ...]
    """Names of the effects."""
    variants: tuple[str, ...]
    """Their hypotheses."""
    coordinates: tuple[float, ...]
    """Fitted, one hypothesis after the other."""
    gain: float
    """By how much they lower the cost of the base fit."""
    p: tuple[float, ...]
    """Of each effect beside other forms of the others, family-wise; what these forms leave counts as noise."""
    p_value: float
    """Of "nothing is missing", where this set is taken for what is missing."""
    left: Left
    own: tuple[float, ...]
    """By how much each effect lowers the cost beside other forms of the others."""
    foretold: tuple[float, ...]
    """Lower 95 % end of what each effect so gains on manoeuvres, with all sizes fitted to the other manoeuvres."""
    bent: Left
    """What is left where all may have other forms."""
    classes: tuple[tuple[str, ...], ...]
    """Each effect with those that the drives do not separate from it, nearest first."""

    def apart(self) -> list[list[str]]:
        """The classes, each without what is named beside it."""
        return [[name for name in members if name == members[0] or name not in self.effects]
                for members in self.classes]


@dataclass(frozen=True)
class Findings:
    """All that the verdict is a function of."""

    excess: float
    """Of the base fit, as `Left.excess`."""
    p_scan: float
    """Of the scan of effects."""
    p_pairs: float | None
    """Of the scan of pairs; None where there was none."""
    p_refit: float
    """Of "nothing is missing": the scan's, or that of the best refit where it is larger."""
    count: float
    """Squared white residual where nothing is missing."""
    trials: int
    day: float
    """Standard deviation of the excess from day to day."""
    freedom: float
    """Degrees of freedom that it rests on."""
    usual: float
    """What smooth functions gain on a reference day, per trial."""
    sets: tuple[TriedSet, ...] = ()
    against: dict[str, list[str]] = field(default_factory=dict)
    """Names of a set, joined by "+" -> what contradicts them. A set that is not there was not put to the test."""
    noise: tuple[str, ...] = ()
    """Channels that are surely noisier or quieter than on the reference days."""

    def p_excess(self, excess: float) -> float:
        """Probability of so much excess on a day with nothing in it."""
        from scipy import stats

        return float(stats.t.sf(excess / self.day, self.freedom))

    def something(self, priors: Thresholds) -> bool:
        """Whether any look at the drives shows more than noise: the scan, what is left, or the scan of pairs."""
        looks = [self.p_scan, self.p_excess(self.excess), *([] if self.p_pairs is None else [self.p_pairs])]
        return min(looks) < priors.alpha

    def settled(self, priors: Thresholds) -> bool:
        """Whether what was found explains enough."""
        chosen = choose(self, priors)
        return chosen is not None and self.named(self.sets[chosen], priors) >= priors.share

    def put_to_test(self, effects: Sequence[str], against: Sequence[str]) -> Findings:
        """With what contradicts a set of effects."""
        return replace(self, against={**self.against, "+".join(effects): list(against)})

    def predictable(self, left: Left, random: float, alpha: float) -> dict[str, float]:
        """What is left though it could be predicted, by what shows it.

        Args:
            random: share of what nothing predicts that counts as well (effects may act at random in part).
        """
        found = {"smooth": left.smooth - self.usual * self.trials}
        if self.p_excess(left.common) < alpha:
            found["common"] = left.common * self.count
        if self.p_excess(left.excess) < alpha:
            found["any"] = random * left.excess * self.count
        return found

    def share(self, gain: float, left: Left, random: float, alpha: float) -> float:
        """What effects gain, as a share of that and of what they leave though it could be predicted."""
        most = max(0.0, *self.predictable(left, random, alpha).values())
        return gain / max(gain + most, 1e-9)

    def named(self, one: TriedSet, priors: Thresholds) -> float:
        """Share of what could be predicted that a set explains."""
        return self.share(one.gain, one.left, priors.form**2, priors.alpha)

    def own(self, one: TriedSet, priors: Thresholds) -> bool:
        """Whether every effect of a set does more than to mend the form of the others: it is significant beside these,
        and the others' manoeuvres foretell it."""
        return max(one.p) < priors.alpha and (len(one.effects) == 1 or min(one.foretold) > 0)

    def log_weight(self, gain: float, effects: int, priors: Thresholds) -> float:
        """Of an explanation: what it gains, in units of what days differ by, less log(1 / alpha) for each effect.

        Squared residuals of days with nothing missing vary by `day`, as those of 2 / day^2 independent values do.
        """
        return gain / max(self.day**2 * self.count, 2.0) - effects * float(np.log(1 / priors.alpha))


@dataclass(frozen=True)
class Posterior:
    """What the findings come to."""

    verdict: str
    chosen: int | None
    """Number of the set that explains most; of `Findings.sets`."""
    share: float
    """That it explains of what can be explained."""
    reason: str
    weights: dict[str, float]
    """Of `none`, `noise` (nothing but other noise), `unknown` and of sets of effects (names joined by " + "): 1 in
    all."""


def posterior(findings: Findings, priors: Thresholds) -> Posterior:
    """Weigh what was tried."""
    verdict, chosen, share, reason = _decide(findings, priors)
    if verdict == "none" and not findings.sets:
        return Posterior(verdict, chosen, share, reason, {"noise" if findings.noise else "none": 1.0})
    return Posterior(verdict, chosen, share, reason, _weights(findings, priors, chosen))


def choose(findings: Findings, priors: Thresholds) -> int | None:
    """The number of the set of the largest posterior weight, if there is any.

    Every effect of it must be significant and more than another form of the others.
    """
    able = [i for i, one in enumerate(findings.sets) if len(one.effects) <= MOST and findings.own(one, priors)]
    return max(able, key=lambda i: findings.log_weight(findings.sets[i].gain, len(findings.sets[i].effects), priors),
               default=None)


def _decide(findings: Findings, priors: Thresholds) -> tuple[str, int | None, float, str]:
    """Verdict, number of the set, its share, and the reason."""
    p_excess = findings.p_excess(findings.excess)
    if not findings.something(priors):
        return "none", None, 0.0, NOTHING
    chosen = choose(findings, priors)
    if chosen is None and p_excess >= priors.alpha:
        return "none", None, 0.0, "what stands out in a linear scan does not hold in a refit"
    one = None if chosen is None else findings.sets[chosen]
    share = 0.0 if one is None else findings.named(one, priors)
    if one is not None and share >= priors.share:
        if against := findings.against.get("+".join(one.effects), []):
            return "unexplained", chosen, share, contradicted(one.effects, share, against)
        return "named", chosen, share, f"explains {share:.0%} of what can be explained"
    if not missing(findings.p_refit if one is None else one.p_value, p_excess, priors):
        return "none", None, 0.0, "what stands out has no name, and days with nothing missing differ by as much"
    after = findings.excess if one is None else one.left.excess
    return ("unexplained", chosen, share, f"the best of the catalogue explains {share:.0%} of what can be explained, "
            f"and {after:.0%} above the noise is left")


def contradicted(effects: Iterable[str], share: float, against: Iterable[str]) -> str:
    """Why effects are not named."""
    return (f"{' and '.join(sorted(effects))} would explain {share:.0%} of what can be explained, but "
            f"{'; '.join(against)}")


def missing(search_p: float, excess_p: float, thresholds: Thresholds) -> bool:
    """Whether something without a name is missing: the search and the excess say so, or one of them beyond doubt. The
    excess alone is one of five looks at the drives."""
    both = max(search_p, excess_p) < thresholds.alpha
    return both or excess_p < thresholds.alpha / 5 or search_p < thresholds.doubt


def _weights(findings: Findings, priors: Thresholds, chosen: int | None) -> dict[str, float]:
    """Posterior weights.

    That nothing is missing has at least the weight -e p log p against 1 (Sellke, Bayarri and Berger 2001). The rest is
    divided by how much each explanation lowers the squared residual, per two units of what days differ by: sets of
    effects gain what they explain, something unknown all that could be predicted, of which it must be worth
    `Thresholds.share`. A further effect costs log(1 / alpha).
    """
    nothing = "noise" if findings.noise else "none"
    p = min([findings.p_refit, *(one.p_value for one in findings.sets)] if findings.sets
            else [findings.p_refit, findings.p_excess(findings.excess)])
    p = min(max(p, 1e-300), np.exp(-1))
    bound = -np.e * p * np.log(p)
    weight = bound / (1 + bound)
    out = {nothing: float(weight)}
    able = {i for i, one in enumerate(findings.sets) if len(one.effects) <= MOST and findings.own(one, priors)}
    names, logs = [], []
    for i, one in enumerate(findings.sets):
        if (i in able or i == chosen) and not findings.against.get("+".join(one.effects)):
            names.append(" + ".join(one.effects))
            logs.append(findings.log_weight(one.gain, len(one.effects), priors))
    most = max((one.gain + max(0.0, *findings.predictable(one.left, priors.form**2, priors.alpha).values())
                for one in findings.sets), default=findings.excess * findings.count)
    names.append("unknown")
    logs.append(findings.log_weight(priors.share * most, 1, priors))
    rest = np.exp(np.array(logs) - max(logs))
    for name, part in zip(names, (1 - weight) * rest / rest.sum(), strict=True):
        out[name] = max(out.get(name, 0.0), float(part))
    return out


def as_json(findings: Findings) -> dict[str, Any]:
    """The findings as a file has them."""
    return {**stamp(KIND), **asdict(findings)}


def from_json(content: dict[str, Any], where: str = "findings") -> Findings:
    """The findings of a file.

    Raises:
        ValueError: if there is a value of another kind, or a set whose lists are not of one length.
    """
    findings = record(where, Findings, {key: value for key, value in content.items() if key not in ("schema", "kind")})
    for index, one in enumerate(findings.sets):
        lengths = {len(each) for each in (one.effects, one.variants, one.p, one.own, one.foretold, one.classes)}
        if len(lengths) != 1 or 0 in lengths or not all(one.classes):
            raise ValueError(f"{where}: sets[{index}]: effects, variants, p, own, foretold and classes must be of one "
                             "length, above 0.")
    for name in ("day", "count", "freedom"):
        if getattr(findings, name) <= 0:
            raise ValueError(f"{where}: {name} = {shown(getattr(findings, name))} must be above 0.")
    return findings


def read(path: Path) -> Findings:
    """The findings of a file that `sysid.close_loop` or `benchmarks.undeclared` kept.

    Raises:
        ValueError: if it is none.
    """
    content = upgraded(KIND, read_json(path, f"no such file. {AGAIN}", AGAIN))
    if content.get("kind") != KIND or content.get("schema") != FORMATS[KIND].schema:
        raise ValueError(f"{path}: kind {shown(content.get('kind'))}, schema {shown(content.get('schema'))}; this "
                         f"program reads {KIND!r}, schema {FORMATS[KIND].schema}. {AGAIN}")
    return from_json(content, str(path))


def write(path: Path, findings: Findings) -> None:
    """Keep the findings."""
    write_whole(path, json.dumps(as_json(findings), indent=1).encode() + b"\n")

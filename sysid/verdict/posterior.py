"""The verdict as a pure function of what was tried: sets of effects, each with what it explains and what it leaves.

`Findings` has all numbers that the verdict rests on. `posterior` weighs them without drives and without a simulator, so
a saved file can be judged again, with other priors too (`python -m sysid.verdict FILE`).
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from whill_mjx.io.fields import record, shown
from whill_mjx.io.folders import write_whole
from whill_mjx.io.formats import FORMATS, stamp, upgraded
from whill_mjx.io.reading import read_json

NOTHING = "nothing stands out of the noise and the day-to-day spread"
UNSURE = "what stands out outweighs neither the noise nor what days differ by"
KIND = "sysid-evidence"
AGAIN = "Give evidence.json of a run of sysid.close_loop."
MOST = 2  # effects that are named together. A third one is only tried to see whether the first stood in for two


@dataclass(frozen=True)
class Thresholds:
    """What decides. Frozen before any drive is looked at; part of the manifest."""

    alpha: float = 0.005
    """Prior odds of each effect, and of something unknown, against nothing; and the family-wise p-value below which an
    effect of a scan is worth a refit. Of two effects the one whose posterior weight is a smaller share of the other's
    is not in its class."""
    form: float = 0.5
    """Standard deviation of an effect's form from the catalogue's law, as a share of its size."""
    share: float = 0.6
    """Share of what effects explain, and of what they leave though replicates share it or smooth functions predict it,
    that something unknown is held to explain: with less than that, effects weigh less than the unknown."""

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

    excess: float  # over what days with nothing missing leave, less 1
    common: float  # the same of what replicates have in common
    smooth: float  # by how much the best smooth functions lower the sum on drives that were held back from them


@dataclass(frozen=True)
class TriedSet:
    """Effects that were refitted together with the base parameters, in numbers."""

    effects: tuple[str, ...]  # names of the effects
    variants: tuple[str, ...]  # their hypotheses
    coordinates: tuple[float, ...]  # fitted, one hypothesis after the other
    gain: float  # by how much they lower the cost of the base fit
    p: tuple[float, ...]  # of each effect beside other forms of the others, family-wise; what these leave is noise
    left: Left
    own: tuple[float, ...]  # by how much each effect lowers the cost beside other forms of the others
    foretold: tuple[tuple[float, ...], ...]
    """By how much each effect so raises the log density of each manoeuvre, as the others predict it."""
    bent: Left  # what is left where all may have other forms
    classes: tuple[tuple[str, ...], ...]  # each effect with those not separated from it, nearest first
    surely: tuple[float, ...] = ()
    """Of each effect: its size furthest from absence, in half widths of its 95 % interval. Older files have none."""

    def apart(self) -> list[list[str]]:
        """The classes, each without what is named beside it."""
        return [[name for name in members if name == members[0] or name not in self.effects]
                for members in self.classes]


@dataclass(frozen=True)
class Findings:
    """All that the verdict is a function of."""

    excess: float  # of the base fit, as `Left.excess`
    p_scan: float  # of the scan of effects
    p_pairs: float | None  # of the scan of pairs; None where there was none
    count: float  # squared white residual where nothing is missing
    trials: int
    day: float  # standard deviation of the excess from day to day
    freedom: float  # degrees of freedom that it rests on
    usual: float  # what smooth functions gain on a reference day, per trial
    sets: tuple[TriedSet, ...] = ()
    against: dict[str, list[str]] = field(default_factory=dict)
    """Names of a set, joined by "+" -> what contradicts them. A set that is not there was not put to the test."""
    noise: tuple[str, ...] = ()  # channels that are surely noisier or quieter than on the reference days

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

    def contradictions(self, one: TriedSet) -> list[str]:
        """What contradicts a set of effects; empty too where it was not put to the test."""
        return [each for names, found in self.against.items() if {*names.split("+")} == {*one.effects}
                for each in found]

    def predictable(self, left: Left, random: float, alpha: float) -> dict[str, float]:
        """What is left though it could be predicted, by what shows it; `random`: share of what nothing predicts that
        counts as well (effects may act at random in part)."""
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

    def able(self, one: TriedSet, priors: Thresholds) -> bool:
        """Whether a set may be named: it is no larger than `MOST`, and every effect does more than to mend the form of
        the others. Beside these it outweighs its prior odds, where what all forms leave counts as noise; and the
        manoeuvres bear it out, unless it is the largest: this would be named by itself."""
        noise = 1 + max(one.bent.excess, 0.0)
        worth = min(self.log_weight(gain / noise, 1, priors) for gain in one.own) > 0
        return len(one.effects) <= MOST and worth and self.borne_out(one, priors)

    def borne_out(self, one: TriedSet, priors: Thresholds) -> bool:
        """Whether manoeuvres bear out every effect but the largest, whose size the others gave: together they raise the
        log density, and none lowers it by as much as the prior odds. Against a true effect, one does so with a
        probability of `alpha` at most, as with any ratio of likelihoods. And some 95 % interval of its sizes must leave
        out absence."""
        largest = max(range(len(one.own)), key=lambda place: one.own[place])
        smaller = [place for place in range(len(one.own)) if place != largest]
        return all(
            sum(one.foretold[place]) > 0 and self.log_weight(-2 * min(one.foretold[place]), 1, priors) < 0
            and (not one.surely or one.surely[place] > 1) for place in smaller)

    def log_weight(self, gain: float, effects: int, priors: Thresholds) -> float:
        """Of an explanation: what it gains, in units of what days differ by, less log(1 / alpha) for each effect."""
        return gain / self.unit + effects * math.log(priors.alpha)

    @property
    def unit(self) -> float:
        """Squared residual that is worth 1 of log weight: those of days with nothing missing vary by `day`, as those of
        2 / day^2 independent values do."""
        return max(self.day * self.day * self.count, 2.0)

    def least_gain(self, priors: Thresholds) -> float:
        """By how much an effect must lower the cost for nothing to have less than alpha of the weight."""
        return self.unit * (math.log(1 / priors.alpha - 1) - math.log(priors.alpha))


@dataclass(frozen=True)
class Posterior:
    """What the findings come to."""

    verdict: str
    chosen: int | None  # number of the set that is named, or else explains most; of `Findings.sets`
    share: float  # that it explains of what can be explained
    reason: str
    weights: dict[str, float]  # of `none` or `noise`, `unknown` and sets of effects (joined by " + "): 1 in all


def posterior(findings: Findings, priors: Thresholds) -> Posterior:
    """Weigh what was tried: the verdict is where the posterior weight is, and `none` unless nothing has less than
    `Thresholds.alpha` of it. A set that the drives contradict has no weight."""
    best, chosen = choose(findings, priors, contradicted=True), choose(findings, priors)
    most = None if best is None else findings.sets[best]
    nothing, logs = _weight_of_nothing(findings, priors, most), _log_weights(findings, priors, most)
    rest = np.exp(np.array(list(logs.values())) - max(logs.values()))
    weights = {"noise" if findings.noise else "none": nothing,
               **dict(zip(logs, ((1 - nothing) * rest / rest.sum()).tolist(), strict=True))}
    if nothing >= priors.alpha:
        return Posterior("none", None, 0.0, UNSURE if findings.something(priors) else NOTHING, weights)
    against = [] if most is None else findings.contradictions(most)
    withdrawn = "" if most is None or not against else contradicted(most.effects, findings.named(most, priors), against)
    if chosen is not None and max(logs, key=lambda name: logs[name]) != "unknown":
        share = findings.named(findings.sets[chosen], priors)
        reason = f"explains {share:.0%} of what can be explained{'; ' if withdrawn else ''}{withdrawn}"
        return Posterior("named", chosen, share, reason, weights)
    share, after = (0.0, findings.excess) if most is None else (findings.named(most, priors), most.left.excess)
    least = f"the best of the catalogue explains {share:.0%} of what can be explained"
    return Posterior("unexplained", best, share, withdrawn or f"{least}, and {after:.0%} above the noise is left",
                     weights)


def _weight_of_nothing(findings: Findings, priors: Thresholds, best: TriedSet | None) -> float:
    """Posterior weight of nothing missing, against the best set of effects, or against as much as the excess of the
    error makes likely at most: -1 / (e p log p) (Sellke, Bayarri and Berger 2001)."""
    p = min(max(findings.p_excess(findings.excess), 1e-300), math.exp(-1))
    against = -math.log(-math.e * p * math.log(p)) + math.log(priors.alpha)
    if best is not None:
        against = max(against, findings.log_weight(best.gain, len(best.effects), priors))
    return 1 / (1 + math.exp(min(against, 700.0)))


def _log_weights(findings: Findings, priors: Thresholds, best: TriedSet | None) -> dict[str, float]:
    """Of what is missing, if anything: posterior weights of sets of effects that nothing contradicts, and of something
    unknown. This gains its share of what can be explained beside the best set, contradicted or not."""
    out: dict[str, float] = {}
    if best is None:
        return {"unknown": 0.0}
    for one in findings.sets:
        if findings.able(one, priors) and not findings.contradictions(one):
            name = next((key for key in out if {*key.split(" + ")} == {*one.effects}), " + ".join(one.effects))
            weight = findings.log_weight(one.gain, len(one.effects), priors)
            out[name] = max(weight, out.get(name, -math.inf))
    left = findings.predictable(best.left, priors.form**2, priors.alpha)
    return {**out, "unknown": findings.log_weight(priors.share * (best.gain + max(0.0, *left.values())), 1, priors)}


def choose(findings: Findings, priors: Thresholds, contradicted: bool = False) -> int | None:
    """The number of the set of the largest posterior weight, of which every effect is more than another form of the
    others, if there is any; `contradicted`: also of those that the drives contradict."""
    able = [i for i, one in enumerate(findings.sets)
            if findings.able(one, priors) and (contradicted or not findings.contradictions(one))]
    return max(able, key=lambda i: findings.log_weight(findings.sets[i].gain, len(findings.sets[i].effects), priors),
               default=None)


def contradicted(effects: Iterable[str], share: float, against: Iterable[str]) -> str:
    """Why effects are not named."""
    return (f"{' and '.join(sorted(effects))} would explain {share:.0%} of what can be explained, but "
            f"{'; '.join(against)}")


def as_json(findings: Findings) -> dict[str, Any]:
    """The findings as a file has them."""
    return {**stamp(KIND), **asdict(findings)}


def from_json(content: dict[str, Any], where: str = "findings") -> Findings:
    """The findings of a file; ValueError for a value of another kind, or a set whose lists are not of one length."""
    known = _of(Findings, upgraded(KIND, content))  # older files have more
    if isinstance(sets := known.get("sets"), list):
        known["sets"] = [_of(TriedSet, one) if isinstance(one, dict) else one for one in sets]
    findings = record(where, Findings, known)
    for index, one in enumerate(findings.sets):
        lists = (one.effects, one.variants, one.p, one.own, one.foretold, one.classes, one.surely or one.own)
        lengths = {len(each) for each in lists}
        if len(lengths) != 1 or 0 in lengths or not all(one.classes) or not all(one.foretold):
            raise ValueError(f"{where}: sets[{index}]: effects, variants, p, own, foretold, classes and surely must be "
                             "of one length, above 0, and so must the members of foretold and classes.")
    for name in ("day", "count", "freedom"):
        if getattr(findings, name) <= 0:
            raise ValueError(f"{where}: {name} = {shown(getattr(findings, name))} must be above 0.")
    return findings


def _of(kind: type, content: dict[str, Any]) -> dict[str, Any]:
    """The entries of a file that are fields of a record."""
    return {each.name: content[each.name] for each in fields(kind) if each.name in content}


def read(path: Path) -> Findings:
    """The findings of a file that `sysid.close_loop` or `benchmarks.undeclared` kept; ValueError if it is none."""
    content = upgraded(KIND, read_json(path, f"no such file. {AGAIN}", AGAIN))
    if content.get("kind") != KIND or content.get("schema") != FORMATS[KIND].schema:
        raise ValueError(f"{path}: kind {shown(content.get('kind'))}, schema {shown(content.get('schema'))}; this "
                         f"program reads {KIND!r}, schema {FORMATS[KIND].schema}. {AGAIN}")
    return from_json(content, str(path))


def write(path: Path, findings: Findings) -> None:
    """Keep the findings."""
    write_whole(path, json.dumps(as_json(findings), indent=1).encode() + b"\n")

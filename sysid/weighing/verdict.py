"""The verdict: what the posterior weights say, and whether it is more than days with nothing missing say.

Three numbers decide. `alpha` is the share of days with nothing missing that may be called otherwise: a score is ranked
among the scores of such days, so its p-value is a rank. A second effect must stand out beside the first as far as that.
`trust` says how far a log evidence is believed: the model is linear and Gaussian, vehicles are not, so differences of a
few percent of the evidence are a tie. `share` is what named effects must explain of all that can be explained.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Literal

import numpy as np

from sysid.weighing.posterior import Posterior, Weighed

NULLS = "null_scores.json"


@dataclass(frozen=True)
class Rules:
    """The three numbers."""

    alpha: float = 0.02
    """Largest share of false alarms."""
    trust: float = 0.1
    """Nats of doubt for each nat of evidence over nothing."""
    share: float = 0.75
    """Least evidence of named effects over that of them and a smooth unknown together."""


@dataclass(frozen=True)
class Named:
    """One effect of the verdict."""

    name: str
    key: str
    members: tuple[str, ...]
    """Its class: effects that these drives cannot distinguish from it, itself first."""
    q: np.ndarray
    deviation: np.ndarray
    """Standard deviation of q."""


@dataclass(frozen=True)
class Verdict:
    """What is missing."""

    verdict: Literal["none", "named", "unexplained"]
    effects: tuple[Named, ...]
    p_value: float
    score: float
    weights: Mapping[str, float]
    """Tempered posterior weights of none, the sets and unknown, largest first."""
    noise: Mapping[str, tuple[float, float, float]]
    """Of each channel: noise over that of the reference days, and its 95 % interval."""
    lives_in: str
    """What the best smooth unknown is a function of."""


def decide(found: Posterior, channels: Sequence[str], null_scores: Sequence[float], rules: Rules | None = None
           ) -> Verdict:
    """The verdict on one log."""
    rules = rules or Rules()
    noise = {channel: (float(found.noise[c]), float(found.noise_low[c]), float(found.noise_high[c]))
             for c, channel in enumerate(channels)}
    p_value, best = rank(found.score, null_scores), chosen(found, null_scores, rules)
    kind: Literal["none", "named", "unexplained"] = "named"
    if p_value > rules.alpha:
        kind = "none"
    elif best is None or found.sets[0].log_evidence < found.none + rules.share * (
            max(found.beside, found.unknown) - found.none):
        kind = "unexplained"  # whether or not all of the best set's effects are named
    effects = []
    if kind == "named" and best is not None:
        for place, key in enumerate(best.keys):
            effects.append(Named(name_of(key), key, _class_of(found, best, place, rules.trust), *best.of(place)))
    lives_in = max(found.families, key=lambda name: found.families[name]) if found.families else ""
    return Verdict(kind, tuple(effects), p_value, found.score, tempered(found, rules.trust), noise, lives_in)


def rank(score: float, null_scores: Sequence[float]) -> float:
    """p-value of a score among those of days with nothing missing."""
    return float((1 + (np.asarray(null_scores, float) >= score).sum()) / (1 + len(null_scores)))


def chosen(found: Posterior, null_scores: Sequence[float], rules: Rules) -> Weighed | None:
    """The smallest set that no larger one beats by what a further effect must bring."""
    best: Weighed | None = None
    for size in sorted({len(one.keys) for one in found.sets}):
        one = next(each for each in found.sets if len(each.keys) == size)
        before = _gain(found, best) if best is not None else 0.0
        more = _gain(found, one) - before
        if best is None or rank(found.quiet * more, null_scores) <= rules.alpha and more > rules.trust * before:
            best = one
    return best


def name_of(key: str) -> str:
    """The effect of a hypothesis."""
    return key.partition("/")[0]


def _gain(found: Posterior, one: Weighed) -> float:
    return one.log_evidence - found.none


def tempered(found: Posterior, trust: float) -> dict[str, float]:
    """Posterior weights with log evidence over nothing divided by what the model is not to be believed of it."""
    temperature = max(1.0, trust * found.score / found.quiet)
    names = ["none", *(" + ".join(one.keys) for one in found.sets), "unknown"]
    logs = np.array([found.none, *(one.log_evidence for one in found.sets), found.unknown])
    weights = np.exp((logs - logs.max()) / temperature)
    weights /= weights.sum()
    order = np.argsort(-weights)
    return {names[i]: float(weights[i]) for i in order}


def _class_of(found: Posterior, best: Weighed, place: int, trust: float) -> tuple[str, ...]:
    """Effects that could stand for one of a set: in its place they leave less than three times the doubt (95 %)."""
    others = set(best.keys) - {best.keys[place]}
    least = best.log_evidence - 3.0 * max(1.0, trust * _gain(found, best))
    members = [name_of(best.keys[place])]
    for one in found.sets:
        if len(one.keys) == len(best.keys) and others < set(one.keys) and one.log_evidence > least:
            [mine] = set(one.keys) - others
            if name_of(mine) not in members:
                members.append(name_of(mine))
    return tuple(members)


def calibration_scores(path: Path | None = None) -> list[float]:
    """Scores of days with nothing missing, at the usual and at other noise."""
    text = path.read_text() if path is not None else (files("sysid") / "data" / NULLS).read_text()
    return [float(one) for one in json.loads(text)["scores"]]

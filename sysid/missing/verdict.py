"""The verdict: what the posterior weights say, and whether it is more than days with nothing missing say.

Two numbers decide. `alpha` is the share of days with nothing missing that may be called otherwise: the score of a log
is ranked among the scores of such days, so the p-value is a rank. `trust` says how far a log evidence is believed: the
model is linear and Gaussian, vehicles are not, so differences of a few percent of the evidence are a tie.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Literal

import numpy as np

from sysid.missing.posterior import Posterior, Weighed
from sysid.missing.saved_evidence import Evidence

NULLS = "null_scores.json"
SURE = 0.95
"""Posterior weight that a class holds."""


@dataclass(frozen=True)
class Rules:
    """The two numbers."""

    alpha: float = 0.01
    """Largest share of false alarms."""
    trust: float = 0.02
    """Nats of doubt for each nat of evidence over nothing."""


@dataclass(frozen=True)
class Named:
    """One effect of the verdict."""

    name: str
    key: str
    members: tuple[str, ...]
    """Its class: effects that these drives cannot distinguish from it, itself first."""
    q: np.ndarray
    deviation: np.ndarray


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


def decide(evidence: Evidence, found: Posterior, null_scores: Sequence[float], rules: Rules | None = None) -> Verdict:
    """The verdict on one log."""
    rules = rules or Rules()
    nulls = np.asarray(null_scores, float)
    p_value = float((1 + (nulls >= found.score).sum()) / (1 + len(nulls)))
    weights = tempered(found, rules.trust)
    noise = {channel: (float(found.noise[c]), float(found.noise_low[c]), float(found.noise_high[c]))
             for c, channel in enumerate(evidence.channels)}
    lives_in = max(found.families, key=lambda name: found.families[name]) if found.families else ""

    def verdict(kind: Literal["none", "named", "unexplained"], effects: tuple[Named, ...] = ()) -> Verdict:
        return Verdict(kind, effects, p_value, found.score, weights, noise, lives_in)

    if p_value > rules.alpha:
        return verdict("none")
    if not found.sets or found.unknown > found.sets[0].log_evidence:
        return verdict("unexplained")
    best = found.sets[0]
    effects = []
    for place, key in enumerate(best.keys):
        axes = [len(evidence.effect(one).axes) for one in best.keys]
        part = slice(sum(axes[:place]), sum(axes[: place + 1]))
        members = _class_of(evidence, found, best, place, weights)
        effects.append(Named(members[0], key, members, best.q[part], best.deviation[part]))
    return verdict("named", tuple(effects))


def tempered(found: Posterior, trust: float) -> dict[str, float]:
    """Posterior weights with log evidence over nothing divided by what the model is not to be believed of it."""
    temperature = max(1.0, trust * found.score)
    names = ["none", *(" + ".join(one.keys) for one in found.sets), "unknown"]
    logs = np.array([found.none, *(one.log_evidence for one in found.sets), found.unknown])
    weights = np.exp((logs - logs.max()) / temperature)
    weights /= weights.sum()
    order = np.argsort(-weights)
    return {names[i]: float(weights[i]) for i in order}


def _class_of(evidence: Evidence, found: Posterior, best: Weighed, place: int, weights: Mapping[str, float]
              ) -> tuple[str, ...]:
    """Effects that could stand for one of the best set: they hold `SURE` of the weight among sets that only differ
    there."""
    others = best.keys[:place] + best.keys[place + 1 :]
    rivals: dict[str, float] = {}
    for one in found.sets:
        if len(one.keys) == len(best.keys) and set(others) <= set(one.keys):
            [mine] = [key for key in one.keys if key not in others] or [best.keys[place]]
            name = evidence.effect(mine).name
            rivals[name] = rivals.get(name, 0.0) + weights[" + ".join(one.keys)]
    first = evidence.effect(best.keys[place]).name
    order = [first, *sorted((name for name in rivals if name != first), key=lambda name: -rivals[name])]
    members: list[str] = []
    total, held = sum(rivals.values()), 0.0
    for name in order:
        if members and held >= SURE * total:
            break
        members.append(name)
        held += rivals[name]
    return tuple(members)


def calibration_scores(path: Path | None = None) -> list[float]:
    """Scores of days with nothing missing, at the usual and at other noise."""
    text = path.read_text() if path is not None else (files("sysid") / "data" / NULLS).read_text()
    return [float(one) for one in json.loads(text)["scores"]]

"""What the search for effects found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from sysid.intervals.statistics import upper_rate
from sysid.missing.catalogue import Hypothesis
from sysid.missing.joint_fit import Refit
from sysid.verdict.posterior import Findings, Thresholds, TriedSet, posterior

LARGEST = 4  # members of a class
ROUNDS = 3  # effects that are searched for one after the other, at most
CANDIDATES = 4  # effects refitted in a round, of each scan; pairs refitted; effects that might imitate the best one
WEIGHED = 2  # sets of a round that are weighed, at most: those that gain most


@dataclass
class Candidate:
    """One refitted hypothesis of a round."""

    hypothesis: Hypothesis
    gain: float  # by how much it lowers the cost, refitted
    p: float  # family-wise, of that gain
    share: float
    refit: Refit


@dataclass(frozen=True)
class Weighed:
    """A set of effects that were refitted together, and what it was found among."""

    numbers: TriedSet
    members: tuple[Candidate, ...]  # the refit of all is the last one's
    rivals: tuple[Sequence[Candidate], ...]  # what was refitted in the place of each
    together: float | None = None  # p-value of "nothing is missing" where it was found as a pair


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
    crowd: list[str] = field(default_factory=list)  # that look alike too, beyond `LARGEST`
    share: float = 0.0
    excess: tuple[float, float] = (0.0, 0.0)  # squared white residual over its number, less 1: before and after
    reason: str = ""
    pairs: PairScan | None = None
    together: float | None = None  # p-value of the scan of pairs, or of the weaker refit, where a pair was accepted
    findings: Findings | None = None  # the numbers that the verdict was reached from; None for drives that stand alone
    weights: dict[str, float] = field(default_factory=dict)  # posterior weights (`sysid.verdict.posterior.Posterior`)
    weighed: Sequence[Weighed] = ()  # the sets of `findings`, with their refits

    def judged(self, findings: Findings, thresholds: Thresholds) -> Search:
        """This search, with the verdict that its findings come to and the set of effects that it is about."""
        outcome = posterior(findings, thresholds)
        self.findings, self.weights = findings, outcome.weights
        self.verdict, self.share, self.reason = outcome.verdict, outcome.share, outcome.reason
        if outcome.chosen is not None:
            self._accept(self.weighed[outcome.chosen], findings)
        return self

    def _accept(self, chosen: Weighed, findings: Findings) -> None:
        """Take a set of effects for what the verdict is about."""
        self.accepted, self.together = list(chosen.members), chosen.together
        self.final = chosen.members[-1].refit
        self.excess = self.excess[0], chosen.numbers.left.excess
        for one in chosen.members:
            if not any(each is one for listed in self.rounds for each in listed):
                self.rounds.append([one])
        withdrawn = [{*names.split("+")} for names, against in findings.against.items() if against]
        classes = [[name for name in members
                    if name == members[0] or {*self.effects} - {members[0]} | {name} not in withdrawn]
                   for members in chosen.numbers.apart()]
        self.classes = [members[:LARGEST] for members in classes]
        self.crowd = [name for members in classes for name in members[LARGEST:]]

    @property
    def effects(self) -> tuple[str, ...]:
        """Those of the set that was accepted."""
        return tuple(one.hypothesis.effect for one in self.accepted)

    @property
    def p_value(self) -> float:
        """Of "nothing is missing": that of the scan and, where refits were tried, of the best of them."""
        if self.together is not None:
            return self.together
        refitted = min((one.p for one in self.rounds[0]), default=0.0) if self.rounds else 0.0
        return max(self.scan.p_family, refitted)


@dataclass(frozen=True)
class Scan:
    """Gains of H hypotheses, each at the level of its highest worth."""

    gain: np.ndarray  # (H,)
    worth: np.ndarray  # (H,)
    q: tuple[np.ndarray, ...]  # (k,) per hypothesis
    null: np.ndarray  # (N, H) worth on simulated nulls
    p: np.ndarray  # (H,) p-value of each by itself
    smallest: np.ndarray  # (N,) smallest p-value of each null

    @property
    def p_family(self) -> float:
        """p-value of the smallest p-value."""
        return float(family(self.smallest, self.p.min()))

    def p_of(self, h: int, worth: float) -> float:
        """Family-wise p-value of hypothesis h if this is its worth."""
        return float(family(self.smallest, tail(self.null[:, h], worth)))


def tail(null: np.ndarray, value: np.ndarray | float, least: float = 1e-9) -> np.ndarray:
    """P(null >= value); beyond the draws (N,) by an exponential tail through their upper tenth, which falls by e over
    `least` or more."""
    value, ordered = np.asarray(value, float), np.sort(null)
    count = len(ordered)
    empirical = (count - np.searchsorted(ordered, value, side="left") + 1) / (count + 1)
    top = ordered[int(0.9 * count) :]
    far = 0.1 * np.exp(-np.maximum(value - top[0], 0.0) / max(float(top.mean() - top[0]), least))
    return np.asarray(np.where(value > top[len(top) // 2], np.maximum(far, 1e-300), empirical))


def tails(null: np.ndarray, values: np.ndarray, least: float = 1e-9) -> np.ndarray:
    """(..., H) `tail` of values (..., H), each of its own draws (N, H)."""
    each = [tail(null[:, h], values[..., h], least) for h in range(null.shape[1])]
    return np.moveaxis(np.array(each).reshape(-1, *values.shape[:-1]), 0, -1)


def family(smallest: np.ndarray, p: np.ndarray | float) -> np.ndarray:
    """p-values of p (...), the smallest of dependent tests, from its null sample (N,); extrapolated as p x effective
    number."""
    rare = np.quantile(smallest, 0.05)
    share = (np.searchsorted(np.sort(smallest), p, side="right") + 1) / (len(smallest) + 1)
    return np.where(p >= rare, share, np.minimum(0.05 / np.maximum(rare, 1e-300) * p, 1.0))


@dataclass(frozen=True)
class PairScan:
    """M pairs of hypotheses, each at the levels of its highest worth."""

    members: tuple[tuple[int, int], ...]
    gain: np.ndarray  # (M,)
    worth: np.ndarray  # (M,)
    q: tuple[np.ndarray, ...]  # coordinates of the first member, then of the second
    p: np.ndarray  # (M,) p-value of each pair by itself
    smallest: np.ndarray  # (N,) smallest p-value of each null
    null: np.ndarray  # (N, M) worth on simulated nulls

    @property
    def p_family(self) -> float:
        """p-value of the smallest p-value."""
        return self.p_of(float(self.p.min())) if len(self.p) else 1.0

    def p_of(self, p: float) -> float:
        """Family-wise p-value of a pair's own."""
        return float(family(self.smallest, p))


@dataclass(frozen=True)
class NullRefits:
    """What was found in N simulated days with nothing missing."""

    p: np.ndarray  # (N,) what `Search.p_value` would be
    alarms: int  # how many of them would not have been called `none`

    def p_of(self, p: float) -> float:
        """Share of days with nothing in them whose p-value is as small, the drives in question counted in."""
        return float((np.sum(self.p <= p) + 1) / (len(self.p) + 1))

    @property
    def upper(self) -> float:
        """Upper end of the one-sided 95 % interval of the false-alarm rate."""
        return upper_rate(self.alarms, len(self.p))

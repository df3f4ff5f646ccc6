"""What is known of a vehicle from other days: its reference, and how far effects seem to wander."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import compress
from typing import Any

import numpy as np
from scipy import stats

from sysid.errors.features import CHANNELS
from sysid.errors.noise import BIN_SHIFT, Whitener, courses_of, scatter
from sysid.errors.space import Space
from sysid.logs.log import START_NOISE
from sysid.logs.records import Trial
from sysid.logs.replicates import course_of, near
from sysid.missing.evidence import Columns

ASSUMED_DAYS = 4.0  # how many days the mean over all hypotheses counts as, beside the days' information on one
EXCESS = 0.06  # standard deviation of a day's excess where reference days do not determine it


@dataclass(frozen=True)
class Leftover:
    """What the base model leaves of one reference drive after that day's own fit."""

    trial: Trial
    day: int
    series: np.ndarray  # (K, C)
    mask: np.ndarray  # (K, C) weights


@dataclass(frozen=True)
class Reference:
    """What is known of a vehicle before the drives in question."""

    params: Any  # fitted `VehicleParams`
    space: Space
    u: np.ndarray  # (P,) fitted unit coordinates
    spread: np.ndarray  # (P, P) covariance of a day's parameters around u
    days: np.ndarray  # (D, P) each day's offset from u
    whitener: Whitener
    factors: np.ndarray  # (4, C) noise of rough bins beside smooth ones
    leftovers: tuple[Leftover, ...]
    width: float  # of the bins [s]
    known: bool  # False where there are no other drives: parameters are then free within bounds
    remark: str
    noise: np.ndarray | float = 1.0  # (C,) noise of the drives in question over that of the reference days
    simulated: bool = False  # whether `leftovers` are drawn from what a vehicle file says of its fit
    blocks: bool = False  # whether the days are blocks of one run

    @property
    def channels(self) -> int:
        return int(self.leftovers[0].series.shape[1])

    @property
    def gyro(self) -> bool:
        return self.channels > len(CHANNELS)

    @property
    def shared(self) -> float:
        """Share of the white noise of a drive that its replicates on the same day have as well: what the model lacks
        that day, and the error of what the other days expect. 0 where no day has replicates."""
        if not self.known:
            return 0.0
        apart = []
        for number in {one.day for one in self.leftovers}:
            mine = [one for one in self.leftovers if one.day == number]
            series = np.stack([self.noise_of(one) for one in mine])
            white = self.whitener.flat(series, np.stack([one.mask for one in mine]))
            apart.append(scatter(white, courses_of([one.trial for one in mine])))
        finite = [one for one in apart if np.isfinite(one)]
        usual = float(np.clip(-np.mean(finite), 0.0, 1.0)) if finite else 0.0
        return usual * float(np.mean(1 / np.square(self.noise)))

    def expected(self, trial: Trial, bins: int) -> np.ndarray:
        """(K, C) mean leftover of reference drives with commands of the same course; 0 where there is none."""
        same = [one for one in self.leftovers if alike(one.trial, trial)]
        return mean_by_day(same, bins, self.channels) if self.known else np.zeros((bins, self.channels))

    def expected_on_others(self, one: Leftover) -> np.ndarray:
        """(K, C) mean leftover of the other days' drives of the same course, for a reference drive itself."""
        return expected_without(self.leftovers, one) if self.known else np.zeros_like(one.series)

    def noise_of(self, one: Leftover) -> np.ndarray:
        """(K, C) what is noise of a reference drive, as large as in the drives in question."""
        return (one.series - self.expected_on_others(one)) * self.noise

    def noisier(self, factor: np.ndarray) -> Reference:
        """The same for drives in which each channel's noise is larger by a factor (C,)."""
        return replace(self, whitener=self.whitener.scaled(factor), noise=self.noise * factor)

    def target_of(self, drives: Any) -> np.ndarray:
        """(B, K, C) measured features of `Drives` less what the model is known to leave of such ones."""
        bins = drives.target.shape[1]
        return drives.target - np.stack([self.expected(trial, bins) for trial in drives.trials])


def alike(a: Trial, b: Trial) -> bool:
    """Whether two trials are nearly the same drive, so that the model leaves about the same in their bins: commands
    that are close as functions of time, in shape and in size, from the same speeds."""
    same_start = max(abs(a.start.v - b.start.v), abs(a.start.omega - b.start.omega)) <= START_NOISE
    return a.manoeuvre == b.manoeuvre and same_start and near(course_of(a), course_of(b), BIN_SHIFT)


def mean_by_day(leftovers: Sequence[Leftover], bins: int, channels: int = len(CHANNELS)) -> np.ndarray:
    """(K, C) mean over days of the mean over a day's drives, shrunk towards 0 where few days were seen."""
    days: dict[int, list[np.ndarray]] = {}
    for one in leftovers:
        days.setdefault(one.day, []).append(_fit_length(one.series * (one.mask > 0), bins))
    if not days:
        return np.zeros((bins, channels))
    drives = sum(len(each) for each in days.values())
    mean = np.mean([np.mean(each, axis=0) for each in days.values()], axis=0)
    return mean * drives / (drives + 1.0)


def expected_without(leftovers: Sequence[Leftover], one: Leftover) -> np.ndarray:
    """(K, C) mean leftover of the other days' drives of the same course."""
    others = [other for other in leftovers if other.day != one.day and alike(other.trial, one.trial)]
    return mean_by_day(others, *one.series.shape)


def difference_sizes(spread: np.ndarray) -> np.ndarray:
    """(P,) steps of difference quotients, in unit coordinates: a day's standard deviation, within reason."""
    return np.clip(np.sqrt(np.diag(spread)), 0.004, 0.05)


@dataclass(frozen=True)
class Wander:
    """Day-to-day covariance of the coordinates, in the order of `Evidence.columns`."""

    covariance: tuple[np.ndarray, ...]  # (k, k) each
    shapes: tuple[np.ndarray, ...]  # (D, k) each: root mean square 1 in units of that covariance
    freedom: float  # degrees of freedom that the covariances rest on
    excess: float = EXCESS  # standard deviation from day to day of the squared residual over the noise, less 1
    usual: float = 0.0  # what smooth functions that know no physics gain on a reference day, per trial
    usual_size: float = 0.0  # root mean square of it over the days, for a new one; 0 where days do not show it
    scatter: float = 0.0  # excess of what a reference day's replicates do not share
    level: float = 1.0  # mean square of the white residual where nothing is missing: less with quieter sensors

    def unshared(self, residual: np.ndarray, courses: np.ndarray) -> float:
        """Excess that replicates among trials (B,) of white residuals (B, n) do not share, beyond what is usual."""
        return max(float(np.nan_to_num((scatter(residual, courses) + 1) / self.level - 1 - self.scatter)), 0.0)

    def at(self, columns: Sequence[Columns], hypothesis: int, q: np.ndarray) -> np.ndarray:
        """(k, k) covariance of the coordinates of a hypothesis near q (k,)."""
        mine = [i for i, one in enumerate(columns) if one.hypothesis == hypothesis]
        return self.covariance[min(mine, key=lambda i: abs(columns[i].level - float(np.abs(q).max())))]

    def variances(self, columns: Sequence[Columns], numbers: Sequence[int], split: Sequence[np.ndarray]) -> np.ndarray:
        """(k,) variance of the coordinates, all of them in turn, of hypotheses with these numbers near `split`."""
        each = [np.diag(self.at(columns, number, q)) for number, q in zip(numbers, split, strict=True)]
        return np.concatenate([[], *each])

    def draw_shares(self, draws: int, rng: np.random.Generator) -> np.ndarray:
        """(N, D) of each reference day's apparent effects in simulated days, heavy-tailed as few days ask for."""
        days = len(self.shapes[0])
        share = rng.standard_normal((draws, days)) / np.sqrt(days)
        return share * np.sqrt(self.freedom / rng.chisquare(self.freedom, size=(draws, 1)))

    def away(self, column: int, share: np.ndarray) -> np.ndarray:
        """(N, k) apparent coordinates of one of the evidence's columns on days with these shares (N, D)."""
        return share @ self.shapes[column] * np.sqrt(np.diag(self.covariance[column]))

    def of(self, kept: Sequence[bool]) -> Wander:
        """Of some of the evidence's columns only."""
        return replace(self, covariance=tuple(compress(self.covariance, kept)),
                       shapes=tuple(compress(self.shapes, kept)))

    def p_excess(self, excess: float) -> float:
        """Probability of so much excess on a day with nothing in it."""
        return float(stats.t.sf(excess / self.excess, self.freedom))

    def excess_limit(self, alpha: float) -> float:
        """Excess that a day with nothing in it has with probability alpha."""
        return float(stats.t.isf(alpha, self.freedom)) * self.excess

    def smooth_limit(self, alpha: float) -> float:
        """What smooth functions gain per trial on a day with nothing in it with probability alpha; infinite where days
        do not show it."""
        return float(stats.t.isf(alpha, self.freedom)) * self.usual_size if self.usual_size > 0 else float("inf")


def no_wander(columns: Sequence[Columns], size: float = 0.0) -> Wander:
    """Coordinates that wander by themselves with a given standard deviation."""
    width = max((c.index[-1] for c in columns), default=0) + 1
    shapes = []
    for one in columns:
        shape = np.zeros((width, len(one.index)))
        shape[one.index, range(len(one.index))] = np.sqrt(width)
        shapes.append(shape)
    return Wander(tuple(size**2 * np.eye(len(c.index)) for c in columns), tuple(shapes), ASSUMED_DAYS)


def _fit_length(series: np.ndarray, bins: int) -> np.ndarray:
    out = np.zeros((bins, series.shape[1]))
    out[: min(bins, len(series))] = series[:bins]
    return out

"""A vehicle as its reference drives show it: the fitted base model, how far it wanders from day to day, what it
does not reproduce, and the noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

from sysid.errors.noise import (
    Whitener,
    first_scales,
    fit_roughness,
    fit_whitener,
    replicate_groups,
    roughness,
    scatter,
)
from sysid.errors.space import Space, make_space
from sysid.logs.log import Log, Trial
from sysid.missing.base_fit import fit_base
from sysid.missing.drives import Drives, make_drives
from sysid.replay.records import Plant
from sysid.search.result import Progress
from whill_mjx.vehicle.parameters import set_values

ASSUMED_SPREAD = 0.05
"""Day-to-day standard deviation of a parameter, as a share of its value, where reference drives do not tell."""
ASSUMED_DAYS = 4.0
"""How many days of reference drives that assumption counts as."""
LEAST_SPREAD = 0.003  # of the range: what no parameter is known better than
WEAK_PRIOR = 0.29  # of the range: standard deviation of a parameter of which only its bounds are known
EVEN = 0.97  # least correlation of two commands for their drives to be compared bin by bin


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

    params: Any
    """Fitted `VehicleParams`."""
    space: Space
    u: np.ndarray  # (P,) fitted unit coordinates
    spread: np.ndarray  # (P, P) covariance of a day's parameters around u
    days: np.ndarray  # (D, P) each day's offset from u
    whitener: Whitener
    factors: np.ndarray  # (4, C) noise of rough bins beside smooth ones
    leftovers: tuple[Leftover, ...]
    width: float
    """Of the bins [s]."""
    known: bool
    """False where the drives in question are themselves the only ones: parameters are then free within bounds."""
    remark: str

    @property
    def shared(self) -> float:
        """Share of the white noise of a drive that its replicates on the same day have as well: what the model lacks
        that day, and the error of what the other days expect. 0 where no day has replicates."""
        if not self.known:
            return 0.0
        apart = []
        for number in {one.day for one in self.leftovers}:
            mine = [one for one in self.leftovers if one.day == number]
            series = np.stack([one.series - self.expected_on_others(one) for one in mine])
            white = self.whitener.apply(series, np.stack([one.mask for one in mine])).reshape(len(mine), -1)
            courses = np.zeros(len(mine), int)
            for course, group in enumerate(replicate_groups(tuple(one.trial for one in mine))):
                courses[group] = course
            apart.append(scatter(white, courses))
        told = [one for one in apart if np.isfinite(one)]
        return float(np.clip(-np.mean(told), 0.0, 1.0)) if told else 0.0

    def expected(self, trial: Trial, bins: int) -> np.ndarray:
        """(K, C) mean leftover of reference drives with commands of the same course; 0 where there is none."""
        same = [one for one in self.leftovers if alike(one.trial, trial)]
        return mean_by_day(same, bins) if self.known else np.zeros((bins, self.leftovers[0].series.shape[1]))

    def expected_on_others(self, one: Leftover) -> np.ndarray:
        """(K, C) mean leftover of the other days' drives of the same course, for a reference drive itself."""
        return expected_without(self.leftovers, one) if self.known else np.zeros_like(one.series)

    def target_of(self, drives: Drives) -> np.ndarray:
        """(B, K, C) measured features less what the model is known to leave of such drives."""
        bins = drives.target.shape[1]
        return drives.target - np.stack([self.expected(trial, bins) for trial in drives.trials])


def alike(a: Trial, b: Trial) -> bool:
    """Whether two trials have the same course of commands up to size, so that bins correspond."""
    if a.manoeuvre != b.manoeuvre or len(a.command.t) != len(b.command.t):
        return False
    if not np.allclose(a.command.t, b.command.t, atol=0.02):
        return False
    for name in ("v", "omega"):
        x, y = getattr(a.command, name), getattr(b.command, name)
        if np.allclose(x, y, atol=1e-6):
            continue
        size = np.linalg.norm(x) * np.linalg.norm(y)
        if size == 0 or x @ y < EVEN * size:
            return False
    return True


def mean_by_day(leftovers: Sequence[Leftover], bins: int) -> np.ndarray:
    """(K, C) mean over days of the mean over a day's drives, shrunk towards 0 where few days were seen."""
    channels = leftovers[0].series.shape[1] if leftovers else 5
    days: dict[int, list[np.ndarray]] = {}
    for one in leftovers:
        days.setdefault(one.day, []).append(_fit_length(one.series * (one.mask > 0), bins))
    if not days:
        return np.zeros((bins, channels))
    drives = sum(len(each) for each in days.values())
    mean = np.mean([np.mean(each, axis=0) for each in days.values()], axis=0)
    return mean * drives / (drives + 1.0)


def _fit_length(series: np.ndarray, bins: int) -> np.ndarray:
    out = np.zeros((bins, series.shape[1]))
    out[: min(bins, len(series))] = series[:bins]
    return out


def make_reference(
    plant: Plant, start: Any, logs: Sequence[Log], known: bool = True, iterations: int = 15,
    names: Sequence[str] | None = None, progress: Progress | None = None, fitted: bool = False,
) -> Reference:
    """Fit the base model to the training trials of all logs, then each log by itself.

    Args:
        start: `VehicleParams` where the fit starts.
        logs: drives of one vehicle, each log of one day.
        known: whether they are reference drives, or the drives in question themselves.
        fitted: `start` is a vehicle fitted before; it is kept.
    """
    spec = logs[0].spec
    space = make_space(start, spec, names)
    trials = tuple(trial for log in logs for trial in log.training)
    day = np.array([number for number, log in enumerate(logs) for _ in log.training])
    drives = make_drives(plant, start, space.names, trials)
    groups = replicate_groups_by_day(trials, day)
    whitener = first_scales(drives.target, drives.mask, groups)
    u = space.to_unit(space.initial)
    sizes = difference_sizes(np.diag(assumed_spread(space, u) ** 2))
    if not fitted:
        u = fit_base(drives, space, whitener, u, sizes, iterations, progress=progress).u
    at = drives.simulate(space.to_values(u)[None])[0]
    factors = fit_roughness(drives.target - at, drives.mask, roughness(at, drives.features.width, spec.track))
    drives = drives.weighted(at, factors, spec.track)
    if not fitted:
        whitener = fit_whitener(drives.target - at, drives.mask)
        u = fit_base(drives, space, whitener, u, sizes, max(iterations // 2, 3), progress=progress).u
    left = drives.target - drives.simulate(space.to_values(u)[None])[0]
    whitener = fit_whitener(left, drives.mask)
    days = np.zeros((len(logs), space.size))
    if known:
        prior = (u, np.diag(1 / (3 * assumed_spread(space, u)) ** 2))
        for number, log in enumerate(logs):
            index = np.flatnonzero(day == number)
            one = drives.of(log.training, plant.dt)
            one = one.weighted(one.simulate(space.to_values(u)[None])[0], factors, spec.track)
            fit = fit_base(one, space, whitener, u, sizes, 6, prior=prior, progress=progress)
            days[number] = fit.u - u
            bins = one.target.shape[1]
            left[index, :bins] = one.target - one.simulate(space.to_values(fit.u)[None])[0]
        shift = days.mean(0)  # the pooled fit weighs drives, not days
        u, days = np.clip(u + shift, 0.0, 1.0), days - shift
        factors = fit_roughness(left, drives.features.mask, roughness(at, drives.features.width, spec.track))
        drives = drives.weighted(at, factors, spec.track)
        whitener = fit_whitener(left, drives.mask)
    spread, remark = _spread(space, u, days, known)
    leftovers = tuple(Leftover(trial, int(day[i]), left[i], drives.mask[i]) for i, trial in enumerate(trials))
    if known:
        whitener = fit_whitener(np.stack([one.series - expected_without(leftovers, one) for one in leftovers]),
                                drives.mask)
    params = set_values(start, space.names, jnp.asarray(space.to_values(u), jnp.result_type(float)))
    return Reference(params, space, u, spread, days, whitener, factors, leftovers, drives.features.width,
                     known, remark)


def expected_without(leftovers: Sequence[Leftover], one: Leftover) -> np.ndarray:
    """(K, C) mean leftover of the other days' drives of the same course."""
    others = [other for other in leftovers if other.day != one.day and alike(other.trial, one.trial)]
    return mean_by_day(others, len(one.series))


def replicate_groups_by_day(trials: tuple[Trial, ...], day: np.ndarray) -> list[list[int]]:
    """Replicates within each day: another day's vehicle differs."""
    groups = []
    for number in np.unique(day):
        index = np.flatnonzero(day == number)
        groups += [[int(index[i]) for i in group] for group in replicate_groups(tuple(trials[i] for i in index))]
    return groups


def difference_sizes(spread: np.ndarray) -> np.ndarray:
    """(P,) steps of difference quotients, in unit coordinates: a day's standard deviation, within reason."""
    return np.clip(np.sqrt(np.diag(spread)), 0.004, 0.05)


def assumed_spread(space: Space, u: np.ndarray) -> np.ndarray:
    """(P,) standard deviations in unit coordinates where drives do not tell."""
    value = np.abs(space.to_values(u))
    scale = np.where(value > 0, value, space.high - space.low)
    return np.clip(ASSUMED_SPREAD * scale / np.maximum(space.slope(u), 1e-12), LEAST_SPREAD, WEAK_PRIOR)


def _spread(space: Space, u: np.ndarray, days: np.ndarray, known: bool) -> tuple[np.ndarray, str]:
    """Covariance of a new day's parameters and what it rests on."""
    if not known:
        return WEAK_PRIOR**2 * np.eye(space.size), (
            "no reference drives: base parameters are free, so effects that they imitate (mass, track, scrub, "
            "friction, drag, traction) cannot be seen")
    assumed = np.diag(assumed_spread(space, u) ** 2)
    if len(days) < 2:
        return assumed, (f"one reference day: parameters are assumed to vary by {ASSUMED_SPREAD:.0%} of their values "
                         "from day to day")
    centred = days - days.mean(0)
    covariance = centred.T @ centred
    count = len(days) - 1
    mixed = (ASSUMED_DAYS * assumed + covariance) / (ASSUMED_DAYS + count) * (1 + 1 / len(days))
    return mixed, f"day-to-day spread from {len(days)} reference days, with {ASSUMED_SPREAD:.0%} of the values as prior"

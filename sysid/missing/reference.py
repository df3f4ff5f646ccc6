"""A vehicle as its reference drives show it: the fitted base model, how far it wanders from day to day, what it
does not reproduce, and the noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import jax.numpy as jnp
import numpy as np

from sysid.errors.features import GYRO, bin_width, channel_names
from sysid.errors.noise import (
    Whitener,
    courses_of,
    first_scales,
    fit_roughness,
    fit_whitener,
    replicate_groups,
    roughness,
)
from sysid.errors.prior import EXPECTED, LEAST, SPREAD, UNKNOWN, expected_sd
from sysid.errors.space import Space, make_space
from sysid.logs.records import Log, Trial
from sysid.missing.days import Leftover, Reference, difference_sizes, expected_without
from sysid.missing.drives import Drives, make_drives
from sysid.missing.fit_statistics import FittedVehicle, Leftovers, drawn, leftovers_of
from sysid.replay.records import FreeVehicle, Plant
from sysid.search.gauss_newton import BoxStep, GaussNewton, Patience, State, Try
from sysid.search.result import Progress
from whill_mjx.io.steps import step
from whill_mjx.vehicle.parameters import set_values

ASSUMED_DAYS = 4.0  # how many days of reference drives that assumption counts as
OWN_ITERATIONS = 30  # of the base fit to one day, at most: days whose fits are cut short would differ by too little
BLOCK = "block"  # field of a log that is one part of a long run
LEAST_DRAWN = 24  # drives that are simulated, at least, to show the noise that a vehicle file states
CHOICES = tuple(Try(factor) for factor in (0.1, 1.0, 10.0, 100.0))
PATIENCE = Patience(tolerance=1e-3, first=3)


def make_reference(
    vehicle: FreeVehicle, logs: Sequence[Log], known: bool = True, iterations: int = 15,
    progress: Progress | None = None,
) -> Reference:
    """Fit the base model to the training trials of all logs, then each log by itself.

    Args:
        vehicle: where the fit starts, with the parameters of the base model free.
        logs: drives of one vehicle, each log of one day.
        known: whether they are reference drives, or the drives in question themselves.
        iterations: of the fit to all; 0 keeps a vehicle that was fitted before.
    """
    spec = logs[0].spec
    space = make_space(vehicle.params, spec, vehicle.names)
    trials = tuple(trial for log in logs for trial in log.training)
    day = np.array([number for number, log in enumerate(logs) for _ in log.training])
    drives = make_drives(vehicle, trials)
    groups = replicate_groups_by_day(trials, day)
    whitener = first_scales(drives.target, drives.mask, groups)
    u = space.to_unit(space.initial)
    sizes = difference_sizes(np.diag(assumed_spread(space, u) ** 2))
    if iterations:
        u = BaseFit(drives, space, whitener, sizes).run(u, iterations, progress=progress)
    at = drives.simulate(space.to_values(u)[None])[0]
    factors = fit_roughness(drives.target - at, drives.mask, roughness(at, drives.features.width, spec.track))
    drives = drives.weighted(at, factors, spec.track)
    if iterations:
        whitener = fit_whitener(drives.target - at, drives.mask)
        u = BaseFit(drives, space, whitener, sizes).run(u, max(iterations // 2, 3), progress=progress)
    left = drives.target - drives.simulate(space.to_values(u)[None])[0]
    whitener = fit_whitener(left, drives.mask)
    days = np.zeros((len(logs), space.size))
    if known:
        prior = (u, np.diag(1 / (3 * assumed_spread(space, u)) ** 2))
        for number, log in enumerate(logs):
            index = np.flatnonzero(day == number)
            one = drives.of(log.training)
            one = one.weighted(one.simulate(space.to_values(u)[None])[0], factors, spec.track)
            own = BaseFit(one, space, whitener, sizes).run(u, OWN_ITERATIONS, prior, progress)
            days[number] = own - u
            bins = one.target.shape[1]
            left[index, :bins] = one.target - one.simulate(space.to_values(own)[None])[0]
        shift = days.mean(0)  # the pooled fit weighs drives, not days
        u, days = np.clip(u + shift, 0.0, 1.0), days - shift
        factors = fit_roughness(left, drives.features.mask, roughness(at, drives.features.width, spec.track))
        drives = drives.weighted(at, factors, spec.track)
        whitener = fit_whitener(left, drives.mask)
    blocks = all(BLOCK in log.fields for log in logs)
    spread, remark = _spread(space, u, days, known)
    leftovers = tuple(Leftover(trial, int(day[i]), left[i], drives.mask[i]) for i, trial in enumerate(trials))
    if known:
        whitener = fit_whitener(np.stack([one.series - expected_without(leftovers, one) for one in leftovers]),
                                drives.mask)
    params = set_values(vehicle.params, space.names, jnp.asarray(space.to_values(u), jnp.result_type(float)))
    return Reference(params, space, u, spread, days, whitener, factors, leftovers, drives.features.width,
                     known, remark, blocks=blocks)


def of_vehicle(
    plant: Plant, vehicle: FittedVehicle, log: Log, names: Sequence[str], progress: Progress | None = None
) -> Reference:
    """A vehicle that was fitted before, without drives of it: nothing of the log in question is taken for known.

    Spread and noise are those of its fit, or where the file says nothing of it, of a fit to the log itself. Reference
    drives that stand for the noise are drawn from them, and have no course in common with drives in question.
    """
    params, known = vehicle.params, vehicle.statistics
    space = make_space(params, log.spec, names)
    u = space.to_unit(space.initial)
    assumed = np.diag(assumed_spread(space, u) ** 2)
    remark = f"one vehicle file: parameters are assumed to vary by {SPREAD:.0%} of their values from day to day"
    spread = assumed
    if known is not None:
        errors = known.covariance(space.names, space.slope(u))
        spread = assumed + _within(errors, UNKNOWN)
        remark += ", beside the standard errors of its fit; how far effects seem to wander is assumed"
    width = bin_width(log.training) if known is None else known.leftovers.width
    gyro = None if known is None else GYRO in known.leftovers.measured
    if gyro is False and any(trial.gyro is not None for trial in log.training):
        remark += "; its fit had no gyro, so that of these drives is left out"
    drives = make_drives(FreeVehicle(plant, params, space.names), log.training, width, gyro=gyro)
    at = drives.simulate(space.to_values(u)[None])[0]
    names_of = channel_names(drives.target.shape[-1])
    measured = {name for c, name in enumerate(names_of) if (drives.features.mask[..., c] > 0).any()}
    if known is not None and measured <= set(known.leftovers.measured):
        left = known.leftovers
    else:
        why = "the file does not say what its fit left" if known is None else (
            f"its fit had no {', '.join(sorted(measured - set(known.leftovers.measured)))}")
        remark += f"; the noise is assumed to be what a fit to these drives leaves, since {why}"
        left = _own_leftovers(drives, space, u, log, progress)
    drives = drives.weighted(at, left.factors, log.spec.track)
    leftovers = _drawn(log.training, drives.mask, left)
    return Reference(params, space, u, spread, np.zeros((1, space.size)), left.whitener, left.factors, leftovers,
                     drives.features.width, True, remark, simulated=True)


def _own_leftovers(drives: Drives, space: Space, u: np.ndarray, log: Log, progress: Progress | None) -> Leftovers:
    """What a fit of the base model to the drives themselves leaves, near a vehicle u (P,)."""
    spread = assumed_spread(space, u)
    whitener = first_scales(drives.target, drives.mask, replicate_groups(log.training))
    prior = (u, np.diag(1 / (3 * spread) ** 2))
    own = BaseFit(drives, space, whitener, difference_sizes(np.diag(spread**2))).run(u, OWN_ITERATIONS, prior, progress)
    at = drives.simulate(space.to_values(own)[None])[0]
    return leftovers_of(log.training, drives.target, at, drives.features, log.spec.track)


def _drawn(trials: tuple[Trial, ...], mask: np.ndarray, left: Leftovers) -> tuple[Leftover, ...]:
    """Leftovers of simulated drives with the commands of trials, whose manoeuvres nobody drove."""
    times = -(-LEAST_DRAWN // len(trials))
    courses = courses_of(trials)
    every = np.concatenate([courses + k * (courses.max() + 1) for k in range(times)])
    series = drawn(left, np.tile(mask, (times, 1, 1)), every.tolist(), np.random.default_rng(0))
    return tuple(Leftover(replace(trials[i % len(trials)], manoeuvre=f"simulated/{every[i]}"), 0, one,
                          mask[i % len(trials)]) for i, one in enumerate(series))


def _within(covariance: np.ndarray, most: float) -> np.ndarray:
    """A covariance (P, P) with standard deviations of at most so much."""
    size = np.sqrt(np.maximum(np.diag(covariance), 1e-30))
    ratio = np.minimum(1.0, most / size)
    return np.asarray(covariance * np.outer(ratio, ratio))


def replicate_groups_by_day(trials: tuple[Trial, ...], day: np.ndarray) -> list[list[int]]:
    """Replicates within each day: another day's vehicle differs."""
    groups = []
    for number in np.unique(day):
        index = np.flatnonzero(day == number)
        groups += [[int(index[i]) for i in group] for group in replicate_groups(tuple(trials[i] for i in index))]
    return groups


def assumed_spread(space: Space, u: np.ndarray) -> np.ndarray:
    """(P,) standard deviations in unit coordinates where drives do not show them.

    A share of a parameter's value; of sizes and places of sensors, which stay, of what rulers and data sheets err by.
    """
    value = np.abs(space.to_values(u))
    scale = np.where(value > 0, value, space.high - space.low)
    sizes = [EXPECTED.get(name, one) for name, one in zip(space.names, scale, strict=True)]
    scale = np.where(_of_gyro(space), scale, sizes)
    spread = np.clip(SPREAD * scale / np.maximum(space.slope(u), 1e-12), LEAST, UNKNOWN)
    return np.where(_of_gyro(space), np.minimum(spread, expected_sd(space)), spread)


def _of_gyro(space: Space) -> np.ndarray:
    """(P,) bool: errors of a gyro, which its maker states."""
    return np.array([name.startswith("gyro_bias.") for name in space.names], bool)


def _spread(space: Space, u: np.ndarray, days: np.ndarray, known: bool) -> tuple[np.ndarray, str]:
    """Covariance of a new day's parameters and what it rests on."""
    if not known:
        return np.diag(np.where(_of_gyro(space), expected_sd(space), UNKNOWN) ** 2), (
            "no reference drives: base parameters are free, so effects that they imitate (mass, track, scrub, "
            "friction, drag, traction) cannot be seen")
    assumed = np.diag(assumed_spread(space, u) ** 2)
    if len(days) < 2:
        return assumed, (f"one reference day: parameters are assumed to vary by {SPREAD:.0%} of their values "
                         "from day to day")
    centred = days - days.mean(0)
    covariance = centred.T @ centred
    count = len(days) - 1
    mixed = (ASSUMED_DAYS * assumed + covariance) / (ASSUMED_DAYS + count) * (1 + 1 / len(days))
    return mixed, f"day-to-day spread from {len(days)} reference days, with {SPREAD:.0%} of the values as prior"


@dataclass(frozen=True)
class BaseFit:
    """Fits of the base model to drives: they minimise |W (f(u) - y)|^2 over the unit box."""

    drives: Drives  # replays over exactly the parameters of `space`
    space: Space
    whitener: Whitener
    sizes: np.ndarray  # (P,) unit coordinates, over which derivatives are taken: what a day changes smooths skids out

    def run(
        self, start: np.ndarray, iterations: int, prior: tuple[np.ndarray, np.ndarray] | None = None,
        progress: Progress | None = None,
    ) -> np.ndarray:
        """The best unit coordinates (P,), from a start (P,). `prior`: their mean (P,) and precision (P, P)."""
        solver = GaussNewton(BoxStep(passes=1), CHOICES, PATIENCE, prior)
        state, measured = solver.init(start[None]), float((self.drives.mask > 0).sum())
        for _ in range(iterations):
            state = State(*step("base fit", partial(self._advanced, solver, state), *state))
            if progress is not None:
                progress(1, f"base fit, cost {state.cost[0] / measured:.3f}")
            if solver.done(state).all():
                break
        return np.asarray(state.u[0])

    def _advanced(self, solver: GaussNewton, state: State) -> State:
        """After an iteration of a single start."""
        at, slopes = self.drives.linearised(self.space.to_values, state.u[0], self.sizes)
        residual = self._white(at[None])
        jacobian = self.whitener.apply(slopes, self.drives.mask).reshape(1, -1, state.u.shape[1])
        state = state._replace(cost=solver.cost(residual, state.u))
        tried = solver.tries(state, *solver.normal(residual, jacobian, state.u))
        points = tried.points[0]
        white = self._white(self.drives.simulate(self.space.to_values(points)))
        return solver.step(state, tried, solver.cost(white, points)[None])

    def _white(self, features: np.ndarray) -> np.ndarray:
        """White residuals (N, n) of features (N, B, K, C)."""
        return np.stack([self.whitener.apply(one - self.drives.target, self.drives.mask).ravel() for one in features])

"""Evidence of one log, from the simulator: the last step of a verdict that replays drives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from sysid.errors.features import CHANNELS
from sysid.errors.noise import BIN_SHIFT
from sysid.logs.log import Trial, command_in_force
from sysid.logs.replicates import same_course
from sysid.missing.joint_fit import Refit, Start
from sysid.missing.refit import Refitter, without_each
from sysid.missing.signatures import gather, manoeuvre_groups
from sysid.missing.unexplained import _rolled
from sysid.search.result import Progress
from sysid.weighing.posterior import proposals
from sysid.weighing.priors import DEFAULT, Priors
from sysid.weighing.saved_evidence import MOTION, Axis, Effect, Evidence, Point
from whill_mjx.vehicle.specs import VehicleSpec

if TYPE_CHECKING:
    from sysid.verdict.result import Prepared

ITERATIONS = 5
"""Of a nonlinear refit, at most."""
Proposal = tuple[tuple[str, ...], np.ndarray]
"""Keys of a set of effects and the coordinates (k,) where its refit starts."""


class Maker:
    """Evidence of the training trials of one log, and its refits."""

    def __init__(self, ready: Prepared, trials: tuple[Trial, ...], spec: VehicleSpec, name: str = "",
                 progress: Progress | None = None):
        from sysid.missing.catalogue import base_values
        from sysid.missing.drives import make_drives

        reference, self.hypotheses, self.progress = ready.reference, ready.hypotheses, progress
        base = base_values(ready.full)
        values = np.array([base[one] for one in ready.names])
        drives = make_drives(ready.plant, ready.full, ready.names, trials, reference.width, ready.paths)
        at = drives.simulate(values[None])[0]
        self.drives = drives.weighted(at, reference.factors, spec.track)
        gathered, slopes = gather(self.drives, reference, ready.hypotheses, ready.full, progress, pools=False)
        self.refitter = Refitter(self.drives, reference, values, slopes)
        fit = self.refitter.fit((), np.zeros(0))
        self.refitter.renews = False  # its starts are close, and most of the time would go into the base
        shape = self.drives.mask.shape
        self.size = np.sqrt(np.diag(reference.spread))
        residual = fit.residual + fit.jacobian @ (fit.u - reference.u)
        columns = gathered.design[..., gathered.base_size :].reshape(*shape, -1)
        offset, effects, scale = gathered.base_size, [], np.ones(columns.shape[-1])
        wander = np.zeros((columns.shape[-1],) * 2)
        for number, one in enumerate(ready.hypotheses):
            mine = [each for each in gathered.columns if each.hypothesis == number]
            places = tuple(tuple(i - offset for i in each.index) for each in mine)
            for each, place in zip(mine, places, strict=True):
                scale[list(place)] = each.level
                covariance = ready.wander.covariance[gathered.columns.index(each)]
                wander[np.ix_(place, place)] = covariance / each.level**2
            axes = tuple(Axis(a.parameter, a.signed, a.limit, a.dependent) for a in one.axes)
            effects.append(Effect(one.key, one.effect, one.kind, axes, tuple(each.level for each in mine), places))
        groups = np.zeros(len(trials), int)
        for number, group in enumerate(manoeuvre_groups(self.drives)):
            groups[list(group)] = number
        names = [trials[int(np.flatnonzero(groups == g)[0])].manoeuvre for g in range(groups.max() + 1)]
        pool, manoeuvre, day, course = _pool(ready, names, shape[1])
        self.evidence = Evidence(
            tuple(one.name for one in trials), groups, self.drives.courses.of_trial, CHANNELS,
            reference.whitener.scale / np.diag(reference.whitener.inverse), reference.width,
            (self.drives.mask > 0).astype(float), residual.reshape(shape), tuple(reference.space.names),
            (fit.jacobian * self.size).reshape(*shape, -1), reference.spread / np.outer(self.size, self.size),
            tuple(effects), columns * scale, wander, np.stack([motion(one, shape[1], reference.width, spec)
                                                               for one in trials]),
            pool, manoeuvre, day, course, spec.track, about={"log": name})

    def values(self, key: str, q: np.ndarray) -> dict[str, float]:
        """Parameter values of an effect at coordinates q (k,)."""
        base = dict(zip(self.refitter.names, self.refitter.values.tolist(), strict=True))
        return next(one for one in self.hypotheses if one.key == key).values(q, base)

    def refine(self, proposals: Sequence[Proposal], iterations: int = ITERATIONS) -> None:
        """Refit sets of effects, and add the linearisation at each to the evidence."""
        known = {one.key: one for one in self.hypotheses}
        starts = [Start(tuple(known[key] for key in keys), self.refitter.reference.u, np.asarray(q, float))
                  for keys, q in proposals]
        fits = self.refitter.fit_all(starts, iterations)
        have = {point.keys for point in self.evidence.points}
        new = tuple(self._point(fit) for fit in fits if tuple(one.key for one in fit.hypotheses) not in have)
        self.evidence = replace(self.evidence, points=(*self.evidence.points, *new))
        if self.progress is not None:
            self.progress(1, "refits")

    def refine_all(self, priors: Priors = DEFAULT) -> None:
        """Refit all sets that are worth it."""
        while listed := proposals(self.evidence, priors):
            self.refine(listed)

    def _point(self, fit: Refit) -> Point:
        shape, size = self.drives.mask.shape, len(fit.u)
        own = fit.jacobian[..., size:]
        # The base's columns of the evidence serve all points: a refit's own differ from them by what a day changes.
        base = self.evidence.base.reshape(shape[0], -1, size)
        moved = base @ ((fit.u - self.refitter.reference.u) / self.size)
        residual = fit.residual + moved + own @ fit.q
        whole, *less = self.drives.simulate(np.stack([fit.values, *without_each(fit, self.refitter)]))
        responses = np.stack([self.refitter.white(whole - one).reshape(shape) for one in less], axis=-1)
        return Point(tuple(one.key for one in fit.hypotheses), fit.q, residual.reshape(shape),
                     own.reshape(*shape, -1), responses)


def motion(trial: Trial, bins: int, width: float, spec: VehicleSpec) -> np.ndarray:
    """(K, 10) quantities of the motion at the middle of each bin, in the order of `MOTION`."""
    t = (np.arange(bins) + 0.5) * width
    held = np.maximum(command_in_force(trial.command, t), 0)
    command = [trial.command.v[held], trial.command.omega[held]]
    v, omega = command
    if trial.odometry is not None:
        v, omega = (np.interp(t, trial.odometry.t, series) for series in (trial.odometry.v, trial.odometry.omega))
    angle = _rolled(trial, t, spec.track) / spec.wheel_radius
    place = [np.full(bins, np.nan)] * 3
    if trial.ground_truth is not None:
        truth = trial.ground_truth
        place = [np.interp(t, truth.t, series) for series in (truth.x, truth.y, truth.yaw)]
        place[2] = np.mod(place[2] + np.pi, 2 * np.pi) - np.pi
    out = np.stack([(t <= trial.duration).astype(float), v, omega, *command, *np.mod(angle.T, 2 * np.pi), *place], -1)
    assert out.shape[1] == len(MOTION)
    return out


def _pool(ready: Prepared, names: Sequence[str], bins: int) -> tuple[np.ndarray, ...]:
    """White noise (J, K, C) of the reference's drives, their manoeuvres (-1 for others), days and courses."""
    reference = ready.reference
    series = np.zeros((len(reference.leftovers), bins, len(CHANNELS)))
    mask = np.zeros_like(series)
    courses: list[Trial] = []
    course = []
    for number, one in enumerate(reference.leftovers):
        part = (one.series - reference.expected_on_others(one))[:bins]
        series[number, : len(part)], mask[number, : len(part)] = part, one.mask[:bins]
        course.append(_course_of(one.trial, one.day, courses, reference.leftovers))
    manoeuvre = np.array([names.index(one.trial.manoeuvre) if one.trial.manoeuvre in names else -1
                          for one in reference.leftovers])
    day = np.array([one.day for one in reference.leftovers])
    return reference.whitener.apply(series, mask), manoeuvre, day, np.array(course)


def _course_of(trial: Trial, day: int, seen: list[Trial], leftovers: Sequence[object]) -> int:
    """Number of the replicates that a reference drive belongs to."""
    for number, other in enumerate(seen):
        if other is trial or len(same_course((other, trial), BIN_SHIFT)) == 1 and _day_of(other, leftovers) == day:
            return number
    seen.append(trial)
    return len(seen) - 1


def _day_of(trial: Trial, leftovers: Sequence[object]) -> int:
    return next(one.day for one in leftovers if one.trial is trial)  # type: ignore[attr-defined]

"""A set of drives in features: the measured ones, and replays of them with any parameters."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import jax
import numpy as np

from sysid.errors.features import Features, bin_width, make_features
from sysid.errors.noise import BIN_SHIFT, roughness
from sysid.logs.records import Trial
from sysid.logs.replicates import same_course
from sysid.replay.arrays import Quotients, moved
from sysid.replay.cores import on_all_cores
from sysid.replay.records import ODOMETRY, POSE, TURN, Batch, FreeVehicle, Measured, Simulated
from sysid.replay.rollout import PathReplay, make_batch, records_of
from whill_mjx.effects.supply_sag import ROUND
from whill_mjx.vehicle.parameters import get_values, set_values
from whill_mjx.vehicle.types import parameters_of

SESSION, DRAIN = "supply_sag.session", "supply_sag.drain"  # when a drive begins, and what makes that matter
RECORD_DT = 0.025  # s between recorded states: bins of motion are ten times as long


@dataclass(frozen=True)
class Courses:
    """Which trials repeat one another's motion: same commands, same start at rest or in motion.

    Where they start and which way they face does not matter to a vehicle in its own frame, unless something in the
    room does: replicates are simulated once.
    """

    first: np.ndarray  # (U,) one trial of each course
    of_trial: np.ndarray  # (B,) course of each trial
    room: tuple[tuple[int, float], ...]  # that tie the motion to room or session: index and neutral value
    shared: bool  # false where a parameter that is not free does so

    def repeat(self, values: np.ndarray) -> bool:
        """Whether trials of one course repeat one another with these values (P,)."""
        return self.shared and all(values[index] == neutral for index, neutral in self.room)


@dataclass(frozen=True)
class Drives:
    """Trials with their features and a compiled replay over named parameters."""

    trials: tuple[Trial, ...]
    vehicle: FreeVehicle
    paths: PathReplay
    batch: Batch
    courses: Courses
    measured: Measured
    features: Features
    target: np.ndarray  # (B, K, 5) measured features
    weight: np.ndarray | None = None  # (B, K, 5) weights of the bins where not all have the same noise

    @property
    def names(self) -> tuple[str, ...]:
        """Parameters that replays are given."""
        return self.vehicle.names

    @property
    def mask(self) -> np.ndarray:
        """(B, K, 5) weights of the bins, 0 where nothing was measured."""
        return self.features.mask if self.weight is None else self.weight

    @property
    def repeats(self) -> np.ndarray:
        """(B,) number of the drive that each trial repeats: as `courses`, and trials from rest whose commands are the
        same functions of time but were not recorded at the same instants, which each need a replay of their own."""
        numbers = self.courses.of_trial.copy()
        for group in same_course(self.trials, BIN_SHIFT):
            rest = [i for i in group if self.trials[i].start.v == self.trials[i].start.omega == 0.0]
            numbers[rest] = numbers[rest].min(initial=len(numbers))
        return numbers

    @cached_property
    def began(self) -> np.ndarray:
        """(B,) time of the session at which each trial began [s], nan where nothing says it."""
        return session_times(self.trials)

    @cached_property
    def _records(self) -> np.ndarray:
        """(B,) records that a replay of each trial needs: what its course is read for."""
        own = records_of(self.trials, self.vehicle.plant.dt * self.batch.command.shape[2])
        most = np.zeros(len(self.courses.first), int)
        np.maximum.at(most, self.courses.of_trial, own)
        return np.asarray(most[self.courses.of_trial])

    def weighted(self, simulated: np.ndarray, factors: np.ndarray, track: float) -> Drives:
        """The same drives with rough bins, as `simulated` (B, K, 5) shows them, weighted by noise `factors` (4, 5)."""
        level = roughness(simulated, self.features.width, track)
        return replace(self, weight=self.features.mask / factors[level])

    def simulate(self, values: np.ndarray) -> np.ndarray:
        """Features (N, B, K, 5) of replays with values (N, P)."""
        def seen(each: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
            return self.features.of(self._sampled(*each))

        return np.stack(on_all_cores(seen, self._paths(values)))

    def replay(self, values: np.ndarray) -> Simulated:
        """Replays with values (N, P) in the room, at the measurements' times; leaves gain the axis N in front."""
        start = np.asarray(self.batch.start, float)
        first = start[self.courses.first[self.courses.of_trial]]
        every = np.arange(len(self.trials))

        def seen(each: tuple[np.ndarray, np.ndarray]) -> Simulated:
            paths, mine = each
            if len(paths) < len(mine):
                poses = moved(paths[mine][..., POSE], first[:, None], start[:, None])
                paths = np.concatenate([poses, paths[mine][..., POSE.stop :]], axis=-1)
            return self._sampled(paths, every)

        return jax.tree.map(lambda *leaves: np.stack(leaves), *on_all_cores(seen, self._paths(values)))

    def _paths(self, values: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Of each of values (N, P) the paths (U, R + 1, 9) of courses, or of all trials where those do not repeat one
        another, and which of them is that of each trial (B,)."""
        every = np.arange(len(self.trials))
        once = [self.courses.repeat(row) for row in values]
        rows = [self.courses.first if shared else every for shared in once]
        sets = np.repeat(np.arange(len(values)), [len(each) for each in rows])
        drives = np.concatenate(rows)
        paths = self.paths(self._in_session(values[sets], drives), self.batch, drives, self._records)
        parts = np.split(paths, np.cumsum([len(each) for each in rows])[:-1])
        return [(part, self.courses.of_trial if shared else every) for part, shared in zip(parts, once, strict=True)]

    def _in_session(self, values: np.ndarray, drives: np.ndarray) -> np.ndarray:
        """Values (N, P) of one drive each (N,), with the time of the session at which that drive began."""
        if SESSION not in self.names or DRAIN not in self.names:
            return values
        began = self.began[drives]
        known = np.isfinite(began) & (values[:, self.names.index(DRAIN)] != 0)
        out = values.copy()
        out[known, self.names.index(SESSION)] = began[known]
        return out

    def _sampled(self, paths: np.ndarray, of_trial: np.ndarray) -> Simulated:
        """Paths (U, R + 1, 9), of each trial the one of `of_trial` (B,), at the measurements' times."""
        first = paths.shape[1] * of_trial[:, None]
        flat = paths.reshape(-1, paths.shape[2])

        def at(index: Any, weight: Any, columns: slice) -> np.ndarray:
            place = first + np.asarray(index)
            before, after = (flat.take(place + step, axis=0)[..., columns].astype(float) for step in (0, 1))
            with np.errstate(invalid="ignore"):  # a replay that diverged is infinite
                return before + np.asarray(weight)[..., None] * (after - before)

        one = self.batch
        pose = at(one.pose_index, one.pose_weight, POSE)
        odometry = at(one.odometry_index, one.odometry_weight, ODOMETRY)
        gyro = None if one.gyro_index is None else at(one.gyro_index, one.gyro_weight, TURN)
        return Simulated(pose, odometry, paths[of_trial, -1, 8], gyro)  # type: ignore[arg-type]

    def linearised(self, sets: Callable[[np.ndarray], np.ndarray], u: np.ndarray, sizes: np.ndarray
                   ) -> tuple[np.ndarray, np.ndarray]:
        """Features (B, K, 5) at unit coordinates u (P,), and their derivatives (B, K, 5, P) by differences of the given
        sizes. `sets` turns unit coordinates (P,) into values of all replayed parameters."""
        pairs = Quotients.central(u[None], sizes)
        at, slopes = pairs.along(u[None], lambda points: self.simulate(np.stack([sets(point) for point in points])))
        return at[0], slopes[0]

    def of(self, trials: tuple[Trial, ...]) -> Drives:
        """Other trials through the same compiled replay."""
        return make_drives(self.vehicle, trials, self.features.width, self.paths, self.features.gyro is not None)


def session_times(trials: Sequence[Trial]) -> np.ndarray:
    """(B,) times of the session at which trials began [s]: in the middle of the round of replicates that a name counts.

    A name counts rounds where all drives of its manoeuvre have the same commands and are numbered, such as circle_1 to
    circle_3. A date, or the running number of a recording, does not: nan.
    """
    began, alike = np.full(len(trials), np.nan), Counter(trial.manoeuvre for trial in trials)
    for group in same_course(trials):
        manoeuvre = trials[group[0]].manoeuvre
        found = [re.fullmatch(re.escape(manoeuvre) + r"_(\d{1,2})", trials[i].name) for i in group]
        rounds = [int(one.group(1)) for one in found if one]
        if len(rounds) == len(group) == alike[manoeuvre] and (len(group) > 1 or rounds == [1]):
            began[group] = (np.array(rounds) - 0.5) * ROUND
    return began


def make_drives(vehicle: FreeVehicle, trials: tuple[Trial, ...], width: float | None = None,
                paths: PathReplay | None = None, gyro: bool | None = None) -> Drives:
    """Drives of trials, replayed with the free parameters of a vehicle.

    `width`: of the bins [s]; by default what the outside poses allow (`bin_width`).
    `paths`: the compiled replay of earlier drives of the same vehicle.
    `gyro`: whether a gyro is a channel; by default where a trial has one.
    """
    if gyro is False:
        trials = tuple(trial if trial.gyro is None else replace(trial, gyro=None) for trial in trials)
    params, names = vehicle.params, vehicle.names
    batch, measured = make_batch(trials, vehicle.plant.dt, RECORD_DT)
    neutral = {f"{effect.name}.{field}": about.neutral for effect in getattr(params, "effects", ())
               if effect.room_fixed for field, about in parameters_of(effect).items()}
    held = [name for name in neutral if name not in names]
    shared = all(float(get_values(params, [name])[0]) == neutral[name] for name in held)
    room = tuple((names.index(name), neutral[name]) for name in neutral if name in names)
    if DRAIN in names and SESSION in names:
        room += ((names.index(DRAIN), 0.0),)
    courses = _courses(batch, room, shared)
    features = make_features(trials, bin_width(trials) if width is None else width, gyro)
    paths = paths or PathReplay(vehicle.plant, lambda values: set_values(params, names, values))
    return Drives(trials, vehicle, paths, batch, courses, measured, features, features.of(measured))


def _courses(batch: Batch, room: tuple[tuple[int, float], ...], shared: bool) -> Courses:
    """Trials of a batch with the same commands and the same speeds at the start."""
    keys = [command.tobytes() + start[3:].tobytes()
            for command, start in zip(np.asarray(batch.command), np.asarray(batch.start), strict=True)]
    numbers = {key: number for number, key in enumerate(dict.fromkeys(keys))}
    first, of_trial = [keys.index(key) for key in numbers], [numbers[key] for key in keys]
    return Courses(np.array(first), np.array(of_trial), room, shared)

"""Derivatives of a replay by differences over a share of each parameter's range.

Skidding wheels, torque limits and sampled delays make a motion rough: the mean slope shows where it goes, the
derivative at one point need not. Forward mode through a contact solver, which switches between sticking and sliding,
means nothing. Searches by differences end at about the same costs in a fraction of the time: replays of many sets fill
vectors, tangents do not.

Where a vehicle starts and which way it faces does not matter to its motion in its own frame, unless an effect is tied
to the room. Trials with the same commands and start speeds are therefore one course: it is replayed from the origin,
with its derivatives, then moved to the start of each trial and read at that trial's own times.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import jax
import numpy as np

from sysid.errors.pose_objective import Replays
from sysid.errors.space import STEP, Space
from sysid.logs.records import Trial
from sysid.replay import pieces
from sysid.replay.arrays import Quotients, namespace
from sysid.replay.cores import on_all_cores, on_processor
from sysid.replay.models import Parameters, set_parameters
from sysid.replay.on_host import HostReplay
from sysid.replay.records import ODOMETRY, POSE, TURN, Measured, Plant, Simulated
from sysid.replay.rollout import PathReplay, Replay, make_batch, records_of, sent

AROUND = 0.1  # s, over which the speeds at the begin of a piece are averaged


class CourseReplay:
    """`sysid.replay.rollout.Replay` of trials, with as many drives as there are courses; `courses` is their number."""

    def __init__(self, plant: Plant, trials: tuple[Trial, ...], set_values: Callable[[jax.Array], Any],
                 anywhere: bool = True, paths: PathReplay | None = None):
        """`set_values` turns values (P,) into the vehicle's parameters. Unless the motion is the same `anywhere` in the
        room, every trial is a course. `paths`: compiled programs of the same plant and `set_values`."""
        batch, self.measured = make_batch(trials, plant.dt)
        command, start = np.asarray(batch.command), np.asarray(batch.start, float)
        self._anywhere, self._dt, self._record = anywhere, plant.dt, plant.dt * command.shape[2]
        seen: dict[bytes, int] = {}
        keys = [command[i].tobytes() + start[i, 3 if anywhere else 0 :].tobytes() for i in range(len(trials))]
        self._course = np.array([seen.setdefault(key, len(seen)) for key in keys])  # (B,)
        first = np.array([keys.index(key) for key in seen])
        self.courses = len(first)
        own = records_of(trials, self._record)
        self._records = np.array([own[self._course == course].max() for course in range(self.courses)])
        # Poses are moved from the start of the course to that of the trial.
        from_start = start[first] * ([0, 0, 0, 1, 1] if anywhere else [1, 1, 1, 1, 1])
        self._from, self._to = from_start[self._course, :3], start[:, :3]
        records = command.shape[1]
        every = np.tile(np.minimum(np.arange(records + 1), records - 1), (self.courses, 1))
        last = np.tile((np.arange(records + 1) == records).astype(float), (self.courses, 1))
        self._times = {"pose": (np.asarray(batch.pose_index), np.asarray(batch.pose_weight, float)),
                       "odometry": (np.asarray(batch.odometry_index), np.asarray(batch.odometry_weight, float))}
        if batch.gyro_index is not None:
            self._times["gyro"] = np.asarray(batch.gyro_index), np.asarray(batch.gyro_weight, float)
        ends = {"index": sent(every), "weight": sent(last)}
        read: dict[str, Any] = {f"{name}_{what}": one for name in self._times for what, one in ends.items()}
        whole = replace(batch, command=sent(command[first]), start=sent(from_start), **read)
        kind: Any = HostReplay if plant.host is not None and on_processor() else Replay
        self._replay = kind(plant, whole, set_values)
        self.paths = paths or PathReplay(plant, set_values)
        self._traced, self.drives, self.states = self._replay, self.courses, self.courses * records
        self._trials = [trials[i] for i in first]

    @cached_property
    def in_pieces(self) -> CourseReplay:
        """The same with drives in pieces side by side, if they are long, start at rest and may be anywhere."""
        batch = self._replay.batch
        records, step = batch.command.shape[1], self._record
        count = pieces.count(records * step)
        if count < 2 or batch.warm_up or not self._anywhere or isinstance(self._replay, HostReplay):
            return self
        times = pieces.begins(records, count) * step - pieces.OVERLAP
        speeds = np.stack([speeds_at(trial, times) for trial in self._trials])
        other = copy(self)
        other._traced = self._replay.on(replace(batch, speeds=sent(speeds)))
        other.drives = count * self.courses
        return other

    def simulate(self, values: np.ndarray) -> Simulated:
        """Replay of all trials with each of values (N, P); leaves gain the axis N in front."""
        if isinstance(self._replay, HostReplay):
            return self._spread(self._replay.simulate(values))
        if not on_processor():
            size = max(len(values), 2 * values.shape[1] + 1)  # a single one and a Jacobian's are compiled together
            return self._spread(self._replay.simulate(values, size))
        sets, courses = len(values), self.courses
        paths = self.paths(np.repeat(values, courses, axis=0), self._replay.batch, np.tile(np.arange(courses), sets),
                           self._records)
        paths = paths.reshape(sets, courses, *paths.shape[1:])
        turned = paths[..., TURN] if self._replay.batch.gyro_index is not None else None
        path = Simulated(paths[..., POSE], paths[..., ODOMETRY], paths[:, :, -1, 8], turned)  # type: ignore[arg-type]
        # One by one: memory of many at once would be fetched from the system each time.
        each = on_all_cores(lambda n: self._spread(jax.tree.map(lambda leaf: leaf[n : n + 1], path)), range(sets))
        return jax.tree.map(lambda *leaves: np.concatenate(leaves), *each)

    def compile(self, parameters: int, trials: tuple[Trial, ...]) -> None:
        """Begin to compile what a processor needs to replay drives as long as these trials by so many parameters."""
        if not isinstance(self._replay, HostReplay):
            self.paths.compile(parameters, make_batch(trials, self._dt)[0])

    def traced(self, values: jax.Array) -> Simulated:
        """As `simulate`, within a compiled function."""
        return self._spread(self._traced.traced(values))

    def _spread(self, simulated: Simulated) -> Simulated:
        """Courses (N, U, R + 1, ...) at the trials' times (N, B, M, ...)."""
        xp = namespace(simulated.pose)
        pose, odometry, *gyro = (self._at(name, xp.asarray(getattr(simulated, name))) for name in self._times)
        diverged: Any = simulated.diverged[:, self._course]
        turn = self._to[:, 2:] - self._from[:, 2:]  # (B, 1)
        x, y, yaw = pose[..., 0] - self._from[:, :1], pose[..., 1] - self._from[:, 1:2], pose[..., 2] + turn
        cos, sin = np.cos(turn), np.sin(turn)
        placed: Any = xp.stack([cos * x - sin * y + self._to[:, :1], sin * x + cos * y + self._to[:, 1:2], yaw], axis=3)
        return Simulated(placed, odometry, diverged, *gyro)

    def _at(self, name: str, values: Any) -> Any:
        """Values (N, U, R + 1, C) of courses at the trials' times (N, B, M, C)."""
        xp, (index, weight) = namespace(values), self._times[name]
        flat = values.reshape(len(values), -1, values.shape[3])
        rows = self._course[:, None] * values.shape[2] + index
        before, after = (xp.take(flat, one, axis=1) for one in (rows, rows + 1))  # ten times as fast as by two indices
        return before + weight[..., None] * (after - before)


def make_courses(plant: Plant, trials: tuple[Trial, ...], set_values: Callable[[jax.Array], Any],
                 params: Any, paths: PathReplay | None = None) -> tuple[CourseReplay, Measured]:
    """Replay of trials of a vehicle with `params`, and what was measured; `paths` as of `CourseReplay`."""
    tied = any(getattr(effect, "room_fixed", True) for effect in params.effects)
    replay = CourseReplay(plant, trials, set_values, not tied, paths)
    return replay, replay.measured


@dataclass(frozen=True)
class DifferenceReplay:
    """A replay whose Jacobian is that of central differences, one-sided at a bound: 2 P + 1 drives of each course."""

    replay: CourseReplay
    space: Space

    @cached_property
    def compiled(self) -> dict[Any, Any]:
        """What `sysid.errors.normal_equations` compiled of it."""
        return {}

    @property
    def drives(self) -> int:
        """Of one set, side by side."""
        return self.replay.drives

    @property
    def states(self) -> int:
        """That are recorded of one set."""
        return self.replay.states

    @cached_property
    def in_pieces(self) -> DifferenceReplay:
        """The same with long drives in pieces side by side (`sysid.replay.pieces`) where it is traced."""
        pieces = self.replay.in_pieces
        return self if pieces is self.replay else replace(self, replay=pieces)

    def compile(self, trials: tuple[Trial, ...]) -> None:
        """Begin to compile what replays of trials as long as these need on a processor."""
        self.replay.compile(self.space.size, trials)

    def simulate(self, values: np.ndarray) -> Simulated:
        return self.replay.simulate(values)

    def traced(self, values: jax.Array) -> Simulated:
        """As `simulate`, within a compiled function."""
        return self.replay.traced(values)

    def jacobian(self, values: np.ndarray) -> tuple[Simulated, Simulated]:
        """Replay and derivatives (a last axis P) for each of values (N, P)."""
        pairs = Quotients.central(self.space.to_unit(values), STEP).mapped(self.space.to_values)
        return pairs.along(values, self.replay.simulate)


def make_replay(
    plant: Plant, params: Any, space: Space, trials: tuple[Trial, ...], like: Replays | None = None
) -> tuple[Replays, Measured]:
    """Replay of trials with the space's parameters, the others as in `params`, and what was measured.

    `like`: another replay of this plant, space and vehicle, whose compiled programs serve here too.
    """
    paths = like.replay.paths if isinstance(like, DifferenceReplay) else None

    def put(values: jax.Array) -> Any:
        return set_parameters(params, space.names, values)

    if not isinstance(params, Parameters):
        courses, measured = make_courses(plant, trials, put, params, paths)
    else:
        courses = CourseReplay(plant, trials, put, anywhere=not params.room_fixed, paths=paths)
        measured = courses.measured
    return DifferenceReplay(courses, space), measured


def speeds_at(trial: Trial, times: np.ndarray) -> np.ndarray:
    """(W, 2) speeds that the odometry reports at times (W,) of a trial, or those commanded where it reports none."""
    found = trial.commanded(times).T
    found[times <= 0] = trial.start.v, trial.start.omega
    if trial.odometry is not None:
        for i, time in enumerate(times):
            near = np.abs(trial.odometry.t - time) < AROUND
            if time > 0 and near.any():
                found[i] = trial.odometry.v[near].mean(), trial.odometry.omega[near].mean()
    return found

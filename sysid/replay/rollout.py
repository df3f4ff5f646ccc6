"""Open-loop replay of a log, batched over trials and parameter sets: the only compiled entry point of this package.

Commands are resampled to the physics grid (each holds until the next), trials are padded to one length with masks, the
motion is recorded every few steps and interpolated at the measurements' times. The vehicle is a few functions of one
instance (`Plant`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sysid.logs.records import GyroStream, OdometryStream, PoseStream, Prediction, Trial
from sysid.replay.arrays import quaternion_product
from sysid.replay.cores import Compiled, on_all_cores, on_processor
from sysid.replay.delays import delay_apart
from sysid.replay.one_drive import (
    IN_ONE,
    WARM_UP,
    Commanded,
    advance,
    as_sensed,
    begun_drive,
    from_reference,
    own_effects,
    path_of,
    simulate_one,
)  # fmt: skip
from sysid.replay.records import RECORD_DT, Batch, Measured, Plant, Simulated
from whill_mjx.processor import as_one_function
from whill_mjx.vehicle.config import VehicleConfig
from whill_mjx.vehicle.specs import VehicleSpec

ROWS = 96
"""Drives that a core replays together: a step has as many loops for a few drives as for many. By drive 32 take twice as
long and 160 nearly as long, but searches often try four parameter sets at once, on eight courses."""
ACCELERATED = 8192  # the same on an accelerator, which takes nearly as long for one
FETCHED = 512  # rows by which what an accelerator sends back grows: each size is compiled once
BEYOND = 0.5  # s that a drive is replayed beyond its last measurement, of which late time stamps show a part
ROOMS = (512, 1024, 2048, 4096)
"""Records for which one program has room, up to 41 s; longer drives have programs for multiples of the last."""


def vehicle_plant(spec: VehicleSpec, config: VehicleConfig | None = None) -> Plant:
    """The simulator's vehicle as a `Plant`; its parameters are `VehicleParams`."""
    from whill_mjx.vehicle.dynamics import place, record, substep, substeps
    from whill_mjx.vehicle.kinematics import quaternion_from_angles, reference_pose
    from whill_mjx.vehicle.model import build_model

    config = replace(config or VehicleConfig(), limited=False)  # a log has commands that the vehicle took
    model = build_model(spec, config)

    def observe(state: Any) -> jax.Array:
        odometry = state.odometry
        return jnp.stack([*reference_pose(model, state.qpos), odometry.x, odometry.y, odometry.yaw, odometry.v,
                          odometry.omega, state.diverged.astype(state.qpos.dtype)])

    def move(state: Any, start: jax.Array) -> Any:
        x, y, yaw = reference_pose(model, state.qpos)
        turn = start[2] - yaw
        cos, sin = jnp.cos(turn), jnp.sin(turn)

        def rotate(a: jax.Array, b: jax.Array) -> jax.Array:
            return jnp.stack([cos * a - sin * b, sin * a + cos * b])

        origin = start[:2] + rotate(state.qpos[0] - x, state.qpos[1] - y)
        attitude = quaternion_product(quaternion_from_angles(0 * turn, 0 * turn, turn), state.qpos[3:7])
        qpos = jnp.concatenate([origin, state.qpos[2:3], attitude, state.qpos[7:]])
        qvel = jnp.concatenate([rotate(state.qvel[0], state.qvel[1]), state.qvel[2:]])
        zero = jnp.zeros_like(turn)
        encoder, odometry = (one.replace(x=zero, y=zero, yaw=zero) for one in (state.encoder, state.odometry))
        return state.replace(qpos=qpos, qvel=qvel, encoder=encoder, odometry=odometry)

    def at(params: Any, start: jax.Array) -> Any:
        x, y, yaw, v, omega = start
        return place(model, params, x, y, yaw, (v, omega))

    return Plant(at,
                 lambda params, state, command: substep(model, params, state, command), observe,
                 config.physics_dt, move,
                 lambda params, state, commands: substeps(model, params, state, commands),
                 lambda params, state, commands: record(model, params, state, commands, observe), arithmetic=True)


def make_batch(trials: tuple[Trial, ...], dt: float, record_dt: float = RECORD_DT) -> tuple[Batch, Measured]:
    """Resample and pad trials; ValueError when there is none."""
    if not trials:
        raise ValueError("no trials to simulate. Check the selections of training and held-out trials.")
    stride = max(round(record_dt / dt), 1)
    record = stride * dt
    records = int(records_of(trials, record).max())
    middles = (np.arange(records * stride) + 0.5) * dt  # of the physics steps, in which what is in force then acts
    command = np.stack([trial.commanded(middles).T for trial in trials])
    start = np.array([[t.start.x, t.start.y, t.start.yaw, t.start.v, t.start.omega] for t in trials])
    pose_t, pose, pose_mask = padded([trial.ground_truth for trial in trials], 3)
    odometry_t, odometry, odometry_mask = padded([trial.odometry for trial in trials], 5)
    pose_index, pose_weight = _grid(pose_t, record, records)
    odometry_index, odometry_weight = _grid(odometry_t, record, records)
    batch = Batch(sent(command.reshape(len(trials), records, stride, 2)), sent(start), sent(pose_index),
                  sent(pose_weight), sent(odometry_index), sent(odometry_weight),
                  warm_up=round(WARM_UP / dt) if start[:, 3:].any() else 0)
    if all(trial.gyro is None for trial in trials):
        return batch, Measured(pose, pose_mask, odometry, odometry_mask)
    gyro_t, gyro, gyro_mask = padded([trial.gyro for trial in trials], 1)
    gyro_index, gyro_weight = _grid(gyro_t, record, records)
    batch = replace(batch, gyro_index=sent(gyro_index), gyro_weight=sent(gyro_weight))
    return batch, Measured(pose, pose_mask, odometry, odometry_mask, gyro, gyro_mask, gyro_t)


def records_of(trials: Sequence[Trial], record: float) -> np.ndarray:
    """(B,) how many records, `record` seconds apart, each trial lasts."""
    return np.array([math.ceil(trial.duration / record - 1e-6) + 1 for trial in trials])


def sent(array: np.ndarray) -> jax.Array:
    """A copy with JAX's usual precision on its device; `jnp.asarray` would compile a program for each shape."""
    return jax.device_put(array.astype(jnp.result_type(float if array.dtype.kind == "f" else int)))


def simulate(plant: Plant, params: Any, batch: Batch) -> Simulated:
    """Replay all trials of a batch with one parameter set. Differentiable in forward mode."""
    return jax.vmap(lambda one: simulate_one(plant, params, one))(batch)


class Replay:
    """Compiled replay of one batch for many parameter sets: `values` (N, P) go in, host arrays come out.

    A call with fewer sets than an earlier one is padded to that size instead of compiled again.
    """

    def __init__(self, plant: Plant, batch: Batch, set_values: Callable[[jax.Array], Any]):
        """`set_values` turns values (P,) into the vehicle's parameters."""

        def rows(values: jax.Array, batch: Batch, directions: int = 1) -> Simulated:
            """Each set on each trial, in one row of instances: loops over a single axis fill a processor's vectors."""
            sets, trials = len(values), len(batch.start)
            few = sets * trials * directions <= IN_ONE and batch.speeds is None

            def tiled(leaf: jax.Array) -> jax.Array:
                return jnp.tile(leaf, (sets, *(1,) * (leaf.ndim - 1)))

            one = jax.vmap(lambda value, trial: simulate_one(plant, set_values(value), trial, few))
            found = one(jnp.repeat(values, trials, axis=0), jax.tree.map(tiled, batch))
            return jax.tree.map(lambda leaf: leaf.reshape(sets, trials, *leaf.shape[1:]), found)

        def jacobian(values: jax.Array, batch: Batch) -> tuple[Simulated, Simulated]:
            """Values and their derivatives along each parameter: forward mode, directions batched."""
            tangents = jnp.eye(values.shape[1], dtype=values.dtype)

            def along(tangent: jax.Array) -> tuple[Simulated, Simulated]:
                return jax.jvp(lambda v: rows(v, batch, len(tangents)), (values,),
                               (jnp.broadcast_to(tangent, values.shape),))

            return jax.vmap(along, out_axes=(None, -1))(tangents)

        self.batch = batch
        self._simulate, self._jacobian = jax.jit(rows), jax.jit(jacobian)
        self._sizes: dict[Any, set[int]] = {self._simulate: set(), self._jacobian: set()}

    def on(self, batch: Batch) -> Replay:
        """The same replay of another batch; nothing is compiled again where its shapes are the same."""
        other = object.__new__(Replay)
        other.__dict__ = {**self.__dict__, "batch": batch}
        return other

    def simulate(self, values: np.ndarray, size: int | None = None) -> Simulated:
        """Replay with each of values (N, P); leaves gain the axis N in front. `size`: rows that are computed."""
        return self._call(self._simulate, values, size)

    def traced(self, values: jax.Array) -> Simulated:
        """As `simulate`, within a compiled function."""
        return self._simulate(values, self.batch)

    def jacobian(self, values: np.ndarray) -> tuple[Simulated, Simulated]:
        """Replay and derivatives (a last axis P) for each of values (N, P)."""
        return self._call(self._jacobian, values)

    def _call(self, function: Any, values: np.ndarray, size: int | None = None) -> Any:
        count = len(values)
        sizes = self._sizes[function]
        size = size or min((size for size in sizes if size >= count), default=count)
        sizes.add(size)
        padded = np.concatenate([values, np.repeat(values[-1:], size - count, axis=0)])
        output = function(jnp.asarray(padded, jnp.result_type(float)), self.batch)
        return jax.tree.map(lambda leaf: np.asarray(leaf)[:count], output)


def predictions(trials: tuple[Trial, ...], simulated: Simulated, row: int | None = None) -> list[Prediction]:
    """Per trial what `metrics.score` compares, from the padded arrays of a set: that of a row of the axis N, if any."""
    simulated = simulated if row is None else jax.tree.map(lambda leaf: leaf[row], simulated)
    results = []
    for i, trial in enumerate(trials):
        truth = odometry = None
        if trial.ground_truth is not None:
            pose = np.asarray(simulated.pose[i, : len(trial.ground_truth.t)], float)
            truth = PoseStream(trial.ground_truth.t, *pose.T)
        if trial.odometry is not None:
            table = np.asarray(simulated.odometry[i, : len(trial.odometry.t)], float)
            odometry = OdometryStream(trial.odometry.t, *table.T)
        gyro = None
        if trial.gyro is not None and simulated.gyro is not None:
            gyro = GyroStream(trial.gyro.t, np.asarray(simulated.gyro[i, : len(trial.gyro.t), 0], float))
        results.append(Prediction(truth, odometry, gyro))
    return results


class _Programs:
    """`path_of` for rows of drives in three programs; the large one serves drives of any length (`ROOMS`)."""

    def __init__(self, plant: Plant, set_values: Callable[[jax.Array], Any], rows: int):
        in_one = as_one_function if rows <= IN_ONE and plant.arithmetic else lambda function: function

        def begin(values: jax.Array, command: jax.Array, start: jax.Array, warm_up: int) -> tuple[Any, jax.Array]:
            params = set_values(values)
            start = from_reference(params, start)
            state, command = begun_drive(plant, own_effects(plant, params), command, start, warm_up)
            room = next((room for room in ROOMS if room >= len(command)), -(-len(command) // ROOMS[-1]) * ROOMS[-1])
            spare = jnp.zeros((room - len(command), *command.shape[1:]), command.dtype)
            return state, jnp.concatenate([command, spare])

        def drive(values: jax.Array, state: Any, command: jax.Array, count: jax.Array, own: jax.Array) -> jax.Array:
            vehicle, _ = delay_apart(own_effects(plant, set_values(values)))
            first = plant.observe(state)
            path = jnp.concatenate([first[None], jnp.zeros((len(command), len(first)), first.dtype)])

            def after(number: jax.Array, carry: tuple[Any, jax.Array]) -> tuple[Any, jax.Array]:
                state, path = carry
                state = advance(plant, vehicle, state, command[number])
                return state, path.at[number + 1].set(plant.observe(state))

            def steps(state: Any, path: jax.Array, count: jax.Array) -> jax.Array:
                return jax.lax.fori_loop(0, count, after, (state, path))[1]

            path = in_one(steps)(state, path, count)
            return jnp.where(jnp.arange(len(path))[:, None] > own, path[own], path)  # it stays where it ended

        def finish(values: jax.Array, path: jax.Array, command: jax.Array, start: jax.Array, gyro: bool) -> jax.Array:
            params = set_values(values)
            commanded = Commanded(command, from_reference(params, start))
            return as_sensed(plant, params, commanded, path[: len(command) + 1], gyro)

        self._begin = Compiled(jax.vmap(begin, in_axes=(0, 0, 0, None)), static=1)
        self._drive = Compiled(jax.vmap(drive, in_axes=(0, 0, 0, None, 0)))
        self._finish = Compiled(jax.vmap(finish, in_axes=(0, 0, 0, 0, None)), static=1)
        self._observe = jax.vmap(plant.observe)

    def compile(self, values: Any, command: Any, start: Any, warm_up: int, gyro: bool) -> None:
        """Begin to compile all three, side by side, for arguments of these shapes."""
        state, held = self._begin.shapes(values, command, start, warm_up)
        seen = jax.eval_shape(self._observe, state)
        path = jax.ShapeDtypeStruct((held.shape[0], held.shape[1] + 1, seen.shape[1]), seen.dtype)
        counts = (jax.ShapeDtypeStruct(shape, jnp.int32) for shape in ((), held.shape[:1]))
        self._drive.compile(values, state, held, *counts)
        self._finish.compile(values, path, command, start, gyro)
        self._begin.compile(values, command, start, warm_up)

    def __call__(
        self, values: np.ndarray, command: np.ndarray, start: np.ndarray, warm_up: int, gyro: bool, records: np.ndarray
    ) -> Any:
        """Paths (N, R + 1, C) of sets (N, P) and drives with commands (N, R, K, 2) from starts (N, 5), each of which
        ends after its number of `records` (N,) and stays there."""
        state, held = self._begin(values, command, start, warm_up)
        path = self._drive(values, state, held, records.max(), records)
        return self._finish(values, path, command, start, gyro)


class PathReplay:
    """Compiled `path_of` for rows of a fixed number: each row is a parameter set on one trial of a batch.

    It is compiled once for all batches; on an accelerator, for those of the same length.
    """

    def __init__(self, plant: Plant, set_values: Callable[[jax.Array], Any], rows: int | None = None):
        rows, self._dt = rows or (ROWS if on_processor() else ACCELERATED), plant.dt

        def one(values: jax.Array, command: jax.Array, start: jax.Array, warm_up: int, gyro: bool) -> jax.Array:
            return path_of(plant, set_values(values), Commanded(command, start, warm_up), rows <= IN_ONE, gyro)

        self.rows, self._begun = rows, set[Any]()
        self._run: Any = _Programs(plant, set_values, rows) if on_processor() else jax.jit(
            jax.vmap(one, in_axes=(0, 0, 0, None, None)), static_argnums=(3, 4))

    def compile(self, parameters: int, batch: Batch) -> None:
        """Begin to compile what sets of so many parameters need on a processor, for drives as long as the batch's."""
        shapes = (parameters,), batch.command.shape[1:], batch.start.shape[1:]
        warm_up, gyro = batch.warm_up, batch.gyro_index is not None
        if (shapes, warm_up, gyro) not in self._begun and isinstance(self._run, _Programs):
            self._begun.add((shapes, warm_up, gyro))
            values, command, start = (jax.ShapeDtypeStruct((self.rows, *shape), jnp.result_type(float))
                                      for shape in shapes)
            self._run.compile(values, command, start, warm_up, gyro)

    def __call__(
        self, values: np.ndarray, batch: Batch, trials: np.ndarray, records: np.ndarray | None = None
    ) -> np.ndarray:
        """Paths (N, R + 1, 9) of sets (N, P), each on the trial of `batch` that trials (N,) names.

        `records`: how many of its R records (`records_of`) each trial of the batch needs, by default all of them. A
        processor then replays drives of about one length together, and none for much longer than it needs.
        """
        if on_processor():
            return self._on_cores(values, batch, trials, records)
        count = len(values)
        spare = -count % self.rows
        values, trials = _filled(values.astype(jnp.result_type(float)), spare), _filled(trials, spare)
        # Commands are much larger than the rest: an accelerator gets them once.
        command, start = (jnp.asarray(one) for one in (batch.command, batch.start))

        def part(first: int) -> jax.Array:
            chosen = trials[first : first + self.rows]
            return self._run(values[first : first + self.rows], command[chosen], start[chosen], batch.warm_up,
                             batch.gyro_index is not None)

        # It computes while rows are sent and fetched; most of the spare ones stay there.
        begun = [part(first) for first in range(0, len(values), self.rows)]
        begun[-1] = begun[-1][: self.rows - spare // FETCHED * FETCHED]
        return np.concatenate([np.asarray(paths) for paths in begun])[:count]

    def _on_cores(self, values: np.ndarray, batch: Batch, trials: np.ndarray, records: np.ndarray | None) -> np.ndarray:
        """Replay on a processor: the longest drives first, as many at once as one program takes."""
        values = values.astype(jnp.result_type(float))
        command, start = np.asarray(batch.command), np.asarray(batch.start)
        longest, gyro = command.shape[1], batch.gyro_index is not None
        beyond = math.ceil(BEYOND / (self._dt * command.shape[2]))
        needed = np.full(len(trials), longest) if records is None else np.minimum(records + beyond, longest)[trials]
        order = np.argsort(-needed, kind="stable")
        self.compile(values.shape[1], batch)

        def part(first: int) -> np.ndarray:
            mine = order[first : first + self.rows]
            filled = _filled(mine, self.rows - len(mine))
            found = self._run(values[filled], command[trials[filled]], start[trials[filled]], batch.warm_up, gyro,
                              needed[filled].astype(np.int32))
            return np.asarray(found)[: len(mine)]

        firsts = range(0, len(values), self.rows)
        parts = on_all_cores(part, firsts)
        paths = np.empty((len(values), *parts[0].shape[1:]), parts[0].dtype)

        def put(number: int) -> None:
            paths[order[firsts[number] : firsts[number] + self.rows]] = parts[number]

        on_all_cores(put, range(len(parts)))
        return paths


def _filled(rows: np.ndarray, spare: int) -> np.ndarray:
    """Rows (N, ...) and the last one as often again as there are spare ones."""
    return np.concatenate([rows, np.repeat(rows[-1:], spare, axis=0)])


def _grid(t: np.ndarray, record: float, records: int) -> tuple[np.ndarray, np.ndarray]:
    index = np.clip(np.floor(t / record + 1e-9).astype(int), 0, records - 1)
    return index, np.clip(t / record - index, 0.0, 1.0)


def padded(
    streams: Sequence[PoseStream | OdometryStream | GyroStream | None], columns: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times (B, M), values (B, M, C) and mask (B, M, C) of streams of different length; nan values are masked."""
    tables = [(np.zeros(0), np.zeros((0, columns))) if one is None else (one.t, one.values) for one in streams]
    longest = max(max(len(t) for t, _ in tables), 1)
    width = tables[0][1].shape[1]
    time = np.zeros((len(tables), longest))
    values, mask = np.zeros((len(tables), longest, width)), np.zeros((len(tables), longest, width))
    for i, (t, table) in enumerate(tables):
        time[i, : len(t)] = t
        known = np.isfinite(table)
        values[i, : len(t)] = np.where(known, table, 0.0)
        mask[i, : len(t)] = known
    return time, values, mask

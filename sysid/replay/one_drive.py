"""The replay of one drive: from its start, by the vehicle, to what sensors report of it.

A trial that starts in motion first drives a while at the start's wheel speeds, so that controller, delays and slip are
those of a vehicle under way, and is then moved to the start pose.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sysid.replay import pieces
from sysid.replay.cores import on_processor
from sysid.replay.delays import delay_apart, delayed, framed, late, reached, without
from sysid.replay.records import ODOMETRY, POSE, SPEEDS, TURN, YAW_COLUMNS, Batch, Plant, Simulated
from whill_mjx.effects.base import act
from whill_mjx.effects.odometry_lag import OdometryLag
from whill_mjx.effects.sensor_delay import SensorDelay
from whill_mjx.processor import as_one_function

WARM_UP = 1.5  # s of driving at the start speeds before a trial that starts in motion
WARM_UP_GAIN = 3.0  # 1/s, of the correction that brings the odometry to the start speeds in that time
IN_ONE = 256
"""Drives at most that one function computes: with 128 it takes 0.7 ms for each of 22 s where many functions take 1.1,
with 512 they take 1.5 and 0.8, for those divide loops among the cores; within one XLA fails to (seen with 1024)."""
UNROLLED = 2  # steps between records at most that `Plant.record` takes: compiling it takes as long as it has steps


class Commanded(NamedTuple):
    """One drive that is to be replayed."""

    command: jax.Array  # (R, K, 2) in force in each of K physics steps between records [m/s, rad/s]
    start: jax.Array  # (5,) x, y, yaw, v, omega
    warm_up: int = 0  # physics steps at the start's speeds before it
    speeds: jax.Array | None = None  # (W, 2) where pieces begin, to replay it in these (`sysid.replay.pieces`)


def path_of(plant: Plant, params: Any, commanded: Commanded, few: bool = False, gyro: bool = False) -> jax.Array:
    """States (R + 1, 9) at the records, as `Plant.observe` gives them, of one drive; with a gyro's turn [rad] (R + 1,
    10).

    `few`: `IN_ONE` drives at most are computed side by side: by one function, if the plant is `arithmetic`.
    """
    commanded = commanded._replace(start=from_reference(params, commanded.start))
    path = _driven(plant, own_effects(plant, params), commanded, few)
    return as_sensed(plant, params, commanded, path, gyro)


def own_effects(plant: Plant, params: Any) -> Any:
    """The vehicle without effects that `as_sensed` applies to the whole drive."""
    params, _ = without(params, SensorDelay.name)
    return without(params, OdometryLag.name)[0] if plant.frame else params


def from_reference(params: Any, start: jax.Array) -> jax.Array:
    """Where (5,) the vehicle's reference point starts; logs give that of a tracked point."""
    for effect in getattr(params, "effects", ()):
        if hasattr(effect, "reference"):
            start = effect.reference(start)
    return start


def as_sensed(plant: Plant, params: Any, commanded: Commanded, path: jax.Array, gyro: bool) -> jax.Array:
    """What sensors make of the states (R + 1, 9) of a drive; arguments as of `path_of`."""
    params, latency = without(params, SensorDelay.name)
    params, lag = without(params, OdometryLag.name) if plant.frame else (params, None)
    gap = plant.dt * commanded.command.shape[1]
    turns = jax.lax.stop_gradient(_turns(commanded.start[2] - path[0, 2]))
    for column in YAW_COLUMNS:
        path = path.at[:, column].set(_unwrap(path[:, column]))
    if lag is not None and plant.frame:
        path = path.at[:, SPEEDS].set(framed(path[:, SPEEDS], lag.time_constant, plant.frame, gap))
    turned = path[:, 2]
    for effect in getattr(params, "effects", ()):
        if hasattr(effect, "turned"):
            turned = effect.turned(turned, gap)
    if latency is not None:
        path = path.at[:, ODOMETRY].set(late(path[:, ODOMETRY], latency, gap))
    for effect in getattr(params, "effects", ()):
        if hasattr(effect, "outside"):
            path = path.at[:, POSE].set(act(effect, "outside", (), path[:, POSE], gap)[1])
    # The measured yaw may count full turns from another origin than the simulated one.
    path = path.at[:, 2].add(turns)
    return jnp.concatenate([path, turned[:, None]], axis=1) if gyro else path


def _driven(plant: Plant, params: Any, commanded: Commanded, few: bool) -> jax.Array:
    """States (R + 1, 9) of the drive, before what sensors make of them."""
    command, start, warm_up, speeds = commanded
    vehicle, _ = delay_apart(params)
    in_one = as_one_function if few and plant.arithmetic else lambda function: function

    def after(state: Any, commands: jax.Array) -> tuple[Any, jax.Array]:
        state = advance(plant, vehicle, state, commands)
        return state, plant.observe(state)

    def drive(start: jax.Array, command: jax.Array) -> jax.Array:
        state, command = begun_drive(plant, params, command, start, warm_up)
        if plant.record is None or on_processor() or command.shape[1] > UNROLLED:
            later = in_one(partial(jax.lax.scan, after))(state, command)[1]
        else:
            later = plant.record(vehicle, state, command)
        return jnp.concatenate([plant.observe(state)[None], later])

    if speeds is None:
        return drive(start, command)
    begin, gap = ((POSE, start[:3]), (slice(3, 6), jnp.zeros_like(start[:3]))), plant.dt * command.shape[1]
    path = pieces.record(drive, command, start, speeds, round(pieces.OVERLAP / gap), begin)
    return path.at[-1, 8].set(path[:, 8].max())


def begun_drive(
    plant: Plant, params: Any, command: jax.Array, start: jax.Array, warm_up: int
) -> tuple[Any, jax.Array]:
    """State at the start (5,) of a drive, and the commands (R, K, 2) as the vehicle's delay lets them come."""
    params, delay = delay_apart(params)
    state, before = plant.place(params, start), None
    if warm_up:
        state, before = _settle(plant, params, state, start[3:], warm_up, command.shape[1])
        state = plant.move(state, start)
    return state, delayed(delay, command, plant.dt, before)


def simulate_one(plant: Plant, params: Any, one: Batch, few: bool = False) -> Simulated:
    """Replay one trial of a batch with one parameter set."""
    commanded = Commanded(one.command, one.start, one.warm_up, one.speeds)
    path = path_of(plant, params, commanded, few, one.gyro_index is not None)

    def at(index: jax.Array, weight: jax.Array, columns: slice) -> jax.Array:
        before, after = path[index, columns], path[index + 1, columns]
        return before + weight[:, None] * (after - before)

    turned = None
    if one.gyro_index is not None and one.gyro_weight is not None:
        turned = at(one.gyro_index, one.gyro_weight, TURN)
    return Simulated(at(one.pose_index, one.pose_weight, POSE), at(one.odometry_index, one.odometry_weight, ODOMETRY),
                     path[-1, 8], turned)


def advance(plant: Plant, params: Any, state: Any, commands: jax.Array) -> Any:
    """State after K physics steps, each with its own of commands (K, 2)."""
    if plant.substeps is not None:
        return plant.substeps(params, state, commands)
    return jax.lax.scan(lambda state, command: (plant.substep(params, state, command), None), state, commands)[0]


def _settle(
    plant: Plant, params: Any, state: Any, speeds: jax.Array, steps: int, held: int
) -> tuple[Any, jax.Array]:
    """State after driving so that the odometry reports `speeds` (2,), and the command (2,) that does it, raised where
    the vehicle falls short of its command, as a skid-steered one does. Effects on commands have reached what they make
    of it at once: a lag or limit that began at rest would last longer than this."""
    params = reached(params)

    def body(carry: tuple[Any, jax.Array], _: None) -> tuple[tuple[Any, jax.Array], None]:
        state, command = carry
        state = advance(plant, params, state, jnp.broadcast_to(command, (held, 2)))
        return (state, command + WARM_UP_GAIN * held * plant.dt * (speeds - plant.observe(state)[SPEEDS])), None

    return jax.lax.scan(body, (state, speeds), None, length=max(steps // held, 1))[0]


def _turns(angle: jax.Array) -> jax.Array:
    return 2 * jnp.pi * jnp.round(angle / (2 * jnp.pi))


def _unwrap(angle: jax.Array) -> jax.Array:
    """Angle (T,) without jumps; the full turns are constants to differentiation."""
    jumps = jax.lax.stop_gradient(_turns(jnp.diff(angle)))
    return angle - jnp.concatenate([jnp.zeros(1, angle.dtype), jnp.cumsum(jumps)])

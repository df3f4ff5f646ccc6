"""One episode per instance, recorded in every control period: what evaluations are made of."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.env import Env, State, end_names, observe, reset_state, sense, step_state
from whill_mjx.evaluation.conditions import Condition, begin_under, nominal, seen_under
from whill_mjx.evaluation.drivers import Driver
from whill_mjx.vehicle.kinematics import body_twist, reference_pose
from whill_mjx.vehicle.types import VehicleParams
from whill_mjx.world.collision import free_distance
from whill_mjx.world.scene import Scene, footprint

CHANNELS = ("x", "y", "yaw", "v", "omega", "clearance", "v_command", "omega_command", "action_v", "action_omega")
"""What a trace holds of each control period; the command and the action are those that led to it."""
SIGHTS = ("open", "blank", "freeze")


@struct.dataclass
class Rollout:
    """N episodes, leaves (N, ...). Rows after the end of an episode repeat its last one."""

    trace: jax.Array  # (N, T + 1, len(CHANNELS)); row 0 is the start
    ends: dict[str, jax.Array]  # (N,) the metrics of the end
    scene: Scene
    frames: jax.Array  # (N, T + 1, H, W, 3) uint8 what the driver was shown, or (N, 0, ...) where not asked for


def rollout(
    env: Env,
    params: VehicleParams,
    keys: jax.Array,
    driver: Driver,
    condition: Condition | None = None,
    *,
    sight: str = "open",
    max_latency: int = 0,
    memory: Any = None,
    frames: bool = False,
) -> Rollout:
    """Drive one episode from each key, until all have ended.

    The action repeat of the task is ignored: a driver has its own period, and every control period is recorded.

    Args:
        env: static model and task.
        params: leaves (N, ...): each episode has its own vehicle.
        keys: (N,) of the episodes; the same key gives the same world, whoever drives.
        driver: who drives.
        condition: leaves (N,); None changes nothing.
        sight: "open", "blank" (black images) or "freeze" (the first image for the whole episode).
        max_latency: largest latency in `condition` [control periods].
        memory: first memory of the driver, leaves (N, ...); None takes the driver's own.
        frames: keep the images.

    Raises:
        ValueError: unknown sight.
    """
    if sight not in SIGHTS:
        raise ValueError(f"unknown sight {sight!r}; use one of {SIGHTS}.")
    count, steps = keys.shape[0], env.task.max_steps
    env = dataclasses.replace(env, task=dataclasses.replace(env.task, action_repeat=1))
    changed = condition is not None
    if condition is None:
        condition = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (count,)), nominal())
    states = jax.vmap(lambda p, key: reset_state(env, p, key))(params, keys)
    if changed:
        states = jax.vmap(lambda c, p, state: begin_under(c, env, p, state))(condition, params, states)
    drive_keys = jax.vmap(lambda key: jax.random.fold_in(key, 1))(keys)
    names = end_names(env, jax.tree.map(lambda leaf: leaf[0], states))
    if memory is None:
        memory = jax.vmap(driver.begin)(states, drive_keys)

    def look(one: Condition, p: VehicleParams, state: State) -> tuple[State, Any]:
        return sense(env, p, state, seen_under(one, env, state) if changed else state)

    def take(states: State) -> tuple[State, Any]:
        return jax.vmap(look)(condition, params, states)

    _, shapes = jax.eval_shape(take, states)
    blind = jax.tree.map(lambda shape: jnp.zeros(shape.shape, shape.dtype), shapes)
    first = take(states)[1] if driver.sees or frames else blind
    filmed = frames and bool(env.sensors)  # the camera, whatever the driver observes
    late = jnp.clip(jnp.round(condition.latency).astype(jnp.int32), 0, max_latency)

    def see(step: jax.Array, states: State, past: Any) -> tuple[State, Any, Any]:
        """States, what the drivers are shown (N, ...), and the ring of what was to be seen (L, N, ...)."""
        if sight == "blank" or not (driver.sees or frames):
            return states, blind, past
        if sight == "freeze":
            return states, first, past
        states, now = take(states)
        if max_latency == 0:
            return states, now, past
        past = jax.tree.map(lambda ring, new: ring.at[step % (max_latency + 1)].set(new), past, now)
        shown = jnp.maximum(step - late, 0) % (max_latency + 1)  # before anything has arrived: the first picture
        return states, jax.tree.map(lambda ring: ring[shown, jnp.arange(count)], past), past

    def decide(step: jax.Array, states: State, memory: Any, past: Any) -> tuple[State, Any, jax.Array, Any, Any]:
        states, image, past = see(step, states, past)
        step_keys = jax.vmap(lambda key: jax.random.fold_in(key, step))(drive_keys)
        memory, action = jax.vmap(driver.act)(memory, states, image, step_keys)
        return states, memory, jnp.clip(action, -1.0, 1.0), image, past

    def hold(step: jax.Array, states: State, memory: Any, past: Any, action: jax.Array, image: Any):
        if max_latency:  # pictures arrive between the decisions too
            states, image, past = see(step, states, past)
        return states, memory, action, image, past

    def advance(loop: dict[str, Any]) -> dict[str, Any]:
        step, states, memory, past = loop["step"], loop["states"], loop["memory"], loop["past"]
        if driver.period == 1:
            states, memory, action, image, past = decide(step, states, memory, past)
        else:
            states, memory, action, image, past = jax.lax.cond(
                step % driver.period == 0,
                lambda: decide(step, states, memory, past),
                lambda: hold(step, states, memory, past, loop["action"], loop["image"]),
            )
        after, outcome = jax.vmap(lambda p, state, a: step_state(env, p, state, a))(params, states, action)
        row = jax.vmap(lambda state, a: _row(env, state, a))(after, action)
        row = jnp.where(states.done[:, None], loop["last"], row)
        shown = jax.vmap(lambda state: observe(env, state))(states) if filmed else image
        pictures = loop["frames"].at[:, step].set(shown) if frames else loop["frames"]
        return {
            "step": step + 1, "states": after, "memory": memory, "past": past, "action": action, "image": image,
            "last": row, "trace": loop["trace"].at[:, step + 1].set(row), "frames": pictures,
            "ends": {name: loop["ends"][name] + outcome.metrics[name] for name in names},
        }  # fmt: skip

    start = jax.vmap(lambda state: _row(env, state, jnp.zeros(2)))(states)
    loop = {
        "step": jnp.zeros((), jnp.int32),
        "states": states,
        "memory": memory,
        "past": jax.tree.map(lambda x: jnp.broadcast_to(x, (max_latency + 1, *x.shape)), first) if max_latency else (),
        "action": jnp.zeros((count, 2)),
        "image": blind if sight == "blank" else first,
        "last": start,
        "trace": jnp.broadcast_to(start[:, None], (count, steps + 1, len(CHANNELS))),
        "frames": jnp.zeros((count, steps + 1 if frames else 0, env.height, env.width, 3), jnp.uint8),
        "ends": {name: jnp.zeros(count) for name in names},
    }
    end = jax.lax.while_loop(lambda loop: (loop["step"] < steps) & ~jnp.all(loop["states"].done), advance, loop)
    rows = jnp.arange(steps + 1)[None, :, None]
    trace = jnp.where(rows <= end["step"], end["trace"], end["last"][:, None])
    pictures = end["frames"]
    if frames:
        last = jax.vmap(lambda state: observe(env, state))(end["states"]) if filmed else end["image"]
        pictures = jnp.where(rows[..., None, None] < end["step"], pictures, last[:, None])
    return Rollout(trace, end["ends"], end["states"].scene, pictures)


def _row(env: Env, state: State, action: jax.Array) -> jax.Array:
    """One row of a trace, in the order of CHANNELS."""
    x, y, yaw = reference_pose(env.model, state.vehicle.qpos)
    v, omega = body_twist(env.model, state.vehicle.qpos, state.vehicle.qvel)
    near = free_distance(footprint(env.model.spec, x, y, yaw), state.scene)
    return jnp.stack([x, y, yaw, v, omega, near, state.command[0], state.command[1], action[0], action[1]])

"""One episode per instance, recorded in every control period: what evaluations are made of."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.env import Env, State, end_names, observe, reset_state, sense, step_state
from whill_mjx.evaluation.conditions import Condition, arranged, begin_under, nominal, seen_under
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


@dataclass(frozen=True)
class View:
    """What a driver is shown, and what of it is kept."""

    sight: str = "open"
    """ "open", "blank" (black images) or "freeze" (the first image for the whole episode)."""
    max_latency: int = 0
    """Largest latency in the condition [control periods]."""
    frames: bool = False
    """Keep the images."""

    def __post_init__(self) -> None:
        if self.sight not in SIGHTS:
            raise ValueError(f"unknown sight {self.sight!r}; use one of {SIGHTS}.")


def rollout(
    env: Env,
    params: VehicleParams,
    keys: jax.Array,
    driver: Driver,
    condition: Condition | None = None,
    *,
    view: View = View(),  # noqa: B008
) -> Rollout:
    """Drive one episode from each key, until all have ended.

    The action repeat of the task is ignored: a driver has its own period, and every control period is recorded.

    Args:
        env: static model and task.
        params: leaves (N, ...): each episode has its own vehicle.
        keys: (N,) of the episodes; the same key gives the same world, whoever drives.
        driver: who drives.
        condition: leaves (N,); None changes nothing.
        view: what the driver is shown, and whether images are kept.
    """
    env = dataclasses.replace(env, task=dataclasses.replace(env.task, action_repeat=1))
    changed = condition is not None
    if condition is None:
        condition = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, keys.shape), nominal())

    def begin(one: Condition, p: VehicleParams, key: jax.Array) -> State:
        if not changed:
            return reset_state(env, p, key)
        return begin_under(one, env, p, reset_state(arranged(one, env), p, key))

    states = jax.vmap(begin)(condition, params, keys)
    drive_keys = jax.vmap(lambda key: jax.random.fold_in(key, 1))(keys)
    names = end_names(env, jax.tree.map(lambda leaf: leaf[0], states))
    memory = jax.vmap(driver.begin)(states, drive_keys) if driver.memory is None else driver.memory
    sensing = _Sensing(env, params, condition, changed)
    _, shapes = jax.eval_shape(sensing.take, states)
    blind = jax.tree.map(lambda shape: jnp.zeros(shape.shape, shape.dtype), shapes)
    first = sensing.take(states)[1] if driver.sees or view.frames else blind
    episodes = _Episodes(sensing, driver, drive_keys, view, names, blind, first)
    start = episodes.start(states, memory)
    going = lambda loop: (loop["step"] < env.task.max_steps) & ~jnp.all(loop["states"].done)  # noqa: E731
    return episodes.record(jax.lax.while_loop(going, episodes.advance, start))


@dataclass(frozen=True)
class _Sensing:
    """How N instances are seen under their conditions."""

    env: Env
    params: VehicleParams
    condition: Condition
    changed: bool

    def take(self, states: State) -> tuple[State, Any]:
        """States after the sensors' work, and the observations, leaves (N, ...)."""
        return jax.vmap(self._look)(self.condition, self.params, states)

    def _look(self, one: Condition, p: VehicleParams, state: State) -> tuple[State, Any]:
        return sense(self.env, p, state, seen_under(one, self.env, state) if self.changed else state)


@dataclass(frozen=True)
class _Episodes:
    """What stays the same while N episodes are driven, and one control period of them."""

    sensing: _Sensing
    driver: Driver
    keys: jax.Array
    view: View
    names: tuple[str, ...]
    blind: Any
    """Observations of a driver that sees nothing."""
    first: Any
    """Observations at the start."""

    @property
    def _seen(self) -> bool:
        return self.driver.sees or self.view.frames

    @property
    def _filmed(self) -> bool:
        """Whether frames are the camera's although the driver observes something else."""
        return self.view.frames and bool(self.sensing.env.sensors)

    def start(self, states: State, memory: Any) -> dict[str, Any]:
        """What the loop over control periods begins with."""
        env, count = self.sensing.env, self.keys.shape[0]
        steps, frames, ring = env.task.max_steps, self.view.frames, self.view.max_latency + 1
        row = jax.vmap(lambda state: _row(env, state, jnp.zeros(2)))(states)
        past = jax.tree.map(lambda x: jnp.broadcast_to(x, (ring, *x.shape)), self.first) if ring > 1 else ()
        return {
            "step": jnp.zeros((), jnp.int32),
            "states": states,
            "memory": memory,
            "past": past,
            "action": jnp.zeros((count, 2)),
            "image": self.blind if self.view.sight == "blank" else self.first,
            "last": row,
            "trace": jnp.broadcast_to(row[:, None], (count, steps + 1, len(CHANNELS))),
            "frames": jnp.zeros((count, steps + 1 if frames else 0, env.height, env.width, 3), jnp.uint8),
            "ends": {name: jnp.zeros(count) for name in self.names},
        }

    def advance(self, loop: dict[str, Any]) -> dict[str, Any]:
        """Drive one control period."""
        env, step = self.sensing.env, loop["step"]
        if self.driver.period == 1:
            states, memory, action, image, past = self._decide(loop)
        else:
            states, memory, action, image, past = jax.lax.cond(
                step % self.driver.period == 0, lambda: self._decide(loop), lambda: self._hold(loop)
            )
        after, outcome = jax.vmap(lambda p, state, a: step_state(env, p, state, a))(self.sensing.params, states, action)
        row = jax.vmap(lambda state, a: _row(env, state, a))(after, action)
        row = jnp.where(states.done[:, None], loop["last"], row)
        shown = jax.vmap(lambda state: observe(env, state))(states) if self._filmed else image
        pictures = loop["frames"].at[:, step].set(shown) if self.view.frames else loop["frames"]
        return {
            "step": step + 1, "states": after, "memory": memory, "past": past, "action": action, "image": image,
            "last": row, "trace": loop["trace"].at[:, step + 1].set(row), "frames": pictures,
            "ends": {name: loop["ends"][name] + outcome.metrics[name] for name in self.names},
        }  # fmt: skip

    def record(self, end: dict[str, Any]) -> Rollout:
        """The episodes, where rows after an end repeat its last one."""
        env, states = self.sensing.env, end["states"]
        rows = jnp.arange(env.task.max_steps + 1)[None, :, None]
        trace = jnp.where(rows <= end["step"], end["trace"], end["last"][:, None])
        pictures = end["frames"]
        if self.view.frames:
            last = jax.vmap(lambda state: observe(env, state))(states) if self._filmed else end["image"]
            pictures = jnp.where(rows[..., None, None] < end["step"], pictures, last[:, None])
        return Rollout(trace, end["ends"], states.scene, pictures)

    def _see(self, step: jax.Array, states: State, past: Any) -> tuple[State, Any, Any]:
        """States, what the drivers are shown (N, ...), and the ring of what was to be seen (L, N, ...)."""
        if self.view.sight == "blank" or not self._seen:
            return states, self.blind, past
        if self.view.sight == "freeze":
            return states, self.first, past
        states, now = self.sensing.take(states)
        most = self.view.max_latency
        if most == 0:
            return states, now, past
        past = jax.tree.map(lambda ring, new: ring.at[step % (most + 1)].set(new), past, now)
        late = jnp.clip(jnp.round(self.sensing.condition.latency).astype(jnp.int32), 0, most)
        shown = jnp.maximum(step - late, 0) % (most + 1)  # before anything has arrived: the first picture
        return states, jax.tree.map(lambda ring: ring[shown, jnp.arange(len(self.keys))], past), past

    def _decide(self, loop: dict[str, Any]) -> tuple[State, Any, jax.Array, Any, Any]:
        """States, memory, action, image and past after the driver has chosen."""
        step = loop["step"]
        states, image, past = self._see(step, loop["states"], loop["past"])
        step_keys = jax.vmap(lambda key: jax.random.fold_in(key, step))(self.keys)
        memory, action = jax.vmap(self.driver.decide)(loop["memory"], states, image, step_keys)
        return states, memory, jnp.clip(action, -1.0, 1.0), image, past

    def _hold(self, loop: dict[str, Any]) -> tuple[State, Any, jax.Array, Any, Any]:
        """The same where it keeps its action. Pictures arrive between the decisions too.

        Sensors remember what they measured at decisions alone, as in the training, whose steps are decisions.
        """
        image, past = loop["image"], loop["past"]
        if self.view.max_latency:
            _, image, past = self._see(loop["step"], loop["states"], past)
        return loop["states"], loop["memory"], loop["action"], image, past


def _row(env: Env, state: State, action: jax.Array) -> jax.Array:
    """One row of a trace, in the order of CHANNELS."""
    x, y, yaw = reference_pose(env.model, state.vehicle.qpos)
    v, omega = body_twist(env.model, state.vehicle.qpos, state.vehicle.qvel)
    near = free_distance(footprint(env.model.spec, x, y, yaw), state.scene)
    return jnp.stack([x, y, yaw, v, omega, near, state.command[0], state.command[1], action[0], action[1]])

"""A task with the interface of `brax.envs.Env`, for trainers such as `brax.training.agents.ppo`.

Brax itself is not needed: its trainers and wrappers call these names and no others. Episodes end by the task's endings;
the time limit is the trainer's `episode_length`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.env import POSE_METRICS
from whill_mjx.env import reset as reset_env
from whill_mjx.env import step as step_env
from whill_mjx.gym.vectors import joined, make_endless
from whill_mjx.sensors.base import Sensor
from whill_mjx.tasks.tasks import Task
from whill_mjx.vehicle.types import TimeStep


@struct.dataclass
class BraxState:
    """The fields of `brax.envs.State`."""

    pipeline_state: Any  # `whill_mjx.env.State`
    obs: Any  # (D,), or {"state": (D,), "privileged_state": (D + P,)} where a sensor is privileged
    reward: jax.Array  # ()
    done: jax.Array  # () 0 or 1
    metrics: dict[str, jax.Array] = struct.field(default_factory=dict)
    info: dict[str, Any] = struct.field(default_factory=dict)


class BraxEnv:
    """One instance of a task; `brax.envs.training.wrap` makes many of it."""

    backend = "whill_mjx"

    def __init__(
        self, task: str | Task = "point_goal", vehicle: Any = None,
        observations: Mapping[str, Sensor] | Sequence[str] | None = None,
    ) -> None:  # fmt: skip
        """Arguments as of `make_env`; observations must be vectors."""
        self.env, self.params, self.episode_length = make_endless(task, vehicle, observations)

    def reset(self, rng: jax.Array) -> BraxState:
        """Start an episode; `rng` is a random key of either kind."""
        key = rng if jnp.issubdtype(rng.dtype, jax.dtypes.prng_key) else jax.random.wrap_key_data(rng)
        state, first = reset_env(self.env, self.params, key)
        return BraxState(state, self._obs(first), jnp.zeros(()), jnp.zeros(()), self._metrics(first))

    def step(self, state: BraxState, action: jax.Array) -> BraxState:
        """One environment step with an action (2,) in [-1, 1]."""
        after, time_step = step_env(self.env, self.params, state.pipeline_state, action)
        return dataclasses.replace(
            state, pipeline_state=after, obs=self._obs(time_step), reward=time_step.reward,
            done=time_step.terminated.astype(jnp.float32), metrics={**state.metrics, **self._metrics(time_step)},
        )  # fmt: skip

    @property
    def observation_size(self) -> Any:
        """D, or the sizes by name."""
        shapes = jax.eval_shape(self.reset, jax.ShapeDtypeStruct((2,), jnp.uint32)).obs
        return {name: one.shape for name, one in shapes.items()} if isinstance(shapes, dict) else shapes.shape[-1]

    @property
    def action_size(self) -> int:
        """Speed and yaw rate."""
        return 2

    @property
    def dt(self) -> float:
        """Duration of an environment step [s]."""
        return self.env.model.config.control_dt * self.env.task.action_repeat

    @property
    def unwrapped(self) -> BraxEnv:
        """The environment without wrappers."""
        return self

    def _obs(self, time_step: TimeStep) -> Any:
        seen, all_of_it = joined(self.env, time_step.obs)
        return seen if all_of_it is None else {"state": seen, "privileged_state": all_of_it}

    def _metrics(self, time_step: TimeStep) -> dict[str, jax.Array]:
        kept = {name: value for name, value in time_step.metrics.items() if name not in POSE_METRICS}
        return {name: jnp.asarray(value, jnp.float32) for name, value in kept.items()}

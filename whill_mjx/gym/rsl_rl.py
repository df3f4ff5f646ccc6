"""Many instances with the interface of `rsl_rl.env.VecEnv` (rsl-rl-lib 5), as PyTorch tensors.

PyTorch and tensordict come with rsl-rl-lib and are not installed with this package. Arrays go from JAX to PyTorch and
back without a copy where both are on one device.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from whill_mjx.batch import BatchState, make_batch
from whill_mjx.gym.kinds import strong
from whill_mjx.gym.vectors import joined, make_endless
from whill_mjx.sensors.base import Sensor
from whill_mjx.tasks.tasks import Task


class RslRlVecEnv:
    """N instances of a task, each of which begins anew within the step that ends it.

    Observation groups are "policy" (N, D) and, where a sensor is privileged, "critic" (N, D + P).
    """

    num_actions = 2

    def __init__(
        self, num_envs: int, task: str | Task = "point_goal", vehicle: Any = None,
        observations: Mapping[str, Sensor] | Sequence[str] | None = None, seed: int = 0,
    ) -> None:  # fmt: skip
        """Start all instances.

        Args:
            num_envs: N.
            task, vehicle, observations: as of `make_env`; observations must be vectors.
            seed: of all worlds.
        """
        import torch

        env, params, self.max_episode_length = make_endless(task, vehicle, observations)
        self.batch, self.num_envs = make_batch(env, params, num_envs), num_envs
        self.cfg = {"task": env.task.name, "num_envs": num_envs, "seed": seed}
        self._begin_all = jax.jit(self._begin)
        self._step_all = jax.jit(self._step)
        self._keys = jax.random.key(seed)
        self._torch = torch
        self.reset()
        self.device = next(iter(self._obs.values())).device
        self.episode_length_buf = torch.zeros(num_envs, dtype=torch.long, device=self.device)
        """(N,) environment steps since each instance began; one that reaches `max_episode_length` begins anew."""

    def reset(self) -> tuple[Any, dict[str, Any]]:
        """Start all instances; observations and extras."""
        self._keys, key = jax.random.split(self._keys)
        self._state, obs = self._begin_all(jax.random.split(key, self.num_envs))
        self._obs = self._tensors(obs)
        if hasattr(self, "episode_length_buf"):
            self.episode_length_buf.zero_()
        return self.get_observations(), {}

    def get_observations(self) -> Any:
        """Observations by group: a TensorDict, or a dict where tensordict is not installed."""
        try:
            from tensordict import TensorDict
        except ImportError:
            return dict(self._obs)
        return TensorDict(dict(self._obs), batch_size=[self.num_envs])

    def step(self, actions: Any) -> tuple[Any, Any, Any, dict[str, Any]]:
        """One environment step; actions (N, 2) in [-1, 1].

        Returns:
            Observations, those of a new episode where one has ended; rewards (N,); dones (N,) long; extras with
            "time_outs" (N,) and the "log" of the endings.
        """
        torch = self._torch
        self.episode_length_buf += 1
        late = self.episode_length_buf >= self.max_episode_length
        sent, timeouts = (jnp.from_dlpack(one.detach().contiguous()) for one in (actions.float(), late.int()))
        self._keys, key = jax.random.split(self._keys)
        self._state, (obs, reward, terminated, ends) = self._step_all(self._state, sent, timeouts > 0, key)
        self._obs = self._tensors(obs)
        rewards, ended = torch.from_dlpack(reward), torch.from_dlpack(terminated)
        dones = (ended.bool() | late).long()
        self.episode_length_buf *= 1 - dones
        count = max(int(dones.sum()), 1)
        log = {f"/ending/{name}": float(value) / count for name, value in ends.items()}
        return self.get_observations(), rewards, dones, {"time_outs": late & ~ended.bool(), "log": log}

    def close(self) -> None:
        """Nothing is open."""

    def _begin(self, origins: jax.Array) -> Any:
        state, first = jax.vmap(self.batch.begin_one)(origins)
        return strong((state, self._groups(first.obs)))

    def _step(self, state: BatchState, actions: jax.Array, late: jax.Array, key: jax.Array) -> Any:
        after, step = jax.vmap(self.batch.step_one)(state, actions)
        ended = step.terminated | late
        fresh, first = jax.vmap(self.batch.begin_one)(jax.random.split(key, self.num_envs))

        def choose(new: jax.Array, old: jax.Array) -> jax.Array:
            return jnp.where(ended.reshape(-1, *[1] * (new.ndim - 1)), new, old)

        state, obs = jax.tree.map(choose, (fresh, first.obs), (after, step.obs))
        ends = {name: step.metrics[name].sum() for name in ("success", "collision")}
        return strong((state, (self._groups(obs), step.reward, step.terminated.astype(jnp.int32), ends)))

    def _groups(self, obs: Any) -> dict[str, jax.Array]:
        seen, all_of_it = joined(self.batch.env, obs)
        return {"policy": seen} if all_of_it is None else {"policy": seen, "critic": all_of_it}

    def _tensors(self, obs: Mapping[str, jax.Array]) -> dict[str, Any]:
        return {name: self._torch.from_dlpack(value) for name, value in obs.items()}

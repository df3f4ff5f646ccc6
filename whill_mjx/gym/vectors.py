"""What trainers of single vectors share: observations put together, and episodes that the trainer itself ends."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from whill_mjx.env import Env, make_env
from whill_mjx.sensors.base import Sensor
from whill_mjx.sensors.privileged import Privileged
from whill_mjx.tasks.check import check_is_task
from whill_mjx.tasks.tasks import Task, make_task
from whill_mjx.vehicle.types import VehicleParams

ENDLESS = 1_000_000
"""Control periods of an episode that the trainer ends."""


def make_endless(
    task: str | Task, vehicle: Any = None, observations: Mapping[str, Sensor] | Sequence[str] | None = None
) -> tuple[Env, VehicleParams, int]:
    """Environment without a time limit, its vehicle, and the environment steps after which the trainer shall end it.

    Raises:
        ValueError: of `make_env`; an observation that is no vector.
    """
    task = make_task(task) if isinstance(task, str) else task
    check_is_task(task)
    steps = -(-task.max_steps // task.action_repeat)
    env, params = make_env(dataclasses.replace(task, max_steps=ENDLESS), vehicle=vehicle, observations=observations)
    images = [name for name, sensor in env.sensors if len(sensor.reading(env).shape) != 1]
    if images or not env.sensors:
        raise ValueError(f"task {task.name!r}: observes {', '.join(images) or 'the camera image'}, no vector. Give "
                         'vectors alone, such as observations=("goal", "lidar").')
    return env, params, steps


def joined(env: Env, obs: Any) -> tuple[jax.Array, jax.Array | None]:
    """Observations (..., D) of the policy, from those by name, and of the critic: the same and the privileged ones.

    The critic's are None without a privileged sensor. Sensors come in the order of their names.
    """
    seen: list[jax.Array] = []
    hidden: list[jax.Array] = []
    for name, sensor in env.sensors:
        (hidden if isinstance(sensor, Privileged) else seen).append(obs[name])
    vector = jnp.concatenate(seen, -1)
    return vector, jnp.concatenate([vector, *hidden], -1) if hidden else None

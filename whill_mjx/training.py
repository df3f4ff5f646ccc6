"""The parts of a training run: presets, the environment as the learner sees it, evaluation and statistics."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dreamer import agent as agents
from dreamer.config import DreamerConfig
from dreamer.config import preset as learner_preset
from dreamer.types import FunctionalEnv, Params, Transition
from whill_mjx.batch import BatchEnv, make_batch
from whill_mjx.env import END_METRICS, make_env
from whill_mjx.intervals import wilson_interval
from whill_mjx.task import Task, make_task
from whill_mjx.types import TimeStep


@dataclass(frozen=True)
class Preset:
    """A task and the size of the learner and of the run that go with it."""

    task: Task
    learner: DreamerConfig
    total_steps: int
    """Environment steps (decisions of the policy), summed over instances."""
    instances: int = 16
    eval_every: int = 1000
    """Environment steps between evaluations."""
    eval_episodes: int = 100
    """Episodes of an evaluation inside the run; they are not those of the final one."""


def find_preset(name: str, task: str) -> Preset:
    """Preset by name ("paper", "cpu" or "smoke") for a task; ValueError names the known ones.

    "paper" is the reference paper's setting: 16 instances, 22,000 control steps on the obstacle course and 200,000 in
    the corridor. "cpu" is an easier course for 2 cores: forward speeds only, one gate, a decision every 0.5 s, a small
    network on 8x8 patches. "smoke" only shows that everything runs.
    """
    easy: dict[str, Any] = {"v_min": 0.0, "gates": 1} if task == "obstacle_course" else {}
    match name:
        case "paper":
            steps = 22_000 if task == "obstacle_course" else 200_000
            return Preset(make_task(task), learner_preset("size12m", train_ratio=512.0), steps, eval_episodes=200)
        case "cpu":
            course = make_task(task, action_repeat=5, **easy)
            return Preset(course, learner_preset("cpu", lr=6e-4), 8_000, instances=8)
        case "smoke":
            course = make_task(task, action_repeat=5, **easy)
            tiny = learner_preset("cpu", deter=64, hidden=32, units=32, stoch=8, patch_units=16, batch_size=4)
            tiny = dataclasses.replace(tiny, batch_length=8, learning_starts=64, train_ratio=4.0, imag_horizon=4)
            return Preset(course, tiny, 400, instances=4, eval_every=200, eval_episodes=8)
    raise ValueError(f"unknown preset {name!r}; use 'paper', 'cpu', 'smoke', or 'auto' to go by the device.")


def to_transition(step: TimeStep) -> Transition:
    """A time step as the learner reads it."""
    metrics = {name: step.metrics[name] for name in END_METRICS}
    ended = step.terminated | step.truncated
    return Transition(step.obs, step.reward, step.first, ended, step.terminated, metrics)


def functional_env(batch: BatchEnv) -> FunctionalEnv:
    """The learner's view of a batch of chairs."""

    def reset(key: jax.Array) -> tuple[Any, Transition]:
        state, step = batch.reset(key)
        return state, to_transition(step)

    def step(state: Any, action: jax.Array) -> tuple[Any, Transition]:
        state, step = batch.step(state, action)
        return state, to_transition(step)

    shape = (batch.env.height, batch.env.width, 3)
    return FunctionalEnv(num_envs=batch.count, obs_shape=shape, action_dim=2, reset=reset, step=step)


def make_training_env(task: Task, vehicle: str | Path | None, instances: int, spread: float = 0.0) -> BatchEnv:
    """`instances` chairs of a vehicle file or preset in a task."""
    env, params = make_env(task, vehicle)
    return make_batch(env, params, instances, spread)


@dataclass(frozen=True)
class Drives:
    """One recorded episode per instance; arrays are held at their last value after the end."""

    path: np.ndarray  # (N, T, 3) x [m], y [m], yaw [rad]
    length: np.ndarray  # (N,) environment steps
    metrics: dict[str, np.ndarray]  # (N,) values on the last frame
    frames: np.ndarray  # (V, T, H, W, 3) uint8 images of the first V instances
    scenes: Any  # scene of each instance (leaves (N, ...))


Driver = Callable[[Any, TimeStep, jax.Array], tuple[Any, jax.Array]]
"""(carry, time step, key) -> carry, actions (N, 2)."""


def random_driver() -> tuple[Any, Driver]:
    """A driver that draws every action uniformly, and its first carry."""

    def act(carry: Any, step: TimeStep, key: jax.Array) -> tuple[Any, jax.Array]:
        return carry, jax.random.uniform(key, (step.reward.shape[0], 2), minval=-1.0)

    return (), act


def policy_driver(config: DreamerConfig, params: Params, count: int) -> tuple[Any, Driver]:
    """The trained policy acting deterministically, and its first carry."""

    def act(carry: Any, step: TimeStep, key: jax.Array) -> tuple[Any, jax.Array]:
        return agents.act(config, params, carry, step.obs, step.first, key, True)

    return agents.init_carry(config, count, 2), act


def record_drives(batch: BatchEnv, carry: Any, act: Driver, key: jax.Array, videos: int = 4) -> Drives:
    """Drive one episode in every instance and record it.

    Args:
        batch: chairs; their action repeat decides how long an episode can be.
        carry, act: a driver and its first carry.
        key: random key of worlds and driver.
        videos: images are kept of so many instances.
    """
    steps = -(-batch.env.task.max_steps // batch.env.task.action_repeat)
    reset_key, drive_key = jax.random.split(key)

    def one(loop: tuple, step_key: jax.Array) -> tuple[tuple, tuple]:
        state, step, carry, kept, ended = loop
        carry, action = act(carry, step, step_key)
        # An instance that has ended would start anew; what it does then is not looked at.
        state, step = batch.step(state, jnp.clip(action, -1.0, 1.0))
        new = {name: jnp.where(ended, kept[name], value) for name, value in step.metrics.items()}
        now = ended | step.terminated | step.truncated
        pose = jnp.stack([new["x"], new["y"], new["yaw"]], axis=-1)
        return (state, step, carry, new, now), (pose, step.obs[:videos], ~ended)

    @jax.jit
    def run(reset_key: jax.Array, drive_key: jax.Array, carry: Any) -> tuple:
        state, step = batch.reset(reset_key)
        scenes = state.env.scene
        loop = (state, step, carry, step.metrics, jnp.zeros(batch.count, bool))
        (_, _, _, metrics, _), (poses, frames, alive) = jax.lax.scan(one, loop, jax.random.split(drive_key, steps))
        start = jnp.stack([step.metrics["x"], step.metrics["y"], step.metrics["yaw"]], axis=-1)
        return start, poses, step.obs[:videos], frames, alive, metrics, scenes

    start, poses, first, frames, alive, metrics, scenes = jax.device_get(run(reset_key, drive_key, carry))
    path = np.concatenate([start[:, None], poses.swapaxes(0, 1)], axis=1)
    frames = np.concatenate([first[:, None], frames.swapaxes(0, 1)], axis=1)
    return Drives(path, alive.sum(0), metrics, frames, scenes)


def summarise(drives: Drives) -> dict[str, Any]:
    """Figures of a set of drives: shares of the endings, return and time to the goal."""
    count = len(drives.length)
    success = drives.metrics["success"] > 0.5
    low, high = wilson_interval(int(success.sum()), count)
    return {
        "episodes": count,
        "success": float(success.mean()),
        "success_interval_95": [low, high],
        **{name: float(drives.metrics[name].mean()) for name in ("collision", "timeout", "diverged")},
        "return_mean": float(drives.metrics["episode_return"].mean()),
        "return_sd": float(drives.metrics["episode_return"].std()),
        "time_to_goal_s": float(drives.metrics["time_s"][success].mean()) if success.any() else None,
    }

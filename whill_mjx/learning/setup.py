"""The parts of a training run: presets, the environment as the learner sees it, and what it leaves to drive with."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from dreamer import agent as agents
from dreamer.config import DreamerConfig
from dreamer.config import preset as learner_preset
from dreamer.types import FunctionalEnv, Mirror, Params, Transition
from whill_mjx.batch import BatchEnv, make_batch
from whill_mjx.env import END_METRICS, State, make_env
from whill_mjx.evaluation.drivers import Driver
from whill_mjx.learning import ppo, privileged
from whill_mjx.learning.ppo import PpoConfig
from whill_mjx.learning.shaping import Safety, Step, limit_action, limited_policy, penalty
from whill_mjx.tasks.tasks import Task, make_task
from whill_mjx.vehicle.types import TimeStep

PAINTS = 15
"""Worlds of other looks that the mirror shows at most; any number could be drawn, but each takes memory."""
TRUTH = "truth"
"""Name of the observation that `whill_mjx.learning.privileged` makes; for `DreamerConfig.decode_only`."""


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
    exploring_starts: float = 0.0
    """Share of training episodes that begin anywhere on the way (`whill_mjx.tasks.starts`); evaluations never do."""
    second_tries: float = 0.0
    """Share of the training episodes without an arrival whose world is begun again (`whill_mjx.batch`)."""
    looks: str | None = None
    """What changes the picture from episode to episode: "plain" nothing, "paper" what the paper randomises, "rich"
    a furnished room (`whill_mjx.world.rich`); None leaves it to the task."""
    spread: float = 0.0
    """Relative spread of the vehicle's parameters from episode to episode, in training."""
    safety: Safety = Safety()
    """What is asked besides the task."""
    ppo: PpoConfig = PpoConfig()
    """The model-free baseline, where it is chosen instead."""
    stop_success: float | None = None
    """End when two evaluations in a row have had this share of successes."""


def find_preset(name: str, task: str) -> Preset:
    """Preset by name ("paper", "transfer", "wallclock", "cpu" or "smoke") for a task; ValueError names the known ones.

    "paper" is the reference paper's setting: 16 instances, 22,000 control steps on the obstacle course and 200,000 in
    the corridor (at ratios of 384 and 160). Its updates are few, so it learns faster at first and explores more
    than DreamerV3's defaults; it also learns from the mirrored world and predicts what the simulator knows. A quarter
    of its instances act without noise; an average of its parameters drives. On the course it looks 5 s ahead, not 33,
    trusts its critic less, and begins half of its training episodes anywhere on the way: from the paper's start and
    with noise alone, two seeds in five learned a fixed layout. Its drives are short, so twice as many sequences of half
    the length make a batch, in less time. In the corridor, whose box may look like the floor behind it, what the
    simulator knows weighs more, half of the failed worlds are begun again, and every drive is seen in four paints.
    "transfer" is that budget in furnished rooms with other materials, light, film and vehicle in each episode, for a
    policy that drives where nobody trained. "wallclock" spends environment steps to save time: thousands of instances,
    few updates per step, and an end when nearly all held-out episodes succeed. "cpu" is an easier course for 2 cores:
    forward speeds only, one gate, a decision every 0.5 s, a small network on 8x8 patches. "smoke" only shows that
    everything runs.
    """
    easy: dict[str, Any] = {"v_min": 0.0, "gates": 1} if task == "obstacle_course" else {}
    match name:
        case "paper":
            on_course = task == "obstacle_course"
            steps, ratio = (22_000, 384) if on_course else (200_000, 160)
            learner = learner_preset(
                "size12m", train_ratio=float(ratio), lr=1.5e-4, lr_decay=steps * ratio // 1024, entropy_scale=1e-3,
                replay_capacity=250_000, average_rate=0.002, greedy_share=0.25, decode_only=(TRUTH,),
            )  # fmt: skip
            own: dict[str, Any] = dict(vector_scale=5.0, mirror=3)
            if on_course:
                own = dict(horizon=50.0, return_lambda=0.98, imag_horizon=25, mirror=1, batch_size=32, batch_length=32)
            return Preset(
                make_task(task), dataclasses.replace(learner, **own), steps, eval_every=1000 if on_course else 20_000,
                eval_episodes=200, exploring_starts=0.5 if on_course else 0.0, second_tries=0.0 if on_course else 0.5,
            )  # fmt: skip
        case "transfer":
            return dataclasses.replace(find_preset("paper", task), looks="rich", spread=0.1)
        case "wallclock":
            learner = learner_preset(
                "size12m", train_ratio=4.0, batch_size=64, learning_starts=150_000, lr=3e-4, entropy_scale=1e-3,
                horizon=100.0, return_lambda=0.98, decode_only=(TRUTH,),
            )  # fmt: skip
            return Preset(
                make_task(task), learner, 8_000_000, instances=2048, eval_every=500_000, eval_episodes=1000,
                exploring_starts=0.5, ppo=PpoConfig(rollout=32, minibatches=16), stop_success=0.99,
            )  # fmt: skip
        case "cpu":
            course = make_task(task, action_repeat=5, **easy)
            small = PpoConfig(rollout=32, minibatches=4, width=128, channels=(16, 32, 32))
            return Preset(course, learner_preset("cpu", lr=6e-4, mean_pull=0.01), 8_000, instances=8, ppo=small)
        case "smoke":
            course = make_task(task, action_repeat=5, **easy)
            tiny = learner_preset("cpu", deter=64, hidden=32, units=32, stoch=8, patch_units=16, batch_size=4)
            tiny = dataclasses.replace(tiny, batch_length=8, learning_starts=64, train_ratio=4.0, imag_horizon=4)
            small = PpoConfig(rollout=16, minibatches=2, epochs=1, width=32, channels=(8, 8, 8))
            return Preset(course, tiny, 400, instances=4, eval_every=200, eval_episodes=8, ppo=small)
    known = "'paper', 'transfer', 'wallclock', 'cpu', 'smoke', or 'auto' to go by the device"
    raise ValueError(f"unknown preset {name!r}; use {known}.")


def with_layout(preset: Preset, layout: str) -> Preset:
    """The same training in worlds of this layout. Where all look alike, the mirror shows no more than one other."""
    task = dataclasses.replace(preset.task, layout=layout)  # an unknown one is refused here
    worlds = preset.learner.mirror if task.randomised else min(preset.learner.mirror, 1)
    return dataclasses.replace(preset, task=task, learner=dataclasses.replace(preset.learner, mirror=worlds))


def with_repeat(preset: Preset, repeat: int) -> Preset:
    """The same training with a decision every `repeat` control periods.

    Control periods, updates and the horizon in seconds stay what they are; what counts decisions is scaled. A batch has
    as many steps as before, in sequences of about the same time, so that learning begins as early.
    """
    task = dataclasses.replace(preset.task, action_repeat=repeat)  # a number below 1 is refused here
    factor = repeat / preset.task.action_repeat
    learner = preset.learner
    length = max(8, round(learner.batch_length / factor))
    learner = dataclasses.replace(
        learner,
        train_ratio=learner.train_ratio * factor,
        horizon=learner.horizon / factor,
        learning_starts=round(learner.learning_starts / factor),
        batch_length=length,
        batch_size=max(1, round(learner.replayed_per_update / length)),
    )
    return dataclasses.replace(
        preset,
        task=task,
        learner=learner,
        total_steps=round(preset.total_steps / factor),
        eval_every=max(1, round(preset.eval_every / factor)),
    )


def with_settings(learner: Any, settings: Sequence[str]) -> Any:
    """The learner's configuration with some settings changed, each given as NAME=VALUE with a value as in JSON.

    ValueError says what is wrong with one.
    """
    known = {field.name for field in dataclasses.fields(learner)}
    changes = {}
    for text in settings:
        name, _, value = text.partition("=")
        if name not in known:
            raise ValueError(f"{text!r} changes no setting of the learner; these are: {', '.join(sorted(known))}.")
        try:
            found = json.loads(value)
        except json.JSONDecodeError as error:
            raise ValueError(f"{text!r}: give NAME=VALUE, the value as in JSON: 0.1, true or [1, 2].") from error
        changes[name] = tuple(found) if isinstance(found, list) else found
        if not _alike(changes[name], getattr(learner, name)):
            raise ValueError(f"{text!r}: {name} is {getattr(learner, name)!r} by default; give a finite value like it.")
    return dataclasses.replace(learner, **changes)


def _alike(value: Any, default: Any) -> bool:
    """Whether a setting has the type of its default; numbers must be finite."""
    if isinstance(default, tuple):
        same = isinstance(value, tuple) and all(isinstance(one, (int, float, str)) for one in value)
        return same and (not default or all(_alike(one, default[0]) for one in value))
    if isinstance(default, (bool, str)):
        return isinstance(value, type(default))
    if isinstance(default, int):
        return isinstance(value, int)
    return isinstance(value, (int, float)) and math.isfinite(value)


def to_transition(step: TimeStep) -> Transition:
    """A time step as the learner reads it."""
    metrics = {name: step.metrics[name] for name in END_METRICS}
    ended = step.terminated | step.truncated
    return Transition(step.obs, step.reward, step.first, ended, step.terminated, metrics)


def functional_env(
    batch: BatchEnv, safety: Safety | None = None, shaped: bool = True, targets: bool = False
) -> FunctionalEnv:
    """The learner's view of a batch of chairs, with left and right as its mirror.

    Args:
        batch: the chairs.
        safety: limits the commands and, if `shaped`, takes its penalties off the reward; None asks nothing.
        shaped: False leaves the reward the task's own, as evaluations must.
        targets: show what only the simulator knows too, as TRUTH beside "camera"; it is no input of a policy.
    """
    safety = safety or Safety()
    task = batch.env.task
    seconds = batch.env.model.config.control_dt * task.action_repeat

    def emit(state: Any, step: TimeStep) -> Transition:
        transition = to_transition(step)
        if not targets:
            return transition
        known = jax.vmap(lambda one: privileged.truth(batch.env, one))(state.env)
        return dataclasses.replace(transition, obs={"camera": step.obs, TRUTH: known})

    def reset(key: jax.Array) -> tuple[Any, Transition]:
        state, step = batch.reset(key)
        return state, emit(state, step)

    def step(state: Any, action: jax.Array) -> tuple[Any, Transition]:
        before = state.env.command
        if safety.limits:
            action = jax.vmap(lambda a, b: limit_action(task, safety, a, b, seconds))(action, before)
        state, step = batch.step(state, action)
        if shaped and (safety.clearance_gain or safety.change_gain):
            span = jnp.array([task.v_max - task.v_min, 2.0 * task.omega_max]) / 2.0
            change = (state.env.command - before) / span
            near = step.metrics["clearance"]
            lost = jax.vmap(lambda distance, moved: penalty(safety, distance, moved, seconds))(near, change)
            step = dataclasses.replace(step, reward=step.reward - jnp.where(step.first, 0.0, lost))
        return state, emit(state, step)

    image = (batch.env.height, batch.env.width, 3)
    shape = {"camera": image, TRUTH: (privileged.SIZE,)} if targets else image
    return FunctionalEnv(
        num_envs=batch.count, obs_shape=shape, action_dim=2, reset=reset, step=step, mirror=mirror_of(batch)
    )


def mirror_of(batch: BatchEnv) -> Mirror:
    """Left and right exchanged. A vehicle that pulls to one side breaks the symmetry by as much as it pulls.

    Where looks are drawn at random, each of its worlds has its own, every second one with left and right as they are:
    what is learned from one drive is seen in several.
    """
    paints = batch.env.repaints

    def turned(plain: jax.Array, mirrored: jax.Array) -> jax.Array:
        """Every second of the worlds (K, ...) as it is."""
        every_second = jnp.arange(plain.shape[0]) % 2 == 1
        return jnp.where(every_second.reshape(-1, *[1] * (plain.ndim - 1)), plain, mirrored)

    def other_obs(state: Any, obs: Any, worlds: int) -> Any:
        known = isinstance(obs, dict)
        image = batch.observe_repainted(state, worlds) if paints else (obs["camera"] if known else obs)[None]
        image = turned(image, image[..., ::-1, :])
        if not known:
            return image
        vector = jnp.broadcast_to(obs[TRUTH], (worlds, *obs[TRUTH].shape))
        return {"camera": image, TRUTH: turned(vector, privileged.mirrored(vector))}

    def other_action(action: jax.Array, worlds: int) -> jax.Array:
        action = jnp.broadcast_to(action, (worlds, *action.shape))
        return turned(action, action * jnp.array([1.0, -1.0]))

    return Mirror(other_obs, other_action, worlds=PAINTS if paints else 1)


def make_training_env(
    task: Task, vehicle: str | Path | None, instances: int, spread: float = 0.0, devices: tuple = (),
    exploring_starts: float = 0.0, second_tries: float = 0.0, looks: str | None = None,
) -> BatchEnv:  # fmt: skip
    """`instances` chairs of a vehicle file or preset in a task, split over `devices`; for the rest see `Preset`."""
    env, params = make_env(task, vehicle, exploring_starts=exploring_starts, looks=looks)
    return make_batch(env, params, instances, spread, devices, second_tries)


def dreamer_policy(preset: Preset, params: Params, control_dt: float) -> tuple[Step, dict[str, Any]]:
    """The trained agent as the step of one instance, limits included, and its first carry."""
    learner = preset.learner
    params = jax.tree.map(jnp.asarray, params)
    carry = agents.policy_carry(learner, 2)
    if preset.looks == "rich":
        carry[agents.SURPRISE] = jnp.zeros(1)
    return limited_policy(
        preset.task, preset.safety, lambda carry, image: agents.policy_step(learner, params, carry, image),
        carry, control_dt * preset.task.action_repeat,
    )  # fmt: skip


def ppo_policy(preset: Preset, params: Any, control_dt: float, size: tuple[int, int]) -> tuple[Step, dict[str, Any]]:
    """The same of the model-free baseline, for images of `size` (H, W)."""
    return limited_policy(
        preset.task, preset.safety, lambda carry, image: ppo.policy_step(preset.ppo, params, carry, image),
        ppo.policy_carry(preset.ppo, *size), control_dt * preset.task.action_repeat,
    )  # fmt: skip


def step_driver(step: Step, carry: dict[str, Any], period: int, name: str = "policy") -> Driver:
    """A policy step as a driver of evaluations."""

    def act(memory: Any, state: State, image: jax.Array, key: jax.Array) -> tuple[Any, jax.Array]:
        return step(memory, image)

    return Driver(name, lambda state, key: carry, act, period)

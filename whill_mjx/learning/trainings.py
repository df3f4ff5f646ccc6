"""The training itself: of the world model and its policy, or of the baseline without one; with evaluations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax

from dreamer.evaluate import Rounds, evaluate
from dreamer.train import TrainingOptions, train
from dreamer.training import checkpoint
from dreamer.training.programs import Kept, Programs
from whill_mjx.batch import BatchEnv
from whill_mjx.devices import choose_devices
from whill_mjx.evaluation.episodes import Course, episode_keys
from whill_mjx.evaluation.rollouts import rollout
from whill_mjx.io.heartbeat import say
from whill_mjx.learning.checks import Evaluate, Stopper, keep_best, mean_figures, read_best
from whill_mjx.learning.kept import kept_programs
from whill_mjx.learning.options import TrainOptions
from whill_mjx.learning.ppo_training import Length, train_ppo
from whill_mjx.learning.setup import (
    Preset,
    dreamer_policy,
    functional_env,
    learned_env,
    make_evaluation_env,
    make_training_env,
    ppo_policy,
    step_driver,
)
from whill_mjx.learning.shaping import Step

Stage = Callable[[str], None]
"""Gets a line when a stage of the command begins."""


@dataclass(frozen=True)
class Trained:
    """What either learner leaves."""

    params: Any
    env_steps: int
    updates: int
    wall_s: float


def train_policy(options: TrainOptions, preset: Preset, vehicle: Path, stage: Stage = say) -> Trained:
    """Train the world model and its policy, with an evaluation every `eval_every` steps."""
    devices = choose_devices(options.devices)
    batch = make_training_env(preset, vehicle, devices)
    held_out = make_evaluation_env(preset.task, vehicle, preset.eval_episodes, preset.looks)
    kept = kept_programs(preset, options.learner, vehicle, devices)
    evaluate = evaluation_of(held_out, preset, options.seed, kept)
    stopper = Stopper(options.out, preset.stop_success)
    result = train(
        learned_env(preset, batch),
        preset.learner,
        options.out,
        stopper.total_steps(preset.total_steps),
        options.seed,
        TrainingOptions(
            eval_fn=keep_best(options.out, preset, evaluate),
            eval_ahead=lambda params: evaluate(params, 0),
            eval_every=preset.eval_every,
            checkpoint_every_s=options.checkpoint_every_s,
            stop=stopper,
            devices=devices,
            tensorboard=options.tensorboard,
            kept=kept,
            announce=stage,
        ),
    )
    return Trained(jax.device_get(result.agent.acting), result.env_steps, result.updates, result.wall_s)


def train_baseline(options: TrainOptions, preset: Preset, vehicle: Path, stage: Stage = say) -> Trained:
    """Train the model-free baseline with as many environment steps."""
    devices = choose_devices(options.devices)
    batch = make_training_env(preset, vehicle, devices)
    course = make_course(preset, vehicle)
    keys = episode_keys(options.seed + 77, preset.eval_episodes)
    vehicles = course.vehicles(keys)
    step, carry = policy_of(options, preset, course)
    kept = kept_programs(preset, options.learner, vehicle, devices)

    @jax.jit
    def ends(params: Any, vehicles: Any, keys: jax.Array) -> dict[str, jax.Array]:
        driver = step_driver(step, params, carry, preset.task.action_repeat)
        return rollout(course.env, vehicles, keys, driver).ends

    ended = Kept("ppo_evaluate", ends, kept)

    def evaluate(params: Any, env_steps: int) -> dict[str, float]:
        episodes = jax.device_get(ended(params, vehicles, keys))
        return mean_figures({**episodes, "return": episodes["episode_return"]})

    stopper = Stopper(options.out, preset.stop_success)
    how = TrainingOptions(
        eval_fn=evaluate,
        eval_ahead=None if devices else lambda params: evaluate(params, 0),
        eval_every=preset.eval_every,
        checkpoint_every_s=options.checkpoint_every_s,
        stop=stopper,
        kept=kept,
        announce=stage,
    )
    length = Length(preset.total_steps, stopper.total_steps(preset.total_steps))
    env = functional_env(batch, preset.safety)
    return Trained(*train_ppo(env, preset.ppo, options.out, length, options.seed, how))


def evaluation_of(batch: BatchEnv, preset: Preset, seed: int, kept: Programs | None = None) -> Evaluate:
    """(params, steps) -> figures of one episode in every instance of `batch`; always the same worlds."""
    env = functional_env(batch, preset.safety, shaped=False)

    def run(params: Any, env_steps: int) -> dict[str, float]:
        key = jax.random.key(seed + 77)
        return mean_figures(evaluate(env, preset.learner, params, key, batch.count, Rounds(kept=kept)))

    return run


def best_params(options: TrainOptions, preset: Preset, result: Trained) -> Trained | None:
    """The best parameters, if they are not those at the end of the run."""
    best = read_best(options.out)
    if best is None or best["env_steps"] == result.env_steps:
        return None
    path = options.out / "best" / f"{int(best['env_steps']):012d}"
    try:
        state, _ = checkpoint.load(path, {"params": result.params}, preset.learner)
    except checkpoint.CheckpointError as error:
        say(f"the best parameters are lost, so the last ones become the policy: {error}")
        return None
    return Trained(state["params"], int(best["env_steps"]), result.updates, result.wall_s)


def make_course(preset: Preset, vehicle: Path) -> Course:
    """The environment of evaluations."""
    batch = make_evaluation_env(preset.task, vehicle, 1, preset.looks)
    return Course(batch.env, batch.params)


def policy_of(options: TrainOptions, preset: Preset, course: Course) -> tuple[Step, dict[str, Any]]:
    """What drives, and is exported: the step of one instance and its first carry."""
    return (ppo_policy if options.learner == "ppo" else dreamer_policy)(preset, course.env)

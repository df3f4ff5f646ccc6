"""What a training comes to: the final evaluation with its pictures, and the policy file."""

from __future__ import annotations

import dataclasses
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from dreamer.policy_files.export import PolicyContract, SensingPolicy, export_policy, export_sensing
from whill_mjx.evaluation.drivers import planner_driver, random_driver
from whill_mjx.evaluation.episodes import episode_keys
from whill_mjx.evaluation.policies.novelty import SURPRISE, largest_surprise, limits
from whill_mjx.evaluation.policies.policy_file import camera_contract, sensor_contract
from whill_mjx.io.fields import percent
from whill_mjx.io.formats import stamp
from whill_mjx.io.heartbeat import say
from whill_mjx.learning.final_report import evaluate_drivers, write_report
from whill_mjx.learning.options import TrainOptions
from whill_mjx.learning.prediction import write_prediction
from whill_mjx.learning.setup import Preset, obs_shape_of, step_driver
from whill_mjx.learning.trainings import Stage, Trained, make_course, policy_of
from whill_mjx.logs.dataset import plain

NOVELTY_SEED, NOVELTY_EPISODES = 3_000_017, 200  # episodes in which a policy meets its own world
FINAL_SEED = 1_000_003  # keys of the final evaluation, apart from those of the training


def evaluate_policy(
    options: TrainOptions, preset: Preset, vehicle: Path, result: Trained, stage: Stage = say
) -> dict[str, Any]:
    """Drive the final evaluation with the policy, the planner and random actions; write pictures and videos."""
    from whill_mjx.evaluation.output import pictures

    course = make_course(preset, vehicle)
    step, carry = policy_of(options, preset, course)
    driver = step_driver(step, jax.tree.map(jnp.asarray, result.params), carry, preset.task.action_repeat)
    drivers = {"policy": driver, "random": random_driver(preset.task.action_repeat)}
    if options.planner:
        drivers["planner"] = planner_driver(course.env)
    with jax.default_matmul_precision("highest"):  # float32, as on the vehicle; a GPU would round to fewer bits
        driven = evaluate_drivers(course, drivers, FINAL_SEED + options.seed, options.episodes, stage)
    stage("drawing pictures and videos of the final evaluation")
    summary = write_report(options.out, course, driven, options.videos, say)
    references: dict[str, float] = {name: summary[name]["return"] for name in drivers if name != "policy"}
    try:
        pictures.reward_curve(
            options.out / "metrics.jsonl", options.out / "reward_curve.png", references, preset.task.action_repeat
        )
    except ImportError as error:
        say(f"reward_curve.png is left out: {error}. Install the base package to draw it.")
    seen = options.learner == "dreamer" and not course.env.sensors  # other observations make no picture
    if options.videos and seen and preset.learner.representation == "reconstruct":
        stage("drawing what the world model predicts")
        try:
            key = jax.random.key(FINAL_SEED + options.seed)
            write_prediction(options.out / "prediction.gif", preset, vehicle, result.params, options.videos, key)
        except ImportError as error:
            say(f"prediction.gif is left out: {error}. Install the base package to draw it.")
    return {**stamp("whill-mjx-evaluation"), "task": plain(preset.task), "learner": options.learner,
            "seed": options.seed, "env_steps": result.env_steps, "updates": result.updates, **summary}


def outcome_line(evaluation: dict[str, Any]) -> str:
    """Successes of the policy and of its baselines in the final evaluation."""
    share, (low, high) = evaluation["policy"]["success"], evaluation["policy"]["success_interval_95"]
    baselines = [name for name in ("planner", "random") if name in evaluation]
    others = "".join(f", {name} {percent(evaluation[name]['success'])}" for name in baselines)
    return f"success {percent(share)} (95% interval {percent(low)} to {percent(high)}){others}"


def diverged_note(evaluation: dict[str, Any]) -> str:
    """Why episodes of the policy ended as diverged; nothing where none did."""
    share = evaluation["policy"]["diverged"]
    why = "a reward, a sensor or the motion became not finite, or the vehicle turned over"
    return f"; diverged: {percent(share)} of the episodes: {why}" if share else ""


def export(options: TrainOptions, preset: Preset, vehicle: Path, result: Trained, path: Path) -> Path | None:
    """Write a policy file."""
    task = preset.task
    course = make_course(preset, vehicle)
    contract = PolicyContract(
        action_low=(task.v_min, -task.omega_max),
        action_high=(task.v_max, task.omega_max),
        task=options.task,
        rate_hz=10.0,
        action_repeat=task.action_repeat,
        camera=camera_contract(course.env.model, course.params),
    )
    policy, carry = policy_of(options, preset, course)
    weights = jax.tree.map(jnp.asarray, result.params)
    if SURPRISE in carry:
        keys = episode_keys(NOVELTY_SEED + options.seed, NOVELTY_EPISODES)
        with jax.default_matmul_precision("highest"):  # as the runtime that will be held to these limits
            surprises = largest_surprise(course.env, course.params, policy, weights, carry, keys)
        contract = dataclasses.replace(contract, novelty=limits(*surprises))
    shown, step = obs_shape_of(course.env), partial(policy, weights)
    try:
        if isinstance(shown, dict):
            sensors = sensor_contract(course.env, course.params)
            return export_sensing(path, SensingPolicy(step, carry, shown, result.params, sensors), contract, vehicle)
        return export_policy(path, step, carry, result.params, contract, vehicle_file=vehicle)
    except ImportError as error:
        say(f"the policy file is left out: {error}. Install the base package and give the same command again.")
        return None

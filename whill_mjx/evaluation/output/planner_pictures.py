"""What is seen of a planner's drive: a sheet of many worlds, a film of one episode, or a recording for a viewer."""

from __future__ import annotations

import dataclasses
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from whill_mjx.env import Env, State, observe, reset_state, step_state
from whill_mjx.env.view_from_above import top_view
from whill_mjx.evaluation.output.rerun_log import RerunLog, step_with_terms
from whill_mjx.evaluation.planner import PlannerConfig, first_plan, for_task, plan_action
from whill_mjx.io.folders import whole_file
from whill_mjx.vehicle.types import VehicleParams

QUICKLY = {"xla_backend_optimization_level": 1}
"""Of programs that run once: compiling takes longer than they do, and the picture is the same bit for bit."""


def contact_sheet(env: Env, params: VehicleParams, worlds: int, steps: int, seed: int = 0) -> np.ndarray:
    """Sheet (rows, columns, 3) uint8 of `worlds` worlds, at the size of the camera image."""
    keys = jax.vmap(partial(jax.random.split, num=3))(jax.random.split(jax.random.key(seed), worlds))
    reset_keys, plan_keys, drive_keys = keys.T
    with ThreadPoolExecutor() as threads:  # XLA compiles without holding Python's lock

        def begin(function, *args):
            """What the function of one world gives, as shapes, and the program of all, which is being compiled."""
            traced = jax.jit(jax.vmap(function)).trace(*args)
            return traced.out_info, threads.submit(lambda: traced.lower().compile(compiler_options=QUICKLY))

        start, reset = begin(partial(reset_state, env, params), reset_keys)
        plan, first = begin(partial(first_plan, for_task(env.task), env), start, plan_keys)
        (later, path), drive = begin(partial(_drive, env, params, steps=steps), start, plan, drive_keys)
        _, above = begin(partial(top_view, env), later, path)
        _, see = begin(partial(observe, env), start)
    run_reset, run_first, run_drive, run_above, run_see = (
        one.result() for one in (reset, first, drive, above, see)
    )
    start = run_reset(reset_keys)
    later, path = run_drive(start, run_first(start, plan_keys), drive_keys)
    images = run_see(start), run_see(later), run_above(later, path)
    return np.concatenate([np.concatenate(np.asarray(row), axis=1) for row in images])


def _drive(
    env: Env, params: VehicleParams, start: State, plan: jax.Array, key: jax.Array, steps: int
) -> tuple[State, jax.Array]:
    """State of one instance after `steps` control periods of the planner, and about twelve points (T, 2) of its way."""
    config = for_task(env.task)

    def one_step(carry, step_key):
        state, plan = carry
        action, plan = plan_action(config, env, state, plan, step_key)
        state, outcome = step_state(env, params, state, action)
        return (state, plan), jnp.stack([outcome.metrics["x"], outcome.metrics["y"]])

    (later, _), path = jax.lax.scan(one_step, (start, plan), jax.random.split(key, steps))
    return later, path[:: max(1, steps // 12)]


def planner_film(env: Env, params: VehicleParams, seed: int) -> tuple[list[np.ndarray], float]:
    """Frames (H, W, 3) uint8 that the camera sees in an episode of the planner, and how many there are in a second."""
    config, state, plan, plan_key = _start(env, params, seed)

    def one_step(state, plan, step_key):
        action, plan = plan_action(config, env, state, plan, step_key)
        return step_state(env, params, state, action)[0], plan, observe(env, state)

    step, frames = jax.jit(one_step), []
    for number in range(env.task.max_steps):
        state, plan, image = step(state, plan, jax.random.fold_in(plan_key, number))
        frames.append(np.asarray(image))
        if bool(state.done):
            break
    return frames, 1.0 / (env.model.config.control_dt * env.task.action_repeat)


def record_planner(env: Env, params: VehicleParams, seed: int, path: Path | None, live: bool) -> int:
    """Drive an episode with the planner for the Rerun viewer; returns its number of control periods.

    Args:
        env: static model and task.
        params: of the vehicle.
        seed: of the episode.
        path: recording to write (.rrd), whole or not at all; None writes none.
        live: open the viewer, and show the drive as it comes.
    """
    env = dataclasses.replace(env, task=dataclasses.replace(env.task, action_repeat=1))
    config, state, plan, plan_key = _start(env, params, seed)

    def one_step(state, plan, step_key):
        action, plan = plan_action(config, env, state, plan, step_key)
        return *step_with_terms(env, params, state, action), plan

    step = jax.jit(one_step)
    with nullcontext() if path is None else whole_file(path) as temporary:
        with RerunLog(env, temporary, live) as log:
            log.begin(state)
            for number in tqdm(range(env.task.max_steps), unit="step", leave=False):
                state, rewards, plan = step(state, plan, jax.random.fold_in(plan_key, number))
                log.moment(state, rewards)
                if bool(state.done):
                    break
    return int(state.step_count)


def _start(env: Env, params: VehicleParams, seed: int) -> tuple[PlannerConfig, State, jax.Array, jax.Array]:
    """What a planner's episode begins with: its settings, the state, a plan, and the key of all later plans."""
    config = for_task(env.task)
    key, plan_key = jax.random.split(jax.random.key(seed))
    state = jax.jit(partial(reset_state, env, params))(key)
    return config, state, first_plan(config, env, state, plan_key), plan_key

"""The host's side of a PPO training: dispatch, evaluate, and log in the same words as the other learner."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from whill_mjx.learning.ppo import PpoConfig, init_state, iterate


def train_ppo(
    env: Any,
    config: PpoConfig,
    out: Path,
    total_steps: int,
    seed: int,
    eval_fn: Callable[[Any, int], dict[str, float]] | None = None,
    eval_every: int = 10_000,
    stop: Callable[[dict[str, float]], bool] | None = None,
    say: Callable[[str], None] = lambda text: None,
    eval_ahead: bool = False,
) -> tuple[Any, int, int, float]:
    """Train until `total_steps` environment steps, summed over instances, are done, or until `stop` says so.

    It starts anew each time: a baseline of minutes keeps no checkpoints.

    Args:
        env: vector environment.
        config: hyperparameters.
        out: folder that gets metrics.jsonl.
        total_steps: rounded up to whole rollouts.
        seed: of everything random.
        eval_fn: (params, env_steps) -> figures, logged as eval/...
        eval_every: environment steps between evaluations; one more happens at the end.
        stop: called with every line that holds an evaluation; True ends the run.
        say: told each evaluation.
        eval_ahead: call `eval_fn` once in a thread at the start, so that it is compiled beside the run's own program.
            Not with several devices.

    Returns:
        Parameters, environment steps, gradient steps and time [s].
    """
    out.mkdir(parents=True, exist_ok=True)
    began, each = time.monotonic(), env.num_envs * config.rollout
    iterations = -(-total_steps // each)
    state = jax.jit(lambda: init_state(env, config, iterations, seed))()
    threads = ThreadPoolExecutor(1)
    params = jax.tree.map(jnp.copy, state.params)  # the run's own are donated
    ready = [threads.submit(eval_fn, params, 0)] if eval_ahead and eval_fn is not None else []
    threads.shutdown(wait=False)
    run = jax.jit(lambda state: iterate(env, config, iterations, state), donate_argnums=0)
    evaluated_at = 0
    with (out / "metrics.jsonl").open("w") as file:
        for iteration in range(1, iterations + 1):
            state, metrics = run(state)
            env_steps = iteration * each
            due = iteration == iterations or env_steps // eval_every > evaluated_at
            if not due:
                continue
            evaluated_at = env_steps // eval_every
            line = _line(jax.device_get(metrics), env_steps, iteration * config.epochs * config.minibatches)
            line["wall_s"] = time.monotonic() - began
            if eval_fn is not None:
                wait(ready)
                line |= {f"eval/{name}": value for name, value in eval_fn(state.params, env_steps).items()}
            file.write(json.dumps(line) + "\n")
            file.flush()
            say(f"{env_steps} steps: " + ", ".join(f"{name} {line[name]:.3g}" for name in line if "eval/" in name))
            if stop is not None and stop(line):
                break
    return state.params, env_steps, iteration * config.epochs * config.minibatches, time.monotonic() - began


def _line(metrics: dict[str, Any], env_steps: int, updates: int) -> dict[str, float]:
    """Sums over ended episodes as means."""
    line: dict[str, float] = {"env_steps": env_steps, "updates": updates}
    episodes = float(metrics["episodes"])
    for name, value in metrics.items():
        if not name.startswith("episode/"):
            line[name] = float(value)
        elif episodes:
            renamed = "episode/return" if name == "episode/episode_return" else name
            line[renamed] = float(value) / episodes
    return line

"""The host's side of a PPO training: dispatch, evaluate, log in the same words as the other learner, and resume."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from dreamer import checkpoint
from dreamer.progress import Progress
from whill_mjx.io.folders import write_whole
from whill_mjx.io.reading import read_lines
from whill_mjx.learning.ppo import PpoConfig, PpoState, init_state, iterate

SHOWN = ("success", "return")
"""Figures of an evaluation in the progress bar."""


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
    checkpoint_every_s: float = 60.0,
    last_step: int | None = None,
    announce: Callable[[str], None] = lambda text: None,
    progress: bool = False,
) -> tuple[Any, int, int, float]:
    """Train until `total_steps` environment steps, summed over instances, are done, or until `stop` says so.

    A run that was interrupted goes on from its last checkpoint in `out`, as if nothing had happened.

    Args:
        env: vector environment.
        config: hyperparameters.
        out: folder that gets metrics.jsonl and checkpoints/.
        total_steps: rounded up to whole rollouts; a resumed run must get the same, since its learning rate spans them.
        seed: of everything random.
        eval_fn: (params, env_steps) -> figures, logged as eval/...
        eval_every: environment steps between evaluations; one more happens at the end.
        stop: called with every line that holds an evaluation; True ends the run.
        say: gets a line for each evaluation.
        eval_ahead: call `eval_fn` once in a thread at the start, so that it is compiled beside the run's own program.
            Not with several devices.
        checkpoint_every_s: time between checkpoints [s]; one more is written at the end.
        last_step: environment step at which an earlier start of this run was stopped; none trains them all.
        announce: gets a line when something begins that takes long.
        progress: show a bar on stderr.

    Returns:
        Parameters, environment steps, gradient steps and time [s].
    """
    out.mkdir(parents=True, exist_ok=True)
    each, updates_each = env.num_envs * config.rollout, config.epochs * config.minibatches
    iterations = -(-total_steps // each)
    last = iterations if last_step is None else min(iterations, -(-last_step // each))
    announce("compiling the training program, usually 1 to 2 minutes")
    state, wall_before = _first_state(env, config, out, iterations, seed)
    done, began = int(state.updates), time.monotonic()
    logged = done * each // eval_every
    _keep_lines(out / "metrics.jsonl", done * each)
    ready = _ahead(eval_fn, state.params) if eval_ahead and eval_fn is not None and done < last else []
    run = jax.jit(lambda state: iterate(env, config, iterations, state), donate_argnums=0)
    saved_at = time.monotonic()

    def wall_s() -> float:
        return wall_before + time.monotonic() - began

    def save() -> None:
        checkpoint.save(out / "checkpoints", state, config, int(state.updates) * each, wall_s())

    def due(done: int) -> bool:
        return done == last or done * each // eval_every > logged

    def evaluated(metrics: dict[str, Any]) -> dict[str, float]:
        line = _line(jax.device_get(metrics), done * each, done * updates_each)
        line["wall_s"] = wall_s()
        if eval_fn is not None:
            wait(ready)
            line |= {f"eval/{name}": value for name, value in eval_fn(state.params, done * each).items()}
        with (out / "metrics.jsonl").open("a") as file:
            file.write(json.dumps(line) + "\n")
        say(f"{done * each} steps: " + ", ".join(f"{name} {line[name]:.3g}" for name in line if "eval/" in name))
        return line

    stopped, running, bar = False, None, Progress(iterations * each, done * each, progress)
    try:
        while done < last and not stopped:
            state, metrics = run(state)
            done += 1
            if progress:
                jax.block_until_ready(running)  # the device stays at most one iteration behind the bar
                bar.show(done * each, {})
            running = metrics
            if due(done):
                line = evaluated(metrics)
                bar.note({name: f"{line[f'eval/{name}']:.3g}" for name in SHOWN if f"eval/{name}" in line})
                logged = done * each // eval_every
                stopped = stop is not None and stop(line)
            if done == last or stopped or time.monotonic() - saved_at >= checkpoint_every_s:
                save()
                saved_at = time.monotonic()
    except KeyboardInterrupt:
        if checkpoint.is_whole(state) and not due(int(state.updates)):
            save()  # an evaluation that is due would be missing from the run that goes on from here
        raise
    finally:
        bar.close()
    return state.params, done * each, done * updates_each, wall_s()


def _first_state(env: Any, config: PpoConfig, out: Path, iterations: int, seed: int) -> tuple[PpoState, float]:
    """State to start from and the time [s] already spent."""
    state = jax.jit(lambda: init_state(env, config, iterations, seed))()
    restored = checkpoint.restore(out / "checkpoints", state, config)
    return (state, 0.0) if restored is None else (restored[0], float(restored[1]["wall_s"]))


def _keep_lines(path: Path, env_steps: int) -> None:
    """Drop the lines of a log that a resumed run is about to write again, and one that a kill has cut off."""
    kept = [text for text, line in read_lines(path) if line["env_steps"] <= env_steps]
    write_whole(path, "".join(text + "\n" for text in kept))


def _ahead(eval_fn: Callable[[Any, int], Any], params: Any) -> list[Future]:
    """An evaluation in a thread, with a copy of the parameters: the run's own are donated."""
    threads = ThreadPoolExecutor(1)
    ready = [threads.submit(eval_fn, jax.tree.map(jnp.copy, params), 0)]
    threads.shutdown(wait=False)
    return ready


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

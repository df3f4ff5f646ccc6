"""The learner on tasks that are not ours: cart-pole of the DeepMind Control Suite, and a grid world of discrete moves.

    python -m benchmarks.cartpole --task balance --seeds 3 --steps 100000 --preset size12m --minutes 9
    python -m benchmarks.cartpole --task balance --sight joints --preset tiny --steps 20000     # minutes on a CPU
    python -m benchmarks.cartpole --task grid --preset tiny --steps 20000

Steps are those of the suite (0.01 s), of which a decision takes two (grid: one). All seeds run in one program. The same
command goes on where it was stopped, by the clock or by a kill; the curve of every seed goes into
results/dreamer_control.json.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import statistics
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import cartpole_env, grid_env
from benchmarks.harness import figure, record
from dreamer import spaces
from dreamer.config import DreamerConfig, preset
from dreamer.evaluate import evaluate
from dreamer.train import train
from dreamer.types import FunctionalEnv

CLAIM = "DreamerV3 on tasks that are not ours; the curve of every seed, [environment steps, return of each seed]"
TINY = dict(
    deter=128, hidden=64, units=64, stoch=8, classes=8, batch_size=8, batch_length=32, lr=1e-3, warmup=100,
    policy_layers=2, value_layers=2, vector_layers=2, imag_last=8, learning_starts=512,
    patch=4, entropy_scale=3e-3, train_ratio=128.0,
)  # fmt: skip
"""Upon the preset `cpu`: a network for minutes on a CPU."""


@dataclasses.dataclass(frozen=True)
class Task:
    """An environment for training and one for evaluation."""

    train: FunctionalEnv
    test: FunctionalEnv
    repeat: int
    """Environment steps of one decision."""
    max_decisions: int
    """Of an episode, one more than its length."""


def make_task(options: argparse.Namespace) -> Task:
    """The task of the command line."""
    if options.task == "grid":
        return Task(grid_env.make(options.instances), grid_env.make(options.episodes), 1, grid_env.LIMIT + 1)
    repeat = 2
    training, testing = (
        cartpole_env.make(options.task, count, options.sight, repeat) for count in (options.instances, options.episodes)
    )
    return Task(training, testing, repeat, cartpole_env.EPISODE_STEPS // repeat + 1)


def make_config(options: argparse.Namespace, task: Task) -> DreamerConfig:
    """The preset, with the replay as large as the run."""
    decisions = options.steps // task.repeat
    given: dict[str, Any] = {"replay_capacity": decisions + 2 * options.instances}
    if options.ratio is not None:
        given["train_ratio"] = options.ratio
    if options.unroll is not None:
        given["scan_unroll"] = options.unroll
    if options.preset == "tiny":
        return preset("cpu", **{**TINY, **given})  # type: ignore[arg-type]
    return preset(options.preset, **given)


def random_return(env: FunctionalEnv, decisions: int) -> float:
    """Mean return of uniformly random actions over the first episode of every instance."""
    actions = spaces.actions(env.action_dim)

    def one(carry: tuple, key: jax.Array) -> tuple[tuple, None]:
        state, total, over = carry
        state, transition = env.step(state, actions.to_env(actions.random(key, (env.num_envs,))))
        return (state, total + jnp.where(over, 0.0, transition.reward), over | transition.is_last), None

    def play(key: jax.Array) -> jax.Array:
        state, _ = env.reset(key)
        start = (state, jnp.zeros((env.num_envs,)), jnp.zeros((env.num_envs,), bool))
        return jnp.mean(jax.lax.scan(one, start, jax.random.split(key, decisions))[0][1])

    return float(jax.jit(play)(jax.random.PRNGKey(4)))


def run(options: argparse.Namespace) -> None:
    """Train all seeds, and record their curves as far as they go."""
    task = make_task(options)
    config = make_config(options, task)
    seeds = tuple(range(options.first_seed, options.first_seed + options.seeds))
    out = options.out / f"{label(options)}_{options.steps}_{seeds[0]}-{seeds[-1]}"
    began = time.monotonic()

    def evaluation(params: Any, decisions: int) -> dict[str, float]:
        result = evaluate(
            task.test, config, params, jax.random.PRNGKey(77), options.episodes, max_steps=task.max_decisions
        )
        each = np.atleast_2d(result["return"]).mean(-1)
        text = " ".join(f"{value:.4g}" for value in each)
        print(f"{decisions * task.repeat} steps, {time.monotonic() - began:.0f} s: return {text}", flush=True)
        return {f"return_{seed}": float(value) for seed, value in zip(seeds, each, strict=True)}

    result = train(
        task.train, config, out, options.steps // task.repeat, seeds, eval_fn=evaluation,
        eval_every=max(1, options.eval_every // task.repeat), checkpoint_every_s=options.checkpoint_s, log_every_s=10.0,
        on_metrics=progress(task, began), progress=False,
        time_limit_s=None if options.minutes is None else 60 * options.minutes,
    )  # fmt: skip
    lines = [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]
    figures = summary(options, task, config, seeds, lines)
    for name, entry in figures.items():
        print(f"{name}: {entry['value']:.4g} {entry['unit']} {[round(x, 3) for x in entry['repeats']]}", flush=True)
    if result.env_steps * task.repeat < options.steps:
        print(f"stopped at {result.env_steps * task.repeat} of {options.steps} steps; the same command goes on.")
    if figures and not options.dry:
        print(f"written to {record('dreamer_control', CLAIM, figures)}")


def progress(task: Task, began: float) -> Any:
    """Prints a line for every logged one."""

    def say(line: dict[str, float]) -> None:
        names = ("updates_per_s", "updates_per_env_step", "episode/return", "kl", "policy_std", "policy_certainty")
        text = ", ".join(f"{name} {line[name]:.3g}" for name in names if name in line)
        print(f"{int(line['env_steps']) * task.repeat} steps, {time.monotonic() - began:.0f} s: {text}", flush=True)

    return say


def label(options: argparse.Namespace) -> str:
    """What the figures' names begin with."""
    return "_".join([options.task, *([] if options.task == "grid" else [options.sight]), options.preset])


def summary(
    options: argparse.Namespace, task: Task, config: DreamerConfig, seeds: tuple[int, ...], lines: list[dict]
) -> dict[str, dict[str, Any]]:
    """Figures of a run: the return of every seed at its last evaluation, with the curve; speed and time."""
    evaluated = [line for line in lines if f"eval/return_{seeds[0]}" in line]
    if not evaluated:
        return {}
    curve = [
        [int(line["env_steps"]) * task.repeat, [round(line[f"eval/return_{seed}"], 3) for seed in seeds]]
        for line in evaluated
    ]
    name = label(options)
    rates = [line["updates_per_s"] for line in lines if line["updates_per_s"] > 0][1:] or [0.0]
    last = evaluated[-1]
    return {
        f"{name}_return": {
            **figure([last[f"eval/return_{seed}"] for seed in seeds], "-"), "steps": curve[-1][0],
            "curve": curve, "seeds": list(seeds), "episodes": options.episodes, "updates": int(last["updates"]),
            "train_ratio": config.train_ratio, "instances": options.instances,
        },
        f"{name}_random_return": figure([random_return(task.test, task.max_decisions)], "-"),
        f"{name}_minutes": {**figure([lines[-1]["wall_s"] / 60], "min"), "seeds_in_one_program": len(seeds)},
        f"{name}_updates_per_s": {
            **figure([statistics.median(rates) * len(seeds)], "1/s"), "seeds_in_one_program": len(seeds),
        },
    }  # fmt: skip


def parse() -> argparse.Namespace:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", choices=("balance", "swingup", "grid"), default="balance")
    parser.add_argument("--sight", choices=("image", "joints", "both"), default="image")
    parser.add_argument("--preset", default="size12m", help="tiny, cpu, size1m, size12m, ...")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=100_000, help="environment steps of each seed")
    parser.add_argument("--ratio", type=float, help="replayed steps per decision; the preset's unless given")
    parser.add_argument("--unroll", type=int, help="steps of the recurrences in one loop body")
    parser.add_argument("--instances", type=int, default=16)
    parser.add_argument("--episodes", type=int, default=10, help="of every evaluation")
    parser.add_argument("--eval-every", type=int, default=10_000, help="environment steps")
    parser.add_argument("--minutes", type=float, help="stop and save after so long")
    parser.add_argument("--checkpoint-s", type=float, default=600.0, help="seconds between checkpoints")
    parser.add_argument("--out", type=Path, default=Path("runs/control"))
    parser.add_argument("--dry", action="store_true", help="print only")
    return parser.parse_args()


if __name__ == "__main__":
    run(parse())

"""The learner on tasks that are not ours: cart-pole of the DeepMind Control Suite, and a grid world of discrete moves.

    python -m benchmarks.cartpole --task balance --seeds 3 --steps 100000 --preset size12m --minutes 9
    python -m benchmarks.cartpole --task balance --sight joints --preset tiny --steps 20000     # minutes on a CPU
    python -m benchmarks.cartpole --task grid --preset tiny --steps 20000

Steps are those of the suite (0.01 s), of which a decision takes two (grid: one); the train ratio counts decisions, so
that published curves with 256 for each step or 512 for each decision of two both mean --ratio 512, a quarter of an
update per step. All seeds run in one program. The same command goes on where it was stopped, by the clock or by a kill;
the curve of every seed goes into results/dreamer_control.json. Seeds that ran in processes of their own (--seeds 1
--first-seed N --separate --dry) are put together by the command of all seeds with --separate --collect DEVICE.
"""

from __future__ import annotations

import argparse
import dataclasses
import statistics
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import cartpole_env, grid_env
from benchmarks.harness import figure, record
from bridge.nodes.options import Parser, in_range, whole
from dreamer import spaces
from dreamer.config import DreamerConfig, preset
from dreamer.evaluate import Rounds, evaluate
from dreamer.train import TrainingOptions, train
from dreamer.types import FunctionalEnv
from whill_mjx.io.command_line import guarded
from whill_mjx.io.reading import read_lines

CLAIM = "DreamerV3 on tasks that are not ours; the curve of every seed, [environment steps, return of each seed]"
TINY = dict(
    deter=128, hidden=64, units=64, stoch=8, classes=8, batch_size=8, batch_length=32, lr=1e-3, warmup=100,
    policy_layers=2, value_layers=2, vector_layers=2, imag_last=8, learning_starts=512, train_ratio=128.0,
)  # fmt: skip
"""Upon the preset `cpu`: a network for minutes on a CPU."""
TINY_GRID = dict(patch=4, entropy_scale=3e-3)
TINY_CART = dict(batch_size=16, batch_length=16, free_nats=0.2)
"""Five numbers that change slowly fit into one free nat, below which the prior would learn nothing."""


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
        own = TINY_GRID if options.task == "grid" else TINY_CART
        return preset("cpu", **{**TINY, **own, **given})  # type: ignore[arg-type]
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
    began = time.monotonic()
    groups = [(seed,) for seed in seeds] if options.separate else [seeds]
    if options.collect:
        runs = [(group, read_log(folder(options, group))) for group in groups]
    else:
        runs = [(group, train_group(options, task, config, group, began)) for group in groups]
    figures = summary(options, task, config, runs)
    for name, entry in figures.items():
        print(f"{name}: {entry['value']:.4g} {entry['unit']} {[round(x, 3) for x in entry['repeats']]}", flush=True)
    if any(not lines or lines[-1]["env_steps"] * task.repeat < options.steps for _, lines in runs):
        print("stopped by the clock; the same command goes on.")
    if options.collect:
        made_there = (name for name in figures if "random" not in name)
        figures = {name: {**figures[name], "device": options.collect} for name in made_there}
    if figures and not options.dry:
        print(f"written to {record('dreamer_control', CLAIM, figures)}")


def folder(options: argparse.Namespace, seeds: tuple[int, ...]) -> Path:
    """Where seeds that share a program leave their run."""
    return options.out / f"{label(options)}_{options.steps}_{'-'.join(map(str, seeds))}"


def read_log(out: Path) -> list[dict[str, float]]:
    """All lines of a run's log."""
    return [line for _, line in read_lines(out / "metrics.jsonl")]


def train_group(
    options: argparse.Namespace, task: Task, config: DreamerConfig, seeds: tuple[int, ...], began: float
) -> list[dict[str, float]]:
    """Train these seeds as one program, or go on with them, and return all lines of the log."""
    out = folder(options, seeds)

    def evaluation(params: Any, decisions: int) -> dict[str, float]:
        key, rounds = jax.random.PRNGKey(77), Rounds(task.max_decisions)
        result = evaluate(task.test, config, params, key, options.episodes, rounds)
        each = np.atleast_2d(result["return"]).mean(-1)
        text = ", ".join(f"seed {seed} {value:.4g}" for seed, value in zip(seeds, each, strict=True))
        print(f"{decisions * task.repeat} steps, {time.monotonic() - began:.0f} s: return of {text}", flush=True)
        return {f"return_{seed}": float(value) for seed, value in zip(seeds, each, strict=True)}

    left = None if options.minutes is None else max(0.0, 60 * options.minutes - (time.monotonic() - began))
    if left == 0.0 and not (out / "metrics.jsonl").exists():
        return []
    train(
        task.train, config, out, options.steps // task.repeat, seeds[0] if options.separate else seeds,
        TrainingOptions(eval_fn=evaluation, eval_every=max(1, options.eval_every // task.repeat),
                   checkpoint_every_s=options.checkpoint_s, log_every_s=10.0, on_metrics=progress(task, began),
                   progress=False, time_limit_s=left),
    )  # fmt: skip
    return read_log(out)


def progress(task: Task, began: float) -> Any:
    """Prints a line for every logged one."""

    def say(line: dict[str, float]) -> None:
        line = {**line, "updates_per_step": line["updates_per_env_step"] / task.repeat}  # the learner counts decisions
        names = ("updates_per_s", "updates_per_step", "episode/return", "kl", "policy_std", "policy_certainty")
        text = ", ".join(f"{name} {line[name]:.3g}" for name in names if name in line)
        print(f"{int(line['env_steps']) * task.repeat} steps, {time.monotonic() - began:.0f} s: {text}", flush=True)

    return say


def label(options: argparse.Namespace) -> str:
    """What the figures' names begin with."""
    return "_".join([options.task, *([] if options.task == "grid" else [options.sight]), options.preset])


def summary(
    options: argparse.Namespace, task: Task, config: DreamerConfig, runs: list[tuple[tuple[int, ...], list[dict]]]
) -> dict[str, dict[str, Any]]:
    """Figures of the runs: returns at the last evaluation that all seeds have, with the curves; speed and time."""
    curves: dict[int, dict[int, float]] = {}  # of each seed: return by environment steps
    updates: dict[int, int] = {}
    for seeds, lines in runs:
        for line in lines:
            for seed in seeds:
                if f"eval/return_{seed}" in line:
                    at = int(line["env_steps"]) * task.repeat
                    curves.setdefault(seed, {})[at] = line[f"eval/return_{seed}"]
                    updates[at] = int(line["updates"])
    every = [seed for seeds, _ in runs for seed in seeds]
    shared = sorted(set.intersection(*(set(curves.get(seed, {})) for seed in every)))
    if not shared:
        return {}
    name, last = label(options), shared[-1]
    together = len(runs[0][0])
    rates = [line["updates_per_s"] * together for _, lines in runs for line in lines[1:] if line["updates_per_s"] > 0]
    minutes = [lines[-1]["wall_s"] / 60 for _, lines in runs if lines]
    return {
        f"{name}_return": {
            **figure([curves[seed][last] for seed in every], "-"), "steps": last, "seeds": every,
            "curve": [[at, [round(curves[seed][at], 3) for seed in every]] for at in shared],
            "episodes": options.episodes, "updates": updates[last],
            "updates_per_step": updates[last] / last, "train_ratio": config.train_ratio,
            "instances": options.instances,
        },
        f"{name}_random_return": figure([random_return(task.test, task.max_decisions)], "-"),
        f"{name}_minutes": {**figure(minutes, "min"), "seeds_in_one_program": together},
        f"{name}_updates_per_s": {
            **figure([statistics.median(rates or [0.0])], "1/s"), "seeds_in_one_program": together,
        },
    }  # fmt: skip


def parse() -> argparse.Namespace:
    """Command line."""
    parser = Parser(
        prog="python -m benchmarks.cartpole", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--task", choices=("balance", "swingup", "grid"), default="balance")
    parser.add_argument("--sight", choices=("image", "joints", "both"), default="image")
    parser.add_argument("--preset", default="size12m", help="tiny, cpu, size1m, size12m, ...")
    parser.add_argument("--seeds", type=whole(0), default=3)
    parser.add_argument("--first-seed", type=whole(0), default=0)
    parser.add_argument("--steps", type=whole(), default=100_000, help="environment steps of each seed")
    parser.add_argument("--ratio", type=in_range(0), help="replayed steps per decision; the preset's unless given")
    parser.add_argument("--unroll", type=whole(), help="steps of the recurrences in one loop body")
    parser.add_argument("--instances", type=whole(), default=16)
    parser.add_argument("--episodes", type=whole(), default=10, help="of every evaluation")
    parser.add_argument("--eval-every", type=whole(), default=10_000, help="environment steps")
    parser.add_argument("--minutes", type=in_range(0), help="stop and save after so long")
    parser.add_argument("--checkpoint-s", type=in_range(0), default=600.0, help="seconds between checkpoints")
    parser.add_argument("--out", type=Path, default=Path("runs/control"))
    parser.add_argument("--separate", action="store_true", help="one seed after the other, each a program of its own")
    parser.add_argument("--collect", metavar="DEVICE", help="only record the runs in --out, which were made there")
    parser.add_argument("--dry", action="store_true", help="print only")
    return parser.parse_args()


if __name__ == "__main__":
    with guarded():
        run(parse())

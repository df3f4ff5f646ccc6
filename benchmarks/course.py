"""The paper's two trainings with every seed shown, and the planner that is the course's ceiling.

    python -m benchmarks.course run --seed 0 --out runs/course/0 [--preset cpu] [--layout fixed] [--vehicle FILE]
    python -m benchmarks.course run --task corridor --seed 0 --out runs/corridor/0 [--spread 0.1]
    python -m benchmarks.course run --preset wallclock [--learner ppo] --seed 0 --out runs/wallclock/0
    python -m benchmarks.course together --seeds 0 1 2 --out runs/course/fixed --layout fixed    # in one program
    python -m benchmarks.course collect --runs runs/course/*      # into benchmarks/results/course.json, with a plot
    python -m benchmarks.course together --change mirror=0 --out runs/ablation/unmirrored
    python -m benchmarks.course ablation --runs runs/ablation/*   # one figure for all seeds of a name NAME_SEED
    python -m benchmarks.course planner
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import statistics
from pathlib import Path
from typing import Any

import jax
import numpy as np

from benchmarks.course_figures import BLIND, draw, groups, is_corridor, last_evaluation, load_run
from benchmarks.harness import RESULTS, device_name, figure, record
from bridge.nodes.options import Parser, in_range, whole
from dreamer.config import PRESETS
from dreamer.config import preset as learner_preset
from dreamer.evaluate import evaluate
from dreamer.train import TrainingOptions, train
from whill_mjx import evaluate as evaluation_command
from whill_mjx.io.command_line import guarded
from whill_mjx.io.reading import read_lines
from whill_mjx.learning.checks import mean_figures
from whill_mjx.learning.options import TrainOptions, choose_preset, preset_name
from whill_mjx.learning.setup import (
    find_preset,
    functional_env,
    learned_env,
    make_evaluation_env,
    make_training_env,
    with_layout,
    with_repeat,
    with_settings,
)
from whill_mjx.learning.trainings import train_baseline, train_policy
from whill_mjx.logs.dataset import plain, write_json
from whill_mjx.train import begin, main

CLAIM = "DreamerV3 (PPO where a name says so) from 64x64 RGB on the obstacle course; every seed listed in repeats"
FINAL = 1000  # episodes of the last evaluation of seeds side by side
CORRIDOR_CLAIM = "DreamerV3 from 64x64 RGB in the paper's corridor, randomised; every seed listed in repeats"


def run(options: argparse.Namespace) -> None:
    """One training of the main command with its proofs of sight; notes device and settings beside its results."""
    preset = preset_name(options.preset)
    asked = TrainOptions(
        out=options.out, vehicle=options.vehicle, task=options.task, preset=preset, layout=options.layout,
        seed=options.seed, steps=options.steps, targets=options.targets, train_ratio=options.ratio,
        action_repeat=options.repeat, exploring_starts=options.starts, learner=options.learner, lr=options.lr,
        second_tries=options.second_tries, change=tuple(options.change), instances=options.instances,
        eval_every=options.eval_every, spread=options.spread,
        export="best" if preset == "cpu" else "last",
        episodes=options.episodes, videos=0, checkpoint_every_s=options.checkpoint_s, planner=options.planner,
    )  # fmt: skip
    result = train_alone(asked) if options.training_only else main(asked)
    note = {"device": device_name(), "preset": preset, "layout": options.layout, "seed": options.seed}
    if options.beside:
        note["together"] = 1 + options.beside
    if options.spread:
        note["spread"] = options.spread
    write_json(options.out / "course.json", {**note, **result})
    if not (options.out / "policy").exists():
        print("no proofs of sight: there is no policy file", flush=True)
        return
    again = evaluation_command.EvaluateOptions(
        str(options.out / "policy"), out=options.out / "sight", episodes=options.episodes, layout=options.layout,
        blind=BLIND, videos=0,
    )  # fmt: skip
    evaluated = evaluation_command.main(again)
    note["sight"] = {kind: evaluated["drivers"][f"policy {kind}"]["success"] for kind in BLIND}
    if options.spread:  # the same worlds once more, each with a vehicle of its own
        varied = dataclasses.replace(again, out=options.out / "varied", spread=options.spread, blind=())
        note["varied"] = evaluation_command.main(varied)["drivers"]["policy"]
    write_json(options.out / "course.json", {**note, **result})


def train_alone(asked: TrainOptions) -> dict[str, Any]:
    """The training without what the main command does after it: its last evaluation stands for the final one."""
    preset = choose_preset(asked)
    train_it = train_policy if asked.learner == "dreamer" else train_baseline
    with begin(asked, preset) as vehicle:
        train_it(asked, preset, vehicle)
    lines = [line for _, line in read_lines(asked.out / "metrics.jsonl")]
    return {"learner": asked.learner, "seed": asked.seed, **last_evaluation(asked.out, plain(preset), lines)}


def together(options: argparse.Namespace) -> None:
    """Several seeds side by side in one program, without what the main command does besides; OUT/seed_N each.

    The time is that of all of them, so it says nothing of one run's.
    """
    preset = with_layout(find_preset(options.preset, options.task), options.layout)
    if options.repeat:
        preset = with_repeat(preset, options.repeat)
    task = preset.task
    steps = options.steps or preset.total_steps
    learner = with_settings(preset.learner, options.change)
    rows = steps + 2 * preset.instances + learner.pretrain_steps
    learner = dataclasses.replace(learner, replay_capacity=min(learner.replay_capacity, rows))
    vehicle = options.vehicle or "whill_cr_ramp"
    held_out = functional_env(make_evaluation_env(task, vehicle, preset.eval_episodes, preset.looks), shaped=False)

    def evaluation(params: Any, number: int, episodes: int) -> list[dict[str, float]]:
        found = evaluate(held_out, learner, params, jax.random.key(number), episodes)
        found = {name: np.atleast_2d(value) for name, value in found.items()}
        return [mean_figures({name: value[i] for name, value in found.items()}) for i in range(len(options.seeds))]

    def inside(params: Any, env_steps: int) -> dict[str, float]:
        each = evaluation(params, 77, preset.eval_episodes)
        print(env_steps, " ".join(f"{one['return']:.0f} ({one['success']:.0%})" for one in each), flush=True)
        return {f"{name}_{seed}": value for seed, one in zip(options.seeds, each, strict=True)
                for name, value in one.items()}

    starts = preset.exploring_starts if options.starts is None else options.starts
    plain = dataclasses.replace(preset, task=task, learner=learner, exploring_starts=starts, spread=0.0, vary=())
    training = make_training_env(plain, vehicle)
    env = learned_env(plain, training)
    seeds = tuple(options.seeds) if len(options.seeds) > 1 else options.seeds[0]
    limit = 60 * options.minutes if options.minutes else None
    options.out.mkdir(parents=True, exist_ok=True)
    noted = {"task": options.task, "layout": options.layout, "exploring_starts": starts}
    (options.out / "environment.json").write_text(json.dumps(noted) + "\n")
    run = TrainingOptions(eval_fn=inside, eval_every=preset.eval_every, checkpoint_every_s=1e9, progress=False,
                          time_limit_s=limit)
    result = train(env, learner, options.out, steps, seeds, run)
    if result.env_steps < steps:
        print(f"stopped at {result.env_steps} of {steps} steps; the same command goes on.")
        return
    lines = [line for _, line in read_lines(options.out / "metrics.jsonl")]
    last = evaluation(result.agent.acting, 1077, FINAL)
    for seed, policy in zip(options.seeds, last, strict=True):
        folder = options.out / f"seed_{seed}"
        folder.mkdir(exist_ok=True)
        mine = [_of_seed(line, seed) for line in lines]
        (folder / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in mine))
        note = {"device": device_name(), "preset": options.preset, "layout": options.layout, "seed": seed,
                "together": len(options.seeds), "task": dataclasses.asdict(task),
                "policy": {"episodes": FINAL, **policy}}
        (folder / "course.json").write_text(json.dumps(note, indent=1) + "\n")
        print(seed, policy, flush=True)


def _of_seed(line: dict[str, Any], seed: int) -> dict[str, Any]:
    """A logged line with the evaluation of one seed alone."""
    ending = f"_{seed}"
    own = {name.removesuffix(ending): value for name, value in line.items()
           if name.startswith("eval/") and name.endswith(ending)}
    return {**{name: value for name, value in line.items() if not name.startswith("eval/")}, **own}


def collect(options: argparse.Namespace) -> None:
    """Merge finished runs into course.json and draw their curves."""
    runs = sorted((load_run(path, options.device) for path in options.runs), key=lambda one: one["seed"])
    if options.warm:
        runs = [{"together": 1, **one} for one in runs]  # as beside others, whose time says nothing either
    for name, mine, figures in groups(runs):
        draw(mine, RESULTS / f"{name}.png")
        corridor = is_corridor(mine[0])
        record("corridor" if corridor else "course", CORRIDOR_CLAIM if corridor else CLAIM, figures)
        print(name)
        for one, entry in figures.items():
            print(f"{one:40s} {entry['value']:.4g} {entry['unit']:8s} {entry['repeats']}")


def ablation(options: argparse.Namespace) -> None:
    """Record how well trainings with other settings drive late in the run, whether or not they were finished.

    A folder is called NAME_SEED. A seed's value is the median return (or `metric`) of the evaluations in the last
    quarter of its steps. Beside it: the settings that differ from the size's defaults, and what whole runs came to.
    """
    groups: dict[str, dict[int, tuple[Path, list[dict[str, Any]]]]] = {}
    for path in options.runs:
        name, _, seed = path.name.rpartition("_")
        lines = [line for _, line in read_lines(path / "metrics.jsonl")]
        groups.setdefault(name, {})[int(seed)] = path, lines
    figures = {}
    for name, seeds in groups.items():
        values, last, whole = [], [], {}
        for seed, (path, lines) in sorted(seeds.items()):
            key = next(key for key in (f"eval/{options.metric}", f"eval/{options.metric}_{seed}")
                       if any(key in line for line in lines))  # fmt: skip
            last.append(int(lines[-1]["env_steps"]))
            late = [line[key] for line in lines if key in line and line["env_steps"] >= 0.75 * last[-1]]
            values.append(statistics.median(late))
            config = json.loads((path / "config.json").read_text())
            if (path / "course.json").exists():
                policy = json.loads((path / "course.json").read_text())["policy"]
                whole[str(seed)] = {key: policy[key] for key in ("episodes", "success", "collision", "return")
                                    if key in policy}  # fmt: skip
        changed = min((_changes(config, size) for size in PRESETS), key=len)
        entry = {**figure(values, "-", options.device), "seeds": sorted(seeds), "steps": last, "changed": changed}
        if (path / "environment.json").exists():  # older runs have none
            entry["environment"] = json.loads((path / "environment.json").read_text())
        elif (path / "run.json").exists():
            begun = json.loads((path / "run.json").read_text())
            starts = {key: begun["preset"].get(key, 0.0) for key in ("exploring_starts", "second_tries")}
            entry["environment"] = {key: begun["command"][key] for key in ("task", "layout")} | starts
        if whole:
            entry["whole"] = whole
        figures[f"ablation_{name}_{options.metric}"] = entry
        print(f"{name}, {options.metric}: {[f'{value:.3g}' for value in values]} at {last} steps, {changed}")
    record("course", CLAIM, figures)


def _changes(config: dict[str, Any], size: str) -> dict[str, Any]:
    """Settings of a run that are not those of a size."""
    usual = json.loads(json.dumps(dataclasses.asdict(learner_preset(size))))
    return {field: value for field, value in config.items() if field in usual and value != usual[field]}


def planner(options: argparse.Namespace) -> None:
    """Return, success and arrival of the ground-truth planner over `episodes` randomised worlds."""
    from whill_mjx.env import make_env, reset_state, step_state
    from whill_mjx.evaluation.planner import first_plan, for_task, plan_action

    env, params = make_env("obstacle_course")
    config = for_task(env.task)

    def episode(key: jax.Array) -> tuple[jax.Array, ...]:
        reset_key, plan_key, drive_key = jax.random.split(key, 3)
        state = reset_state(env, params, reset_key)

        def one(carry: tuple, step_key: jax.Array) -> tuple[tuple, None]:
            state, plan = carry
            action, plan = plan_action(config, env, state, plan, step_key)
            return (step_state(env, params, state, action)[0], plan), None

        start = (state, first_plan(config, env, state, plan_key))
        (state, _), _ = jax.lax.scan(one, start, jax.random.split(drive_key, env.task.max_steps))
        return state.episode_return, state.goal_distance <= env.task.goal_radius, state.step_count * 0.1

    returns, reached, seconds = map(np.asarray, jax.jit(jax.vmap(episode))(
        jax.random.split(jax.random.key(5), options.episodes)))
    figures = {
        "planner_return": {**figure([float(returns.mean())], "-"), "episodes": options.episodes,
                           "sd": float(returns.std())},
        "planner_success": figure([float(reached.mean())], "share"),
        "planner_arrival_s": figure([float(seconds[reached].mean())], "s"),
    }
    record("course", CLAIM, figures)
    print({name: entry["value"] for name, entry in figures.items()})


def parse() -> argparse.Namespace:
    """Command line."""
    parser = Parser(
        prog="python -m benchmarks.course", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(required=True)
    one = commands.add_parser("run")
    one.add_argument("--out", type=Path, required=True)
    one.add_argument("--seed", type=whole(0), default=0)
    one.add_argument("--preset", default="auto")
    one.add_argument("--task", default="obstacle_course", choices=("obstacle_course", "corridor"))
    one.add_argument("--layout", default="randomised")
    one.add_argument("--vehicle", type=Path)
    one.add_argument("--learner", default="dreamer", choices=("dreamer", "ppo"))
    one.add_argument("--instances", type=whole(), help="chairs side by side; the preset's unless given")
    one.add_argument("--steps", type=whole())
    one.add_argument("--eval-every", type=whole(), help="environment steps; the preset's unless given")
    one.add_argument("--lr", type=in_range(0), help="learning rate; the preset's unless given")
    one.add_argument("--targets", action="store_true", help="the world model also predicts what the simulator knows")
    one.add_argument("--change", nargs="+", default=[], metavar="NAME=VALUE", help="other settings of the learner")
    one.add_argument("--ratio", type=in_range(0), help="replayed steps per environment step; the preset's unless given")
    one.add_argument("--repeat", type=whole(), help="control periods that a decision holds; the preset's unless given")
    for name, of in (("--starts", "share of exploring starts"),
                     ("--second-tries", "share of failed worlds begun again"),
                     ("--spread", "of the vehicle's parameters between training episodes")):
        one.add_argument(name, type=in_range(0, 1), help=f"{of}; the preset's unless given")
    one.add_argument("--episodes", type=whole(), default=1000, help="of the final evaluation and the proofs of sight")
    one.add_argument("--no-planner", dest="planner", action="store_false", help="not beside the policy in the end")
    one.add_argument("--training-only", action="store_true", help="no final evaluation, policy file or proofs of sight")
    one.add_argument("--checkpoint-s", type=in_range(0), default=60.0, help="seconds between checkpoints")
    one.add_argument("--beside", type=whole(0), default=0,
                     help="other trainings on the same device: its time says nothing")
    one.set_defaults(call=run)
    side = commands.add_parser("together")
    side.add_argument("--out", type=Path, required=True)
    side.add_argument("--seeds", type=whole(0), nargs="+", default=[0, 1, 2, 3, 4])
    side.add_argument("--preset", default="paper")
    side.add_argument("--task", default="obstacle_course", choices=("obstacle_course", "corridor"))
    side.add_argument("--repeat", type=whole(), help="control periods that a decision holds; the preset's unless given")
    side.add_argument("--starts", type=in_range(0, 1), help="share of exploring starts; the preset's unless given")
    side.add_argument("--layout", default="randomised")
    side.add_argument("--vehicle", type=Path)
    side.add_argument("--steps", type=whole())
    side.add_argument("--minutes", type=in_range(0), help="stop by then; the same command goes on")
    side.add_argument("--change", nargs="+", default=[], metavar="NAME=VALUE", help="settings of the learner")
    side.set_defaults(call=together)
    several = commands.add_parser("collect")
    several.add_argument("--runs", type=Path, nargs="+", required=True)
    several.add_argument("--device", help="on which runs without a note of it were made")
    several.add_argument("--warm", action="store_true", help="programs were compiled before: their time says nothing")
    several.set_defaults(call=collect)
    tried = commands.add_parser("ablation")
    tried.add_argument("--runs", type=Path, nargs="+", required=True)
    tried.add_argument("--metric", default="return", help="figure of the evaluations in the log")
    tried.add_argument("--device", required=True, help="on which they were made")
    tried.set_defaults(call=ablation)
    ceiling = commands.add_parser("planner")
    ceiling.add_argument("--episodes", type=whole(), default=200)
    ceiling.set_defaults(call=planner)
    return parser.parse_args()


if __name__ == "__main__":
    with guarded():
        arguments = parse()
        arguments.call(arguments)

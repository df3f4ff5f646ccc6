"""Evaluate a policy file: figures with intervals, baselines, proofs of sight, sweeps, pictures and failures as videos.

    python -m whill_mjx.evaluate RUN/policy --task corridor --episodes 1000 --baselines planner random
        --blind blank freeze replay --sweep "obstacle_x=2,3 obstacle_y=-0.4:0.4:5" --html

POLICY is the folder of an exported policy, or `planner` or `random`. docs/evaluate.md says what each figure means.
"""

from __future__ import annotations

import json
import sys
import time
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import numpy as np
import tyro

from whill_mjx.env import make_env
from whill_mjx.evaluation.drivers import Driver, planner_driver, policy_driver, random_driver
from whill_mjx.evaluation.episodes import NEAR_M, Course, Episodes, episode_keys, summarise
from whill_mjx.evaluation.policy_file import RUN_FILE, PolicyFile, load_policy
from whill_mjx.evaluation.sweeps import STANDARD, Sweep, parse_sweep, run_sweep
from whill_mjx.heartbeat import say
from whill_mjx.logs.dataset import plain, write_json
from whill_mjx.tasks.tasks import TASKS, Task, make_task

SCRIPTED = ("planner", "random")


@dataclass(frozen=True)
class EvaluateOptions:
    """Options of the command."""

    policy: Annotated[str, tyro.conf.Positional]
    """Folder of an exported policy, or "planner" or "random"."""
    task: str | None = None
    """obstacle_course or corridor; none takes the one that the policy was trained for."""
    episodes: int = 200
    """Episodes of each driver."""
    out: Path = Path("runs/evaluation")
    """Folder for everything that is written."""
    vehicle: str | None = None
    """Vehicle file or preset; none takes the one inside the policy file, else the built-in chair."""
    layout: Literal["randomised", "fixed"] = "randomised"
    """A new world in each episode, or always the same one."""
    set: tuple[str, ...] = ()
    """Fields of the task, such as gates=1; those that the policy was trained with are found beside it."""
    looks: Literal["task", "on", "off"] = "task"
    """Random colours, light and photometric changes; task leaves it to the task."""
    spread: float = 0.0
    """Relative spread of the vehicle's parameters from episode to episode."""
    baselines: tuple[str, ...] = ()
    """Also drive the same episodes with planner, random, or another policy as NAME=FOLDER."""
    blind: tuple[Literal["blank", "freeze", "replay"], ...] = ()
    """Proofs of sight: black images, the first image frozen, actions of another episode replayed."""
    sweep: tuple[str, ...] = ()
    """Grids such as "obstacle_x=2,3 obstacle_y=-0.4:0.4:5"; "standard" stands for those of the task."""
    sweep_episodes: int = 50
    """Episodes in each cell of a grid."""
    videos: int = 4
    """Failures shown as video, at most."""
    html: bool = False
    """Also write one page with everything."""
    near: float = NEAR_M
    """Distance below which there is a near miss [m]."""
    seed: int = 2_000_003
    """Of the episodes; training and its own evaluations use others."""
    batch: int = 1000
    """Episodes at a time."""
    runtime: Literal["jax", "onnxruntime"] = "jax"
    """Who computes the policy: compiled with the simulator, or the vehicle's runtime, slowly."""


def main(options: EvaluateOptions) -> dict[str, Any]:
    """Evaluate and return what is written to evaluation.json."""
    began = time.perf_counter()
    if options.episodes < 1 or options.sweep_episodes < 1 or options.batch < 1:
        raise ValueError("episodes, sweep_episodes and batch must each be at least 1.")
    policy = None if options.policy in SCRIPTED else load_policy(options.policy, options.runtime)
    task = choose_task(options, policy)
    sweeps = [parse_sweep(text) for text in chosen_sweeps(options, task)]
    others = dict(_named(text) for text in options.baselines)
    courses: dict[str | None, Course] = {}

    def course(vehicle: str | None = None) -> Course:
        if vehicle not in courses:
            courses[vehicle] = make_course(options, task, policy, vehicle)
        return courses[vehicle]

    main_name = options.policy if policy is None else "policy"

    def drives(here: Course) -> Driver:
        return make_driver(options.policy, policy, here, options)

    drivers = {main_name: drives(course())}
    for name, source in others.items():
        drivers[name] = make_driver(source, None, course(), options)
    options.out.mkdir(parents=True, exist_ok=True)
    keys = episode_keys(options.seed, options.episodes)
    with jax.default_matmul_precision("highest"):  # float32, as on the vehicle; a GPU would round to fewer bits
        driven = {name: _drive(course(), driver, keys) for name, driver in drivers.items()}
        for blind in dict.fromkeys(options.blind):
            driven[f"{main_name} {blind}"] = course().blinded(drivers[main_name], keys, blind, driven[main_name])
        summaries = {name: summarise(episodes, options.near) for name, episodes in driven.items()}
        for name, summary in summaries.items():
            say(headline(name, summary))
        results: list[Sweep] = []
        for axes in sweeps:
            say(f"sweep over {' and '.join(axis.name for axis in axes)}")
            cell_keys = episode_keys(options.seed, options.sweep_episodes)
            results.append(run_sweep(axes, cell_keys, course, drives))
        evaluation = {
            "policy": options.policy,
            "sha256": policy.sha256 if policy else None,
            "task": {"name": getattr(task, "name", ""), **plain(task)},
            "options": plain(options),
            "device": f"{jax.devices()[0].platform}: {jax.devices()[0].device_kind}",
            "drivers": summaries,
            "sweeps": [result.plain() for result in results],
        }
        pictures, videos = draw(options, task, course(), driven, main_name, results)
    evaluation["seconds"] = time.perf_counter() - began
    write_json(options.out / "evaluation.json", evaluation, allow_nan=False)
    if options.html:
        from whill_mjx.evaluation.pages import page

        say(f"report: {page(evaluation, pictures, videos, options.out / 'report.html')}")
    say(f"{options.out / 'evaluation.json'}: {evaluation['seconds']:.0f} s")
    return evaluation


def choose_task(options: EvaluateOptions, policy: PolicyFile | None) -> Task:
    """The task as the policy was trained on it, with the options' changes.

    Limits and action repeat are the policy's own; other fields come from the run's own note beside the policy, where
    there is one for the same task.
    """
    name = options.task or (policy.task if policy else "obstacle_course")
    if name not in TASKS:
        raise ValueError(f"unknown task {name!r} (known: {', '.join(TASKS)}). Give one with --task.")
    known: dict[str, Any] = {field.name: field.default for field in fields(TASKS[name])}
    changes: dict[str, Any] = {}
    run = policy.path.parent / RUN_FILE if policy else None
    if policy and run and run.is_file() and policy.task == name:
        saved = json.loads(run.read_text())["preset"]["task"]
        changes = {field: tuple(v) if isinstance(v, list) else v for field, v in saved.items() if field in known}
        say(f"task: fields from {run}")
    if policy:
        changes |= {"v_min": policy.low[0], "v_max": policy.high[0], "omega_max": policy.high[1],
                    "action_repeat": policy.action_repeat}
    for text in options.set:
        field, value = _named(text)
        if field not in known:
            raise ValueError(f"--set {text}: task {name!r} has no field {field!r} (known: {', '.join(sorted(known))}).")
        changes[field] = _parse(value, known[field], text)
    return make_task(name, **{**changes, "layout": options.layout})


def _parse(text: str, like: Any, whole: str) -> Any:
    """A field's value from text, of the same type as its default."""
    try:
        if isinstance(like, tuple):
            return tuple(float(part) for part in text.split(","))
        return type(like)(text)
    except ValueError as error:
        raise ValueError(f"--set {whole}: {text!r} is no {type(like).__name__}. Correct it.") from error


def chosen_sweeps(options: EvaluateOptions, task: Task) -> list[str]:
    """The sweeps as text, "standard" replaced by those of the task."""
    texts: list[str] = []
    for text in options.sweep:
        texts += STANDARD[getattr(task, "name", "")] if text == "standard" else [text]
    return texts


def make_course(options: EvaluateOptions, task: Task, policy: PolicyFile | None, vehicle: str | None) -> Course:
    """The environment with a vehicle: the given one, the options', the policy's, or the built-in one."""
    chosen: str | Path | None = vehicle or options.vehicle or (policy.vehicle if policy else None)
    flag = {"task": None, "on": True, "off": False}[options.looks]
    size = (policy.height, policy.width) if policy else (64, 64)
    env, params = make_env(task, chosen, random_looks=flag, photometric=flag, height=size[0], width=size[1])
    rate = 1.0 / env.model.config.control_dt
    if policy and abs(policy.rate_hz - rate) > 1e-6:
        raise ValueError(f"{policy.path}/policy.json: rate_hz is {policy.rate_hz}; the simulator runs at {rate:g} Hz. "
                         "Export the policy with that rate.")
    return Course(env, params, options.spread, options.batch)


def make_driver(source: str, policy: PolicyFile | None, course: Course, options: EvaluateOptions) -> Driver:
    """The driver of a name or a folder."""
    if source == "planner":
        return planner_driver(course.env)
    if source == "random":
        return random_driver(course.env.task.action_repeat)
    policy = policy or load_policy(source, options.runtime)
    task, size = course.env.task, (course.env.height, course.env.width)
    if (policy.height, policy.width) != size:
        raise ValueError(f"{policy.path}: takes images of {policy.height} x {policy.width}, not {size[0]} x {size[1]}.")
    limits = ((task.v_min, -task.omega_max), (task.v_max, task.omega_max))
    if not np.allclose((policy.low, policy.high), limits):
        raise ValueError(f"{policy.path}: its limits are {policy.low} to {policy.high}, those of the task {limits[0]} "
                         f"to {limits[1]}. Evaluate it on its own, or set v_min, v_max and omega_max alike.")
    return policy_driver(policy)


def _drive(course: Course, driver: Driver, keys: jax.Array) -> Episodes:
    began = time.perf_counter()
    episodes = course.drive(driver, keys)
    say(f"{driver.name}: {episodes.count} episodes in {time.perf_counter() - began:.0f} s")
    return episodes


def headline(name: str, summary: dict[str, Any]) -> str:
    """One line of the figures that matter most."""
    low, high = summary["success_interval_95"]
    seconds = summary["time_to_goal_s"]
    return (
        f"{name:18s} success {summary['success']:6.1%} [{low:.1%}, {high:.1%}]  collision {summary['collision']:5.1%}  "
        f"time-out {summary['timeout']:5.1%}  return {summary['return']:.1f}  "
        f"to the goal {'-' if seconds is None else f'{seconds:.2f} s'}  near misses {summary['near_misses']:.2f}"
    )


def draw(
    options: EvaluateOptions, task: Task, course: Course, driven: dict[str, Episodes], main_name: str,
    sweeps: list[Sweep],
) -> tuple[list[Path], list[Path]]:  # fmt: skip
    """Write pictures and videos; what cannot be written for want of a package is left out and said."""
    from whill_mjx.evaluation import pages

    out, episodes = options.out, driven[main_name]
    failed = np.flatnonzero(episodes.ends["success"] < 0.5)
    rate, radius = 1.0 / episodes.control_dt, task.goal_radius
    jobs: dict[str, Any] = {"paths.png": lambda path: pages.paths_from_above(episodes, radius, path)}
    for name in driven:
        if name not in (main_name, "random"):
            jobs[f"paths_{name.replace(' ', '_')}.png"] = (
                lambda path, name=name: pages.paths_from_above(driven[name], radius, path, count=8)
            )
    if len(failed):
        jobs["failures.png"] = lambda path: pages.paths_from_above(episodes.some(failed), radius, path)
    for sweep in sweeps:
        label = "_".join(axis.name for axis in sweep.axes)
        jobs[f"sweep_{label}.png"] = lambda path, sweep=sweep: pages.sweep_picture(sweep, path, main_name)
        if any(axis.name in ("obstacle_x", "obstacle_y") for axis in sweep.axes):
            jobs[f"paths_{label}.png"] = lambda path, sweep=sweep: pages.sweep_paths(sweep, path, radius)
    if len(failed) and options.videos:
        def failures(path: Path) -> None:
            shown = episodes.some(failed[: options.videos])
            pages.episode_video(shown, *course.film(shown), path, rate)

        jobs["failures.mp4"] = failures
    written = []
    for name, job in jobs.items():
        try:
            job(out / name)
            written.append(out / name)
        except ImportError as error:
            say(f"{name} is left out: {error}. Install the base package to draw it.")
    return [path for path in written if path.suffix == ".png"], [path for path in written if path.suffix == ".mp4"]


def _named(text: str) -> tuple[str, str]:
    """NAME=VALUE, or one of the scripted drivers alone."""
    name, equals, value = text.partition("=")
    if not equals and text in SCRIPTED:
        return text, text
    if not equals or not name or not value:
        raise ValueError(f"{text!r} is not NAME=VALUE. Write it so (a baseline may also be one of {SCRIPTED}).")
    return name, value


def cli() -> None:
    """Command line."""
    try:
        main(tyro.cli(EvaluateOptions, description=__doc__))
    except (ValueError, FileNotFoundError) as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    cli()

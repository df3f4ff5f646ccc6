"""Evaluate a policy file: figures with intervals, baselines, proofs of sight, sweeps, pictures and failures as videos.

    python -m whill_mjx.evaluate RUN/policy --task corridor --episodes 1000 --baselines planner random
        --blind blank freeze replay --sweep "obstacle_x=2,3 obstacle_y=-0.4:0.4:5" --html

POLICY is the folder of an exported policy, or `planner` or `random`. docs/evaluate.md says what each figure means.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from whill_mjx.io.command_line import NOT_NEGATIVE, SEED, Range, With, check_once, listen, refusing, run, starts
from whill_mjx.io.heartbeat import Heartbeat, say, say_loading

if starts(__name__):
    listen()
    say_loading()

import jax
import numpy as np
import tyro

from whill_mjx.env import make_env
from whill_mjx.evaluation.drivers import Driver, planner_driver, policy_driver, random_driver
from whill_mjx.evaluation.episodes import NEAR_M, Course, Episodes, episode_keys, other_endings, summarise
from whill_mjx.evaluation.policy_file import PolicyFile, load_policy
from whill_mjx.evaluation.policy_world import find_policy, trained_fields
from whill_mjx.evaluation.sweeps import Axis, Sweep, parse_sweep, run_sweep
from whill_mjx.io.folders import RUN_FILE, claim_folder
from whill_mjx.io.formats import stamp
from whill_mjx.logs.dataset import plain, write_json
from whill_mjx.tasks.check import check_world
from whill_mjx.tasks.options import named_task, read_fields
from whill_mjx.tasks.tasks import Task, make_task

SCRIPTED = ("planner", "random")
NAME = re.compile("[A-Za-z0-9_-]{1,60}")
KIND = "whill_mjx.evaluate"
OUTPUTS = ("report.html", "paths.png", "failures.png", "failures.mp4")
OF_OPTIONS = ("paths_*.png", "sweep_*.png")
"""Pictures whose names depend on the options."""


@dataclass(frozen=True)
class EvaluateOptions:
    """Options of the command."""

    policy: Annotated[str, tyro.conf.Positional]
    """Folder of an exported policy or of its training, or "planner" or "random"."""
    task: str | None = None
    """Name of a task, package.module:TASK or path/to/file.py:TASK; none takes the one that the policy was trained
    for."""
    episodes: Annotated[int, Range(1, 1_000_000)] = 200
    """Episodes of each driver."""
    out: Path = Path("runs/evaluation")
    """Folder for everything that is written."""
    vehicle: str | None = None
    """Vehicle file or preset; none takes the one inside the policy file, else the built-in chair."""
    layout: Literal["randomised", "fixed"] | None = None
    """A new world in each episode, or always the same one; none takes that of the training, else randomised."""
    set: tuple[str, ...] = ()
    """Fields of the task, such as gates=1; those that the policy was trained with are found beside it."""
    looks: Literal["task", "on", "off", "plain", "paper", "rich"] = "task"
    """plain (nothing random), paper (random colours, light and photometric changes) or rich (furnished rooms,
    docs/looks.md); task leaves it to the task. off and on are older names of plain and paper."""
    spread: Annotated[float, Range(0, 1, below=True)] = 0.0
    """Relative spread of the vehicle's parameters from episode to episode."""
    baselines: tuple[str, ...] = ()
    """Also drive the same episodes with planner, random, or another policy as NAME=FOLDER."""
    blind: tuple[Literal["blank", "freeze", "replay"], ...] = ()
    """Proofs of sight: black images, the first image frozen, actions of another episode replayed."""
    sweep: tuple[str, ...] = ()
    """Grids such as "obstacle_x=2,3 obstacle_y=-0.4:0.4:5"; "standard" stands for those of the task."""
    sweep_episodes: Annotated[int, Range(1, 1_000_000), With("sweep")] = 50
    """Episodes in each cell of a grid."""
    videos: Annotated[int, Range(0, 1000)] = 4
    """Failures shown as video, at most."""
    html: bool = False
    """Also write one page with everything."""
    near: Annotated[float, NOT_NEGATIVE] = NEAR_M
    """Distance below which there is a near miss [m]."""
    seed: Annotated[int, SEED] = 2_000_003
    """Random seed of the episodes; training and its own evaluations use others."""
    batch: Annotated[int, Range(1, 1_000_000)] = 1000
    """Episodes at a time."""
    runtime: Literal["jax", "onnxruntime"] = "jax"
    """Who computes the policy: compiled with the simulator, or the vehicle's runtime, slowly."""


@dataclass(frozen=True)
class Plan:
    """What an evaluation drives, read and checked."""

    options: EvaluateOptions
    task: Task
    policy: PolicyFile | None
    sweeps: list[tuple[Axis, ...]]
    courses: dict[str | None, Course] = field(default_factory=dict)
    drivers: dict[str, Driver] = field(default_factory=dict)

    @property
    def main_name(self) -> str:
        """Name of the driver that is evaluated; the others are its baselines."""
        return self.options.policy if self.policy is None else "policy"

    def course(self, vehicle: str | None = None) -> Course:
        """The course with a vehicle, made once; None is the evaluation's own."""
        if vehicle not in self.courses:
            self.courses[vehicle] = make_course(self.options, self.task, self.policy, vehicle)
        return self.courses[vehicle]

    def driver(self, course: Course) -> Driver:
        """The evaluated driver on a course."""
        return make_driver(self.options.policy, self.policy, course, self.options)


def main(options: EvaluateOptions) -> dict[str, Any]:
    """Evaluate and return what is written to evaluation.json."""
    began = time.perf_counter()
    with refusing():
        plan = make_plan(options)
    with claim_folder(options.out, KIND, OUTPUTS) as claim:
        claim.settle({})  # an evaluation replaces an earlier one as a whole
        try:
            with Heartbeat() as heartbeat:
                return evaluate(plan, began, heartbeat.stage)
        except OSError as error:
            error.add_note("The figures so far are in the lines above; the same command begins anew.")
            raise


def make_plan(options: EvaluateOptions) -> Plan:
    """Read and check everything that an evaluation needs before it drives or writes."""
    policy = None if options.policy in SCRIPTED else load_policy(find_policy(options.policy), options.runtime)
    task = choose_task(options, policy)
    plan = Plan(options, task, policy, [parse_sweep(text) for text in chosen_sweeps(options, task)])
    pairs = [_named(text) for text in options.baselines]
    check_once("--baselines", [plan.main_name, *(name for name, _ in pairs)])
    if policy is None and {"blank", "freeze"} & set(options.blind):
        raise ValueError(f"--blind {' '.join(options.blind)}: {options.policy} does not look at images. Leave it out.")
    others = dict(pairs)
    plan.drivers[plan.main_name] = plan.driver(plan.course())
    for name, source in others.items():
        plan.drivers[name] = make_driver(source, None, plan.course(), options)
    for axis in (axis for axes in plan.sweeps for axis in axes if axis.name == "vehicle"):
        for vehicle in axis.values:
            plan.course(vehicle)
    return plan


def evaluate(plan: Plan, began: float, stage: Callable[[str], None] = say) -> dict[str, Any]:
    """Drive everything and write the results to the claimed folder; `stage` gets a line when a part begins."""
    options, task, policy, main_name, course = plan.options, plan.task, plan.policy, plan.main_name, plan.course
    keys = episode_keys(options.seed, options.episodes)
    with jax.default_matmul_precision("highest"):  # float32, as on the vehicle; a GPU would round to fewer bits
        driven = {}
        for name, driver in plan.drivers.items():
            stage(f"{name}: driving {len(keys)} episodes")
            driven[name] = _drive(course(), driver, keys)
        for blind in dict.fromkeys(options.blind):
            stage(f"{main_name} without sight ({blind}): driving {len(keys)} episodes")
            driven[f"{main_name} {blind}"] = course().blinded(plan.drivers[main_name], keys, blind, driven[main_name])
        summaries = {name: summarise(episodes, options.near) for name, episodes in driven.items()}
        for name, summary in summaries.items():
            say(headline(name, summary))
        results: list[Sweep] = []
        for axes in plan.sweeps:
            stage(f"sweep over {' and '.join(axis.name for axis in axes)}")
            cell_keys = episode_keys(options.seed, options.sweep_episodes)
            results.append(run_sweep(axes, cell_keys, course, plan.driver))
        evaluation = {
            **stamp("whill-mjx-evaluation"),
            "policy": options.policy,
            "sha256": policy.sha256 if policy else None,
            "task": {"name": task.name, **plain(task)},
            "options": plain(options),
            "device": f"{jax.devices()[0].platform}: {jax.devices()[0].device_kind}",
            "drivers": summaries,
            "sweeps": [result.plain() for result in results],
        }
        remove_earlier(options.out)
        write_json(options.out / "evaluation.json", evaluation, allow_nan=False)  # kept, whatever becomes of pictures
        stage("drawing pictures and videos")
        pictures, videos = draw(options, task, course(), driven, main_name, results)
    evaluation["seconds"] = time.perf_counter() - began
    write_json(options.out / "evaluation.json", evaluation, allow_nan=False)
    if options.html:
        from whill_mjx.evaluation.pages import page

        say(f"open {page(evaluation, pictures, videos, options.out / 'report.html')} in a browser")
    files = ", ".join(["evaluation.json", *(one.name for one in (*pictures, *videos))])
    say(f"wrote {files} in {options.out}; {evaluation['seconds']:.0f} s"
        + ("" if options.html else ". With --html you get one page with everything."))
    return evaluation


def remove_earlier(out: Path) -> None:
    """Remove page, pictures and video of an earlier evaluation: beside the new figures they would pass for its own."""
    for pattern in (*OUTPUTS, *OF_OPTIONS):
        for path in out.glob(pattern):
            path.unlink(missing_ok=True)


def choose_task(options: EvaluateOptions, policy: PolicyFile | None) -> Task:
    """The task as the policy was trained on it, with the options' changes.

    Limits and action repeat are the policy's own; other fields come from the run's own note beside the policy, where
    there is one for the same task.
    """
    name = options.task or (policy.task if policy else "obstacle_course")
    task = named_task(name)
    changes: dict[str, Any] = {}
    if policy and policy.task == name:
        changes = trained_fields(policy.path, name)
        if changes:
            say(f"task: {name}, as in the training ({policy.path.parent / RUN_FILE})")
    if policy:
        changes |= {"v_min": policy.low[0], "v_max": policy.high[0], "omega_max": policy.high[1],
                    "action_repeat": policy.action_repeat}
    changes |= read_fields(task, options.set)
    if options.layout is not None:
        changes["layout"] = options.layout
    return make_task(name, **changes)


def chosen_sweeps(options: EvaluateOptions, task: Task) -> list[str]:
    """The sweeps as text, "standard" replaced by those of the task."""
    texts: list[str] = []
    for text in options.sweep:
        texts += task.sweeps if text == "standard" else [text]
    return texts


def make_course(options: EvaluateOptions, task: Task, policy: PolicyFile | None, vehicle: str | None) -> Course:
    """The environment with a vehicle: the given one, the options', the policy's, or the built-in one."""
    chosen: str | Path | None = vehicle or options.vehicle or (policy.vehicle if policy else None)
    looks = {"task": None, "on": "paper", "off": "plain"}.get(options.looks, options.looks)
    height, width = (policy.height or 64, policy.width or 64) if policy else (64, 64)
    env, params = make_env(task, chosen, height=height, width=width, looks=looks)
    check_world(env.task)  # of this vehicle, which a map may not have room for
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
    policy = policy or load_policy(find_policy(source), options.runtime)
    task, sensors = course.env.task, {name: sensor.reading(course.env).shape for name, sensor in course.env.sensors}
    wanted: Any = policy.observation or (policy.height, policy.width, 3)
    shown: Any = sensors or (course.env.height, course.env.width, 3)
    if wanted != shown:
        raise ValueError(f"{policy.path}: observes {wanted}, but the task shows {shown}. Evaluate it on its own "
                         "task.")
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
    others = "".join(f"{ending} {share:.1%}  " for ending, share in other_endings(summary).items())
    return (
        f"{name:18s} success {summary['success']:6.1%} [{low:.1%}, {high:.1%}]  collision {summary['collision']:5.1%}  "
        f"time-out {summary['timeout']:5.1%}  {others}return {summary['return']:.1f}  "
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
    for number, sweep in enumerate(sweeps, start=1):
        label = "_".join(axis.name for axis in sweep.axes)
        label += f"_{number}" if f"sweep_{label}.png" in jobs else ""
        jobs[f"sweep_{label}.png"] = lambda path, sweep=sweep: pages.sweep_picture(sweep, path, main_name)
        if any(axis.name in ("obstacle_x", "obstacle_y") for axis in sweep.axes):
            jobs[f"paths_{label}.png"] = lambda path, sweep=sweep: pages.sweep_paths(sweep, path, radius)
    if len(failed) and options.videos:
        def failures(path: Path) -> None:
            shown = episodes.some(failed[: options.videos])
            pages.episode_video(shown, *course.film(shown, options.videos), path, rate)

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
    if not NAME.fullmatch(name):
        raise ValueError(f"--baselines {text}: a name is letters, digits, _ and -, for it is part of files' names. "
                         "Correct it.")
    return name, value


def cli() -> None:
    """Command line."""
    run(EvaluateOptions, main, __doc__, positional=False)


if __name__ == "__main__":
    cli()

"""What an evaluation drives, before it does: task, courses, drivers and sweeps, read from its options and checked."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from whill_mjx.env import make_env
from whill_mjx.evaluation.drivers import Driver, planner_driver, policy_driver, random_driver
from whill_mjx.evaluation.episodes import Course
from whill_mjx.evaluation.options import EvaluateOptions
from whill_mjx.evaluation.policies.policy_file import PolicyFile, load_policy
from whill_mjx.evaluation.policies.policy_world import find_policy, has_changed, trained_fields
from whill_mjx.evaluation.sweeps import Axis, parse_sweep
from whill_mjx.io.command_line import check_once
from whill_mjx.io.folders import RUN_FILE
from whill_mjx.io.heartbeat import say
from whill_mjx.tasks.check import check_world
from whill_mjx.tasks.options import named_task, read_fields
from whill_mjx.tasks.tasks import Task, make_task
from whill_mjx.world.randomize import check_factor

SCRIPTED = ("planner", "random")
NAME = re.compile("[A-Za-z0-9_-]{1,60}")


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
            self.courses[vehicle] = _make_course(self.options, self.task, self.policy, vehicle)
        return self.courses[vehicle]

    def driver(self, course: Course) -> Driver:
        """The evaluated driver on a course."""
        return _make_driver(self.options.policy, self.policy, course, self.options)


def make_plan(options: EvaluateOptions) -> Plan:
    """Read and check everything that an evaluation needs before it drives or writes."""
    policy = None if options.policy in SCRIPTED else load_policy(find_policy(options.policy), options.runtime)
    task = choose_task(options, policy)
    texts = _chosen_sweeps(options, task)
    plan = Plan(options, task, policy, [parse_sweep(text) for text in texts])
    pairs = [_named(text) for text in options.baselines]
    check_once("--baselines", [plan.main_name, *(name for name, _ in pairs)])
    if policy is None and {"blank", "freeze"} & set(options.blind):
        raise ValueError(f"--blind {' '.join(options.blind)}: {options.policy} does not look at images. Leave it out.")
    others = dict(pairs)
    plan.drivers[plan.main_name] = plan.driver(plan.course())
    for name, source in others.items():
        plan.drivers[name] = _make_driver(source, None, plan.course(), options)
    for axis in (axis for axes in plan.sweeps for axis in axes if axis.name == "vehicle"):
        for vehicle in axis.values:
            plan.course(vehicle)
    for text, axes in zip(texts, plan.sweeps, strict=True):
        for axis in axes:
            if axis.relative and text in options.sweep:  # a task's own sweeps are for any vehicle
                check_factor(f"--sweep {text}", plan.course().params, axis.name)
    return plan


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
        if has_changed(policy.path, task):
            say(f"task: {name}: its file has changed since the training ({policy.path.parent / RUN_FILE}), and the "
                "policy may expect other observations. The task is evaluated as it is now")
        elif changes:
            say(f"task: {name}, as in the training ({policy.path.parent / RUN_FILE})")
    if policy:
        changes |= {"v_min": policy.low[0], "v_max": policy.high[0], "omega_max": policy.high[1],
                    "action_repeat": policy.action_repeat}
    chosen = read_fields(task, options.set)
    if policy and chosen.get("action_repeat", policy.action_repeat) != policy.action_repeat:
        raise ValueError(f"--set action_repeat={chosen['action_repeat']}: {policy.path} holds each decision for "
                         f"{policy.action_repeat} control periods, as in its training. Leave the option out.")
    changes |= chosen
    if options.layout is not None:
        changes["layout"] = options.layout
    return make_task(name, **changes)


def _chosen_sweeps(options: EvaluateOptions, task: Task) -> list[str]:
    """The sweeps as text, "standard" replaced by those of the task."""
    texts: list[str] = []
    for text in options.sweep:
        texts += task.sweeps if text == "standard" else [text]
    return texts


def _make_course(options: EvaluateOptions, task: Task, policy: PolicyFile | None, vehicle: str | None) -> Course:
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


def _make_driver(source: str, policy: PolicyFile | None, course: Course, options: EvaluateOptions) -> Driver:
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

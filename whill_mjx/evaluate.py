"""Evaluate a policy file: figures with intervals, baselines, proofs of sight, sweeps, pictures and failures as videos.

    python -m whill_mjx.evaluate RUN/policy --task corridor --episodes 1000 --baselines planner random
        --blind blank freeze replay --sweep "obstacle_x=2,3 obstacle_y=-0.4:0.4:5" --html

POLICY is the folder of an exported policy, or `planner` or `random`. docs/evaluate.md says what each figure means.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from whill_mjx.io.command_line import listen, refusing, run, starts
from whill_mjx.io.heartbeat import Heartbeat, say, say_loading

if starts(__name__):
    listen()
    say_loading()

import jax

from whill_mjx.evaluation.drivers import Driver
from whill_mjx.evaluation.episodes import Course, Episodes, episode_keys, headline, summarise
from whill_mjx.evaluation.options import EvaluateOptions
from whill_mjx.evaluation.output.output_files import OUTPUTS, remove_earlier, write_pictures
from whill_mjx.evaluation.preparation import Plan, make_plan
from whill_mjx.evaluation.sweeps import Sweep, run_sweep
from whill_mjx.io.folders import claim_folder
from whill_mjx.io.formats import stamp
from whill_mjx.logs.dataset import plain, write_json

KIND = "whill_mjx.evaluate"


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
        pictures, videos = write_pictures(options, task, course(), driven, main_name, results)
    evaluation["seconds"] = time.perf_counter() - began
    write_json(options.out / "evaluation.json", evaluation, allow_nan=False)
    if options.html:
        from whill_mjx.evaluation.output.pages import page

        say(f"open {page(evaluation, pictures, videos, options.out / 'report.html')} in a browser")
    files = ", ".join(["evaluation.json", *(one.name for one in (*pictures, *videos))])
    say(f"wrote {files} in {options.out}; {evaluation['seconds']:.0f} s"
        + ("" if options.html else ". With --html you get one page with everything."))
    return evaluation


def _drive(course: Course, driver: Driver, keys: jax.Array) -> Episodes:
    began = time.perf_counter()
    episodes = course.drive(driver, keys)
    say(f"{driver.name}: {episodes.count} episodes in {time.perf_counter() - began:.0f} s")
    return episodes


def cli() -> None:
    """Command line."""
    run(EvaluateOptions, main, __doc__, positional=False)


if __name__ == "__main__":
    cli()

"""Files that an evaluation leaves beside its figures: pictures, videos and a page."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from whill_mjx.evaluation.episodes import Course, Episodes
from whill_mjx.evaluation.options import EvaluateOptions
from whill_mjx.evaluation.sweeps import Sweep
from whill_mjx.io.heartbeat import say
from whill_mjx.tasks.tasks import Task

OUTPUTS = ("report.html", "paths.png", "failures.png", "failures.mp4")
OF_OPTIONS = ("paths_*.png", "sweep_*.png")
"""Pictures whose names depend on the options."""


def remove_earlier(out: Path) -> None:
    """Remove page, pictures and video of an earlier evaluation: beside the new figures they would pass for its own."""
    for pattern in (*OUTPUTS, *OF_OPTIONS):
        for path in out.glob(pattern):
            path.unlink(missing_ok=True)


def write_pictures(
    options: EvaluateOptions, task: Task, course: Course, driven: dict[str, Episodes], main_name: str,
    sweeps: list[Sweep],
) -> tuple[list[Path], list[Path]]:  # fmt: skip
    """Write pictures and videos; what cannot be written for want of a package is left out and said."""
    from whill_mjx.evaluation.output import pages

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

"""The final report of a training: figures of the policy and its baselines in unseen episodes, pictures and videos."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from whill_mjx.evaluation.drivers import Driver
from whill_mjx.evaluation.episodes import Course, Episodes, episode_keys, summarise
from whill_mjx.evaluation.rollouts import CHANNELS
from whill_mjx.io.folders import whole_file
from whill_mjx.io.video import find_ffmpeg


def evaluate_drivers(
    course: Course, drivers: dict[str, Driver], seed: int, episodes: int, stage: Callable[[str], None]
) -> dict[str, Episodes]:
    """The same episodes with each driver; `stage` gets a line before each."""
    keys, driven = episode_keys(seed, episodes), {}
    for name, driver in drivers.items():
        stage(f"final evaluation: {episodes} unseen episodes, driver: {name}")
        driven[name] = course.drive(driver, keys)
    return driven


def write_report(
    out: Path, course: Course, driven: dict[str, Episodes], videos: int, say: Callable[[str], None]
) -> dict[str, Any]:
    """Figures of all drivers; pictures, videos and drives.npz of the policy in `out`.

    Pictures: drives.png and failures.png from above; camera.mp4 shows the first episodes, failures.mp4 the first that
    failed, `videos` of each at most. A line says what is left out because a package is missing.
    """
    from whill_mjx.evaluation.output import pages

    episodes = driven["policy"]
    failed = np.flatnonzero(episodes.ends["success"] < 0.5)
    first = np.arange(min(videos, episodes.count))
    radius, rate = course.env.task.goal_radius, 1.0 / episodes.control_dt

    def films() -> None:
        find_ffmpeg()  # before the work
        shown = episodes.some(np.concatenate([first, failed[:videos]]))
        frames, above = course.film(shown, videos)
        for name, part in (("camera.mp4", slice(0, len(first))), ("failures.mp4", slice(len(first), None))):
            if len(frames[part]):
                chosen = shown.some(np.arange(shown.count)[part])
                pages.episode_video(chosen, frames[part], above[part], out / name, rate)

    jobs: dict[str, Callable[[], Any]] = {
        "drives.png": lambda: pages.paths_from_above(episodes, radius, out / "drives.png"),
    }
    if videos:
        jobs["videos"] = films
    if len(failed):
        jobs["failures.png"] = lambda: pages.paths_from_above(episodes.some(failed), radius, out / "failures.png")
    for name, job in jobs.items():
        try:
            job()
        except ImportError as error:
            say(f"{name} are left out: {error}. Install the base package for them.")
    save_drives(out / "drives.npz", episodes)
    return {name: summarise(one) for name, one in driven.items()}


def save_drives(path: Path, episodes: Episodes) -> None:
    """Traces, lengths and endings of the episodes as plain arrays; `channels` names the columns of the trace."""
    with whole_file(path) as temporary, temporary.open("wb") as file:
        arrays: dict[str, Any] = {"trace": episodes.trace, "length": episodes.length, "channels": np.array(CHANNELS)}
        arrays.update(episodes.ends)
        np.savez_compressed(file, **arrays)

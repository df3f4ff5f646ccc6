"""Draw tasks and scenes as pictures or videos: `python -m whill_mjx.look --scene obstacle_course --out FILE.png`.

A task has one column per world: what the camera sees at the start, what it sees halfway, and the world from above;
its video shows a planner driving. The gallery shows all that the camera can draw: plain, at its best, with lens and
motion; depth, labels and normals; its video is a walk. `--scene all` writes every sheet beside FILE.
With the ending .rrd, FILE is a recording for the Rerun viewer; `--live` opens that viewer.
"""

from __future__ import annotations

import dataclasses
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from whill_mjx.io.command_line import SEED, OptionError, Range, check_known, listen, refusing, run, starts
from whill_mjx.io.heartbeat import Heartbeat, say_loading

if starts(__name__):
    listen()
    say_loading()

from whill_mjx.env import Env, make_env
from whill_mjx.evaluation.output.planner_pictures import contact_sheet, planner_film, record_planner
from whill_mjx.evaluation.output.rerun_log import load_rerun
from whill_mjx.io.folders import check_file, note_written
from whill_mjx.io.png import write_png
from whill_mjx.io.video import VIDEOS, write_video
from whill_mjx.tasks.check import check_world, why_no_world
from whill_mjx.tasks.options import named_task, read_fields
from whill_mjx.tasks.tasks import LAYOUTS, TASKS
from whill_mjx.vehicle.types import VehicleParams
from whill_mjx.world.gallery_pictures import gallery_film, gallery_sheet

RECORDING = ".rrd"
"""Ending of a recording for the Rerun viewer."""


@dataclass(frozen=True)
class Look:
    """Options of the command."""

    scene: str = "obstacle_course"
    """Name of a task, package.module:TASK, path/to/file.py:TASK, gallery, or all."""
    out: Path = Path("look.png")
    """Picture to write, video with the ending .mp4 or .gif, or recording for the Rerun viewer with the ending .rrd."""
    live: bool = False
    """Open the Rerun viewer and show a planner's drive as it comes; OUT is then written only if it ends in .rrd."""
    set: tuple[str, ...] = ()
    """Fields of the task, such as people=6."""
    layout: str = "randomised"
    """randomised or fixed."""
    looks: Literal["plain", "paper", "rich"] = "plain"
    """plain, paper (colours, light and textures at random, and images changed photometrically) or rich (furnished
    rooms, docs/looks.md)."""
    worlds: Annotated[int, Range(1, 100)] = 6
    """Columns of the sheet."""
    steps: Annotated[int, Range(1, 10_000)] = 18
    """Control steps that the planner drives before the second picture."""
    scale: Annotated[int, Range(1, 50)] = 3
    """Enlargement of the pictures."""
    seed: Annotated[int, SEED] = 0
    """First random key."""


def _env(options: Look) -> tuple[Env, VehicleParams]:
    task = named_task(options.scene, "--scene")
    with refusing():
        task = dataclasses.replace(task, **read_fields(task, options.set), layout=options.layout)
        check_world(task)
        return make_env(task, looks=options.looks)


def main(options: Look) -> None:
    """Write the sheet or the video of `options`."""
    known = (*TASKS, "gallery")
    if ":" in options.scene or options.scene.endswith(".py"):
        named_task(options.scene, "--scene")
    elif options.scene not in (*known, "all"):
        raise OptionError(f"--scene: unknown scene {options.scene!r} (known: {', '.join(known)}, all). Correct it.")
    check_known("--layout", options.layout, LAYOUTS)
    if options.out.suffix not in (".png", *VIDEOS, RECORDING):
        raise OptionError(f"--out {options.out}: must end in .png for a picture, {' or '.join(VIDEOS)} for a video, "
                          f"{RECORDING} for the Rerun viewer.")
    if options.scene in ("gallery", "all") and (options.live or options.set or options.out.suffix == RECORDING):
        raise OptionError(f"--scene {options.scene}: is no single task, as --set, --live and {RECORDING} need. Name "
                          "one task.")
    if options.scene != "all":
        _show(options)
        return
    missing = {name: said for name in known if name in TASKS and (said := why_no_world(TASKS[name]))}
    outs = {name: options.out.with_name(f"{options.out.stem}_{name}{options.out.suffix}")
            for name in known if name not in missing}
    for out in outs.values():
        check_file("--out", out)
    for name, said in missing.items():
        print(f"{name}: left out. {said}")
    for name, out in outs.items():
        _show(dataclasses.replace(options, scene=name, out=out))


def _show(options: Look) -> None:
    """Draw or drive one scene."""
    viewed = options.live and options.out.suffix != RECORDING  # nothing is written
    if not viewed:
        check_file("--out", options.out)
    _draw(options)
    if not viewed:
        note_written(options.out)


def _draw(options: Look) -> None:
    if options.live or options.out.suffix == RECORDING:
        try:
            load_rerun()
        except ImportError as error:
            raise OptionError(f"--live and {RECORDING}: {error}") from error
        path = options.out if options.out.suffix == RECORDING else None
        steps = record_planner(*_env(options), options.seed, path, options.live)
        print(f"{path or 'viewer'}: {steps} steps of {options.scene}")
        return
    if options.out.suffix in VIDEOS:
        frames, rate = gallery_film() if options.scene == "gallery" else planner_film(*_env(options), options.seed)
        write_video(options.out, frames, options.scale, rate)
        print(f"{options.out}: {len(frames)} frames of {options.scene}")
        return
    seen = None if options.scene == "gallery" else _env(options)
    with Heartbeat() as heartbeat:
        heartbeat.stage(f"drawing {options.scene}: half a minute, most of it compilation")
        sheet = gallery_sheet() if seen is None else contact_sheet(*seen, options.worlds, options.steps, options.seed)
    write_png(options.out, sheet.repeat(options.scale, 0).repeat(options.scale, 1))
    rows = "" if seen is None else (
        f"; each column is a world. Rows: the camera at the start, the camera after {options.steps} control steps of "
        "a planner, and the world from above with its path")
    print(f"{options.out}: {options.scene}{rows}")


def cli() -> None:
    """Command line."""
    # `--task` is the option's former name.
    run(Look, main, __doc__, args=["--scene" if word == "--task" else word for word in sys.argv[1:]])


if __name__ == "__main__":
    cli()

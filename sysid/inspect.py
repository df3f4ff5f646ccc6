"""Inspect a driving log or a robot file before it is fitted: `python -m sysid.inspect DATASET|ROBOT [--out DIR]`.

Says how regularly each stream was sampled, how the clocks differ, whether units and signs are right, what each trial
excites, how well replicates repeat, and what no fit can find in the log. Of a robot file (URDF, xacro, MJCF) it says
what was understood: wheels, radius, track, mass, what stands on the floor, how it drives, and what is missing.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from whill_mjx.io.command_line import OptionError, listen, refusing, starts

if starts(__name__):
    listen()

import numpy as np

from sysid import command_line
from sysid.logs.coverage import Blind
from sysid.logs.inspection import inspect, text
from sysid.logs.loaders import Form, load_whole
from sysid.logs.next_drives import NextDrive, next_drives
from sysid.logs.records import Log
from whill_mjx.io.command_line import POSITIVE, Range
from whill_mjx.io.fields import in_shell
from whill_mjx.io.folders import check_file, claim_folder, note_written
from whill_mjx.io.formats import stamp

KIND = "sysid.inspect"
OUTPUTS = ("inspect.txt", "inspect.json", "inspect.png", "next_1.csv", "next_2.csv", "next_3.csv", "inspect.html")


@dataclass(frozen=True)
class InspectConfig:
    dataset: Path
    """Folder of a dataset, of DRIVE runs or of MRCLAM; or a robot file."""
    select: tuple[str, ...] = ()
    """Part of a measured set: RUN, GROUP or RUN:FROM-TO. By default all runs of one robot."""
    format: Form = "auto"
    """Form of the data; found out by default."""
    wheels: tuple[str, ...] = ()
    """Joints or actuators of the driven wheels of a robot file, left and right."""
    json: bool = False
    """Print JSON instead of text."""
    out: Path | None = None
    """Folder for inspect.html, .txt, .json, .png and scripts of the next three drives, or for the picture of a robot
    file; without one, nothing is written."""
    space: Annotated[tuple[float, float], Range(0.1, 10_000)] = (4.0, 4.0)
    """Length and width of the free floor for the next drives [m]."""
    v_max: Annotated[float | None, POSITIVE] = None
    """Fastest speed of the next drives [m/s]; by default half of the vehicle's, at most 0.5 m/s."""
    radius: Annotated[float | None, POSITIVE] = None
    """Reach of the vehicle around its drive-axle centre in the next drives [m], rider's feet included; by default that
    of its nominal body."""


def inspect_robot(config: InspectConfig) -> dict[str, Any]:
    """What a robot file is understood as: printed, and with --out drawn."""
    from dataclasses import asdict

    from sysid.pages.report import plain
    from sysid.pages.robot_plot import write_robot
    from sysid.replay.robot_check import check_robot, describe_robot
    from sysid.replay.robot_loading import load_robot

    robot = load_robot(config.dataset, config.wheels)
    check = check_robot(robot)
    found = {"wheel_radius": robot.wheel_radius, "track": robot.distance, "driven_wheels": len(robot.wheels),
             "mass": float(robot.host.body_mass.sum()), "notes": list(robot.notes), **asdict(check),
             "drives_straight": check.drives_straight}
    print(json.dumps(plain(found), indent=1) if config.json else "\n".join(describe_robot(robot, check)))
    if config.out is None:
        print("--out FOLDER draws it", file=sys.stderr)
        return found
    picture = config.out / f"{config.dataset.name.partition('.')[0]}.png"
    check_file("--out", picture, "choose another --out")
    write_robot(picture, robot, check.loads)
    note_written(picture)
    print(f"wrote {picture}", file=sys.stderr)
    return found


def write(folder: Path, log: Log, found: dict[str, Any], drives: Sequence[NextDrive] = ()) -> list[Path]:
    """Write inspect.txt, .json, .png and .html and the scripts of drives; returns their paths."""
    from sysid.pages.inspect_page import write_page, write_plot
    from sysid.pages.report import write_report
    from whill_mjx.logs.dataset import COMMAND_HEADER, write_csv, write_text

    paths = [folder / name for name in (*OUTPUTS[: 3 + len(drives)], OUTPUTS[-1])]
    write_text(paths[0], text(found) + "\n")
    write_report(paths[1], {**stamp("sysid-inspection"), **found})
    write_plot(paths[2], log, found)
    write_page(paths[-1], found, paths[2])
    for path, drive in zip(paths[3:-1], drives, strict=True):
        write_csv(path, COMMAND_HEADER, drive.command.table)
    return paths


def main(config: InspectConfig) -> dict[str, Any]:
    """Load, look, print and write."""
    from whill_mjx.vehicle.vehicle_file import ROBOT_FILES

    if config.dataset.suffix in ROBOT_FILES:
        with refusing():
            return inspect_robot(config)
    with refusing():
        if config.wheels:
            raise OptionError(f"--wheels: {config.dataset} is a driving log; only a robot file has joints.")
        log = load_whole(config.dataset, config.select, config.format)
    if config.out is None:
        return look(config, log)[0]
    with claim_folder(config.out, KIND, OUTPUTS) as claim:
        claim.settle({})  # another look replaces an earlier one as a whole
        found, drives = look(config, log)
        for path in write(config.out, log, found, drives):
            print(f"wrote {path}", file=sys.stderr)
    return found


def look(config: InspectConfig, log: Log) -> tuple[dict[str, Any], list[NextDrive]]:
    """What was found, printed, and what to drive next."""
    from sysid.pages.report import plain

    found = inspect(log)
    drives = next_drives(log, [Blind(**one) for one in found["blind_spots"]], config.space, config.v_max, config.radius)
    found["next_drives"] = [
        {"file": OUTPUTS[3 + k], "manoeuvre": one.name, "why": one.why, "seconds": float(one.command.t[-1]),
         "v": float(np.abs(one.command.v).max()), "omega": float(np.abs(one.command.omega).max()),
         "floor": list(one.floor), "radius": one.radius, "drive_it": f"python -m bridge.manoeuvre "
         f"{in_shell((config.out or Path()) / OUTPUTS[3 + k])} --space {config.space[0]:g} {config.space[1]:g} "
         f"--radius {one.radius:g} --check"} for k, one in enumerate(drives)]
    print(json.dumps(plain(found), indent=1) if config.json else text(found))
    return found, drives


def cli() -> None:
    command_line.run(InspectConfig, main, __doc__)


if __name__ == "__main__":
    cli()

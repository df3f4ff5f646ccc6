"""Convert recordings to a driving-log dataset: `python -m sysid.convert SOURCE --out DATASET`.

SOURCE is a ROS bag (rosbag2 folder, .db3, .mcap, ROS 1 .bag), a CSV or TUM file, a folder of them, a LeRobotDataset, or
one of the published measured sets.
Bags become one trial each, or one per drive between standstills; a bag named circle_1 becomes the trial circle_1. The
dataset is docs/log_format.md's; an existing one gets the new trials added. `--to lerobot` writes a dataset as a
LeRobotDataset v3 instead.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from whill_mjx.io.command_line import listen, refusing, starts

if starts(__name__):
    listen()

from sysid import command_line
from sysid.logs.conversion import ConvertConfig, convert
from sysid.logs.records import Log
from whill_mjx.io.fields import counted, in_shell
from whill_mjx.io.folders import LOCK_FILE, PARTIAL, FolderRefused, check_place, lock_folder


def main(config: ConvertConfig) -> Log:
    """Convert and say what was made."""
    if config.to == "lerobot":
        return to_lerobot(config)
    with refusing(), dataset_folder(config.out):
        log, notes = convert(config)
    if any(note.startswith("column ") for note in notes):
        print("columns as --columns takes them, ROLE=FILE/COLUMN:UNIT, and how role and unit were found:")
    for note in notes:
        print(note)
    print(f"geometry: {log.spec.name}, wheel radius {log.spec.wheel_radius:g} m, track {log.spec.track:g} m; if that "
          "is not your vehicle, convert again with --wheel-radius and --track")
    seconds = sum(trial.duration for trial in log.trials)
    print(f"{config.out}: {counted(len(log.trials), 'trial')}, {seconds:.0f} s; look at it with "
          f"python -m sysid.inspect {in_shell(config.out)}")
    return log


def to_lerobot(config: ConvertConfig) -> Log:
    """Write a dataset as a LeRobotDataset, whole or not at all."""
    from sysid.logs import lerobot
    from sysid.logs.loaders import load_whole

    with refusing():
        log = load_whole(config.source, config.select)
        check_place("--out", config.out)
        if config.out.exists():
            raise FolderRefused(f"--out {config.out}: exists already. Choose another place.")
        config.out.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(prefix=f".{config.out.name}.", dir=config.out.parent) as partial:
            made = Path(partial) / config.out.name
            notes = [*log.notes, *lerobot.write(made, log, config.fps)]
            made.rename(config.out)
    for note in notes:
        print(note)
    print(f"{config.out}: a LeRobotDataset {lerobot.VERSION}")
    return log


@contextmanager
def dataset_folder(out: Path) -> Iterator[None]:
    """Hold a dataset that trials are added to; FolderRefused for what is none, or cannot be written."""
    if out.exists() and not out.is_dir():
        raise FolderRefused(f"--out {out}: is a file, not a folder. Choose another place.")
    check_place("--out", out)
    made = not out.exists()
    foreign = [] if made else [one for one in out.iterdir() if one.name != LOCK_FILE
                               and not one.name.startswith(PARTIAL)]  # of a conversion that was killed
    if foreign and not (out / "dataset.toml").exists():
        raise FolderRefused(f"--out {out}: holds other files, and no dataset.toml. Choose another --out.")
    out.mkdir(parents=True, exist_ok=True)
    try:
        with lock_folder(out):
            yield
    finally:
        if made and [one.name for one in out.iterdir()] == [LOCK_FILE]:
            shutil.rmtree(out)


def cli() -> None:
    command_line.run(ConvertConfig, main, __doc__)


if __name__ == "__main__":
    cli()

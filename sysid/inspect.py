"""Looks at a driving log before it is fitted: `python -m sysid.inspect DATASET [--out DIR] [--json]`.

Says how regularly each stream was sampled, how the clocks differ, whether units and signs are right, what each trial
excites, how well replicates repeat, and what no fit can find in the log.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from whill_mjx.io.command_line import listen, refusing

if __name__ == "__main__":
    listen()

from sysid import command_line
from sysid.logs.inspection import inspect, load_whole, text
from sysid.logs.log import Log
from whill_mjx.io.folders import claim_folder

KIND = "sysid.inspect"
OUTPUTS = ("inspect.txt", "inspect.json", "inspect.png")


@dataclass(frozen=True)
class InspectConfig:
    """Options of the command."""

    dataset: Path
    """Folder of a dataset, of DRIVE runs or of MRCLAM."""
    select: tuple[str, ...] = ()
    """Part of a measured set: RUN, GROUP or RUN:FROM-TO. By default all runs of one robot."""
    format: Literal["auto", "dataset", "drive_norlab", "mrclam"] = "auto"
    """Form of the data; found out by default."""
    json: bool = False
    """Print JSON instead of text."""
    out: Path | None = None
    """Folder for inspect.txt, inspect.json and inspect.png."""


def write(folder: Path, log: Log, found: dict[str, Any]) -> list[Path]:
    """Write inspect.txt, inspect.json and inspect.png; returns their paths."""
    from sysid.pages.inspect_plot import write_plot
    from sysid.pages.report import write_report
    from whill_mjx.logs.dataset import write_text

    paths = [folder / name for name in OUTPUTS]
    write_text(paths[0], text(found) + "\n")
    write_report(paths[1], found)
    write_plot(paths[2], log, found)
    return paths


def main(config: InspectConfig) -> dict[str, Any]:
    """Load, look, print and write."""
    with refusing():
        log = load_whole(config.dataset, config.select, config.format)
    if config.out is None:
        return look(config, log)
    with claim_folder(config.out, KIND, OUTPUTS) as claim:
        claim.settle({})  # another look replaces an earlier one as a whole
        found = look(config, log)
        for path in write(config.out, log, found):
            print(f"wrote {path}", file=sys.stderr)
    return found


def look(config: InspectConfig, log: Log) -> dict[str, Any]:
    """What was found, printed."""
    from sysid.pages.report import plain

    found = inspect(log)
    print(json.dumps(plain(found), indent=1) if config.json else text(found))
    return found


def cli() -> None:
    """Command line."""
    command_line.run(InspectConfig, main, __doc__)


if __name__ == "__main__":
    cli()

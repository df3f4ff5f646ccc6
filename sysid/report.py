"""Write the report of a fit: `python -m sysid.report RUN` writes the page RUN/report.html of an earlier fit."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from whill_mjx.io.command_line import listen, refusing, starts

if starts(__name__):
    listen()

from sysid import command_line
from sysid.logs.sources import refuse_recording
from sysid.pages.report import read_report, write_html
from whill_mjx.io.folders import check_place, lock_folder


@dataclass(frozen=True)
class Options:
    run: Path
    """Folder that sysid.fit wrote."""


def main(options: Options) -> None:
    with refusing():
        refuse_recording(options.run, "the folder that sysid.fit wrote.")
        read_report(options.run)
        check_place("RUN", options.run)
    with lock_folder(options.run, "RUN"):
        print(f"wrote {write_html(options.run)}")


def cli() -> None:
    command_line.run(Options, main, "Write the page RUN/report.html of an earlier fit.")


if __name__ == "__main__":
    cli()

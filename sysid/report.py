"""Write the report of a fit: `report.json` (versioned, below), and the tables and the page that people read.

`python -m sysid.report RUN` writes the page RUN/report.html of an earlier fit.

    schema, kind          1, "sysid-report"
    dataset               name, path, format, sha256, notes, training and held_out trial names
    settings              how the fit was called
    model                 preset, effects
    noise                 source ("replicates", "defaults", "residuals") and the scale per channel
    noise_floor           training, held_out: channel -> metric -> error that a perfect model would still have, or null
    parameters            name, unit, initial, value, interval, confidence, bounds, identifiable, remark
    fixed                 name, value, reason
    prior                 file, assumed_spread, moved (name, before, after, deviations, within); null without
    profiles              name, unit, values, cost, statistic, threshold, interval (null where open), remark
    spectrum              information, combination: eigenvalues of the Fisher information (by shares of the bounds),
                          weakest first, and the parameters along their eigenvectors
    weak_combinations     combinations of parameters that the log does not determine
    search                evaluations, seconds, cost before and after, costs of the starts, number that agree, delays
    code                  SHA-256 over the sources of the packages, their versions and those of what they run on
    errors                per trial and channel: metric -> ideal, initial, fitted
    summary               training, held_out -> channel -> metric -> mean of ideal, initial, fitted, and noise_floor
    groups                the same per group (terrain, robot), where there are several

"ideal" is a vehicle that follows its commands at once without slip, "initial" the model before the fit.
"""

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
    """Options of the command."""

    run: Path
    """Folder that sysid.fit wrote."""


def main(options: Options) -> None:
    """Write the page."""
    with refusing():
        refuse_recording(options.run, "the folder that sysid.fit wrote.")
        read_report(options.run)
        check_place("RUN", options.run)
    with lock_folder(options.run, "RUN"):
        print(f"wrote {write_html(options.run)}")


def cli() -> None:
    """Command line."""
    command_line.run(Options, main, "Write the page RUN/report.html of an earlier fit.")


if __name__ == "__main__":
    cli()

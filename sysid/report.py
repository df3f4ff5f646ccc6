"""The report of a fit: `report.json` (versioned, below), and the tables and the page that people read.

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

import sys
from pathlib import Path

from sysid.logs.sources import refuse_recording
from sysid.pages.report import write_html


def cli() -> None:
    """Command line: `python -m sysid.report RUN`."""
    import argparse

    parser = argparse.ArgumentParser(prog="python -m sysid.report",
                                     description="Write RUN/report.html of an earlier fit.")
    parser.add_argument("run", type=Path, help="folder that sysid.fit wrote")
    run = parser.parse_args().run
    try:
        refuse_recording(run, "the folder that sysid.fit wrote.")
        print(f"wrote {write_html(run)}")
    except (ValueError, FileNotFoundError) as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    cli()

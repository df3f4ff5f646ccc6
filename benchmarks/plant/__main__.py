"""Drive a dataset with the contact plant.

    python -m benchmarks.plant --out DIR --effects '{"slope": 0.02}' --seed 3 --answers FILE
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from benchmarks.plant.chair import VEHICLES
from benchmarks.plant.effects import EFFECTS
from benchmarks.plant.make import Experiment, make_log
from bridge.nodes.options import Parser, in_range, whole
from whill_mjx.io.command_line import OptionError, guarded
from whill_mjx.io.heartbeat import Heartbeat


def main(arguments: list[str] | None = None) -> Path:
    """Parse the command line and write the dataset; returns its folder."""
    table = "\n".join(f"  {name} [{entry.unit}], base {entry.base:g}: {entry.form}" for name, entry in EFFECTS.items())
    parser = Parser(
        prog="python -m benchmarks.plant", description=__doc__, epilog=f"effects:\n{table}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("--out", type=Path, required=True, help="dataset folder to write; it must not exist")
    parser.add_argument("--effects", default="{}", help="JSON: size by name, such as '{\"slope\": 0.02}'")
    parser.add_argument("--seed", type=whole(0), default=0, help="of commands, day, disturbances and noise")
    parser.add_argument("--noise", type=in_range(0), default=1.0, help="factor on disturbances and sensor noise")
    parser.add_argument("--nominal", action="store_true", help="the nominal chair instead of one of a day")
    parser.add_argument("--no-ground-truth", action="store_true", help="leave out the outside pose")
    parser.add_argument("--manoeuvres", nargs="+", help="some of the nine")
    parser.add_argument("--replicates", type=whole(), default=3, help="drives of each manoeuvre; default 3")
    parser.add_argument("--answers", type=Path, help="file, outside the dataset, for what was driven")
    parser.add_argument("--processes", type=whole(), default=1, help="processes that drive at a time; default 1")
    parser.add_argument("--vehicle", choices=VEHICLES, default="chair", help="what drives; default chair")
    given = parser.parse_args(arguments)
    try:
        effects = {str(name): float(size) for name, size in json.loads(given.effects).items()}
    except (ValueError, TypeError, AttributeError):
        raise OptionError(
            f"--effects {given.effects!r}: not JSON of sizes by name. Write '{{\"slope\": 0.02}}'."
        ) from None
    experiment = Experiment(
        effects, given.seed, given.noise, not given.nominal, given.manoeuvres, given.replicates, given.vehicle
    )
    with Heartbeat() as heartbeat:
        heartbeat.stage("driving the manoeuvres on the contact plant")
        return make_log(given.out, experiment, not given.no_ground_truth, given.answers, given.processes)


if __name__ == "__main__":
    with guarded():
        print(main())

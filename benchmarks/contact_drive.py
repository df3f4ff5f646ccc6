"""How near the fitted vehicle drives to the contact plant: `python -m benchmarks.contact_drive [--seeds 2000 2001]`.

The plant (`benchmarks.plant`, real wheel contacts, no code of ours) drives the reference paper's five manoeuvres, three
times each with disturbances and sensor noise. The vehicle is fitted to them with one manoeuvre held out, then drives
the same commands from the start pose alone. It is scored against the plant's drive without disturbances and noise:
largest distance and heading difference at any time of any of the five, the held-out one among them.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.harness import figure, record
from benchmarks.physics import CLAIM
from benchmarks.plant.make import Experiment, make_log
from bridge.nodes.options import Parser, whole
from sysid.logs.log import load_log
from sysid.logs.records import Log
from sysid.search.fitting import fit_log, predict
from sysid.search.settings import FitConfig
from whill_mjx.io.command_line import guarded

FIVE = ("straight", "turn", "circle", "s_curve", "figure_eight")


def logs(seed: int, folder: Path) -> tuple[Log, Log]:
    """One chair's drives as measured, and the same without disturbances and noise."""
    measured = make_log(folder / "measured", Experiment(seed=seed, manoeuvres=FIVE))
    clean = make_log(folder / "clean", Experiment(seed=seed, noise=0.0, manoeuvres=FIVE, replicates=1))
    return load_log(measured), load_log(clean)


def largest_errors(seed: int, iterations: int) -> dict[str, tuple[float, float]]:
    """Largest distance [m] and heading difference [rad] of each manoeuvre."""
    with tempfile.TemporaryDirectory() as folder:
        measured, clean = logs(seed, Path(folder))
    fit = fit_log(measured, FitConfig(iterations=iterations))
    errors = {}
    for trial, driven in zip(clean.trials, predict(fit, clean.trials)[1], strict=True):
        true, ours = trial.ground_truth, driven.ground_truth
        assert true is not None and ours is not None
        turn = np.angle(np.exp(1j * (ours.yaw - true.yaw)))
        errors[trial.manoeuvre] = float(np.hypot(ours.x - true.x, ours.y - true.y).max()), float(np.abs(turn).max())
        held_out = any(one.held_out for one in measured.trials if one.manoeuvre == trial.manoeuvre)
        print(f"{seed} {trial.manoeuvre:13s} {errors[trial.manoeuvre][0]:.4f} m, {errors[trial.manoeuvre][1]:.4f} rad"
              f"{', held out' if held_out else ''}")  # fmt: skip
    return errors


def main() -> None:
    """Fit every chair, print and record."""
    parser = Parser(
        prog="python -m benchmarks.contact_drive", description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("--seeds", type=whole(0), nargs="+", default=[2000, 2001, 2002], help="days of the plant")
    parser.add_argument("--iterations", type=whole(), default=60, help="of the fit: until nothing moves")
    options = parser.parse_args()
    found = {seed: largest_errors(seed, options.iterations) for seed in options.seeds}
    record("physics", CLAIM, figures_of(found))


def figures_of(found: dict[int, dict[str, tuple[float, float]]]) -> dict[str, dict[str, Any]]:
    """One figure of distance and one of heading: the largest of any manoeuvre for every seed, in order of `seeds`."""
    figures = {}
    for part, unit in enumerate(("m", "rad")):
        each = {name: [one[name][part] for one in found.values()] for name in FIVE}
        largest = [max(values) for values in zip(*each.values(), strict=True)]
        entry = {**figure(largest, unit), "largest": max(largest), "seeds": list(found), "manoeuvres": each}
        figures[f"contact_five_manoeuvres_{unit}"] = entry
    return figures


if __name__ == "__main__":
    with guarded():
        main()

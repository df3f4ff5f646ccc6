"""The plots of a first drive: what docs/deploy.md expects, or what was recorded.

    python -m benchmarks.deploy_plots                              # writes docs/images/first_drive.png
    python -m benchmarks.deploy_plots logs/first/trials/straight_1 --out first.png

Without a recording the contact plant drives straight on and turns, as a chair does that is in order.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.loop_direct import drive_directly
from benchmarks.loop_drives import Plan
from benchmarks.page_pictures import save_figure
from benchmarks.pictures import IMAGES
from benchmarks.plant.chair import VEHICLES
from bridge.nodes.options import Parser
from bridge.recording.trial_writer import COLUMNS
from whill_mjx.io.command_line import guarded
from whill_mjx.io.folders import check_file

COMMANDS = "t,v,omega\n0,0,0\n1,0.2,0\n6,0,0\n8,0,0.3\n12,0,0\n14,0,0\n"
GAP = 0.15
"""Largest time between two commands that is in order [s]."""


def columns(trial: Path, stream: str) -> dict[str, np.ndarray]:
    """Return the columns of a stream of a trial.

    Raises:
        ValueError: the trial has no such stream.
    """
    path = trial / f"{stream}.csv"
    if not path.is_file():
        raise ValueError(f"{path}: no such file. Give the folder of a trial that bridge.record wrote.")
    rows = np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2)
    return dict(zip(COLUMNS[stream], rows.T, strict=False))


def draw(trial: Path) -> Any:
    """Return a figure of commands and odometry of a trial."""
    import matplotlib.pyplot as plt

    command, odometry = columns(trial, "command"), columns(trial, "odometry")
    figure, axes = plt.subplots(2, 2, figsize=(9, 5.6), constrained_layout=True)
    for one, name, unit in ((axes[0, 0], "v", "m/s"), (axes[0, 1], "omega", "rad/s")):
        one.step(command["t"], command[name], where="post", color="tab:orange", label="command")
        one.plot(odometry["t"], odometry[name], color="tab:blue", label="odometry")
        one.set(xlabel="t [s]", ylabel=f"{name} [{unit}]")
        one.legend()
    axes[1, 0].plot(odometry["x"], odometry["y"], ".", ms=2, color="tab:blue")
    axes[1, 0].set(xlabel="x [m]", ylabel="y [m]", aspect="equal", adjustable="datalim")
    gaps = np.diff(command["t"])
    axes[1, 1].plot(command["t"][1:], gaps, ".", ms=3, color="tab:orange")
    axes[1, 1].axhline(GAP, color="tab:red", lw=1)
    axes[1, 1].set(xlabel="t [s]", ylabel="time between commands [s]", ylim=(0, 1.3 * max(GAP, gaps.max(initial=0.0))))
    return figure


def expected(folder: Path) -> Path:
    """Drive the contact plant, and return the trial."""
    path = folder / "first.csv"
    path.write_text(COMMANDS)
    drive_directly([Plan("first", path, 1)], folder / "logs", {}, 1, VEHICLES["chair"].nominal)
    return folder / "logs" / "trials" / "first_1"


def main() -> None:
    """Draw what the command line names."""
    import matplotlib

    matplotlib.use("Agg")
    parser = Parser(prog="python -m benchmarks.deploy_plots", description=__doc__)
    parser.add_argument("trial", nargs="?", type=Path, help="folder of a recorded trial")
    parser.add_argument("--out", type=Path, help="PNG file (default: first_drive.png here; without a recording the "
                        "picture of docs/deploy.md)")
    given = parser.parse_args()
    out = given.out or (Path("first_drive.png") if given.trial else IMAGES / "first_drive.png")
    with tempfile.TemporaryDirectory() as folder:
        try:
            if given.out or given.trial:  # the page's own picture is kept by git
                check_file("--out", out)
            figure = draw(given.trial or expected(Path(folder)))
        except ValueError as error:
            parser.error(str(error))
    save_figure(figure, out)


if __name__ == "__main__":
    with guarded():
        main()

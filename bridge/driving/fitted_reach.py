"""The floor that a manoeuvre may need, from paths of the fitted vehicle: simulated by another process.

The simulator is a package of its own, which the vehicle's computer may lack; so it is called as a command and its file
of paths is read.
"""

import csv
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bridge.driving.command_table import PERIOD, REACTION, CommandTable, Reach

SIMULATOR = "whill_mjx.logs.paths"
PATIENCE = 300.0
"""Seconds that the simulation may take; most of them are compilation."""


@dataclass(frozen=True)
class FittedReach:
    """Floor of the fitted vehicle and of all vehicles that it may be."""

    own: Reach
    """With the file's own values."""
    widest: Reach
    """Around the paths of all drawn vehicles."""
    count: int
    """Vehicles that were drawn."""

    def __str__(self) -> str:
        own, widest = self.own, self.widest
        return (f"the fitted vehicle needs {own.length:.1f} x {own.width:.1f} m, the widest of {self.count} vehicles "
                f"that it may be {widest.length:.1f} x {widest.width:.1f} m")


def simulate_reach(table: CommandTable, vehicle: Path, radius: float, count: int) -> FittedReach:
    """Return the floor of a manoeuvre as a vehicle file knows the vehicle.

    Args:
        table: what is driven.
        vehicle: vehicle file, with intervals.
        radius: of the vehicle around its drive-axle centre [m].
        count: vehicles drawn from the intervals.

    Raises:
        ValueError: the file is refused, or the simulator is not installed.
    """
    with tempfile.TemporaryDirectory() as folder:
        commands, out = Path(folder) / "commands.csv", Path(folder) / "paths.csv"
        rows = np.column_stack([np.arange(len(table.v)) * PERIOD, table.v, table.omega])
        commands.write_text("t,v,omega\n" + "".join(f"{t:.3f},{v:.6f},{w:.6f}\n" for t, v, w in rows))
        words = [sys.executable, "-m", SIMULATOR, str(commands), str(vehicle), "--out", str(out), "--count", str(count)]
        try:
            ended = subprocess.run(words, capture_output=True, text=True, timeout=PATIENCE)
        except subprocess.TimeoutExpired:
            raise ValueError(f"--vehicle-file {vehicle}: the simulation took more than {PATIENCE:g} s. Check a shorter "
                             "manoeuvre, or draw fewer vehicles.") from None
        if ended.returncode:
            lines = ended.stderr.strip().splitlines() or ["it ended without a word"]
            if "No module named" in lines[-1]:
                raise ValueError(f"--vehicle-file {vehicle}: the simulator whill_mjx is not installed here. Check the "
                                 "manoeuvre on another computer with --check, or leave the option out.")
            raise ValueError(f"--vehicle-file {vehicle}: {lines[-1].removeprefix('error: ')}")
        return reach_of_paths(read_paths(out), radius)


def read_paths(path: Path) -> list[np.ndarray]:
    """Return the paths of a file: each (T, 4) t [s], x, y [m], yaw [rad]."""
    with open(path, encoding="utf-8", newline="") as file:
        rows = np.array([[float(cell) for cell in row] for row in list(csv.reader(file))[1:]])
    return [rows[rows[:, 0] == number, 1:] for number in np.unique(rows[:, 0])]


def reach_of_paths(paths: list[np.ndarray], radius: float) -> FittedReach:
    """Return the floor of paths, each place widened by the radius and by what the vehicle drives on before it stops."""
    reaches = [_reach(path, radius) for path in paths]
    own = reaches[0]
    ends = [max(getattr(one, name) for one in reaches) for name in ("ahead", "behind", "left", "right", "speed")]
    return FittedReach(own, Reach(*ends), len(paths))


def _reach(path: np.ndarray, radius: float) -> Reach:
    step = np.hypot(np.diff(path[:, 1]), np.diff(path[:, 2])) / np.diff(path[:, 0])
    speed = np.concatenate([[0.0], step])
    margin = radius + speed * REACTION
    low, high = (path[:, 1:3] - margin[:, None]).min(axis=0), (path[:, 1:3] + margin[:, None]).max(axis=0)
    return Reach(float(high[0]), float(-low[0]), float(high[1]), float(-low[1]), float(speed.max()))

"""Export a vehicle as one stand-alone Python file: its step, with all its effects, in numpy alone.

    python -m whill_mjx.export_python VEHICLE --out vehicle.py

VEHICLE is a vehicle file or a built-in vehicle. The file imports nothing of this project, so it can be copied into
another simulator:

    from vehicle import odometry, pose, start, step

    state = start(count=1000)                      # 1000 vehicles at rest at the origin
    for _ in range(200):
        state = step(state, v=0.5, omega=0.3)      # one physics step; numbers or arrays (N,)
    x, y, yaw = pose(state)                        # each (N,)

Every function takes `xp`, the module that computes: numpy by default, or torch, cupy and jax.numpy for their arrays.

The file is not written by hand. `whill_mjx.vehicle.dynamics.substep` is traced into operations on single numbers, with
the vehicle's parameters as constants, and each operation becomes a line. It therefore does what the simulator does.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from whill_mjx.io.command_line import PHYSICS_DT, OptionError, listen, refusing, run, starts

if starts(__name__):
    listen()

from whill_mjx.export.numpy_check import largest_distance
from whill_mjx.export.numpy_file import vehicle_source
from whill_mjx.io.folders import check_file, note_written, write_whole
from whill_mjx.vehicle.vehicle_file import load_vehicle


@dataclass(frozen=True)
class Options:
    """Options of the command."""

    vehicle: str
    """Vehicle file, or a built-in vehicle."""
    out: Path = Path("vehicle.py")
    """File to write; an earlier one is replaced."""
    physics_dt: Annotated[float, PHYSICS_DT] = 0.005
    """Physics step [s]; part of the vehicle, since its controller counts steps."""
    check: bool = True
    """Then drive a figure-eight with the file and in the simulator and print how far apart they are."""


def main(options: Options) -> None:
    """Export, check and say what was written."""
    from whill_mjx.logs.manoeuvres import command_table, held_commands

    with refusing():
        spec, params, _ = load_vehicle(options.vehicle)
        if options.out.suffix != ".py":
            raise OptionError(f"--out {options.out}: must be a file that ends in .py. Correct the name.")
        check_file("--out", options.out)
        source = vehicle_source(spec, params, options.physics_dt)
    write_whole(options.out, source)
    note_written(options.out)
    print(f"wrote {options.out}: {source.count(chr(10))} lines, effects {', '.join(e.name for e in params.effects)}")
    if options.check:
        commands = held_commands(command_table("figure_eight"), options.physics_dt)
        apart_by = largest_distance(options.out, spec, params, commands)
        print(f"figure-eight of {len(commands) * options.physics_dt:.0f} s: the file and the simulator are at most "
              f"{apart_by:.1e} m apart")


def cli() -> None:
    """Command line."""
    run(Options, main, __doc__)


if __name__ == "__main__":
    cli()

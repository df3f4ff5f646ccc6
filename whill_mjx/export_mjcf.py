"""Export a vehicle to C MuJoCo: an MJCF file of its rigid bodies, and a callback that evaluates its forces.

    python -m whill_mjx.export_mjcf VEHICLE --out DIR

writes DIR/vehicle.xml, DIR/vehicle.toml and DIR/drive.py, an example. In MuJoCo:

    model = mujoco.MjModel.from_xml_path("vehicle.xml")
    data = mujoco.MjData(model)
    forces = load_forces("vehicle.toml", model)
    forces.place(data)
    mujoco.set_mjcb_control(forces)  # or call forces(model, data) before each mj_step
    data.ctrl[:] = 0.5, 0.3          # v [m/s], omega [rad/s]
    mujoco.mj_step(model, data)

The callback does what `whill_mjx.vehicle.dynamics.forces` does, with the same code compiled for the processor: the
command in data.ctrl passes the effects, drive and ground give a wrench and wheel torques, and they are written to
data.qfrc_applied of the vehicle's own joints. It keeps the memory of the effects (delays, integrals), once per step of
data.time, and the odometry. Two vehicles in one scene need two callbacks, and names of their own.

MuJoCo moves positions with the speed at the end of a step, the simulator with the mean of both ends: paths differ
by about half a step's change of speed. The file's integrator and timestep are part of the vehicle.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from whill_mjx.io.command_line import PHYSICS_DT, listen, refusing, run, starts

if starts(__name__):
    listen()

from whill_mjx.export.force_callback import load_forces as load_forces  # exported examples take it from here
from whill_mjx.export.mujoco_check import drive_both, scenario_in_proportion
from whill_mjx.export.mujoco_folder import FOLDER_FILES, export_folder
from whill_mjx.logs.manoeuvres import command_table, held_commands
from whill_mjx.vehicle.vehicle_file import load_vehicle


@dataclass(frozen=True)
class Options:
    """Options of the command."""

    vehicle: str
    """Vehicle file, or a built-in vehicle."""
    out: Path = Path("runs/mujoco")
    """Folder to write; it must not exist."""
    physics_dt: Annotated[float, PHYSICS_DT] = 0.005
    """Physics step [s]; part of the vehicle, since its controller counts steps."""
    check: bool = True
    """Then drive a figure-eight in C MuJoCo and in the simulator and print how far apart they are."""


def main(options: Options) -> None:
    """Export, check and say what was written."""
    with refusing():
        spec, params, _ = load_vehicle(options.vehicle)
    folder = export_folder(spec, params, options.out, options.physics_dt)
    print(f"wrote {', '.join(str(folder / name) for name in FOLDER_FILES)}")
    if options.check:
        table = command_table("figure_eight", scenario_in_proportion(spec))
        found = drive_both(folder, held_commands(table, options.physics_dt))
        print(f"figure-eight of {len(found.mujoco) * options.physics_dt:.0f} s: C MuJoCo and the simulator at most "
              f"{1e3 * found.distance:.2f} mm and {1e3 * found.turn:.2f} mrad apart")
        if found.upright < len(found.tilt):
            print(f"the vehicle tips over {found.upright * options.physics_dt:.1f} s into this drive, and both are "
                  "compared until then. Its drives speed up and brake too hard for its size: drive it slowly, or give "
                  "it an acceleration_limit or a lower torque_drive.limit")


def cli() -> None:
    """Command line."""
    run(Options, main, __doc__)


if __name__ == "__main__":
    cli()

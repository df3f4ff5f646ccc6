"""The folder that C MuJoCo drives a vehicle from: bodies, vehicle file and an example."""

from __future__ import annotations

from pathlib import Path

from whill_mjx.export.mjcf_text import vehicle_mjcf
from whill_mjx.io.folders import new_folder
from whill_mjx.vehicle.specs import VehicleSpec
from whill_mjx.vehicle.types import VehicleParams
from whill_mjx.vehicle.vehicle_file import save_vehicle

FOLDER_FILES = ("vehicle.xml", "vehicle.toml", "drive.py")
EXAMPLE = '''"""Drives the vehicle in C MuJoCo for ten seconds; prints where it is and where it thinks it is."""

from pathlib import Path

import mujoco

from whill_mjx.export_mjcf import load_forces

FOLDER = Path(__file__).parent

model = mujoco.MjModel.from_xml_path(str(FOLDER / "vehicle.xml"))
data = mujoco.MjData(model)
forces = load_forces(FOLDER / "vehicle.toml", model)
forces.place(data, x=0.0, y=0.0, yaw=0.0)
mujoco.set_mjcb_control(forces)
data.ctrl[:] = 0.5, 0.3  # v [m/s], omega [rad/s]
while data.time < 10.0:
    mujoco.mj_step(model, data)
mujoco.set_mjcb_control(None)
print("x, y [m], yaw [rad]:", *forces.pose(data).round(3))
print("odometry:", forces.odometry)
'''


def export_folder(spec: VehicleSpec, params: VehicleParams, out: Path, physics_dt: float = 0.005) -> Path:
    """Write the folder `out`, whole or not at all; it must not exist."""
    with new_folder(out) as partial:
        (partial / "vehicle.xml").write_text(vehicle_mjcf(spec, params, physics_dt))
        save_vehicle(partial / "vehicle.toml", spec, params, provenance={"made_by": "whill_mjx.export_mjcf"})
        (partial / "drive.py").write_text(EXAMPLE)
    return out

"""A robot of one's own through every command; its drives are of a contact simulation that shares no code with it."""

from __future__ import annotations

import json

import numpy as np
import pytest

from benchmarks.plant.commands import nine
from benchmarks.plant.first_day import Day, Wrong, make_uncalibrated, slowed, write_urdf
from sysid.close_loop import Arguments as LoopArguments
from sysid.close_loop import main as loop_main
from sysid.design import DesignConfig
from sysid.design import main as design_main
from sysid.fit import Arguments as FitArguments
from sysid.fit import main as fit_main
from sysid.logs.log import load_log, of_file
from sysid.missing.fit_statistics import load_fitted
from sysid.replay.robot_loading import load_robot
from whill_mjx.export.mujoco_check import drive_both
from whill_mjx.export.mujoco_folder import export_folder
from whill_mjx.logs.manoeuvres import held_commands
from whill_mjx.vehicle.vehicle_file import load_intervals, load_vehicle

WRONG = Wrong(x=0.05, y=-0.02)
DRIVES = ("turn", "s_curve", "stop_and_go")


def drives(seed: int) -> dict[str, np.ndarray]:
    tables = slowed({name: table[table[:, 0] < 10.0] for name, table in nine(seed).items() if name in DRIVES})
    for table in tables.values():
        table[-5:, 1:] = 0.0
    return tables


@pytest.fixture(scope="module")
def days(tmp_path_factory):
    """Folder with a day as it should be, and one on which the odometry reads 2 % too far."""
    folder = tmp_path_factory.mktemp("own")
    make_uncalibrated(folder / "usual", Day("small", WRONG, seed=1), 2, drives(1))
    odd = Day("small", WRONG, seed=2, effects=(("odometry_scale", 0.02),))
    make_uncalibrated(folder / "odd", odd, 2, drives(2))
    write_urdf(folder / "robot.urdf")
    return folder


@pytest.fixture(scope="module")
def run(days):
    """The folder of a fit of the robot file to the first day."""
    fit_main(FitArguments(dataset=days / "usual", model=str(days / "robot.urdf"), quick=True, elsewhere=False,
                          out=days / "run"))
    return days / "run"


@pytest.mark.long
def test_a_fit_writes_the_robot_and_the_vehicle_that_drives_alike(run):
    spec, fitted = load_fitted(run / "vehicle.toml")
    names = fitted.statistics.names
    assert {"wheel_radius_difference.common", "track_width.error", "torque_drive.kp", "slip_traction.mu"} <= set(names)
    intervals = load_intervals(run / "vehicle.toml")
    low, high = intervals["wheel_radius_difference.common"]
    assert low - 0.003 < WRONG.radius < high + 0.003
    report = json.loads((run / "report.json").read_text())
    [radius] = [one["value"] for one in report["parameters"] if one["name"] == "wheels.radius"]
    assert load_robot(run / "model.xml").wheel_radius == pytest.approx(radius, rel=0.006)  # it sinks in by as much
    [note] = [one for one in report["dataset"]["notes"] if one.startswith("vehicle.toml is the vehicle")]
    assert float(note.split("it is ")[1].split(" mm")[0]) < 6.0
    assert spec.body_length == pytest.approx(0.144)


@pytest.mark.long
def test_the_loop_finds_what_another_day_of_the_robot_lacks(run, days, tmp_path):
    report = loop_main(LoopArguments(dataset=days / "odd", vehicle=run / "vehicle.toml", quick=True,
                                     out=tmp_path / "loop"))
    assert report["verdict"] == "named"
    assert any("odometry_scale" in (one["name"], *one["class"]) for one in report["effects"])
    usual = of_file(load_log(days / "usual"), load_vehicle(run / "vehicle.toml")[0], "vehicle.toml")
    assert usual.spec.wheelbase == pytest.approx(0.06)  # where its ball stands; dataset.toml has 0.12


@pytest.mark.long
def test_a_drive_is_designed_for_the_robot(run, tmp_path):
    paths = design_main(DesignConfig(vehicle=str(run), out=tmp_path / "next.csv", space=(3.0, 3.0), v_max=0.2,
                                     omega_max=1.0))
    table = np.loadtxt(paths[0], delimiter=",", skiprows=1)
    assert np.abs(table[:, 1]).max() <= 0.2 + 1e-6 and len(table) > 20


@pytest.mark.long
def test_the_robot_drives_in_c_mujoco_as_in_the_simulator(run, tmp_path):
    spec, params, _ = load_vehicle(run / "vehicle.toml")
    found = drive_both(export_folder(spec, params, tmp_path / "mujoco"), held_commands(drives(3)["s_curve"], 0.005))
    assert np.ptp(found.simulator[:, 0]) > 0.2
    assert found.distance < 0.005 and found.turn < 0.01

"""A vehicle file driven by C MuJoCo through the exported file and its force callback."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from whill_mjx import export_mjcf
from whill_mjx.effects import make_effect
from whill_mjx.export.force_callback import VehicleForces
from whill_mjx.export.mjcf_text import vehicle_mjcf
from whill_mjx.export.mujoco_check import BothDrives, drive_both, scenario_in_proportion
from whill_mjx.export.mujoco_folder import export_folder
from whill_mjx.export_mjcf import load_forces
from whill_mjx.logs.manoeuvres import Scenario, command_table, held_commands
from whill_mjx.vehicle.presets import preset
from whill_mjx.vehicle.specs import HUSKY, WHILL_CR
from whill_mjx.vehicle.vehicle_file import load_vehicle, save_vehicle


def changed(value, **fields):
    return dataclasses.replace(value, **{name: jnp.asarray(one) for name, one in fields.items()})


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Export of a vehicle as a fit leaves it: off-centre, loaded, on a slope, with delays at both ends."""
    root = tmp_path_factory.mktemp("export")
    spec, params = preset("whill_cr_physical")
    body = changed(params.body, yaw_inertia=4.5, com_x=-0.22, com_y=0.02, com_z=0.1)
    effects = (*params.effects, make_effect("payload_shift", mass=10.0, y=0.1), make_effect("slope", along_x=0.01),
               make_effect("sensor_delay", delay=0.03))
    save_vehicle(root / "vehicle.toml", spec, dataclasses.replace(params, body=body, effects=effects))
    spec, params, _ = load_vehicle(root / "vehicle.toml")
    return export_folder(spec, params, root / "mujoco")


def test_c_mujoco_drives_a_figure_eight_as_the_simulator_does(folder):
    """Within 6 mm and 2 mrad over the whole drive; MuJoCo moves with the speed at a step's end, half a step early."""
    found = drive_both(folder, held_commands(command_table("figure_eight", Scenario()), 0.005))
    assert np.ptp(found.simulator[:, 0]) > 1.5 and np.ptp(np.unwrap(found.simulator[:, 2])) > 6.0
    assert found.distance < 6e-3 and found.turn < 2e-3


def test_a_vehicle_that_tips_over_is_compared_until_then():
    upright, fallen = np.zeros((4, 3)), np.array([[0, 0, 0], [0.001, 0, 0.002], [1, 0, 3], [1, 0, 3]], float)
    found = BothDrives(fallen, upright, np.array([0.0, 0.1, 1.2, 1.5]))
    assert (found.upright, found.distance, found.turn) == (2, 0.001, 0.002)
    small = dataclasses.replace(WHILL_CR, track=WHILL_CR.track / 4)
    assert scenario_in_proportion(WHILL_CR) == Scenario()
    slower = scenario_in_proportion(small)
    assert (slower.v, slower.omega) == pytest.approx((0.3, 1.0))  # 1.0: the limit


def test_the_callback_repeats_itself_within_a_step_and_starts_afresh_when_time_goes_back(folder):
    model = mujoco.MjModel.from_xml_path(str(folder / "vehicle.xml"))
    forces = load_forces(folder / "vehicle.toml", model)

    def drive(extra):
        data = mujoco.MjData(model)
        forces.place(data, x=1.0, y=2.0, yaw=-1.0)
        np.testing.assert_allclose(forces.pose(data), [1.0, 2.0, -1.0], atol=1e-4)
        data.ctrl[:] = 0.5, 0.6
        for _ in range(100):
            forces(model, data)
            for _ in range(extra):
                forces(model, data)
            mujoco.mj_step(model, data)
        return data.qpos.copy(), forces.odometry

    (once, read), (often, again) = drive(0), drive(2)
    np.testing.assert_array_equal(once, often)
    assert read == again
    assert 0.05 < read["x"] < 0.3 and read["yaw"] > 0.05  # from the odometry's own origin, not the room's
    assert read["v"] == pytest.approx(0.5, abs=0.1)


@pytest.mark.quick
def test_mass_payload_and_gravity_are_those_of_the_vehicle(folder):
    model = mujoco.MjModel.from_xml_path(str(folder / "vehicle.xml"))
    assert model.body("chassis").mass[0] == pytest.approx(WHILL_CR.mass + 10.0)
    assert model.body("chassis").ipos[1] == pytest.approx((52 * 0.02 + 10 * 0.1) / 62, rel=1e-4)
    assert np.linalg.norm(model.opt.gravity) == pytest.approx(9.81, rel=1e-4)
    assert abs(model.opt.gravity[2]) < 9.8099
    np.testing.assert_allclose(model.actuator_ctrlrange, [[-1, 1], [-1, 1]])


@pytest.mark.quick
def test_another_vehicle_has_its_own_geometry():
    _, params = preset("husky")
    model = mujoco.MjModel.from_xml_string(vehicle_mjcf(HUSKY, params))
    np.testing.assert_allclose(model.body("left_wheel").pos, [0.0, HUSKY.track / 2, 0.0])
    assert model.dof_armature[6] == HUSKY.wheel_inertia


@pytest.mark.quick
def test_a_scene_that_cannot_be_driven_says_why(folder, tmp_path):
    text = (folder / "vehicle.xml").read_text()
    spec, params, _ = load_vehicle(folder / "vehicle.toml")
    for old, new, message in (('timestep="0.005"', 'timestep="0.005" integrator="RK4"', "not Euler"),
                              ("</worldbody>", '</worldbody><option><flag actuation="disable"/></option>', "disables"),
                              ('name="omega"', 'name="w"', "no vehicle of prefix ''")):
        with pytest.raises(ValueError, match=message):
            VehicleForces(spec, params, mujoco.MjModel.from_xml_string(text.replace(old, new)))
    with pytest.raises(ValueError, match="exists already"):
        export_folder(spec, params, folder)
    assert not list(folder.parent.glob(".*partial*"))


@pytest.mark.quick
def test_the_command_ends_bad_input_with_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr("sys.argv", ["export_mjcf", str(tmp_path / "no.toml"), "--out", str(tmp_path / "out")])
    with pytest.raises(SystemExit, match="error: .*no.toml: no such vehicle file"):
        export_mjcf.cli()

"""Models of other people: a plain function and a MuJoCo file, fitted to a log of planted parameters."""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import json
import struct
import sys
import threading
import tomllib

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from cart import cart

from benchmarks.planted_logs import Schedule, write_dataset
from sysid import fit as fit_module
from sysid.fit import Arguments
from sysid.logs.log import make_trial
from sysid.logs.records import Command, OdometryStream, PoseStream
from sysid.replay.cores import on_all_cores
from sysid.replay.differences import DifferenceReplay
from sysid.replay.mjcf import mjcf_model
from sysid.replay.model_files import load_model
from sysid.replay.models import function_model, make_parameters, model_space, set_parameters
from sysid.replay.robot_files import read_robot
from sysid.replay.robot_loading import load_robot
from sysid.replay.robot_parameters import default_paths, resolve, write_mjcf
from sysid.run_folder import parts_label, run_folder, settings_of
from sysid.search.fitting import fit_log
from sysid.search.settings import FitConfig
from whill_mjx.io.folders import FolderRefused
from whill_mjx.logs.manoeuvres import Scenario, command_table
from whill_mjx.processor import FLAG, OPTION
from whill_mjx.vehicle.specs import WHILL_CR

DT = 0.02
FUNCTION = cart("lag", "lag", '{"lag": (0.1, 0.02, 1.0, "s"), "turn": (1.0, 0.5, 1.5)}')
PLANTED = {"lag": 0.3, "turn": 0.9, "command_delay.delay": 0.13}
ROBOT = '''
<mujoco model="robot">
  <option timestep="0.01" integrator="implicitfast" iterations="20" ls_iterations="20"/>
  <worldbody>
    <geom name="floor" type="plane" size="10 10 0.1"/>
    <body name="base" pos="0 0 0.1">
      <freejoint/>
      <geom name="box" type="box" size="0.2 0.15 0.05" mass="8" contype="0" conaffinity="0"/>
      <geom name="caster" type="sphere" size="0.05" pos="0.2 0 -0.05" mass="0.1" friction="0.01" priority="1"/>
      <body name="left_wheel" pos="-0.1 0.2 0">
        <joint name="left" axis="0 1 0" damping="0.05" armature="0.01"/>
        <geom name="left_tyre" type="sphere" size="0.1" mass="0.5" friction="0.9" priority="1"/>
      </body>
      <body name="right_wheel" pos="-0.1 -0.2 0">
        <joint name="right" axis="0 -1 0" damping="0.05" armature="0.01"/>
        <geom name="right_tyre" type="sphere" size="0.1" mass="0.5" friction="0.9" priority="1"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <velocity name="left_motor" joint="left" kv="1"/>
    <velocity name="right_motor" joint="right" kv="1"/>
  </actuator>
</mujoco>
'''
URDF = '''
<robot name="cart">
  <link name="base"><inertial><mass value="8"/>
    <inertia ixx="0.1" iyy="0.1" izz="0.2" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><origin xyz="0.2 0 0.25"/><geometry><sphere radius="0.05"/></geometry></collision></link>
  <link name="left_wheel"><inertial><mass value="0.5"/>
    <inertia ixx="0.002" iyy="0.002" izz="0.002" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><origin rpy="1.5708 0 0"/><geometry><cylinder radius="0.1" length="0.04"/></geometry></collision></link>
  <link name="right_wheel"><inertial><mass value="0.5"/>
    <inertia ixx="0.002" iyy="0.002" izz="0.002" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><origin rpy="1.5708 0 0"/><geometry><cylinder radius="0.1" length="0.04"/></geometry></collision></link>
  <joint name="left_wheel_joint" type="continuous"><parent link="base"/><child link="left_wheel"/>
    <origin xyz="-0.1 0.2 0.3" rpy="0 0 0"/><axis xyz="0 1 0"/></joint>
  <joint name="right_wheel_joint" type="continuous"><parent link="base"/><child link="right_wheel"/>
    <origin xyz="-0.1 -0.2 0.3"/><axis xyz="0 1 0"/></joint>
</robot>
'''


@pytest.fixture(scope="module")
def function_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("function") / "cart.py"
    path.write_text(FUNCTION)
    return path


@pytest.fixture(scope="module")
def robot_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("robot") / "robot.xml"
    path.write_text(ROBOT)
    return path


@pytest.fixture(scope="module")
def function_run(function_file, tmp_path_factory):
    """Run folder and report of `sysid.fit --model cart.py --effects command_delay` on a planted log."""
    folder = tmp_path_factory.mktemp("planted")
    model = load_model(str(function_file), WHILL_CR).with_effects(("command_delay",))
    truth = set_parameters(model.params, list(PLANTED), jnp.array(list(PLANTED.values())))
    write_dataset(folder / "log", WHILL_CR, truth,
                  Schedule(replicates=2, scenario=Scenario(v=0.5, omega=0.8, length=3.0), seed=3,
                           manoeuvres=("straight", "s_curve", "figure_eight")),
                  plant=model.plant)
    fit_module.main(Arguments(dataset=folder / "log", out=folder / "run", model=str(function_file), iterations=12,
                              effects=("command_delay",)))
    return folder


def test_a_plain_function_is_fitted_from_the_command_line_with_an_effect_around_it(function_run):
    report = json.loads((function_run / "run" / "report.json").read_text())
    found = {one["name"]: one for one in report["parameters"]}
    assert found.keys() == PLANTED.keys() and report["model"] == {"preset": "function", "effects": ["command_delay"]}
    for name, truth in PLANTED.items():
        assert found[name]["value"] == pytest.approx(truth, rel=0.05), name
    one = report["summary"]["held_out"]["ground_truth"]["trajectory"]
    assert one["fitted"] < 0.03 * one["initial"]


def test_the_fitted_model_is_written_with_units_and_intervals(function_run):
    content = tomllib.loads((function_run / "run" / "model.toml").read_text())
    assert content["parameters"]["lag"]["unit"] == "s" and content["parameters"]["command_delay.delay"]["unit"] == "s"
    low, high = content["parameters"]["turn"]["interval"]
    assert low < content["parameters"]["turn"]["value"] < high
    assert not (function_run / "run" / "vehicle.toml").exists()


def drive_in_mujoco(path, values, manoeuvre, seed):
    """A trial driven by C MuJoCo itself, with parameters written into the file and noise of 2 mm and 2 mrad."""
    robot = load_robot(path)
    planted = write_mjcf(robot, {resolve(robot, name): value for name, value in values.items()},
                         path.with_name(f"planted_{manoeuvre}_{seed}.xml"))
    host = mujoco.MjModel.from_xml_path(str(planted))
    data = mujoco.MjData(host)
    for _ in range(100):
        mujoco.mj_step(host, data)
    table = command_table(manoeuvre, Scenario(v=0.6, omega=1.2, length=2.0))
    times = np.arange(0, table[-1, 0], host.opt.timestep)
    rows = []
    for k, t in enumerate(times):
        v, omega = table[np.searchsorted(table[:, 0], t + 1e-6, side="right") - 1, 1:]
        left, right = (data.qvel[6] * 0.1, -data.qvel[7] * 0.1)
        forward = data.xmat[1].reshape(3, 3)[:, 0]
        centre = (data.xpos[2] + data.xpos[3]) / 2
        if k % 5 == 0:
            rows.append([t, *centre[:2], np.arctan2(forward[1], forward[0]), (left + right) / 2, (right - left) / 0.4])
        data.ctrl[:] = (v - 0.2 * omega) / 0.1, -(v + 0.2 * omega) / 0.1
        mujoco.mj_step(host, data)
    random = np.random.default_rng(seed)
    rows = np.array(rows) + np.column_stack([np.zeros(len(rows)), random.normal(0, 2e-3, (len(rows), 5))])
    t, x, y, yaw, v, omega = rows.T
    yaw = np.unwrap(yaw)
    return make_trial(f"{manoeuvre}_{seed}", Command(*table.T), OdometryStream(t, None, None, None, v, omega),
                      PoseStream(t, x, y, yaw))


def test_a_robot_file_is_fitted_to_a_log_that_c_mujoco_drove(robot_file, unicycle_log):
    """Gain of both servos and friction of both tyres, which slip when turning, from two drives of 4 s."""
    planted = {"actuator.*_motor.gain": 0.25, "geom.*_tyre.friction": 0.12}
    trials = tuple(drive_in_mujoco(robot_file, planted, name, 1) for name in ("s_curve", "turn"))
    log = dataclasses.replace(unicycle_log, trials=trials)
    model = mjcf_model(robot_file, {"actuator.*_motor.gain": (0.05, 5.0), "geom.*_tyre.friction": (0.03, 1.5)})
    fit = fit_log(log, FitConfig(method="both", trials=48, starts=2, iterations=8), model=model)
    found = dict(zip(fit.space.names, fit.space.to_values(fit.u), strict=True))
    for name, truth in planted.items():
        assert found[name] == pytest.approx(truth, rel=0.1), found
    assert fit.cost < 0.05 * fit.initial_cost


@pytest.mark.quick
def test_a_fitted_robot_is_written_back_as_a_file_that_has_the_values(robot_file, tmp_path):
    paths = ["actuator.*_motor.gain", "body.base.mass", "joint.left.damping", "geom.caster.solref"]
    model = mjcf_model(robot_file, paths)
    fitted = set_parameters(model.params, ["body.base.mass", "actuator.*_motor.gain"], jnp.array([20.0, 0.5]))
    written = model.write(tmp_path, fitted)
    before, after = (mujoco.MjModel.from_xml_path(str(path)) for path in (robot_file, written))
    base = after.body("base")
    assert base.mass[0] == pytest.approx(20.0)
    same = before.body("base")
    np.testing.assert_allclose(base.inertia, same.inertia * 20.0 / same.mass[0], rtol=1e-5)
    np.testing.assert_allclose(after.actuator_gainprm[:, 0], 0.5)
    np.testing.assert_allclose(after.actuator_biasprm[:, 2], -0.5)
    np.testing.assert_allclose(after.dof_damping, before.dof_damping)
    np.testing.assert_allclose(after.geom_friction, before.geom_friction)


@pytest.mark.quick
def test_a_urdf_gets_floor_freedom_and_servos_and_stands_still_on_its_wheels(tmp_path):
    path = tmp_path / "cart.urdf"
    path.write_text(URDF)
    robot = load_robot(path)
    assert robot.track == pytest.approx(0.4) and robot.wheel_radius == pytest.approx(0.1) and not robot.motors
    np.testing.assert_allclose(robot.point, [-0.1, 0.0, 0.3], atol=1e-6)
    np.testing.assert_allclose(robot.forward, [1.0, 0.0, 0.0], atol=1e-6)
    assert abs(robot.rest[2]) < 0.01 and robot.rest[3] > 0.999 and robot.sign == (1.0, 1.0)
    assert set(mjcf_model(path).params.values) == {"actuator.*_wheel_joint.gain", "geom.*_wheel.friction"}


def driven_straight(robot, v, seconds=2.0):
    """Speed over the second half of a drive in C MuJoCo from rest, with a constant command."""
    host, data, way = robot.host, mujoco.MjData(robot.host), []
    data.qpos[:] = robot.rest
    data.ctrl[list(robot.actuators)] = np.array(robot.sign) * v / robot.wheel_radius
    for _ in range(2):
        for _ in range(round(seconds / 2 / host.opt.timestep)):
            mujoco.mj_step(host, data)
        way.append(data.qpos[robot.root : robot.root + 2].copy())
    return np.linalg.norm(way[1] - way[0]) / (seconds / 2)


@pytest.mark.quick
@pytest.mark.parametrize("timestep", [0.0005, 0.002])
@pytest.mark.parametrize("wheel", [1e-4, 1e-2, 1.0])
@pytest.mark.parametrize("vehicle", [0.05, 1.0, 10.0])
def test_added_servos_drive_light_and_heavy_robots_at_the_commanded_speed(tmp_path, vehicle, wheel, timestep):
    """Masses and inertias are times these numbers; the cart drags a ball of rubber."""
    text = URDF
    for old, name, scale in (("8", "mass value", vehicle), ("0.5", "mass value", vehicle * wheel),
                             *((old, axis, vehicle) for old in ("0.1", "0.2") for axis in ("ixx", "iyy", "izz")),
                             *(("0.002", axis, vehicle * wheel) for axis in ("ixx", "iyy", "izz"))):
        text = text.replace(f'{name}="{old}"', f'{name}="{float(old) * scale}"')
    path = tmp_path / "cart.urdf"
    path.write_text(text)
    assert driven_straight(load_robot(path, timestep=timestep), 0.6) == pytest.approx(0.6, rel=0.1)


@pytest.mark.quick
@pytest.mark.parametrize(("old", "new", "message"), [
    (('kv="1"', 'implicitfast', 'armature="0.01"'), ('kv="500"', 'Euler', ''), "explodes while it settles"),
    (('size="10 10 0.1"',), ('size="10 10 0.1" contype="0" conaffinity="0"',), "still moves at .* it falls")])
def test_a_model_that_does_not_come_to_rest_is_refused_with_the_reason(tmp_path, old, new, message):
    text = ROBOT
    for one, other in zip(old, new, strict=True):
        text = text.replace(one, other)
    path = tmp_path / "robot.xml"
    path.write_text(text)
    with pytest.raises(ValueError, match=f"robot.xml: .*{message}.*Check its contacts, the gains"):
        load_robot(path)


@pytest.mark.quick
def test_a_robot_is_placed_with_its_axle_at_the_start_and_wheels_that_turn_forwards(robot_file):
    plant, params = mjcf_model(robot_file).plant, mjcf_model(robot_file).params
    start = jnp.array([1.0, -2.0, 2.5, 0.5, 0.3])
    state = plant.place(params, start)
    np.testing.assert_allclose(plant.observe(state), [1.0, -2.0, 2.5, 0, 0, 0, 0.5, 0.3, 0], atol=1e-5)
    assert state.inner.qvel[6] == pytest.approx(4.4) and state.inner.qvel[7] == pytest.approx(-5.6)
    moved = plant.move(state, jnp.array([0.0, 1.0, -1.0, 0.5, 0.3]))
    np.testing.assert_allclose(plant.observe(moved)[:3], [0.0, 1.0, -1.0], atol=1e-5)
    np.testing.assert_allclose(plant.observe(moved)[6:8], [0.5, 0.3], atol=1e-5)
    forward = np.array([np.cos(-1.0), np.sin(-1.0)])
    sideways = 0.3 * 0.1 * np.array([-forward[1], forward[0]])  # the body's origin lies 0.1 m ahead of the axle
    np.testing.assert_allclose(moved.inner.qvel[:2], 0.5 * forward + sideways, atol=1e-5)


@pytest.mark.quick
@pytest.mark.parametrize(("parameters", "message"), [
    (["mass"], "not KIND.NAME.FIELD"), (["body.bse.mass"], "no body 'bse' .known: base, left_wheel"),
    (["body.base.weight"], "no field 'weight'"), (["joint.left.frictionloss"], "leaves dry friction out"),
    (["actuator.*_motor.force_limit"], "no limit in the file"), (["joint.left.stiffness"], "bounds cannot be guessed"),
    ({"body.base.mass": (5.0, 5.0)}, "bounds 5 to 5")])
def test_a_wrong_path_says_what_is_known(robot_file, parameters, message):
    with pytest.raises(ValueError, match=message):
        mjcf_model(robot_file, parameters)


@pytest.mark.quick
@pytest.mark.parametrize(("first", "second"), [
    ("cylinder", "box"), ("box", "cylinder"), ("ellipsoid", "box"), ("capsule", "cylinder"), ("box", "box")])
def test_contacts_that_mjx_lacks_between_parts_of_a_robot_are_left_out_with_a_note(tmp_path, first, second):
    """A caster on a swivel of its own, beside a bumper: two shapes that may meet."""
    path = tmp_path / "robot.xml"
    caster = ROBOT.index('<geom name="caster"')
    path.write_text(ROBOT[:caster] + f'''
      <body name="bumper" pos="-0.3 0 0.3"><joint axis="1 0 0"/>
        <geom name="rubber" type="{first}" size="0.02 0.02 0.02" mass="0.1"/></body>
      <body name="swivel" pos="0.3 0 0.3"><joint axis="0 0 1"/>
        <geom name="fork" type="{second}" size="0.02 0.02 0.02" mass="0.1"/></body>''' + ROBOT[caster:])
    robot = load_robot(path)
    lacking = {first, second} in ({"cylinder", "box"}, {"ellipsoid", "box"})
    between = [note for note in robot.notes if "rubber" in note and "fork" in note]
    assert len(between) == lacking
    assert all("bodies bumper and swivel are left out" in note for note in between)
    model = mjcf_model(path)  # MJX takes it
    written = mujoco.MjModel.from_xml_path(str(model.write(tmp_path, model.params)))
    assert model.notes == robot.notes and written.nexclude == len(robot.notes)


@pytest.mark.quick
def test_a_contact_with_the_room_that_mjx_lacks_is_one_line_with_both_geoms(tmp_path):
    path = tmp_path / "robot.xml"
    path.write_text(ROBOT.replace('<body name="base"', '<geom name="slab" type="cylinder" size="3 1" pos="0 0 -1"/>'
                                  '<body name="base"').replace('contype="0" conaffinity="0"', ''))
    with pytest.raises(ValueError, match=r"no contact between geom 'slab' .cylinder. and geom 'box' .box.. Replace"):
        load_robot(path)


@pytest.fixture(scope="module")
def cube(tmp_path_factory):
    """Bytes of a cube of 0.2 m in binary STL."""
    corners = np.array(np.meshgrid([-0.1, 0.1], [-0.1, 0.1], [-0.1, 0.1])).reshape(3, 8).T
    triangles = [corner for corner in itertools.combinations(range(8), 3)
                 if any(len(set(corners[list(corner), axis])) == 1 for axis in range(3))]
    rows = b"".join(struct.pack("<12fH", 0, 0, 0, *corners[list(one)].ravel(), 0) for one in triangles)
    return b" " * 80 + struct.pack("<I", len(triangles)) + rows


BODY = '<collision><origin xyz="0 0 0.45"/><geometry><mesh filename="{}"/></geometry></collision>'


@pytest.mark.quick
@pytest.mark.parametrize(("named", "lies"), [
    ("package://cart_description/meshes/body.stl", "cart_description/meshes/body.stl"),
    ("package://cart_description/meshes/body.stl", "cart_description/urdf/meshes/body.stl"),
    ("package://cart_description/body.stl", "cart_description/urdf/body.stl"),
    ("../meshes/body.stl", "cart_description/meshes/body.stl"), ("body.stl", "cart_description/urdf/body.stl"),
    ("package://other_package/meshes/body.dae", "other_package/meshes/body.stl"),
    ("file:///elsewhere/body.stl", "cart_description/meshes/deep/body.stl")])
def test_meshes_are_found_where_packages_usually_have_them(tmp_path, cube, named, lies):
    path, mesh = tmp_path / "cart_description" / "urdf" / "cart.urdf", tmp_path / lies
    path.parent.mkdir(parents=True)
    mesh.parent.mkdir(parents=True, exist_ok=True)
    mesh.write_bytes(cube)
    path.write_text(URDF.replace("</inertial>", "</inertial>" + BODY.format(named), 1))
    robot = load_robot(path)
    assert robot.host.nmesh == 1 and robot.notes == ()
    assert np.ptp(robot.host.mesh_vert, axis=0) == pytest.approx([0.2, 0.2, 0.2], abs=1e-5)


@pytest.mark.quick
def test_another_mesh_or_included_file_makes_another_run(tmp_path, cube):
    path, mesh = tmp_path / "cart.urdf", tmp_path / "body.stl"
    path.write_text(URDF.replace("</inertial>", "</inertial>" + BODY.format("body.stl"), 1))
    mesh.write_bytes(cube)
    (tmp_path / "part.xml").write_text(ROBOT)
    whole = tmp_path / "whole.xml"
    whole.write_text('<mujoco><include file="part.xml"/></mujoco>')
    before, one = parts_label(path), parts_label(whole)
    assert parts_label(path) == before and before.startswith("1 files")  # it is the same each time
    mesh.write_bytes(cube.replace(np.float32(0.1).tobytes(), np.float32(0.2).tobytes()))
    assert parts_label(path) != before
    (tmp_path / "part.xml").write_text(ROBOT.replace('mass="0.5"', 'mass="0.6"'))
    assert parts_label(whole) != one


@pytest.mark.quick
def test_a_run_of_a_robot_goes_on_while_its_files_are_the_same(tmp_path, cube):
    """Folders of earlier versions have the file's own checksum only; they go on too."""
    path, mesh = tmp_path / "cart.urdf", tmp_path / "body.stl"
    path.write_text(URDF.replace("</inertial>", "</inertial>" + BODY.format("body.stl"), 1))
    mesh.write_bytes(cube)

    def go_on(folder, identity=None):
        with run_folder(tmp_path / folder, "sysid.fit", (), identity or settings_of(FitConfig(model=str(path)))):
            (tmp_path / folder / "work").touch()

    earlier = settings_of(FitConfig(model=str(path)))
    assert earlier["model"] == f"cart.urdf {hashlib.sha256(path.read_bytes()).hexdigest()[:12]}"
    go_on("new")
    go_on("new")
    go_on("old", {name: value for name, value in earlier.items() if name != "model_parts"})
    go_on("old")
    mesh.write_bytes(cube.replace(np.float32(0.1).tobytes(), np.float32(0.2).tobytes()))
    with pytest.raises(FolderRefused, match="model_parts is 1 files"):
        go_on("new")
    path.write_text(path.read_text().replace("0.45", "0.46"))
    with pytest.raises(FolderRefused, match="model is cart.urdf"):
        go_on("old")


@pytest.mark.quick
@pytest.mark.parametrize("content", [None, b"solid body\n facet normal 0 0 1\n", b"", b"not a mesh"])
def test_a_mesh_that_is_missing_or_unreadable_becomes_a_box_of_its_links_inertia_with_a_note(tmp_path, content):
    path = tmp_path / "cart.urdf"
    text = URDF.replace("</inertial>", "</inertial>" + BODY.format("package://cart/body.stl"), 1)
    text = text.replace("<inertial>", '<inertial><origin xyz="0 0 0.35"/>', 1)  # where the box is, above the floor
    path.write_text(text.replace('<geometry><cylinder radius="0.1" length="0.04"/></geometry>',
                                 '<geometry><mesh filename="wheel.stl"/></geometry>'))
    for name in ("body", "wheel") if content is not None else ():
        (tmp_path / f"{name}.stl").write_bytes(content)
    robot = load_robot(path, wheel_radius=0.1)
    assert len(robot.notes) == 3 and "mesh package://cart/body.stl of link base is not found" in robot.notes[0]
    assert "a cylinder of 0.1 m radius stands in" in robot.notes[1]
    box = robot.host.geom_size[robot.host.geom_type == int(mujoco.mjtGeom.mjGEOM_BOX)]
    sides = 2 * box[0]
    np.testing.assert_allclose(8 / 12 * (np.sum(sides**2) - sides**2), [0.1, 0.1, 0.2], rtol=1e-4)
    assert driven_straight(robot, 0.6) == pytest.approx(0.6, rel=0.1)


@pytest.mark.quick
def test_a_mesh_that_an_mjcf_file_lacks_becomes_a_box(tmp_path, cube):
    path = tmp_path / "robot.xml"
    path.write_text(ROBOT.replace("<worldbody>", '<asset><mesh name="hull" file="hull.stl"/></asset><worldbody>', 1)
                    .replace('name="box" type="box" size="0.2 0.15 0.05"', 'name="box" type="mesh" mesh="hull"')
                    .replace('mass="8" contype="0" conaffinity="0"', 'mass="8" pos="0 0 0.2"'))
    note = load_robot(path).notes[0]
    assert "mesh hull.stl of body base is not found, or MuJoCo cannot read it; a box of 0.1 x" in note
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "hull.stl").write_bytes(cube)
    robot = load_robot(path)
    written = write_mjcf(robot, {}, tmp_path / "elsewhere.xml")
    assert robot.notes == () and mujoco.MjModel.from_xml_path(str(written)).nmesh == 1


@pytest.mark.quick
def test_a_xacro_file_is_expanded_with_packages_from_the_folders_around_it(tmp_path):
    pytest.importorskip("xacro")
    path = tmp_path / "cart_description" / "urdf" / "cart.urdf.xacro"
    path.parent.mkdir(parents=True)
    (path.parent / "sizes.xacro").write_text('<robot xmlns:xacro="http://www.ros.org/wiki/xacro">'
                                             '<xacro:property name="radius" value="0.1"/></robot>')
    head = ('<robot name="cart" xmlns:xacro="http://www.ros.org/wiki/xacro">'
            '<xacro:include filename="$(find cart_description)/urdf/sizes.xacro"/>')
    text = URDF.strip().replace('<robot name="cart">', head).replace('cylinder radius="0.1"',
                                                                     'cylinder radius="${radius}"')
    path.write_text(text)
    assert load_robot(path).wheel_radius == pytest.approx(0.1)
    assert [one.name for one in read_robot(path).parts] == ["sizes.xacro"]
    path.write_text(text.replace("find cart_description", "find nowhere"))
    with pytest.raises(ValueError, match="xacro cannot expand it: .*'radius'.*; package://nowhere/.* is not found"):
        load_robot(path)


@pytest.mark.quick
def test_without_xacro_the_error_has_the_command_that_installs_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "xacro", None)
    path = tmp_path / "cart.xacro"
    path.write_text(URDF.strip())
    with pytest.raises(ValueError, match="cart.xacro: xacro files need the package xacro.* pip install xacro"):
        load_robot(path)


@pytest.mark.quick
def test_a_robot_of_cylinders_is_not_stepped_where_results_are_shared(tmp_path, monkeypatch):
    """XLA would end the process."""
    path = tmp_path / "cart.xml"
    tyre = 'type="sphere" size="0.1" mass="0.5"'
    path.write_text(ROBOT.replace(tyre, 'type="cylinder" size="0.1 0.02" zaxis="0 1 0" mass="0.5"'))
    model = mjcf_model(path)
    monkeypatch.setenv("XLA_FLAGS", f"{FLAG}={OPTION}")
    with pytest.raises(ValueError, match="cart.xml: XLA aborts .* Leave this call out"):
        model.plant.substep(model.params, model.plant.place(model.params, jnp.zeros(5)), jnp.zeros(2))


VISUAL = '<geom type="sphere" size="0.14" contype="0" conaffinity="0" group="2" density="0"/>'


@pytest.mark.quick
@pytest.mark.parametrize(("old", "new"), [
    ('<geom name="{}_tyre"', VISUAL + '<geom name="{}_tyre"'),
    ('<geom name="{}_tyre"', '<geom name="{}_hub" type="cylinder" size="0.04 0.02" mass="0.1"/><geom name="{}_tyre"'),
    ('<geom name="{}_tyre"', '<geom name="{}_cap" type="box" size="0.12 0.01 0.12" contype="2" conaffinity="4" mass="0"'
                             '/><geom name="{}_tyre"'),
    ('<geom name="{}_tyre"', VISUAL + '<body name="{}_rim"><geom name="{}_tyre"')])
def test_friction_is_fitted_on_what_touches_the_ground(tmp_path, old, new):
    """A visual geom first, a hub, a cap that meets only other things, and a tyre on a body fixed to the wheel's."""
    text = ROBOT
    for side in ("left", "right"):
        text = text.replace(old.format(side), new.replace("{}", side))
        if "_rim" in new:
            head, tail = text.split(f'name="{side}_tyre"')
            text = f'{head}name="{side}_tyre"{tail.replace("</body>", "</body></body>", 1)}'
    path = tmp_path / "robot.xml"
    path.write_text(text)
    robot = load_robot(path)
    assert "geom.*_tyre.friction" in default_paths(robot) and robot.wheel_radius == pytest.approx(0.1)


@pytest.mark.quick
def test_wheels_that_cannot_be_told_are_asked_for(robot_file, tmp_path):
    path = tmp_path / "robot.xml"
    path.write_text(ROBOT.replace('name="left"', 'name="a"').replace('name="right"', 'name="b"')
                    .replace('joint="left"', 'joint="a"').replace('joint="right"', 'joint="b"')
                    .replace('pos="-0.1 0.2 0"', 'pos="0.3 0.01 0"').replace('pos="-0.1 -0.2 0"', 'pos="-0.1 -0.01 0"'))
    with pytest.raises(ValueError, match="robot.xml: the names do not show which wheels .*joints: a, b.*--wheels"):
        load_robot(path)
    assert load_robot(path, ("left_motor", "b")).wheels == (6, 7)
    with pytest.raises(ValueError, match="must be two hinge joints"):
        load_robot(path, ("a", "c"))
    path.write_text("<mujoco><worldbody><body></mujoco>")
    with pytest.raises(ValueError, match="robot.xml: MuJoCo cannot use it"):
        load_robot(path)


@pytest.mark.quick
def test_motors_get_a_speed_controller_of_their_own(tmp_path):
    path = tmp_path / "robot.xml"
    path.write_text(ROBOT.replace("<velocity", "<motor").replace(' kv="1"', ""))
    model = mjcf_model(path, ["body.base.mass"])
    assert set(model.params.values) == {"drive.kp", "body.base.mass"}
    assert model_space(model.params).log.all()
    wheel = 0.4 * 0.5 * 0.1**2 + 0.01
    assert dict(model.params.about)["drive.kp"].high == pytest.approx(wheel / 0.01)  # at most the speed in one step


@pytest.mark.quick
def test_replays_on_all_cores_come_back_in_their_order(monkeypatch):
    monkeypatch.setattr("os.sched_getaffinity", lambda _: range(3), raising=False)
    threads: dict[int, str] = {}

    def replay(part):
        threads[part] = threading.current_thread().name
        return 10 * part

    assert on_all_cores(replay, range(5)) == [0, 10, 20, 30, 40]
    assert threading.current_thread().name not in threads.values()
    assert on_all_cores(replay, range(1)) == [0]
    assert threads[0] == threading.current_thread().name


@pytest.mark.quick
def test_differences_give_the_derivatives_that_forward_mode_gives(objective):
    values = np.array([[0.2, 0.2, 1.0], [0.02, 0.5, 1.5]])  # the second one has parameters on their bounds
    exact = objective.replay.jacobian(values)
    differences = DifferenceReplay(objective.replay, objective.space).jacobian(values)
    np.testing.assert_allclose(differences[0].pose, exact[0].pose, atol=1e-5)
    known = objective.measured.pose_mask[None, ..., None] > 0
    for p in range(3):
        one, other = ((slope.pose * known)[..., p] for slope in (exact[1], differences[1]))
        assert np.linalg.norm(one - other) < 0.05 * np.linalg.norm(one)


@pytest.mark.quick
@pytest.mark.parametrize(("text", "error", "message"), [
    ("nowhere.xml", FileNotFoundError, "nowhere.xml: no such model"), ("cart.py:cart", ValueError, "defines no 'cart'"),
    ("cart.py:step", ValueError, "missing|Model"), ("cart.txt", ValueError, "a model is .xml")])
def test_a_model_that_is_not_there_ends_with_an_error(function_file, text, error, message):
    (function_file.parent / "cart.txt").write_text("")
    with pytest.raises((error, TypeError), match=message):
        load_model(str(function_file.parent / text), WHILL_CR)


OWN = """
import jax.numpy as jnp
from gains import GAIN
from sysid.replay.models import function_model

def other(spec):
    from parts.more import LOW
    return function_model(lambda p, state, command: p["gain"] * state, {"gain": (GAIN, LOW, 2.0)}, dt=0.01)

model = function_model(lambda p, state, command: p["gain"] * state, {"gain": (GAIN, 0.5, 2.0)}, dt=0.01)
"""


def own_model(folder, gain):
    """A Python file that imports others beside it."""
    (folder / "parts").mkdir(parents=True, exist_ok=True)
    (folder / "gains.py").write_text(f"GAIN = {gain}\n")
    (folder / "parts" / "__init__.py").write_text("")
    (folder / "parts" / "more.py").write_text("LOW = 0.25\n")
    (folder / "own.py").write_text(OWN)
    return folder / "own.py"


@pytest.mark.quick
def test_modules_beside_a_model_file_are_found_each_by_its_own_model(tmp_path):
    paths = list(sys.path)
    for folder, gain in (("a", 1.0), ("b", 1.125), ("a", 1.0)):
        file = own_model(tmp_path / folder, gain)
        assert load_model(str(file), WHILL_CR).params.values["gain"] == gain
        found = load_model(f"{file}:other", WHILL_CR)
        assert dict(found.params.about)["gain"].low == 0.25
        beside = [file.parent / "gains.py", *(file.parent / "parts" / name for name in ("__init__.py", "more.py"))]
        assert sorted(found.files) == sorted(one.resolve() for one in beside)
    assert sys.path == paths


@pytest.mark.quick
def test_another_module_beside_a_model_file_makes_another_run(tmp_path):
    file = own_model(tmp_path, 1.0)

    def go_on():
        config = FitConfig(model=str(file))
        with run_folder(tmp_path / "run", "sysid.fit", (), settings_of(config, model=load_model(str(file), WHILL_CR))):
            (tmp_path / "run" / "work").touch()

    go_on()
    go_on()
    own_model(tmp_path, 1.125)
    with pytest.raises(FolderRefused, match="model_parts is 1 files"):
        go_on()


@pytest.mark.quick
def test_another_robot_file_of_a_model_file_makes_another_run(tmp_path):
    robot, file = tmp_path / "robot.xml", tmp_path / "own.py"
    wheels = ("left", "right_motor")
    file.write_text(f"from sysid import mjcf_model\nmodel = mjcf_model({str(robot)!r}, wheels={wheels})\n")
    labels = []
    for mass in ("0.5", "0.6"):
        robot.write_text(ROBOT.replace('mass="0.5"', f'mass="{mass}"'))
        model = load_model(str(file), WHILL_CR)
        labels.append(settings_of(FitConfig(model=str(file)), model=model)["model_parts"])
    assert labels[0].startswith("1 files") and labels[0] != labels[1]


@pytest.mark.quick
def test_a_model_file_may_hold_dataclasses(tmp_path):
    """With annotations that are text, dataclasses look up the module that they are in."""
    file = tmp_path / "own.py"
    file.write_text("""
from __future__ import annotations
from dataclasses import dataclass
import jax.numpy as jnp
from sysid.replay.models import function_model

@dataclass(frozen=True)
class Settings:
    gain: float = 1.0

model = function_model(lambda p, state, command: p["gain"] * state, {"gain": (Settings().gain, 0.5, 2.0)}, dt=0.01)
""")
    assert load_model(str(file), WHILL_CR).params.values["gain"] == 1.0


def test_effects_that_act_inside_a_vehicle_are_refused_around_a_model(function_file):
    model = load_model(str(function_file), WHILL_CR)
    with pytest.raises(ValueError, match="'yaw_scrub' acts inside a vehicle"):
        model.with_effects(("yaw_scrub",))
    assert "odometry_lag.time_constant" in model_space(model.with_effects(("odometry_lag",)).params).names


@pytest.mark.quick
def test_a_step_that_returns_something_else_is_refused():
    with pytest.raises(ValueError, match=r"step returns \(2,\) for a state of \(5,\)"):
        function_model(lambda p, state, command: command, {"a": (1.0, 0.0, 2.0)}, dt=0.02)
    with pytest.raises(ValueError, match="parameter 'a': initial value 3"):
        make_parameters({"a": (3.0, 0.0, 2.0)})


@pytest.mark.quick
def test_a_robot_of_the_command_line_has_the_logs_geometry_and_the_paths_that_were_named(robot_file):
    model = load_model(str(robot_file), WHILL_CR, ("left", "right_motor"),
                       ("body.base.mass", "geom.*_tyre.friction", "command_delay.delay"))
    assert list(model.params.values) == ["body.base.mass", "geom.*_tyre.friction"]
    delayed = model.with_effects(("command_delay",))
    space = model_space(delayed.params, ("body.base.mass", "command_delay.delay"))
    assert space.high[0] == pytest.approx(5 * 8.1) and space.fixed == (("geom.*_tyre.friction", "not selected"),)
    state = model.plant.place(model.params, jnp.array([0.0, 0.0, 0.0, WHILL_CR.wheel_radius, 0.0]))
    np.testing.assert_allclose(state.inner.qvel[6:8], [1.0, -1.0], rtol=1e-5)  # rad/s of a wheel of the log's radius

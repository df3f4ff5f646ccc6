"""Robot files: the track is that of the tyres, sides are those on which wheels stand, and servos turn behind gears."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from test_robots import BALL, CYLINDER, joint, link, robot_file, wheel

from sysid.replay.mjcf import Stepped, mjcf_model
from sysid.replay.robot_check import check_robot, describe_robot
from sysid.replay.robot_drive import RobotDrive
from sysid.replay.robot_files import read_robot
from sysid.replay.robot_loading import load_robot
from sysid.replay.robot_servos import is_stable
from whill_mjx.vehicle.model import ASSET
from whill_mjx.vehicle.parameters import get_values
from whill_mjx.vehicle.specs import SPECS, in_proportion

pytestmark = pytest.mark.quick
BOX = '<box size="0.14 0.14 0.02"/>'
CASTER = link("ball", BALL) + joint("caster", "ball", "-0.2 0 -0.05")


def outside(name, y, out, shape=CYLINDER):
    """A wheel whose shape is `out` m to the left of its joint."""
    return (link(f"{name}_link", shape, turn="1.5707963 0 0", origin=f"0 {out} 0")
            + joint(name, f"{name}_link", f"0 {y} 0", "continuous"))


@pytest.mark.parametrize("shape", [CYLINDER, BOX], ids=["cylinder", "box"])
@pytest.mark.parametrize(("left", "right"), [((0.08, 0.02), (-0.08, -0.02)), ((0.08, 0.05), (-0.07, 0.0))])
def test_the_track_is_that_of_the_tyres_wherever_their_joints_are(tmp_path, shape, left, right):
    path = robot_file(tmp_path, outside("left_wheel", *left, shape), outside("right_wheel", *right, shape), CASTER)
    robot, places = load_robot(path), (sum(left), sum(right))
    assert robot.distance == robot.track == pytest.approx(places[0] - places[1])
    assert robot.point == pytest.approx([0.0, sum(places) / 2, 0.0], abs=1e-6)
    check = check_robot(robot)
    assert check.drives_straight and check.rate == pytest.approx(check.command[1], rel=0.01)
    assert f"track {places[0] - places[1]:.4g} m" in describe_robot(robot, check)[1]


def test_the_outermost_ring_of_a_wheel_is_its_tyre(tmp_path):
    """A hub reaches far inwards, and two tyres share a wheel."""
    hub = '<collision><origin xyz="0 {} 0" rpy="1.5707963 0 0"/><geometry><cylinder radius="0.03" length="0.3"/>'
    wheels = [outside(f"{name}_wheel", sign * 0.2, 0.0).replace(
        "<collision>", hub.format(-sign * 0.1) + "</geometry></collision><collision>", 1)
        for name, sign in (("left", 1), ("right", -1))]
    assert load_robot(robot_file(tmp_path, *wheels, CASTER)).distance == pytest.approx(0.4)
    second = '<collision><origin xyz="0 {} 0" rpy="1.5707963 0 0"/><geometry>' + CYLINDER
    twins = [outside(f"{name}_wheel", sign * 0.2, 0.0).replace(
        "<collision>", second.format(sign * 0.06) + "</geometry></collision><collision>", 1)
        for name, sign in (("left", 1), ("right", -1))]
    assert load_robot(robot_file(tmp_path, *twins, CASTER)).distance == pytest.approx(0.46)


def test_the_fitted_sizes_and_the_vehicle_begin_at_the_track_of_the_tyres(tmp_path):
    path = robot_file(tmp_path, outside("left_wheel", 0.08, 0.02), outside("right_wheel", -0.08, -0.02), CASTER)
    spec = in_proportion(SPECS["create"], "robot", 0.1, 0.2, mass=22.0)
    model = mjcf_model(path, calibrate=True, wheel_radius=0.1, track=0.2)
    assert float(model.params.values["wheels.track"]) == pytest.approx(0.2)
    vehicle = model.vehicle(model.params, spec)
    assert float(get_values(vehicle.params, ["track_width.error"])[0]) == pytest.approx(0.0, abs=1e-6)


def test_named_wheels_are_left_and_right_where_they_stand(tmp_path):
    path = robot_file(tmp_path, wheel("left_wheel", 0, 0.2), wheel("right_wheel", 0, -0.2), CASTER)
    robot = load_robot(path, ("right_wheel", "left_wheel"))
    assert robot.forward == pytest.approx([1.0, 0.0, 0.0]) and robot.wheels == load_robot(path).wheels
    assert any("right_wheel first, but left_wheel is on the left" in note for note in robot.notes)
    assert load_robot(path, ("left_wheel", "right_wheel")).notes == ()
    plain = robot_file(tmp_path, wheel("a", 0, 0.2), wheel("b", 0, -0.2), CASTER)
    assert load_robot(plain, ("b", "a")).forward == pytest.approx([1.0, 0.0, 0.0])


def test_wheels_at_one_place_are_refused(tmp_path):
    path = robot_file(tmp_path, wheel("left_wheel", 0, 0.0), wheel("right_wheel", 0, 0.0), CASTER)
    with pytest.raises(ValueError, match=f"{path}: the distance between left_wheel and right_wheel is 0.0; it must be "
                                         "positive, from 0.001 to 10 m. Correct the places of these joints"):
        load_robot(path)


@pytest.mark.parametrize(("old", "new", "said"), [
    ("<inertial><mass", '<inertial><origin xyz="nan 0 0.03"/><mass', "xyz of origin of link 'base' is 'nan 0 0.03'"),
    ('<mass value="20.0"', '<mass value="inf"', "value of mass of link 'base' is 'inf'"),
    ('<mass value="20.0"', '<mass value="20 kg"', "value of mass of link 'base' is '20 kg'"),
    ('ixx="0.5"', 'ixx="nan"', "ixx of inertia of link 'base' is 'nan'"),
    ('axis xyz="0 1 0"', 'axis xyz="0 nan 0"', "xyz of axis of joint 'left_wheel' is '0 nan 0'"),
    ('size="0.6 0.3 0.1"', 'size="1e999 0.3 0.1"', "size of box of link 'base' is '1e999 0.3 0.1'"),
])  # fmt: skip
def test_numbers_of_a_urdf_that_are_not_finite_are_refused(tmp_path, old, new, said):
    path = robot_file(tmp_path, wheel("left_wheel", 0, 0.2), wheel("right_wheel", 0, -0.2), CASTER)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(ValueError, match=f"{path}: {said}; it must be made of finite numbers. Correct it."):
        load_robot(path)


CART = """<mujoco><option integrator="implicitfast"/><worldbody><geom type="plane" size="5 5 0.1"/>
  <body name="base" pos="0 0 0.1"><freejoint/><inertial pos="-0.08 0 0.02" mass="5" diaginertia="0.1 0.1 0.1"/>
    <geom name="ball" type="sphere" size="0.05" pos="-0.2 0 -0.05" friction="0.01" priority="1"/>
    <body name="left_wheel" pos="0 0.2 0"><joint name="left" axis="0 1 0"/><geom type="sphere" size="0.1" mass="0.5"/>
    </body><body name="right_wheel" pos="0 -0.2 0"><joint name="right" axis="0 1 0"/>
      <geom type="sphere" size="0.1" mass="0.5"/></body></body></worldbody><actuator>ACTS</actuator></mujoco>"""


def cart_file(folder, acts):
    """A cart whose wheels are turned by actuators of this form."""
    path = folder / "cart.xml"
    path.write_text(CART.replace("ACTS", "".join(acts.format(side) for side in ("left", "right"))))
    return path


SERVOS = [
    '<velocity joint="{}" kv="0.5" gear="-1"/>', '<velocity joint="{}" kv="0.1" gear="10"/>',
    '<general joint="{}" gainprm="5" biastype="affine" biasprm="0 0 -1"/>',
    '<general joint="{}" gear="-4" gainprm="-5" biastype="affine" biasprm="0 0 -0.3"/>',
]
MOTORS = ['<motor joint="{}" gear="-1"/>', '<motor joint="{}" gear="20" ctrlrange="-3 3"/>',
          '<general joint="{}" gear="-2" gainprm="-5"/>']


@pytest.mark.parametrize("acts", [*SERVOS, *MOTORS])
def test_wheels_turn_as_commanded_behind_any_gear(tmp_path, acts):
    robot = load_robot(cart_file(tmp_path, acts))
    check = check_robot(robot)
    assert not robot.added and robot.motors == (acts in MOTORS)
    assert check.speed == pytest.approx(check.command[0], rel=0.03)
    assert check.rate == pytest.approx(check.command[1], rel=0.03)


@pytest.mark.parametrize("acts", [*SERVOS, *MOTORS])
def test_mjx_and_c_mujoco_pull_the_wheels_alike(tmp_path, acts, monkeypatch):
    robot, kp, command = load_robot(cart_file(tmp_path, acts)), 0.4, np.array([0.3, 0.5])
    stepped, seen = Stepped(robot, {}), []
    monkeypatch.setattr(stepped, "mjx", SimpleNamespace(step=lambda model, data: (seen.append(data.ctrl), data)[1]))
    params = SimpleNamespace(values={"drive.kp": kp})
    state = stepped.place(params, np.array([0.0, 0.0, 0.0, 0.1, -0.2]))
    stepped.substep(params, state, command)
    drive = RobotDrive(robot, {})

    def torques(model, ctrl):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:], data.ctrl[:] = state.qpos, state.qvel, ctrl
        mujoco.mj_forward(model, data)
        return data.qfrc_actuator[list(robot.wheels)]

    pulled = torques(robot.host, np.asarray(seen[0]))
    assert pulled == pytest.approx(torques(drive.model(0, {"drive.kp": kp}), drive.controls(command)), rel=1e-4)
    lag = (command[0] + np.array([-1, 1]) * command[1] * robot.track / 2) / 0.1 - np.asarray(state.qvel)[-2:]
    assert (np.sign(pulled) == np.sign(lag)).all()


def test_a_servo_is_as_stiff_as_its_gear_squared_makes_it(tmp_path):
    host = load_robot(cart_file(tmp_path, '<velocity joint="{}" kv="0.1" gear="10"/>')).host
    stiffness = 0.1 * 10**2 * host.opt.timestep
    inertias = [[(share * stiffness, 1.0)] * 2 for share in (0.9, 1.1)]
    assert [is_stable(host, ("left", "right"), one) for one in inertias] == [False, True]


def test_a_fitted_gain_scales_a_servo_whose_command_is_no_speed(tmp_path):
    path = cart_file(tmp_path, SERVOS[2])
    path.write_text(path.read_text().replace("<general ", '<general name="left_servo" ', 1))
    model = mjcf_model(path, {"actuator.left_servo.gain": (1.0, 50.0)})
    written = mujoco.MjModel.from_xml_path(str(model.write(tmp_path, replace(model.params, values={
        "actuator.left_servo.gain": np.array(10.0)}))))
    assert written.actuator("left_servo").gainprm[0] == 10.0 and written.actuator("left_servo").biasprm[2] == -2.0


def test_a_robot_that_drives_backwards_is_named(tmp_path):
    robot = load_robot(cart_file(tmp_path, SERVOS[1]))
    check = check_robot(robot)
    lines = describe_robot(robot, replace(check, speed=-check.speed))
    assert any("it drives backwards" in line for line in lines)
    assert not any("it drives backwards" in line for line in describe_robot(robot, check))


def test_a_robot_that_explodes_in_a_trial_drive_is_named(tmp_path):
    robot = load_robot(cart_file(tmp_path, SERVOS[1]))
    check = check_robot(robot)
    assert not check.explodes
    robot.host.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
    robot.host.actuator_gainprm[:, 0], robot.host.actuator_biasprm[:, 2] = 1e6, -1e6
    lost = check_robot(robot)
    assert lost.explodes and not lost.drives_straight
    assert any("it explodes in a trial drive" in line for line in describe_robot(robot, lost))


def test_the_floor_that_is_added_lies_under_the_wheels_wherever_their_bodies_begin(tmp_path):
    """As CAD programs write it: all bodies begin at one point, and joints and shapes are where they are."""
    path = cart_file(tmp_path, SERVOS[1])
    plain = path.read_text().replace('<geom type="plane" size="5 5 0.1"/>', "")
    path.write_text(plain)
    usual = load_robot(path)
    shifted = plain.replace('pos="-0.08 0 0.02"', 'pos="-0.08 0 -0.28"').replace('pos="-0.2 0 -0.05"',
                                                                                 'pos="-0.2 0 -0.35"')
    for side, y in (("left", 0.2), ("right", -0.2)):
        shifted = shifted.replace(f'pos="0 {y} 0"><joint name="{side}"', f'><joint name="{side}" pos="0 {y} -0.3"')
    path.write_text(shifted.replace('<geom type="sphere" size="0.1"', '<geom type="sphere" size="0.1" pos="0 Y -0.3"')
                    .replace("Y", "0.2", 1).replace("Y", "-0.2", 1).replace('pos="0 0 0.1"', 'pos="0 0 0.4"'))
    robot = load_robot(path)
    assert robot.distance == pytest.approx(usual.distance)
    check = check_robot(robot)
    assert check.speed == pytest.approx(check_robot(usual).speed, rel=1e-3)
    assert robot.rest[2] - usual.rest[2] == pytest.approx(0.3, abs=1e-3)


def test_flags_of_an_mjcf_have_the_names_of_numbers_and_are_none():
    read_robot(ASSET)  # it has frictionloss="disable"

"""Robot files of strangers: wheels are found, what a URDF leaves out is made up for, and robots drive straight on."""

from __future__ import annotations

import itertools
import json
import re
import subprocess
import sys

import numpy as np
import pytest

from sysid import inspect as inspect_module
from sysid.design import load_subject
from sysid.logs.sources import about
from sysid.replay import xacro_text
from sysid.replay.mjcf import mjcf_model
from sysid.replay.robot_check import check_robot, describe_robot
from sysid.replay.robot_files import expand_xacro
from sysid.replay.robot_loading import load_robot
from sysid.replay.robot_parameters import default_paths
from whill_mjx.io.folders import FolderRefused
from whill_mjx.vehicle.vehicle_file import load_vehicle

pytestmark = pytest.mark.quick
CYLINDER = '<cylinder radius="0.1" length="0.05"/>'
BALL = '<sphere radius="0.05"/>'


def link(name, shape="", mass=1.0, inertia=0.003, origin="0 0 0", turn="0 0 0"):
    body = f'<collision><origin xyz="{origin}" rpy="{turn}"/><geometry>{shape}</geometry></collision>' if shape else ""
    numbers = f'ixx="{inertia}" iyy="{inertia}" izz="{inertia}" ixy="0" ixz="0" iyz="0"'
    return f'<link name="{name}"><inertial><mass value="{mass}"/><inertia {numbers}/></inertial>{body}</link>'


def joint(name, child, place, kind="fixed", axis="0 1 0", parent="base", more=""):
    return (f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="{place}"/><axis xyz="{axis}"/>{more}</joint>')


def wheel(name, x, y, shape=CYLINDER, axis="0 1 0", parent="base", more=""):
    return (link(f"{name}_link", shape, turn="1.5707963 0 0")
            + joint(name, f"{name}_link", f"{x} {y} 0", "continuous", axis, parent, more))


def robot_file(folder, *parts, base=""):
    path = folder / "robot.urdf"
    box = base or link("base", '<box size="0.6 0.3 0.1"/>', 20.0, 0.5, origin="0 0 0.1")
    path.write_text(f'<robot name="r">{box}{"".join(parts)}</robot>')
    return path


def drives(robot):
    check = check_robot(robot)
    return check.drives_straight, check


NAMES = {
    "front and rear": ["front_left_wheel", "front_right_wheel", "rear_left_wheel", "rear_right_wheel"],
    "letters": ["fl_wheel_joint", "fr_wheel_joint", "rl_wheel_joint", "rr_wheel_joint"],
    "back": ["wheel_back_left", "wheel_back_right", "wheel_front_left", "wheel_front_right"],
    "numbers": ["wheel_1", "wheel_2", "wheel_3", "wheel_4"],
}


def test_driven_wheels_are_told_from_casters_with_sides_in_their_names(tmp_path):
    """Wheel frames that are turned about x, on a chassis without a free joint of its own."""
    def turned(name, y):
        frame = joint(name, f"{name}_link", f'0 {y} 0" rpy="-1.5707963 0 0', "continuous", "0 0 1")
        return link(f"{name}_link", CYLINDER) + frame

    def caster(name, x, y):
        return (link(f"{name}_1_link")
                + joint(f"{name}_1_joint", f"{name}_1_link", f"{x} {y} -0.05", "continuous", "0 0 1")
                + link(f"{name}_2_link", BALL)
                + joint(f"{name}_2_joint", f"{name}_2_link", "-0.02 0 0", "continuous", "0 1 0", f"{name}_1_link"))

    robot = load_robot(robot_file(tmp_path, turned("wheel_right_joint", -0.2), turned("wheel_left_joint", 0.2),
                                  caster("caster_front_left", 0.2, 0.1), caster("caster_front_right", 0.2, -0.1)))
    assert [robot.host.actuator(one).name for one in robot.actuators] == ["wheel_left_joint", "wheel_right_joint"]


def test_a_block_on_a_swivel_slides_as_a_ball_does(tmp_path):
    swivel = (link("fork", '<box size="0.04 0.02 0.02"/>', 0.2, 1e-3, origin="-0.02 0 -0.04")
              + joint("swivel", "fork", "-0.25 0 -0.05", "continuous", "0 0 1"))
    robot = load_robot(robot_file(tmp_path, wheel("left_wheel", 0, 0.2), wheel("right_wheel", 0, -0.2), swivel))
    assert robot.host.geom("fork").friction[0] == pytest.approx(0.05)
    assert robot.sliding == ()  # it swings round: no vehicle of the simulator has such a support
    check = check_robot(robot)
    assert check.drives_straight and check.speed > 0.98 * check.command[0]


def test_where_a_vehicle_file_is_needed_a_robot_file_is_told_what_to_do_first(tmp_path):
    path = robot_file(tmp_path)
    with pytest.raises(ValueError, match=f"a robot file; needed here is a vehicle file.*--model {path}"):
        load_vehicle(path)
    assert about(path).startswith("a robot file. Look at it with python -m sysid.inspect")
    (tmp_path / "fit").mkdir()
    (tmp_path / "fit/model.toml").touch()
    with pytest.raises(ValueError, match="the fit of a model of your own"):
        load_subject(str(tmp_path / "fit"))


@pytest.mark.parametrize("names", NAMES.values(), ids=NAMES)
def test_four_wheels_are_found_by_usual_names_and_make_a_skid_steered_robot(tmp_path, names):
    ahead = ("front_", "wheel_front", "fl_", "fr_", "wheel_1", "wheel_2")
    left_ones = ("front_left", "rear_left", "wheel_front_left", "wheel_back_left", "fl_", "rl_", "wheel_1", "wheel_3")
    places = [(0.25 if name.startswith(ahead) else -0.25, 0.25 if name.startswith(left_ones) else -0.25)
              for name in names]
    robot = load_robot(robot_file(tmp_path, *(wheel(name, *place) for name, place in zip(names, places, strict=True))))
    assert len(robot.wheels) == 4 and robot.track == pytest.approx(0.5)
    left = {names[i] for i in range(4) if places[i][1] > 0}
    found = [robot.host.actuator(one).name for one in robot.actuators]
    assert set(found[:2]) == left and places[names.index(found[0])][0] > 0  # from front to rear
    straight, check = drives(robot)
    assert straight and check.rate > 0
    assert "skid-steered, 4 driven wheels" in describe_robot(robot, check)[0]


def test_six_wheels_share_their_parameters_and_the_track_is_not_fitted(tmp_path):
    parts = [wheel(f"{a}_{b}_wheel", x, y) for a, x in (("front", 0.3), ("middle", 0.0), ("rear", -0.3))
             for b, y in (("left", 0.25), ("right", -0.25))]
    path = robot_file(tmp_path, *parts)
    robot = load_robot(path)
    assert len(robot.wheels) == 6 and len(default_paths(robot)) == 2 and drives(robot)[0]
    names = set(mjcf_model(path, calibrate=True).params.values)
    assert "wheels.radius" in names and "wheels.track" not in names
    assert load_robot(path, ("front_left_wheel", "rear_right_wheel", "front_right_wheel", "rear_left_wheel")).sign
    with pytest.raises(ValueError, match="do not stand in pairs"):
        load_robot(path, ("front_left_wheel", "rear_left_wheel", "middle_left_wheel", "rear_right_wheel"))


def test_axles_that_point_opposite_ways_drive_forwards_together(tmp_path):
    parts = [wheel("front_left_wheel", 0.25, 0.25, axis="0 -1 0"), wheel("front_right_wheel", 0.25, -0.25),
             wheel("rear_left_wheel", -0.25, 0.25), wheel("rear_right_wheel", -0.25, -0.25, axis="0 -1 0")]
    robot = load_robot(robot_file(tmp_path, *parts))
    assert robot.sign == (-1.0, 1.0, 1.0, -1.0) and drives(robot)[0]


TWO = (wheel("left_wheel_joint", 0.0, 0.25), wheel("right_wheel_joint", 0.0, -0.25))


def test_swivelling_casters_are_not_driven(tmp_path):
    parts = [*TWO]
    for name, y in (("left_caster", 0.15), ("right_caster", -0.15)):
        parts += [link(f"{name}_fork", mass=0.3),
                  joint(f"{name}_swivel", f"{name}_fork", f"-0.25 {y} 0", "continuous", "0 0 1"),
                  link(f"{name}_wheel_link", BALL, 0.3),
                  joint(f"{name}_wheel", f"{name}_wheel_link", "-0.03 0 -0.05", "continuous", parent=f"{name}_fork")]
    robot = load_robot(robot_file(tmp_path, *parts))
    assert [robot.host.actuator(one).name for one in robot.actuators] == ["left_wheel_joint", "right_wheel_joint"]
    assert drives(robot)[0] and not robot.sliding


def test_balls_before_and_behind_the_axle_leave_the_weight_to_the_wheels(tmp_path):
    balls = [link(name, BALL, 0.1) + joint(f"{name}_joint", name, f"{x} 0 -0.05")
             for name, x in (("a", 0.2), ("b", -0.2))]
    robot = load_robot(robot_file(tmp_path, *TWO, *balls))
    straight, check = drives(robot)
    assert straight and sum(share for name, share in check.loads.items() if "wheel" in name) > 0.5
    assert any("a, b are raised by up to 2 mm" in note for note in robot.notes)


def test_a_support_that_hangs_just_above_the_floor_slides_too(tmp_path):
    """A robot that leans forward comes down on it when it speeds up."""
    balls = [link(name, BALL, mass) + joint(f"{name}_joint", name, f"{x} 0 {z}")
             for name, mass, x, z in (("front", 2.0, 0.2, -0.05), ("rear", 0.1, -0.2, -0.047))]
    robot = load_robot(robot_file(tmp_path, *TWO, *balls))
    assert robot.host.geom("rear").friction[0] == pytest.approx(0.05)
    assert any("front, rear are raised" in note for note in robot.notes) and drives(robot)[0]


def test_a_ball_slides_with_the_friction_that_is_stated_for_gazebo(tmp_path):
    ball = link("ball", BALL, 0.1) + joint("ball_joint", "ball", "-0.2 0 -0.05")
    for stated, friction in (("", 0.05), ("<mu1>0.2</mu1>", 0.2), ("<mu1>0</mu1>", 0.05), ('<mu1 value="0.3"/>', 0.3)):
        more = f'<gazebo reference="ball">{stated}</gazebo>' if stated else ""
        path = robot_file(tmp_path, *TWO, ball, more)
        robot = load_robot(path)
        assert robot.host.geom("ball").friction[0] == pytest.approx(friction)
        assert "geom.ball.friction" in mjcf_model(path, calibrate=True).params.values


def test_wheels_on_springs_that_the_file_lacks_are_held_with_a_note(tmp_path):
    parts = []
    for name, y in (("left", 0.25), ("right", -0.25)):
        drop = '<limit lower="0" upper="0.03" effort="0" velocity="0"/>'
        parts += [link(f"{name}_drop"),
                  joint(f"{name}_drop_joint", f"{name}_drop", f"0 {y} 0", "prismatic", "0 0 1", more=drop),
                  wheel(f"{name}_wheel", 0, 0, parent=f"{name}_drop")]
    ball = link("ball", BALL, 0.1) + joint("ball_joint", "ball", "-0.2 0 -0.05")
    robot = load_robot(robot_file(tmp_path, *parts, ball))
    assert drives(robot)[0]
    assert sum("is held at 0: the file has no motor or spring" in note for note in robot.notes) == 2


def test_a_bearing_that_no_added_servo_could_turn_is_left_out_with_a_note(tmp_path):
    stiff = '<dynamics damping="0" friction="100"/>'
    parts = [wheel("left_wheel", 0, 0.25, more=stiff), wheel("right_wheel", 0, -0.25, more=stiff)]
    ball = link("ball", BALL, 0.1) + joint("ball_joint", "ball", "-0.2 0 -0.05")
    robot = load_robot(robot_file(tmp_path, *parts, ball))
    assert drives(robot)[0]
    assert sum("friction and damping of joint" in note for note in robot.notes) == 2


def test_a_box_that_reaches_below_the_wheels_does_not_carry_the_robot(tmp_path):
    base = link("base", '<mesh filename="package://gone/body.stl"/>', 20.0, 0.8)  # a cube of 0.7 m stands in
    ball = link("ball", BALL, 0.1) + joint("ball_joint", "ball", "-0.2 0 -0.05")
    robot = load_robot(robot_file(tmp_path, *TWO, ball, base=base))
    assert drives(robot)[0]
    assert any("below the driven wheels: its contacts are left out" in note for note in robot.notes)


def test_parts_of_a_urdf_do_not_touch_each_other(tmp_path):
    arm = link("arm", '<box size="0.6 0.6 0.1"/>', 0.5) + joint("arm_joint", "arm", "0 0 0.15", "continuous", "0 0 1")
    ball = link("ball", BALL, 0.1) + joint("ball_joint", "ball", "-0.2 0 -0.05")
    robot = load_robot(robot_file(tmp_path, *TWO, ball, arm))
    straight, check = drives(robot)
    assert straight and set(check.loads) <= {"left_wheel_joint_link", "right_wheel_joint_link", "ball"}


def test_wheels_that_are_capsules_roll(tmp_path):
    path = tmp_path / "robot.xml"
    sides = "".join(
        f'<body name="{side}" pos="0 {y} 0.1"><joint name="{side}_wheel" axis="0 1 0"/><geom type="capsule" '
        f'size="0.1 0.01" zaxis="0 1 0" mass="1"/></body>' for side, y in (("left", 0.25), ("right", -0.25)))
    path.write_text('<mujoco><worldbody><body name="base"><freejoint/><geom type="box" size="0.3 0.15 0.03" '
                    'pos="0 0 0.15" mass="10"/><geom name="ball" type="sphere" size="0.05" pos="-0.2 0 0.05" '
                    f'friction="0.05" mass="0.1"/>{sides}</body></worldbody></mujoco>')
    robot = load_robot(path)
    assert drives(robot)[0] and robot.wheel_radius == pytest.approx(0.1)
    assert "wheels.radius" in mjcf_model(path, calibrate=True).params.values


def test_inspect_says_what_was_understood_and_draws_it(tmp_path, capsys):
    ball = link("ball", BALL, 0.1) + joint("ball_joint", "ball", "-0.2 0 -0.05")
    path = robot_file(tmp_path, *TWO, ball)
    config = inspect_module.InspectConfig(dataset=path, out=tmp_path / "seen")
    found = inspect_module.main(config)
    text = capsys.readouterr().out
    for words in ("differential drive, two driven wheels, 22.1 kg", "wheel radius 0.1 m, track 0.5 m",
                  "left: left_wheel_joint; right: right_wheel_joint", "left_wheel_joint_link: 5",
                  "of the commanded speed"):
        assert words in text
    assert (tmp_path / "seen" / "robot.png").stat().st_size > 5000 and found["drives_straight"]
    inspect_module.main(inspect_module.InspectConfig(dataset=path, out=tmp_path / "seen", json=True))
    assert json.loads(capsys.readouterr().out)["driven_wheels"] == 2


def test_a_robot_is_drawn_where_somebody_asks_for_it_and_nowhere_else(tmp_path, capsys, monkeypatch):
    path = robot_file(tmp_path, *TWO)
    monkeypatch.chdir(tmp_path)
    before = set(tmp_path.iterdir())
    inspect_module.main(inspect_module.InspectConfig(dataset=path, json=True))
    said = capsys.readouterr()
    assert json.loads(said.out)["driven_wheels"] == 2 and "--out FOLDER draws it" in said.err
    assert set(tmp_path.iterdir()) == before
    (tmp_path / "robot.png").write_text("mine")
    with pytest.raises(FolderRefused, match="choose another --out, or remove it"):
        inspect_module.main(inspect_module.InspectConfig(dataset=path, json=True, out=tmp_path))
    assert json.loads(capsys.readouterr().out)["driven_wheels"] == 2
    assert (tmp_path / "robot.png").read_text() == "mine"


def test_json_of_a_robot_is_all_that_comes_on_stdout(tmp_path):
    """In a process of its own, which imports MJX for the first time."""
    path = robot_file(tmp_path, *TWO)
    command = [sys.executable, "-m", "sysid.inspect", str(path), "--json", "--out", str(tmp_path / "seen")]
    assert json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)["driven_wheels"] == 2


def test_motors_of_a_file_are_driven_by_the_host_with_their_own_limits(tmp_path):
    """C MuJoCo steps the speed controller as part of the motor's law."""
    from test_models import ROBOT

    path = tmp_path / "robot.xml"
    path.write_text(ROBOT.replace("<velocity", '<motor ctrlrange="-3 3"').replace(' kv="1"', ""))
    straight, check = drives(load_robot(path))
    assert straight and abs(check.drift) < 0.05
    path.write_text(ROBOT.replace("<velocity", '<motor ctrlrange="-0.01 0.01"').replace(' kv="1"', ""))
    assert not drives(load_robot(path))[0]
    assert np.isfinite(check.rate)


def test_a_xacro_file_whose_sums_never_end_is_refused(tmp_path, monkeypatch):
    pytest.importorskip("xacro")
    monkeypatch.setattr(xacro_text, "SECONDS", 1)
    path = tmp_path / "robot.xacro"
    for text, said in (("${10**10**10}", "it takes more than 1 s of processor time"),
                       ("${().__class__}", "invalid name"), ("${[0] * 10**10}", "when evaluating")):
        path.write_text(f'<robot xmlns:xacro="http://www.ros.org/wiki/xacro" name="r"><link name="{text}"/></robot>')
        with pytest.raises(ValueError, match=f"robot.xacro: xacro cannot expand it: .*{said}"):
            expand_xacro(path)


def test_a_xacro_file_is_read_without_what_other_packages_would_add(tmp_path):
    pytest.importorskip("xacro")
    path = robot_file(tmp_path, '<xacro:include filename="$(find lidars)/urdf/one.xacro"/><xacro:one parent="base"/>',
                      wheel("left_wheel", 0, 0.2), wheel("right_wheel", 0, -0.2))
    text = path.read_text().replace('<robot', '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"')
    path = path.rename(path.with_suffix(".xacro"))
    path.write_text(text)
    robot = load_robot(path)
    assert len(robot.wheels) == 2 and sum("left out" in note for note in robot.notes) == 2
    path.write_text(text.replace('<xacro:include filename="$(find lidars)/urdf/one.xacro"/>', ""))
    with pytest.raises(ValueError, match="unknown macro name: xacro:one"):
        load_robot(path)


def test_wheels_without_usual_names_are_found_where_they_stand(tmp_path):
    robot = load_robot(robot_file(tmp_path, wheel("joint_2", 0, -0.2), wheel("joint_1", 0, 0.2)))
    assert [robot.host.actuator(one).name for one in robot.actuators] == ["joint_1", "joint_2"]
    with pytest.raises(ValueError, match="do not show which wheels"):  # one behind the other
        load_robot(robot_file(tmp_path, wheel("joint_2", 0.2, 0), wheel("joint_1", -0.2, 0.01)))


def test_wheels_that_steer_or_point_different_ways_are_refused_with_the_reason(tmp_path):
    limit = '<limit lower="-0.6" upper="0.6" effort="5" velocity="3"/>'
    steered = (link("knuckle") + joint("steering", "knuckle", "0.2 0 0", "revolute", "0 0 1", more=limit)
               + wheel("front_wheel", 0, 0, parent="knuckle"))
    rear = wheel("left_wheel", 0, 0.2), wheel("right_wheel", 0, -0.2)
    with pytest.raises(ValueError, match="wheel front_wheel is steered by joint steering"):
        load_robot(robot_file(tmp_path, *rear, steered))
    assert len(load_robot(tmp_path / "robot.urdf", ("left_wheel", "right_wheel")).wheels) == 2
    three = [wheel(f"omni_{k}", np.cos(turn), np.sin(turn), axis=f"{np.cos(turn)} {np.sin(turn)} 0")
             for k, turn in enumerate((0.0, 2.1, 4.2))]
    with pytest.raises(ValueError, match="point in different directions"):
        load_robot(robot_file(tmp_path, *three))


def test_wheels_that_are_no_cylinders_roll_as_far_as_they_reach(tmp_path):
    box = '<box size="0.14 0.14 0.05"/>'
    upright = [wheel(f"{side}_wheel", 0, y, box).replace("1.5707963 0 0", "1.5707963 0.785 0")
               for side, y in (("left", 0.2), ("right", -0.2))]
    robot = load_robot(robot_file(tmp_path, *upright))
    assert robot.wheel_radius == pytest.approx(0.099, abs=1e-3) and drives(robot)[0]
    ball, hub = '<sphere radius="0.02"/>', '<sphere radius="0.05"/>'
    rollers = [wheel(f"{side}_wheel", 0, y, hub) + link(f"{side}_roller", ball, 0.01, 1e-5)
               + joint(f"{side}_roller_joint", f"{side}_roller", "0.08 0 0", "continuous", "0 0 1",
                       f"{side}_wheel_link") for side, y in (("left", 0.2), ("right", -0.2))]
    robot = load_robot(robot_file(tmp_path, *rollers))
    assert robot.wheel_radius == pytest.approx(0.1) and drives(robot)[0]
    assert sum("has rollers" in note for note in robot.notes) == 2


def test_sizes_in_millimetres_are_refused(tmp_path):
    large = CYLINDER.replace("0.1", "100")
    with pytest.raises(ValueError, match="wheel radius is 100.* in metres"):
        load_robot(robot_file(tmp_path, wheel("left_wheel", 0, 200, large), wheel("right_wheel", 0, -200, large)))


@pytest.mark.parametrize(("old", "new", "said"), [
    ('mass value="1.0"', 'mass value="0"', "has a mass of 0"),
    ('izz="0.003"', 'izz="0.009"', "moments of inertia that no body has"),
    ('ixx="0.003" iyy="0.003" izz="0.003"', 'ixx="0" iyy="0" izz="0"', "moment of inertia of 0"),
    ("collision>", "visual>", "has no collision shape"),
])  # fmt: skip
def test_links_that_authors_leave_unfinished_drive_all_the_same(tmp_path, old, new, said):
    path = robot_file(tmp_path, wheel("left_wheel", 0, 0.2), wheel("right_wheel", 0, -0.2))
    path.write_text(path.read_text().replace(old, new))
    robot = load_robot(path)
    assert sum(said in note for note in robot.notes) >= 2 and drives(robot)[0]


END = '<limit lower="-3.14" upper="3.14" effort="9" velocity="9"/>'
WEAK = '<limit effort="0.001" velocity="9"/>'


@pytest.mark.parametrize(("change", "straight", "said"), [
    (lambda text: text.replace('"continuous"', '"revolute"').replace("</joint>", END + "</joint>"), True,
     "ends at -3.14 and 3.14 rad: a wheel turns on"),
    (lambda text: text.replace("</joint>", WEAK + "</joint>"), False, "left_wheel_joint gives at most 0.001 N m"),
    (lambda text: text.replace('ball_joint" type="fixed"', 'ball_joint" type="floating"'), True,
     "ball_joint is floating: its part is held at 0"),
    (lambda text: text.replace("<link ", '<link name="world"/><joint name="ground" type="planar"><parent link="world"/>'
                               '<child link="base"/></joint><link ', 1), True, ""),
    (lambda text: text.replace("wheel", "mecanum_wheel"), True, "mecanum or omni wheels are taken for plain ones"),
    (lambda text: text.replace("</robot>", "".join(
        link(f"{side}_finger", BALL, 0.01, origin="0 0 1") + joint(f"{side}_finger_joint", f"{side}_finger", "0 0 0.3",
                                                                   "revolute", "1 0 0", more=END)
        for side in ("left", "right")) + "</robot>").replace("_wheel_joint", "_motor"), True, "left: left_motor;"),
    (lambda text: text.replace('axis xyz="0 1 0"', 'axis xyz="1 0 0"'), False,
     "axis of joint left_wheel_joint does not lie across"),
    (lambda text: text.replace(CYLINDER, CYLINDER.replace("0.1", "0.08"), 1), False, "radii of its wheels differ"),
    (lambda text: text.replace('mass value="20.0"', 'mass value="20000"'), True, "masses are in kg, not in grams"),
    (lambda text: text.replace("</robot>", wheel("free_1", 0.3, 0.25) + wheel("free_2", 0.3, -0.25) + "</robot>"), True,
     "on the spot it reaches only .*: free_._link, free_._link drag sideways"),
])  # fmt: skip
def test_what_keeps_a_robot_from_driving_is_mended_or_named(tmp_path, change, straight, said):
    path = robot_file(tmp_path, *TWO, link("ball", BALL, 0.1, turn="1.5707963 0 0")
                      + joint("ball_joint", "ball", "-0.2 0 -0.05"))
    path.write_text(change(path.read_text()))
    robot = load_robot(path)
    check = check_robot(robot)
    assert check.drives_straight == straight
    assert re.search(said, "\n".join(describe_robot(robot, check)))


def test_wheels_that_are_coupled_are_said_not_to_turn_the_robot(tmp_path):
    left, right = TWO
    path = robot_file(tmp_path, left, right.replace("</joint>", '<mimic joint="left_wheel_joint"/></joint>'))
    robot = load_robot(path)
    assert any("are coupled (mimic)" in line for line in describe_robot(robot, check_robot(robot)))


def test_weight_is_what_a_vehicle_stands_by(tmp_path):
    from test_models import ROBOT

    path = tmp_path / "robot.xml"
    path.write_text(ROBOT.replace("<worldbody>", '<option gravity="0 -9.81 0"/><worldbody>'))
    with pytest.raises(ValueError, match="option gravity is 0 -9.81 0; .* along -z"):
        load_robot(path)
    path.write_text(ROBOT.replace("<body name=", '<body gravcomp="1" name=', 1))
    robot = load_robot(path)
    assert not robot.host.body_gravcomp.any() and any("gravcomp" in note for note in robot.notes)
    with pytest.raises(ValueError, match="begins with <sdf>. Robots are read from URDF"):
        (tmp_path / "robot.sdf").write_text('<sdf version="1.7"/>')
        load_robot(tmp_path / "robot.sdf")


def test_actuators_that_take_no_speed_are_replaced_and_gears_may_turn_back(tmp_path):
    from test_models import ROBOT

    path = tmp_path / "robot.xml"
    path.write_text(ROBOT.replace("<velocity", "<position").replace(' kv="1"', ' kp="1"'))
    robot = load_robot(path)
    assert len(robot.added) == 2 and drives(robot)[0] and "holds an angle" in robot.notes[0]
    motors = ROBOT.replace("<velocity", '<motor gear="30"').replace(' kv="1"', "")
    path.write_text(motors.replace('gear="30"', 'gear="-30"', 1))
    assert drives(load_robot(path))[0]


def test_a_robot_that_falls_over_without_its_controller_is_named_and_not_fitted(tmp_path):
    path = robot_file(tmp_path, *TWO, base=link("base", '<box size="0.1 0.3 0.6"/>', 20.0, 0.5, origin="0 0 0.5"))
    path.write_text(path.read_text().replace('<inertial><mass value="20.0"/>',
                                             '<inertial><origin xyz="0 0 0.5"/><mass value="20.0"/>'))
    robot = load_robot(path)
    assert any("two driven wheels alone" in line for line in describe_robot(robot, check_robot(robot)))
    with pytest.raises(ValueError, match="falls over: .* balances by a controller of its own"):
        mjcf_model(path)
    hung = robot_file(tmp_path, *TWO, link("ball", BALL, 0.1) + joint("ball_joint", "ball", "-0.2 0 -0.05"))
    assert not load_robot(hung).falls


def plugin(file, **tags):
    inside = "".join(f"<{name}>{value}</{name}>" for name, value in tags.items())
    return f'<gazebo><plugin filename="{file}" name="drive">{inside}</plugin></gazebo>'


ROLLING = [wheel(name, x, y) for name, x, y in
           (("port", 0.2, 0.2), ("starboard", 0.2, -0.2), ("idle_a", -0.2, 0.2), ("idle_b", -0.2, -0.2))]
SPEEDS = "".join(f'<joint name="{name}"><command_interface name="velocity"/></joint>' for name in ("starboard", "port"))
GEARS = "".join(f'<transmission name="{name}"><joint name="{name}"><hardwareInterface>hardware_interface/'
                'VelocityJointInterface</hardwareInterface></joint></transmission>' for name in ("starboard", "port"))


@pytest.mark.parametrize("says", [
    plugin("libgazebo_ros_diff_drive.so", leftJoint="port", rightJoint="starboard"),
    plugin("gz-sim-diff-drive-system", left_joint="port", right_joint="starboard"),
    f'<ros2_control name="base" type="system">{SPEEDS}</ros2_control>', GEARS,
])  # fmt: skip
def test_wheels_that_a_file_says_are_driven_are(tmp_path, says):
    robot = load_robot(robot_file(tmp_path, *ROLLING, says))
    assert [robot.host.actuator(one).name for one in robot.actuators] == ["port", "starboard"]


def test_a_plugin_of_four_wheels_gives_their_sides(tmp_path):
    says = plugin("libgazebo_ros_skid_steer_drive.so", leftFrontJoint="port", rightFrontJoint="starboard",
                  leftRearJoint="idle_a", rightRearJoint="idle_b")
    robot = load_robot(robot_file(tmp_path, *ROLLING, says))
    assert [robot.host.actuator(one).name for one in robot.actuators] == ["port", "idle_a", "starboard", "idle_b"]


def test_wheels_with_rollers_are_known_by_plugin_or_picture(tmp_path):
    four = "".join(wheel(name, x, y) for name, x, y in (
        ("fl", 0.2, 0.2), ("fr", 0.2, -0.2), ("rl", -0.2, 0.2), ("rr", -0.2, -0.2)))
    drawn = four.replace("<collision>", '<visual><geometry><mesh filename="package://r/mecanum.stl"/></geometry>'
                         "</visual><collision>")
    for text in (four + plugin("libgazebo_ros_planar_move.so"), drawn):
        assert any("mecanum or omni" in note for note in load_robot(robot_file(tmp_path, text)).notes)
    assert not any("mecanum" in note for note in load_robot(robot_file(tmp_path, four)).notes)


def test_tricycles_are_refused_by_the_name_of_their_steering_or_by_their_plugin(tmp_path):
    rear = wheel("left_wheel", 0, 0.2), wheel("right_wheel", 0, -0.2)
    fork = link("fork") + joint("steering", "fork", "0.4 0 0", "continuous", "0 0 1") + wheel(
        "front_wheel", 0, 0, parent="fork")
    with pytest.raises(ValueError, match="wheel front_wheel is steered by joint steering"):
        load_robot(robot_file(tmp_path, *rear, fork))
    assert load_robot(robot_file(tmp_path, *rear, fork.replace('"steering"', '"caster_steering"'))).wheels
    with pytest.raises(ValueError, match="plugin libgazebo_ros_ackermann_drive.so steers its wheels"):
        load_robot(robot_file(tmp_path, *rear, plugin("libgazebo_ros_ackermann_drive.so")))


def test_a_plugin_that_only_is_called_after_steering_hinders_no_drive(tmp_path):
    pose = plugin("libgazebo_ros_p3d.so").replace('"drive"', '"steering_pose"')
    drive = plugin("libgazebo_ros_diff_drive.so", leftJoint="port", rightJoint="starboard")
    for more in (pose, plugin("libgazebo_ros_ackermann_drive.so")):
        robot = load_robot(robot_file(tmp_path, *ROLLING, drive, more))
        assert [robot.host.actuator(one).name for one in robot.actuators] == ["port", "starboard"]


@pytest.mark.parametrize(("left", "right", "said"), [
    ("prot", "starboard", "a plugin drives joint prot, which is no joint of the file that turns .port, "),
    ("port", "port", "a plugin drives joint port on both sides")])
def test_a_plugin_whose_joints_are_misspelt_or_repeated_is_refused_by_their_name(tmp_path, left, right, said):
    path = robot_file(tmp_path, *ROLLING, plugin("libgazebo_ros_diff_drive.so", leftJoint=left, rightJoint=right))
    with pytest.raises(ValueError, match=said):
        load_robot(path)
    assert len(load_robot(path, ("port", "starboard")).wheels) == 2


@pytest.mark.parametrize(("says", "said"), [
    (plugin("libgazebo_ros_diff_drive.so", leftJoint="left_wheel"), "left_wheel on the left and no joint on the right"),
    (f'<ros2_control name="base" type="system">{SPEEDS}</ros2_control>', "starboard, port, which the file lacks")])
def test_joints_of_a_file_that_are_of_no_use_are_named_where_wheels_are_taken_by_their_names(tmp_path, says, said):
    both = (wheel("left_wheel", 0, 0.2), wheel("right_wheel", 0, -0.2))
    [note] = [one for one in load_robot(robot_file(tmp_path, *both, says)).notes if said in one]
    assert "the driven wheels are taken to be left_wheel, right_wheel" in note
    assert not any("are taken to be" in one for one in load_robot(robot_file(tmp_path, *both)).notes)


def test_a_track_of_many_wheels_drives_as_one_side(tmp_path):
    names = [(f"{side}_track_wheel_{k}", -0.2 + 0.1 * k, y) for side, y in (("left", 0.2), ("right", -0.2))
             for k in range(5)]
    robot = load_robot(robot_file(tmp_path, *(wheel(*one, CYLINDER.replace("0.1", "0.05")) for one in names)))
    assert len(robot.wheels) == 10 and drives(robot)[0]


@pytest.mark.parametrize(("parts", "said"), [
    ([*ROLLING, link("port_link")], "link 'port_link' is there twice"),
    ([joint("left_wheel", "nowhere", "0 0 0", "continuous")], "child of joint 'left_wheel' is link 'nowhere', which"),
    ([link(f"foot_{k}") + joint(f"knee_{k}", f"foot_{k}", f"0 {k} 0", "revolute", more=(
        '<limit lower="-1" upper="1" effort="9" velocity="9"/>')) for k in (-1, 1)], "all joints end within a turn"),
])  # fmt: skip
def test_a_file_that_is_no_robot_on_wheels_says_why(tmp_path, parts, said):
    with pytest.raises(ValueError, match=said):
        load_robot(robot_file(tmp_path, *parts))


def test_a_robots_own_name_shows_no_side(tmp_path):
    robot = load_robot(robot_file(tmp_path, wheel("r1_wheel_r", 0, -0.2), wheel("r1_wheel_l", 0, 0.2)))
    assert [robot.host.actuator(one).name for one in robot.actuators] == ["r1_wheel_l", "r1_wheel_r"]


@pytest.mark.parametrize(("leader", "said"), [
    ("left_finger_joint", ""), ("thumb", "mimics thumb, which the file lacks")])
def test_a_gripper_whose_fingers_follow_each_other_is_held(tmp_path, leader, said):
    fingers = "".join(
        link(f"{side}_finger", mass=0.01) + joint(f"{side}_finger_joint", f"{side}_finger", "0 0 0.3", "prismatic",
                                                  more=END) for side in ("left", "right"))
    fingers = fingers[::-1].replace("</joint>"[::-1], f'<mimic joint="{leader}"/></joint>'[::-1], 1)[::-1]
    robot = load_robot(robot_file(tmp_path, *TWO, fingers))
    assert drives(robot)[0] and robot.host.neq == 0 and said in " ".join(robot.notes)


def test_a_caster_that_is_only_drawn_carries_its_robot(tmp_path):
    seen = link("caster", BALL, 0.1).replace("collision>", "visual>")
    robot = load_robot(robot_file(tmp_path, *TWO, seen, joint("caster_joint", "caster", "-0.2 0 -0.05")))
    assert any("link caster has no collision shape" in note for note in robot.notes)
    assert robot.host.geom_contype[robot.host.geom("caster").id] | robot.host.geom_conaffinity[
        robot.host.geom("caster").id]


CAR = """<mujoco><option timestep="0.002"/><worldbody><geom type="plane" size="5 5 0.1" name="floor"/>
  <body name="car" pos="0 0 0.03"><freejoint/><geom type="box" size="0.08 0.05 0.01" mass="0.5"/>
    <geom name="ball" type="sphere" size="0.015" pos="0.08 0 -0.015" condim="1" priority="1" mass="0.01"/>
    <body pos="-0.05 0.06 0"><joint name="left" axis="0 1 0" damping="0.03"/>
      <geom type="cylinder" size="0.03 0.01" zaxis="0 1 0" mass="0.05"/></body>
    <body pos="-0.05 -0.06 0"><joint name="right" axis="0 1 0" damping="0.03"/>
      <geom type="cylinder" size="0.03 0.01" zaxis="0 1 0" mass="0.05"/></body></body>OTHERS</worldbody>
  <tendon><fixed name="ahead"><joint joint="left" coef="0.5"/><joint joint="right" coef="0.5"/></fixed></tendon>
  <actuator>ACTS</actuator>MORE</mujoco>"""
TENDON = '<motor name="ahead" tendon="ahead"/>'
FILTER = "".join(f'<general joint="{side}" dyntype="filter" dynprm="0.05" gainprm="2" biastype="affine" '
                 'biasprm="0 0 -2"/>' for side in ("left", "right"))
SERVOS = '<velocity joint="left" kv="0.01"/><velocity joint="right" kv="0.01"/>'


def car_file(folder, acts, others="", more=""):
    path = folder / "car.xml"
    path.write_text(CAR.replace("ACTS", acts).replace("OTHERS", others).replace("MORE", more))
    return path


@pytest.mark.parametrize(("acts", "said"), [
    (TENDON, "actuator ahead acts on tendon ahead"), (FILTER, "has a filter or a muscle"),
    (FILTER.replace('dyntype="filter" dynprm="0.05" ', 'gaintype="affine" '), "pulls by a law of its own")])
def test_servos_that_stand_in_for_other_actuators_reach_their_speed_whatever_the_bearing(tmp_path, acts, said):
    sensor = '<sensor><actuatorfrc actuator="ahead"/></sensor>' if acts == TENDON else ""
    robot = load_robot(car_file(tmp_path, acts, more=sensor))
    straight, check = drives(robot)
    assert straight and check.speed == pytest.approx(check.command[0], rel=0.02)
    assert said in " ".join(robot.notes) and "friction and damping of joint left" in " ".join(robot.notes)


@pytest.mark.parametrize(("acts", "said"), [
    ('<intvelocity joint="left" kp="1" actrange="-9 9"/><intvelocity joint="right" kp="1" actrange="-9 9"/>',
     "actuators of joint left, of joint right sum up a speed"),
    ('<position joint="left" kp="1"/>', "actuator of joint left holds an angle of left"),
    ('<motor tendon="ahead"/>', "actuator of tendon ahead acts on tendon ahead")])
def test_an_actuator_without_a_name_is_called_after_what_it_acts_on(tmp_path, acts, said):
    assert said in " ".join(load_robot(car_file(tmp_path, acts)).notes)


def test_a_servo_that_its_bearing_holds_back_is_named(tmp_path):
    robot = load_robot(car_file(tmp_path, SERVOS))
    lines = "\n".join(describe_robot(robot, check_robot(robot)))
    assert ("actuator left (kv 0.01 N m s/rad) is held back by a damping of 0.03 of joint left: it reaches "
            "25% of its speed") in lines


def test_keyframes_of_the_file_do_not_hinder_what_is_added(tmp_path):
    key = '<keyframe><key name="home" qpos="0 0 0.03 1 0 0 0 0 0" ctrl="0 0"/></keyframe>'
    assert load_robot(car_file(tmp_path, SERVOS, more=key), regulated=True).integrals


def test_what_stands_or_rolls_aside_carries_nothing_and_hinders_nothing(tmp_path):
    aside = ('<geom name="post" type="cylinder" size="0.2 0.4" pos="-3 1 0.4"/>'
             '<body pos="2 0 0.1"><freejoint/><geom name="toy" type="sphere" size="0.1"/></body>')
    path = car_file(tmp_path, SERVOS, aside)
    path.write_text(path.read_text().replace(' damping="0.03"', ""))
    robot = load_robot(path)
    straight, check = drives(robot)
    assert "the obstacle's contacts are left out" in " ".join(robot.notes) and "toy" not in check.loads and straight
    with pytest.raises(ValueError, match="MJX has no contact between"):
        load_robot(car_file(tmp_path, SERVOS, '<geom type="cylinder" size="2 0.01" pos="0 0 -0.01"/>'))


@pytest.mark.parametrize("turn", ["0 0 0", "0 0 30", "90 0 0"])
def test_a_mesh_is_a_floor_where_the_robot_stands_on_it_and_an_obstacle_elsewhere(tmp_path, turn):
    """MuJoCo turns a mesh into its principal axes, so that its first axis may be the vertical one."""
    sides = (6, 0.1, 5) if turn == "90 0 0" else (6, 5, 0.1)
    corners = " ".join(f"{a * side / 2}" for signs in itertools.product((-1, 1), repeat=3)
                       for a, side in zip(signs, sides, strict=True))
    mesh = f'<asset><mesh name="slab" vertex="{corners}"/></asset>'
    slab = f'<geom name="slab" type="mesh" mesh="slab" pos="2 1 -0.05" euler="{turn}"/>'
    with pytest.raises(ValueError, match=r"MJX has no contact between .* and geom 'slab' .mesh."):
        load_robot(car_file(tmp_path, SERVOS, slab, mesh))
    aside = load_robot(car_file(tmp_path, SERVOS, slab.replace("2 1 -0.05", "5 1 -0.05"), mesh))
    assert "the obstacle's contacts are left out" in " ".join(aside.notes)


def test_what_drags_on_the_floor_is_named_with_its_friction(tmp_path):
    path = car_file(tmp_path, SERVOS)
    text = path.read_text().replace('condim="1" priority="1"', 'friction="0 0 0"')
    path.write_text(text.replace("0.08 0 -0", "0.02 0 -0"))
    robot = load_robot(path)
    assert any('ball slides on the floor with a friction of 1 ' in line
               for line in describe_robot(robot, check_robot(robot)))

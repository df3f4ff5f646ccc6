"""Sides of a robot's wheels: what names, places and a person say of them, alone and against each other."""

from __future__ import annotations

import pytest
from test_robots import BALL, joint, link, plugin, robot_file, wheel

from sysid.replay.mjcf import mjcf_model
from sysid.replay.robot_check import check_robot, describe_robot
from sysid.replay.robot_loading import load_robot

pytestmark = pytest.mark.quick
CASTER = link("ball", BALL, 0.1) + joint("ball_joint", "ball", "-0.2 0 -0.05")
AXES = {"alike": (1, 1), "mirrored": (1, -1), "backwards": (-1, -1)}


def wheels(axles, signs=(1, 1), names=("left", "right"), mirrored=()):
    """Wheels on axles; the axles `mirrored` have the left wheel's name on the right."""
    return [wheel(f"{side}_wheel_{k}", x, y * (-1 if k in mirrored else 1), axis=f"0 {sign} 0")
            for k, x in enumerate(axles) for side, y, sign in zip(names, (0.2, -0.2), signs, strict=True)]


def named(robot):
    return [robot.host.joint(one).name for one in robot.joints]


def cart(folder, axles, **how):
    return robot_file(folder, *wheels(axles, **how), CASTER if len(axles) == 1 else "")


@pytest.mark.parametrize("signs", AXES.values(), ids=AXES)
@pytest.mark.parametrize("axles", [(0.0,), (0.2, -0.2), (0.25, 0.0, -0.25)], ids=["two", "four", "six"])
@pytest.mark.parametrize("order", [1, -1], ids=["left first", "right first"])
def test_a_robot_drives_and_turns_alike_however_its_wheels_are_named_and_its_axes_point(tmp_path, axles, signs, order):
    path = cart(tmp_path, axles, signs=signs)
    names = [f"{side}_wheel_{k}" for side in ("left", "right")[::order] for k in range(len(axles))]
    robot = load_robot(path, names)
    assert named(robot) == named(load_robot(path)) and robot.forward == pytest.approx([1.0, 0.0, 0.0])
    assert robot.track == pytest.approx(0.4)
    assert any("first, but left_wheel_0" in note for note in robot.notes) == (order == -1)
    check = check_robot(robot)
    assert check.drives_straight and check.rate > 0.1 * check.command[1]
    assert "; front: +x" in "\n".join(describe_robot(robot, check))


@pytest.mark.parametrize("axles", [(0.0,), (0.2, -0.2), (0.25, 0.0, -0.25)], ids=["two", "four", "six"])
def test_names_that_places_deny_turn_the_robot_round_with_a_note_unless_the_left_ones_are_named(tmp_path, axles):
    path = cart(tmp_path, axles, mirrored=range(len(axles)))
    robot = load_robot(path)
    assert robot.forward == pytest.approx([-1.0, 0.0, 0.0], abs=1e-6)
    assert any("front is taken to be -x" in note for note in robot.notes)
    right_ones_first = [f"{side}_wheel_{k}" for side in ("right", "left") for k in range(len(axles))]
    robot = load_robot(path, right_ones_first)  # which stand on the left
    assert robot.forward == pytest.approx([1.0, 0.0, 0.0], abs=1e-6) and not robot.notes


@pytest.mark.parametrize("axles", [(0.2, -0.2), (0.25, 0.0, -0.25)], ids=["four", "six"])
def test_names_that_mix_both_sides_are_refused(tmp_path, axles):
    with pytest.raises(ValueError, match="_wheel_. is taken for a wheel of the left and .* the other way round"):
        load_robot(cart(tmp_path, axles, mirrored=(1,)))


def test_a_plugin_that_exchanges_the_sides_turns_the_robot_round_with_a_note(tmp_path):
    says = plugin("libgazebo_ros_diff_drive.so", leftJoint="right_wheel_0", rightJoint="left_wheel_0")
    robot = load_robot(robot_file(tmp_path, *wheels((0.0,)), CASTER, says))
    assert named(robot) == ["right_wheel_0", "left_wheel_0"]
    assert any("front is taken to be -x" in note for note in robot.notes)


@pytest.mark.parametrize("x", [0.15, -0.15])
def test_front_and_rear_drive_with_casters_behind_and_ahead(tmp_path, x):
    casters = [link(f"{side}_fork", mass=0.3) + joint(f"{side}_swivel", f"{side}_fork", f"{-x} {y} 0", "continuous",
                                                      "0 0 1")
               + link(f"{side}_roll", BALL, 0.3) + joint(f"{side}_caster", f"{side}_roll", "-0.03 0 -0.05",
                                                         "continuous", parent=f"{side}_fork")
               for side, y in (("left", 0.15), ("right", -0.15))]
    robot = load_robot(robot_file(tmp_path, *wheels((x,)), *casters), ("left_wheel_0", "right_wheel_0"))
    check = check_robot(robot)
    assert check.drives_straight and robot.forward == pytest.approx([1.0, 0.0, 0.0]) and not robot.notes
    assert robot.point[0] == pytest.approx(x)


def test_wheels_whose_axes_do_not_lie_across_are_not_fitted(tmp_path):
    along = [one.replace('axis xyz="0 1 0"', 'axis xyz="1 0 0"') for one in wheels((0.0,))]
    path = robot_file(tmp_path, *along, CASTER)
    with pytest.raises(ValueError, match="axis of left_wheel_0, right_wheel_0 does not lie across"):
        mjcf_model(path)

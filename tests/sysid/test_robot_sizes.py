"""Robot files: the track is that of the tyres, sides are those on which wheels stand, numbers are finite."""

from __future__ import annotations

import pytest
from test_robots import BALL, CYLINDER, joint, link, robot_file, wheel

from sysid.replay.mjcf import mjcf_model
from sysid.replay.robot_check import check_robot, describe_robot
from sysid.replay.robot_loading import load_robot
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

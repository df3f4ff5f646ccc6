"""A robot file that is driven a command at a time."""

import numpy as np
import pytest

from benchmarks.plant.first_day import write_urdf
from sysid.replay.robot_online import OnlineRobot
from whill_mjx.vehicle.specs import WHILL_CR

pytestmark = pytest.mark.quick


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return OnlineRobot(write_urdf(tmp_path_factory.mktemp("robot") / "small.urdf"))


def test_it_is_placed_drives_straight_and_turns_to_the_left_as_it_reports(robot):
    robot.place(1.0, -2.0, 1.5)
    np.testing.assert_allclose(robot.motion, [1.0, -2.0, 1.5, 0, 0], atol=1e-9)
    robot.advance(0.2, 0.0, 2.0)
    ahead = (robot.motion[:2] - [1.0, -2.0]) @ [np.cos(1.5), np.sin(1.5)]
    assert ahead == pytest.approx(0.4, abs=0.02) and robot.odometry[0] == pytest.approx(ahead, abs=0.005)
    assert robot.motion[3] == pytest.approx(0.2, abs=0.005)
    robot.advance(0.0, 0.5, 2.0)
    assert robot.motion[2] - 1.5 == pytest.approx(1.0, abs=0.1) and robot.motion[4] == pytest.approx(0.5, abs=0.03)


def test_one_drive_after_another_begins_at_rest_and_is_the_same(robot):
    def path():
        robot.place(0.0, 0.0, 0.0)
        robot.advance(0.2, 0.3, 1.0)
        return robot.motion

    assert np.array_equal(path(), path())


def test_its_outline_is_that_of_its_file_and_its_camera_that_of_the_vehicle_given(robot):
    spec = robot.spec(WHILL_CR)
    assert spec.wheel_radius == pytest.approx(0.033) and spec.track == pytest.approx(0.16)
    assert spec.body_length < 0.2 and spec.mass == pytest.approx(1.2, abs=0.01) and spec.camera == WHILL_CR.camera


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="robot.urdf: no such robot file"):
        OnlineRobot(tmp_path / "robot.urdf")

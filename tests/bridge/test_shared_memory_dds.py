"""Large images through shared memory: with the default settings of ROS they are lost, with the bridge's profile not.

These tests stay in one file, so they never run side by side: all ROS domains of a host share the first ports of shared
memory.
"""

import json

import pytest
from ros_graph import check_pace


@pytest.fixture
def domain(graph, monkeypatch):
    """A graph whose nodes use shared memory: ROS adds it for LOCALHOST."""
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    graph.environment["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    return graph


def test_images_lost_in_a_small_segment_are_named_with_the_profile_to_use(domain, policy):
    robot = domain.peer("robot")
    robot.base(), robot.watch(), robot.e_stop()
    robot.camera(size=(720, 1280))
    domain.start("drive", policy)
    robot.wait_for_status(causes="fastdds.xml")
    assert domain.end("drive") == 0  # in order, so that its segments are removed


def test_large_best_effort_images_arrive_with_the_shipped_profile(domain, policy, tmp_path):
    del domain.environment["FASTRTPS_DEFAULT_PROFILES_FILE"]
    domain.start("drive", policy)
    domain.wait_for("drive", "standing")
    domain.start("simulate", "--simulator", "point_robot:PointRobot", "--episodes", 1, "--image-size", 720, 1280,
                 "--results", tmp_path / "results.json")
    assert domain.wait("simulate") == 0, domain.log("simulate")
    outcome = json.loads((tmp_path / "results.json").read_text())
    (episode,) = outcome["episodes"]
    assert episode["reached_goal"]
    check_pace(outcome, episode)
    assert domain.end("drive") == 0

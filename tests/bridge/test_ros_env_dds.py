"""The Gymnasium environment over real DDS: lock-step with the simulator, and a vehicle on the wall clock."""

import random
import re
import time

import numpy as np
import pytest
from ros_graph import WAIT


@pytest.fixture
def env(graph, monkeypatch):
    """A function that joins the graph as a Gymnasium environment."""
    pytest.importorskip("rclpy")
    from bridge import ros_env
    from bridge.ros_env import RosEnv

    made = []
    monkeypatch.setattr(ros_env, "PATIENCE", WAIT)  # a busy machine may take longer to start the simulator
    monkeypatch.setattr(RosEnv._wait_for, "__defaults__", (WAIT,))

    def make(**options):
        monkeypatch.setenv("ROS_DOMAIN_ID", str(graph.domain))
        made.append(RosEnv(**options))
        return made[-1]

    yield make
    for one in made:
        one.close()


def serve(graph, robot="PointRobot"):
    """Start the simulator with episode control; return its port."""
    graph.start("simulate", "--simulator", f"point_robot:{robot}", "--port", 0, "--wait", 1000)
    graph.wait_for("simulate", "episode control")
    return int(re.search(r"port (\d+)", graph.log("simulate"))[1])


def step_of(image):
    """The number of the step that PointRobot drew."""
    (dark,) = np.flatnonzero(image[0, :, 0] != 255)
    return int(dark)


def test_lock_step_passes_gymnasiums_checks_and_ends_with_the_episode(graph, env):
    from gymnasium.utils.env_checker import check_env

    made = env(port=serve(graph))
    check_env(made, skip_render_check=True, skip_close_check=True)
    image, info = made.reset(seed=3)
    assert step_of(image) == 0
    for number in range(1, 100):
        image, reward, terminated, truncated, info = made.step(np.array([0.3, 0.0]))
        assert step_of(image) == number and np.isfinite(reward)
        if terminated or truncated:
            break
    assert info["reached_goal"] and number == 10
    from bridge.episodes import ProtocolError

    with pytest.raises(ProtocolError, match="call reset first"):
        made.step(np.array([0.3, 0.0]))


def test_no_image_of_an_older_step_or_episode_is_ever_taken(graph, env):
    from benchmarks.bridge_robot import message_type

    peer, rng, kept = graph.peer("relay"), random.Random(0), []
    image = message_type("sensor_msgs/Image")
    out = peer.publisher("sensor_msgs/Image", "delayed/image", 10)

    def relay(message):
        """Send older images again before and after the new one, and the new one late."""
        kept.append(message)
        for one in rng.sample(kept, min(len(kept), 3)):
            out.publish(one)
        time.sleep(rng.uniform(0, 0.01))
        out.publish(message)
        out.publish(rng.choice(kept))
        del kept[:-20]

    port = serve(graph)
    peer.node.create_subscription(image, "sensing/camera/front/image_raw", relay, 10)
    made = env(port=port, image_topic="delayed/image")
    for episode in range(30):
        image, _ = made.reset(seed=episode)
        assert step_of(image) == 0
        for number in range(1, 4):
            image, *_ = made.step(np.array([0.1, 0.0]))
            assert step_of(image) == number


def test_a_vehicle_is_driven_on_the_wall_clock_with_new_images_only(graph, env):
    graph.start("simulate", "--simulator", "point_robot:RovingRobot", "--wait", 1)
    made = env(period=0.1)
    made.reset()
    began, seen = time.monotonic(), []
    for _ in range(10):
        image, reward, terminated, truncated, _ = made.step(np.array([0.3, 0.0]))
        seen.append((step_of(image), image.min()))  # columns come again each 64 steps, their colours each 100
    assert time.monotonic() - began > 0.8 and len(set(seen)) == 10 and not (terminated or truncated)


@pytest.mark.quick
@pytest.mark.parametrize("options", [{}, {"port": 1, "period": 0.1}])
def test_simulator_or_vehicle_must_be_chosen(options):
    pytest.importorskip("rclpy")
    from bridge.ros_env import RosEnv

    with pytest.raises(ValueError, match="either the port of a simulator or the control period"):
        RosEnv(**options)

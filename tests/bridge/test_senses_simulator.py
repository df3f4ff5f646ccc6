"""The simulator shows a policy of several sensors what it was trained with."""

import json
import math

import numpy as np
import pytest
import tiny_policy

from bridge.policy import read_policy
from whill_mjx.env import make_env
from whill_mjx.evaluation.policies import policy_file
from whill_mjx.evaluation.policies.policy_world import read_world
from whill_mjx.sensors.camera import Camera
from whill_mjx.sensors.commands import Commands
from whill_mjx.sensors.lidar import Lidar
from whill_mjx.sensors.odometry import Odometry
from whill_mjx.vehicle.specs import CameraMount

REAR = CameraMount(x=-0.4, z=0.6, pitch=0.2, fov_y=1.0, yaw=math.pi)
TRAINED = {"camera": Camera(), "rear": Camera(height=6, width=8, mount=REAR),
           "lidar": Lidar(rays=4, reach=8.0, rate_hz=20.0), "odometry": Odometry(), "commands": Commands(1)}


def export(path):
    """Write a policy file whose sensors are those of an environment, as a training writes them."""
    env, params = make_env("point_goal", height=8, width=8, observations=TRAINED)
    sensors = json.loads(json.dumps(policy_file.sensor_contract(env, params)))
    return tiny_policy.write_sensing(path, sensors=sensors, task="point_goal")


def test_the_simulator_gets_back_the_very_sensors_of_the_training(tmp_path, monkeypatch):
    monkeypatch.setattr(policy_file, "camera_contract", lambda model, params: {"fov_y": model.spec.camera.fov_y})
    world = read_world(export(tmp_path / "policy"))
    assert {name: sensor for name, (sensor, _) in world.senses.items()} == TRAINED
    assert (world.task, world.height, world.width) == ("point_goal", 8, 8)
    assert [world.senses[name][1].camera["fov_y"] for name in ("camera", "rear")] == [1.2, 1.0]


@pytest.mark.long
def test_policy_of_several_sensors_drives_the_real_simulator(graph, tmp_path):
    exported = export(tmp_path / "policy")
    rear = read_policy(exported, ("dreamer-onnx-policy",)).contract.sensors["rear"].camera
    assert rear["frame"] == "base_footprint" and abs(rear["yaw"]) == pytest.approx(math.pi, abs=0.01)
    results = tmp_path / "results.json"
    graph.start("drive", exported)
    graph.start("simulate", exported, "--episodes", 1, "--wait", 60, "--results", results, "--set", "max_steps=60")
    assert graph.wait("simulate", 300) == 0, graph.log("simulate")
    assert graph.end("drive") == 0, graph.log("drive")
    (episode,) = json.loads(results.read_text())["episodes"]
    commands = np.array([one[1:] for one in json.loads(results.read_text())["commands"]])
    assert episode["steps"] > 10 and commands[:, 0].max() == pytest.approx(0.3)

"""Whole drives of separate processes over real DDS, on a domain of their own."""

import csv
import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from ros_graph import check_pace, wait_until

from bridge.nodes.exits import Exit


def column(path, name):
    with open(path, encoding="utf-8", newline="") as file:
        return [float(row[name]) for row in csv.DictReader(file)]


def so_far(logs, stream):
    """Rows of a stream that a recorder has handed out up to now, as texts."""
    found = [path.read_text().rpartition("\n")[0].splitlines()[1:] for path in logs.glob(f".*/{stream}.csv")]
    return found[0] if found else []


def test_policy_drives_the_simulator_to_the_goal_and_the_drive_is_recorded(graph, policy, tmp_path):
    results, logs = tmp_path / "results.json", tmp_path / "logs"
    graph.start("record", logs, "straight_1")
    graph.start("simulate", "--simulator", "point_robot:PointRobot", "--episodes", 2, "--wait", 0, "--linger", 600,
                "--results", results)
    wait_until(lambda: so_far(logs, "odometry") and so_far(logs, "ground_truth"))  # both before anything moves
    graph.start("drive", policy)
    graph.wait_for("simulate", "episode 2: ")
    # The camera fell silent: the bridge stops by itself.
    wait_until(lambda: [float(row.split(",")[1]) for row in so_far(logs, "command")[-5:]] == [0.0] * 5)
    assert graph.end("simulate") == 0, graph.log("simulate")
    assert graph.end("drive") == 0, graph.log("drive")
    assert graph.end("record") == 0, graph.log("record")

    outcome = json.loads(results.read_text())
    assert [(episode["reached_goal"], episode["collided"]) for episode in outcome["episodes"]] == [(True, False)] * 2
    for episode in outcome["episodes"]:
        check_pace(outcome, episode)

    trial = logs / "trials" / "straight_1"
    speeds, times = column(trial / "command.csv", "v"), column(trial / "command.csv", "t")
    assert max(speeds) == pytest.approx(0.3, abs=1e-3) and speeds[-5:] == [0.0] * 5
    assert times == sorted(times)
    distance, truth = (column(trial / f"{name}.csv", "x") for name in ("odometry", "ground_truth"))
    assert max(distance) == pytest.approx(max(truth) - truth[0], abs=0.05) and max(truth) > 0.2
    gap, image_gap = (np.median(np.diff(t)) for t in (column(trial / "odometry.csv", "stamp"), outcome["image_times"]))
    assert image_gap / gap > 1.2  # 20 Hz against 10 Hz
    sysid_log = pytest.importorskip("sysid.logs.log")
    (loaded,) = sysid_log.load_log(tmp_path / "logs").trials
    assert loaded.name == "straight_1" and loaded.odometry is not None and loaded.ground_truth is not None


def knows_guard(base):
    """Whether a peer has found the publisher of the guard's zeros."""
    infos = base.node.get_publishers_info_by_topic("/whill/controller/cmd_vel")
    return any(info.node_name == "bridge_guard" for info in infos)


@pytest.mark.parametrize("number, code", [(signal.SIGTERM, 0), (signal.SIGINT, 0), (signal.SIGKILL, -9)])
def test_vehicle_is_stopped_however_the_policy_node_ends(graph, policy, number, code):
    base = graph.peer("base")
    base.base()
    graph.start("simulate", "--simulator", "point_robot:EndlessRobot")
    graph.start("drive", policy)
    base.wait_until(lambda base: base.moving() and knows_guard(base))  # DDS may find the simulator's reader before ours
    assert graph.end("drive", number) == code, graph.log("drive")
    # Where a pause had stopped it just before the kill, its own zero may be the only one.
    zeros = [(0.0, 0.0)] * (1 if number == signal.SIGKILL else 5)
    base.wait_until(lambda base: [one[1:] for one in base.commands[-len(zeros):]] == zeros)
    assert graph.end("simulate") == 0, graph.log("simulate")


def test_second_signal_does_not_cut_the_goodbye_short(graph, policy):
    """An impatient Ctrl-C, or a terminal and a launcher that both send one: zeros, and no guard left behind."""
    base = graph.peer("base")
    base.whole()
    graph.start("drive", policy, "--base", "generic")  # which gets zeros also where a pause stops it before the signal
    base.wait_until(lambda base: base.moving())
    pid = graph.processes["drive"].pid
    (guard,) = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    since = time.monotonic()
    graph.processes["drive"].send_signal(signal.SIGINT)
    base.first_zero(since)
    # The second signal may come when the goodbye is over, and then ends what is left of Python.
    assert graph.end("drive", signal.SIGINT) in (0, Exit.STOPPED, -signal.SIGINT), graph.log("drive")
    assert not Path(f"/proc/{guard}").exists()
    base.wait_until(lambda base: [one[1:] for one in base.commands[-5:]] == [(0.0, 0.0)] * 5)


def test_second_commander_makes_the_bridge_stand_and_name_it(graph, policy):
    graph.start("simulate", "--simulator", "point_robot:EndlessRobot")
    graph.start("drive", policy)
    graph.wait_for("drive", "driving")
    code = ("import rclpy, time; from geometry_msgs.msg import Twist; rclpy.init(); "
            "node = rclpy.create_node('joystick'); "
            "publisher = node.create_publisher(Twist, '/whill/controller/cmd_vel', 1); time.sleep(600)")
    graph.processes["joystick"] = subprocess.Popen([sys.executable, "-c", code], env=graph.environment)
    graph.wait_for("drive", "another node publishes commands")
    graph.wait_for("drive", "has other publishers: /joystick")


@pytest.mark.parametrize("damage", ["missing", "hash"])
def test_refused_policy_ends_the_node_with_an_error_before_it_joins_the_graph(graph, policy, damage):
    if damage == "hash":
        (policy / "policy.onnx").write_bytes(b"x")
    graph.start("drive", policy if damage == "hash" else policy.with_name("nowhere"))
    assert graph.wait("drive") == Exit.FAULT
    assert ("SHA-256" if damage == "hash" else "does not exist") in graph.log("drive")


def test_unarmed_bridge_stands_before_a_good_camera_until_it_is_armed(graph, policy, tmp_path):
    graph.start("simulate", "--simulator", "point_robot:EndlessRobot", "--results", tmp_path / "results.json")
    graph.start("drive", policy, "--require-arm", "--ros-args", "-p", "use_sim_time:=true")  # and nobody sends /clock
    graph.wait_for("drive", "disarmed: not armed")
    time.sleep(1.0)
    assert graph.end("drive") == 0 and graph.end("simulate") == 0
    assert json.loads((tmp_path / "results.json").read_text())["commands"] == []  # the rider keeps the joystick

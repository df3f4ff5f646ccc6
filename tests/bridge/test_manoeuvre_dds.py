"""Manoeuvres over real DDS: driven as written, recorded, stopped by whatever stops the vehicle."""

import csv
import json
import signal
from contextlib import suppress

import numpy as np
import pytest

from benchmarks.bridge_robot import message_type


def rows(path):
    with open(path, encoding="utf-8", newline="") as file:
        return [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]


@pytest.fixture
def commands(tmp_path):
    path = tmp_path / "ahead.csv"
    path.write_text("t,v,omega\n0,0.4,0\n1.5,0,0\n")
    return path


def start(graph, commands, *options, space=(6, 4)):
    graph.start("simulate", "--simulator", "point_robot:RovingRobot", "--wait", 0)
    graph.start("manoeuvre", commands, "--space", *space, "--dataset", commands.parent / "logs", *options)
    robot = graph.peer("operator")
    robot.watch()
    robot.wait_for_status(state="disarmed", holds="[]")
    return robot


def recorded(logs):
    """Whether some replicate has commands by now, on its way or put aside."""
    with suppress(FileNotFoundError):  # its folder gets another name at any moment
        return any(path.read_text().count("\n") > 2 for path in logs.rglob("command.csv"))
    return False


def arm_again_and_again(robot):
    """Arm each half second: a pause of a busy machine stops a replicate, which then begins again."""
    arm = message_type("std_msgs/Empty")
    return robot.repeat(robot.publisher("std_msgs/Empty", "bridge/rearm"), 0.5, arm)


def test_replicates_are_driven_until_all_are_whole_and_recorded(graph, commands):
    robot = start(graph, commands, "--repeat", 2)
    arm_again_and_again(robot)
    assert graph.wait("manoeuvre", 600) == 0, graph.log("manoeuvre")
    trials = commands.parent / "logs" / "trials"
    assert sorted(path.name for path in trials.iterdir()) == ["ahead_1", "ahead_2"]
    for trial in trials.iterdir():
        command, odometry = rows(trial / "command.csv"), rows(trial / "odometry.csv")
        assert max(row["v"] for row in command) == pytest.approx(0.4) and command[0]["v"] == command[-1]["v"] == 0
        first, last = (pick(row["t"] for row in command if row["v"]) for pick in (min, max))
        assert first > 0.5 and command[-1]["t"] - last > 0.5 and last - first == pytest.approx(1.5, abs=0.6)
        # The simulator moves 0.05 s with each message. A pause of it alone shortens the way, and nobody can know.
        in_force = np.searchsorted([row["t"] for row in command], [row["t"] for row in odometry], "right") - 1
        moved = 0.05 * sum(command[max(number, 0)]["v"] for number in in_force)
        assert odometry[-1]["x"] == pytest.approx(moved, abs=0.25) and moved < 0.4 * 1.5 + 0.25
    sysid_log = pytest.importorskip("sysid.logs.log")
    assert [trial.manoeuvre for trial in sysid_log.load_log(commands.parent / "logs").trials] == ["ahead"] * 2


def test_a_drive_that_a_person_ends_is_put_aside_and_no_trial(graph, commands):
    commands.write_text("t,v,omega\n0,0.2,0\n60,0,0\n")
    robot, logs = start(graph, commands, space=(20, 4)), commands.parent / "logs"
    timer = arm_again_and_again(robot)
    robot.wait_until(lambda _: recorded(logs))
    timer.cancel()
    collided = message_type("std_msgs/Bool")(data=True)
    robot.repeat(robot.publisher("std_msgs/Bool", "collision_sensor"), 0.1, lambda: collided)
    graph.wait_for("manoeuvre", "stopped on the way")
    assert graph.end("manoeuvre", signal.SIGINT) == 3
    assert not list((logs / "trials").iterdir())
    asides = list((logs / "aborted").iterdir())  # of a pause, too
    assert any(rows(aside / "command.csv") for aside in asides)
    assert all(json.dumps(str(aside))[1:-1] in graph.log("manoeuvre") for aside in asides)


def test_a_drive_that_the_operator_interrupts_is_put_aside_and_cannot_be_recovered_as_a_trial(graph, commands):
    commands.write_text("t,v,omega\n0,0.2,0\n60,0,0\n")
    graph.start("simulate", "--simulator", "point_robot:RovingRobot", "--wait", 0)
    logs = commands.parent / "logs"
    graph.start("manoeuvre", commands, "--space", 20, 4, "--dataset", logs)
    robot = graph.peer("operator")
    arm_again_and_again(robot)
    robot.wait_until(lambda _: recorded(logs))
    assert graph.end("manoeuvre", signal.SIGINT) == 3, graph.log("manoeuvre")
    assert not list(logs.glob("trials/*")) and not list(logs.glob(".*.partial-*"))
    assert any(rows(aside / "command.csv") for aside in (logs / "aborted").iterdir())


def test_a_trial_that_exists_is_refused_before_anything_moves(graph, commands):
    (commands.parent / "logs" / "trials" / "ahead_2").mkdir(parents=True)
    graph.start("manoeuvre", commands, "--space", 6, 4, "--dataset", commands.parent / "logs", "--repeat", 2)
    assert graph.wait("manoeuvre") == 2 and "ahead_2: exists already" in graph.log("manoeuvre")

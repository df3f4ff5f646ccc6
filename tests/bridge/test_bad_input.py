"""What users and other nodes feed by mistake: it is refused or left out by name, and nothing good is lost by it."""

import argparse
import ast
import json
import math
import re
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from bridge import __main__ as listing
from bridge import drive, guard, manoeuvre, record, simulate
from bridge.chair_joy import ZEROS, Expiry, JoyNode
from bridge.driving import vehicle_node
from bridge.nodes import parameters, ros
from bridge.nodes.commands import finite_command
from bridge.nodes.exits import Exit, OptionError
from bridge.policy import SensorInput
from bridge.recording.record_node import planar_pose
from bridge.recording.recovery import recover
from bridge.recording.split_writer import SplitWriter
from bridge.recording.trial_writer import TrialWriter, left_out
from bridge.sensing.sense_topics import reader_of
from bridge.sensing.senses import Scan, SenseError, rays_of
from bridge.sensing.view import read_calibration, view_of
from bridge.simulation.simulator_choice import ready_vehicle

pytestmark = pytest.mark.quick
ROOT = Path(__file__).parents[2]


def quaternion(w=0.0, x=0.0, y=0.0, z=0.0):
    return SimpleNamespace(w=w, x=x, y=y, z=z)


def odometry(x=0.0, orientation=None, v=0.0):
    """A made-up nav_msgs/Odometry."""
    pose = SimpleNamespace(position=SimpleNamespace(x=x, y=0.0), orientation=orientation or quaternion(1.0))
    twist = SimpleNamespace(linear=SimpleNamespace(x=v), angular=SimpleNamespace(z=0.0))
    header = SimpleNamespace(stamp=SimpleNamespace(sec=1, nanosec=0))
    return SimpleNamespace(header=header, pose=SimpleNamespace(pose=pose), twist=SimpleNamespace(twist=twist))


def imu(force=0.0, turn=0.0):
    """A made-up sensor_msgs/Imu with the first numbers of its two covariances."""
    vector = SimpleNamespace(x=0.0, y=0.0, z=0.0)
    return SimpleNamespace(linear_acceleration=vector, angular_velocity=vector,
                           linear_acceleration_covariance=[force] * 9, angular_velocity_covariance=[turn] * 9)


def reader(kind, count):
    return reader_of(SensorInput(kind, kind, (count,)), lambda name, pose: pose)


@pytest.mark.parametrize("bad", [(math.nan, 0.0, 0.0), (1.0, math.inf, 0.0), (1.0, 0.0, math.nan), (1.0, 0, math.inf)])
@pytest.mark.parametrize("at", [0, 1, 3])
def test_a_pose_that_is_not_finite_costs_the_recording_that_pose_alone(bad, at, tmp_path):
    writer = TrialWriter(tmp_path, "a")
    poses = [(2.0 + 0.1 * i, 0.0, 0.0) for i in range(4)]
    poses.insert(at, bad)
    for i, pose in enumerate(poses):
        writer.odometry(0.1 * i, pose, (0.0, 0.0))
    assert writer.rows["odometry"] == 4 and writer.left_out == {**dict.fromkeys(writer.rows, 0), "odometry": 1}
    rows = np.loadtxt(writer.close() / "odometry.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(rows[:, 1], [0.0, 0.1, 0.2, 0.3], atol=1e-6)


def test_a_recorder_says_of_what_it_left_out_how_many(tmp_path, capsys):
    writer = SplitWriter(tmp_path, "drive", 1.0, record.say_trial)
    for i in range(4):
        writer.odometry(0.1 * i, (math.nan if i % 2 else 0.1 * i, 0.0, 0.0), (0.5, 0.0))
    assert record.finish(writer)
    assert "odometry: 2 messages were left out" in capsys.readouterr().err and left_out({"imu": 0}) == []


@pytest.mark.parametrize("yaw", [0.0, 1.0, -3.0])
@pytest.mark.parametrize("length", [1e-3, 1.0, 2.0])
def test_the_yaw_of_a_quaternion_does_not_depend_on_its_length(yaw, length):
    q = quaternion(length * math.cos(yaw / 2), z=length * math.sin(yaw / 2))
    assert ros.yaw_of(q) == pytest.approx(yaw)


@pytest.mark.parametrize("q", [quaternion(), quaternion(math.nan), quaternion(1.0, z=math.inf)])
def test_an_orientation_that_is_none_gives_no_yaw_to_a_log_and_no_odometry_to_a_policy(q):
    assert math.isnan(planar_pose(odometry(orientation=q))[2])
    with pytest.raises(SenseError, match="not all finite"):
        reader("odometry", 5)(odometry(orientation=q))


def test_odometry_far_from_the_origin_of_a_map_keeps_its_centimetres():
    read = reader("odometry", 5)
    (a, _), (b, _) = read(odometry(x=4_500_000.0)), read(odometry(x=4_500_000.01))
    assert b[0] - a[0] == pytest.approx(0.01, abs=1e-6)


@pytest.mark.parametrize("message", [odometry(x=1e300), odometry(v=math.nan)])
def test_odometry_that_no_policy_can_read_is_refused_with_its_values(message):
    with pytest.raises(SenseError, match=r"values .*(1e\+300|nan).* are not all finite"):
        reader("odometry", 5)(message)


@pytest.mark.parametrize("message", [imu(force=-1.0), imu(turn=-1.0)])
def test_an_imu_that_says_that_it_does_not_measure_is_not_read(message):
    with pytest.raises(SenseError, match="covariance of -1"):
        reader("imu", 6)(message)
    assert reader("imu", 6)(imu())[0].shape == (6,)


def scan(ranges, least):
    return Scan(-0.75 * math.pi, math.pi / 2, least, 20.0, np.array(ranges, np.float32))


@pytest.mark.parametrize("given, why", [
    (scan([1.0] * 4, math.nan), "range_min"), (scan([1.0] * 4, math.inf), "range_min"),
    (scan([-2.0] * 4, -5.0), "range_min"), (scan([0.0] * 4, 0.0), "scanner is blind"),
])  # fmt: skip
def test_a_scan_without_a_sound_least_range_or_of_zeros_is_refused(given, why):
    with pytest.raises(SenseError, match=why):
        rays_of(given, SensorInput("lidar", "lidar", (4,), {"reach": 8.0}))


def test_no_ray_is_longer_than_the_reach():
    shown = rays_of(scan([-np.inf, np.inf, 9.5, 19.0], 9.0), SensorInput("lidar", "lidar", (4,), {"reach": 8.0}))
    assert shown.tolist() == [8.0] * 4


CALIBRATION = {"image_width": 64, "image_height": 64, "distortion_model": "plumb_bob",
               "camera_matrix": {"data": [60.0, 0, 32, 0, 60.0, 32, 0, 0, 1]},
               "distortion_coefficients": {"data": [0.0] * 4}}


@pytest.mark.parametrize("field, value", [
    ("distortion_model", ["plumb_bob"]), ("distortion_model", {}), ("distortion_coefficients", {"data": [True] * 4}),
    ("camera_matrix", {"data": [10**400, 0, 32, 0, 60.0, 32, 0, 0, 1]}),
])  # fmt: skip
def test_a_calibration_with_values_of_the_wrong_kind_is_refused_by_field(field, value, tmp_path):
    path = tmp_path / "camera.yaml"  # JSON is YAML
    path.write_text(json.dumps(CALIBRATION))
    assert read_calibration(path).matrix == (60.0, 60.0, 32.0, 32.0)
    path.write_text(json.dumps({**CALIBRATION, field: value}))
    with pytest.raises(ValueError, match=f"camera.yaml: {field}"):
        read_calibration(path)


def test_an_abbreviated_option_is_refused_since_a_parameter_would_win_over_it(capsys):
    words = parameters.with_options(["--ros-args", "-p", "v_limits:=[-1.0, 1.0]"], "bridge_drive", "policy",
                                    ["policy", "--v-lim", "0", "0.1"])
    with pytest.raises(SystemExit) as ended:
        drive.parse_arguments(words)
    assert ended.value.code == Exit.REFUSED and "--v-lim" in capsys.readouterr().err


def test_a_small_negative_number_is_a_number_on_the_command_line_and_as_a_parameter():
    assert drive.parse_arguments(["policy", "--v-limits", "-1e-1", "0.3"]).v_limits == [-0.1, 0.3]
    words = parameters.as_options(["--ros-args", "-p", "v_limits:=[-0.00001, 0.3]"], "bridge_drive", "policy")
    assert drive.parse_arguments(["policy", *words]).v_limits == [-1e-5, 0.3]


@pytest.mark.parametrize("option", ["--frame-age", "--stamp-age", "--signal-age"])
def test_an_age_that_nothing_keeps_is_refused(option, capsys):
    with pytest.raises(SystemExit):
        drive.parse_arguments(["policy", option, "0"])
    assert f"{option}: 0 must be above 0" in capsys.readouterr().err


def test_a_crop_without_pixels_is_refused():
    with pytest.raises(OptionError, match="--crop 0 0 0 3: HEIGHT and WIDTH"):
        view_of(SensorInput("camera", "camera", (64, 64, 3)), (0, 0, 0, 3))


def test_the_list_of_commands_takes_no_words(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["bridge", "chair-joy", "--full"])
    with pytest.raises(SystemExit) as ended:
        listing.main()
    told = capsys.readouterr()
    assert ended.value.code == Exit.REFUSED and not told.out and "Type python -m bridge.chair_joy." in told.err


def test_replicates_are_looked_up_among_the_trials_that_are_there(tmp_path):
    for name in ("run_7", "run_2", "run_07", "other", "run_x"):
        (tmp_path / "trials" / name).mkdir(parents=True)
    options = SimpleNamespace(dataset=tmp_path, trial="run", first=3, repeat=1_000_000_000)
    assert manoeuvre.trial_names(options) == ["run_3", "run_7"]


def test_a_recording_of_nothing_leaves_no_trial_which_a_reader_of_the_dataset_would_refuse(tmp_path, capsys):
    assert record.finish(TrialWriter(tmp_path, "empty"))
    assert "nothing was recorded" in capsys.readouterr().err and not list(tmp_path.iterdir())


def test_two_killed_recordings_of_one_name_are_both_left_as_they_are(tmp_path):
    partials = [tmp_path / f".a.partial-{number}" for number in (2**30, 2**30 + 1)]
    for partial in partials:
        partial.mkdir()
        (partial / "odometry.csv").write_text("t\n1.0\n2.")
    with pytest.raises(ValueError, match="Rename one of them"):
        recover(tmp_path)
    assert [(one / "odometry.csv").read_text() for one in partials] == ["t\n1.0\n2."] * 2


@pytest.mark.parametrize("cause", ["folder gone", "no space"])
def test_results_that_cannot_be_written_are_reported_and_end_no_drive(cause, tmp_path, monkeypatch, capsys):
    path = tmp_path / "results" / "drive.json"
    if cause == "no space":
        path.parent.mkdir()
        path.write_text("before")
        monkeypatch.setattr(ros.os, "replace", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    assert not ros.write_results("bridge.drive", path, {"counts": {}})
    line = capsys.readouterr().err
    assert line.count("\n") == 1 and str(path) in line and "The results are not written" in line
    assert [one.read_text() for one in path.parent.glob(".*")] == []
    assert cause == "folder gone" or path.read_text() == "before"


@pytest.mark.parametrize("v, omega", [(math.nan, 0.1), (0.1, math.inf)])
def test_a_command_that_is_not_finite_counts_as_zero_and_is_named(v, omega):
    said = []
    logger = SimpleNamespace(warning=lambda text, **_: said.append(text))
    node = SimpleNamespace(get_logger=lambda: logger, resolve_topic_name=lambda topic: f"/left/{topic}")
    assert finite_command(node, "cmd_vel", v, omega) == (0.0, 0.0)
    assert finite_command(node, "cmd_vel", 0.1, 0.2) == (0.1, 0.2)
    assert len(said) == 1 and said[0].startswith(f"/left/cmd_vel: a command v {v:g} m/s")


@pytest.mark.parametrize("commanded", [False, True])
def test_the_joystick_is_left_to_its_rider_at_the_end_unless_a_command_moved_the_chair(commanded, monkeypatch):
    monkeypatch.setattr("bridge.chair_joy.PERIOD", 0.0)
    node, sent = JoyNode.__new__(JoyNode), []
    node._expiry, node.publish = Expiry(), lambda *command: sent.append(command)
    if commanded:
        node._expiry.command(10.0)
    node.close()
    assert sent == [(0.0, 0.0)] * (ZEROS if commanded else 0)


@pytest.mark.parametrize("source, told", [
    ("def make(:", "SyntaxError"), ("def make(task):\n    pass", "unexpected keyword argument"),
    ("def make(**k):\n    raise RuntimeError('no port')", "simulator_of_mine.py, line 2"),
    ("def make(**k):\n    return 3", "no attribute 'reset'"),
    ("def make(**k):\n    open('no.urdf')", "simulator_of_mine.py, line 2.*no.urdf"),
    ("def make(**k):\n    raise ValueError('of shape (3,)')", "simulator_of_mine.py, line 2.*shape"),
])  # fmt: skip
def test_an_error_in_a_simulator_of_the_users_own_is_one_line_with_its_place(source, told, tmp_path, monkeypatch):
    (tmp_path / "simulator_of_mine.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "simulator_of_mine", raising=False)
    with pytest.raises(OptionError, match=told) as refused:
        ready_vehicle(simulate.parse_arguments(["--simulator", "simulator_of_mine:make"]))
    assert str(refused.value).startswith("--simulator simulator_of_mine:make: ")


@pytest.mark.parametrize("topic", ["whill/controller/cmd_vel", "/whill/controller/cmd_vel"])
def test_a_bridge_that_would_yield_to_itself_is_refused(topic):
    pytest.importorskip("std_msgs")
    from bridge.driving.vehicle_node import VehicleNode

    node = SimpleNamespace(resolve_topic_name=lambda name: "/" + name.strip("/"), get_namespace=lambda: "/",
                           get_name=lambda: "bridge_drive")
    options = argparse.Namespace(command_topic=ros.COMMAND_TOPIC, command_type="auto", yield_to=[topic])
    with pytest.raises(OptionError, match="would yield to itself"):
        VehicleNode(node, SimpleNamespace(supervisor=None), options)


@pytest.mark.parametrize("words, code", [
    ("--bogus", Exit.REFUSED), ("-r __ns:=/9a", Exit.REFUSED), ("--log-level nope", Exit.REFUSED), ("-r", Exit.REFUSED),
    ("-p use_sim_time:=maybe", Exit.FAULT),
])  # fmt: skip
@pytest.mark.parametrize("command", ["guard", "record"])
def test_arguments_that_ros_refuses_end_with_one_line_and_leave_nothing(command, words, code, tmp_path, capsys):
    pytest.importorskip("rclpy")
    own = [str(tmp_path / "logs"), "a"] if command == "record" else []
    with pytest.raises(SystemExit) as ended:
        {"guard": guard, "record": record}[command].main([*own, "--ros-args", *words.split()])
    line = capsys.readouterr().err + (ended.value.code if isinstance(ended.value.code, str) else "")
    found = Exit.FAULT if isinstance(ended.value.code, str) else ended.value.code
    assert found == code and "orrect" in line and words.split()[-1].rpartition("=")[2] in line
    assert not list(tmp_path.iterdir())


def test_an_environment_in_which_ros_does_not_start_is_named(monkeypatch):
    pytest.importorskip("rclpy")
    monkeypatch.setenv("ROS_DOMAIN_ID", "seventeen")
    with pytest.raises(SystemExit, match="ROS does not start: .*ROS_DOMAIN_ID"):
        guard.main([])


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="signals of POSIX")
def test_ctrl_c_during_the_imports_of_a_command_ends_it_with_one_line(tmp_path):
    (tmp_path / "numpy.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGINT)\nsignal.pause()\n")
    ended = subprocess.run([sys.executable, "-m", "bridge.drive", "policy"], cwd=tmp_path, capture_output=True,
                           text=True, env={"PYTHONPATH": f"{tmp_path}:{ROOT}"}, timeout=200,
                           preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler))
    assert ended.returncode == Exit.STOPPED and ended.stderr == "bridge: stopped before the work began (SIGINT)\n"


@pytest.mark.parametrize("path", sorted((ROOT / "bridge").rglob("*.py")), ids=lambda path: path.stem)
def test_no_message_shows_a_name_in_braces_in_place_of_its_value(path):
    tree = ast.parse(path.read_text())
    known = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
    texts = [node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)]
    assert not [text for text in texts if known & set(re.findall(r"\{(\w+)\}", text))]


@pytest.mark.parametrize(("readings", "offset"), [([5.0, 5.01], 95.0), ([5.0, 5.2], None)])
def test_a_pause_between_the_readings_of_two_clocks_is_no_step_of_one(readings, offset, monkeypatch):
    steady = iter(readings)
    monkeypatch.setattr(vehicle_node, "time", SimpleNamespace(monotonic=lambda: next(steady), time=lambda: 100.0))
    assert vehicle_node.clock_offset() == offset

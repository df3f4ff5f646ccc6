"""The robot's side runs on Python 3.10 and on Humble's rclpy."""

import ast
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.quick
ROOT = Path(__file__).resolve().parents[2]
MODULES = sorted((ROOT / "bridge").rglob("*.py"))
LATER = {"tomllib", "StrEnum", "UTC", "Self", "ExceptionGroup", "BaseExceptionGroup", "assert_never", "override",
         "LiteralString", "reveal_type", "TaskGroup", "batched", "itertools.batched", "add_note"}
"""Names of the standard library that came after Python 3.10."""


@pytest.mark.parametrize("path", MODULES, ids=lambda path: path.name)
def test_module_is_python_3_10(path):
    tree = ast.parse(path.read_text(encoding="utf-8"), feature_version=(3, 10))
    names = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
    names |= {node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            names |= {alias.name for alias in node.names} | {getattr(node, "module", None) or ""}
    assert not names & LATER
    constants = {node.value for node in ast.walk(tree) if isinstance(node, ast.Constant)}
    assert "-P" not in constants  # an option of the interpreter from 3.11 on


def test_modules_compile_under_python_3_10_where_there_is_one(tmp_path):
    found = [shutil.which("python3.10"), *Path.home().glob(".pyenv/versions/3.10*/bin/python3.10")]
    for python in filter(None, found):
        ask = [python, "-c", "import sys; print(sys.version_info[:2])"]
        if subprocess.run(ask, capture_output=True, text=True).stdout.strip() == "(3, 10)":
            break
    else:
        pytest.skip("there is no Python 3.10")
    code = "import sys, pathlib\nfor name in sys.argv[1:]:\n    compile(pathlib.Path(name).read_text(), name, 'exec')"
    subprocess.run([python, "-c", code, *map(str, MODULES)], check=True, cwd=tmp_path)


START = """
import json, sys, time, types
clock = [100.0]
def read():
    clock[0] += 1e-5  # a loop that waits for a time ends
    return clock[0]
def sleep(seconds):
    clock[0] += seconds
# Before the modules that read them: in this time nothing is late, however busy the machine.
time.monotonic = time.perf_counter = time.time = read
time.sleep = sleep
import humble_stub
humble_stub.install()
import numpy as np
from bridge.nodes import commands
from bridge import drive, guard
from bridge.driving import drive_node, vehicle_node
from bridge.safeguards import guard_node
from bridge.driving.controller import Controller
from bridge.policy import SensorInput
from bridge.safeguards.safety import SafetyConfig

class Policy:
    contract = commands = types.SimpleNamespace(rate_hz=200.0, action_repeat=1)
    pacer = SensorInput("image", "camera", (8, 8, 3))
    sensors = {"image": pacer}
    reset = lambda self: None
    step = lambda self, image: np.array([0.2, 0.1])
    prepare = lambda self: begun.append(len(node.publishers["/whill/controller/cmd_vel"].sent))

begun = []  # commands sent before each beginning of a next step
vehicle_node.LOOK_PERIOD = commands.SETTLE = 0.0
options = drive.parse_arguments(["policy", "--guard", "other", *sys.argv[1:]])
node = humble_stub.Node("bridge_drive")
kind = "TwistStamped" if "stamped" in options.image_topic else "Twist"
node.topics["/whill/controller/cmd_vel"] = f"geometry_msgs/msg/{kind}"
safety = SafetyConfig((-1.0, -1.0), (1.0, 1.0), hold_zeros=False, require_arm=options.require_arm)
bridge = drive_node.DriveNode(node, Controller(Policy(), safety), options)
beat = {"guard": "other", "topic": "/whill/controller/cmd_vel", "type": kind, "ready": True, "stops": 0,
        "hears": [bridge.guard.session]}
"""
DRIVE = START + """
for i in range(6):
    node.clock.nanoseconds = (i + 1) * 10**8
    node.deliver("/bridge/guard", humble_stub.String(data=json.dumps(beat)))
    joystick = 80 if i == 5 else 0
    node.deliver("/whill/states/model_cr2", humble_stub.ModelCr2State(power_on=1, battery_power=90, joy_side=joystick))
    node.deliver("/e_stop", humble_stub.Bool(data=False))
    image = humble_stub.Image(height=8, width=8, encoding="rgb8", step=24, data=bytes([i]) * 192)
    image.header.stamp = humble_stub.Time(nanosec=(i + 1) * 10**8)
    node.deliver("/" + options.image_topic, image)
    assert begun[-1] == len(node.publishers["/whill/controller/cmd_vel"].sent)  # the next step begins after the command
    time.sleep(0.012)  # housekeeping waits until the frame is done
    node.fire()
watch = guard_node.GuardNode(humble_stub.Node("bridge_guard"), guard.parse_arguments([]))
watch.node.fire()
bridge.close()
assert isinstance(drive.ros.make_executor(), humble_stub.SingleThreadedExecutor)
sent = [getattr(message, "twist", message) for message in node.publishers["/whill/controller/cmd_vel"].sent]
reports = [report.status[0].message for report in node.publishers["/diagnostics"].sent]
assert any(report.startswith("driving") for report in reports), reports
asked = [client.asked for client in node.clients.values()]
print(json.dumps([[[message.linear.x, message.angular.z] for message in sent], asked]))
"""
ARM = START + """
(driver,) = node.clients.values()
driver.ready = False  # it unlocked at the start, and answers nothing more
for i in range(6):
    node.clock.nanoseconds = (i + 1) * 10**8
    node.deliver("/bridge/guard", humble_stub.String(data=json.dumps(beat)))
    node.deliver("/e_stop", humble_stub.Bool(data=False))
    image = humble_stub.Image(height=8, width=8, encoding="rgb8", step=24, data=bytes([i]) * 192)
    image.header.stamp = humble_stub.Time(nanosec=(i + 1) * 10**8)
    if i == 5:  # a frame comes at once, before any watch
        node.deliver("/bridge/rearm", humble_stub.Empty())
    node.deliver("/" + options.image_topic, image)
    if i < 5:
        time.sleep(0.012)
        node.fire()
print(bridge.supervisor.state.value, bridge.supervisor.holds, node.publishers["/whill/controller/cmd_vel"].sent)
"""
FAST = START + """
begun = []  # commands sent before each beginning of a next step
vehicle_node.LOOK_PERIOD = vehicle_node.STATUS_PERIOD = 0.02
vehicle_node.OVERDUE = 0.05
statuses, end = node.publishers["/bridge/status"].sent, time.monotonic() + 30
before = len(statuses)
while len(statuses) < before + 3 and time.monotonic() < end:
    node.clock.nanoseconds += 10**7
    image = humble_stub.Image(height=8, width=8, encoding="rgb8", step=24, data=bytes([len(statuses) % 9]) * 192)
    image.header.stamp = node.clock.now().to_msg()
    node.deliver("/" + options.image_topic, image)
    node.fire()  # at once: there is no pause between two steps
print(len(statuses) - before)
"""

CHAIR = """
import sys
import humble_stub
humble_stub.install()
from fake_chair import FakeChair
from bridge import chair

node = humble_stub.Node("bridge_chair")
clock = [0.0]
chair.time.monotonic = lambda: clock[0]
bridge = chair.ChairNode(node, chair.parse_arguments([]))
fake = FakeChair()
for i in range(500):
    fake.command(0.5, 0.3)
    fake.advance(0.01)
    if i % 50 == 0:
        clock[0] = fake.now
        node.deliver("/whill/states/model_cr2", humble_stub.ModelCr2State(battery_current=0.0, speed_mode_indicator=0,
                                                                         **vars(fake.state())))
last = node.publishers["/whill/odom"].sent[-1].pose.pose.position
print(last.x - fake.x, last.y - fake.y, node.logged)
"""


def run(code, folder, *arguments):
    """Run a script on the stub; return what it prints."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests" / "bridge")])}
    result = subprocess.run([sys.executable, "-c", code, *arguments], env=environment, cwd=folder, capture_output=True,
                            text=True)
    assert result.returncode == 0, result.stderr
    return result.stdout


def test_chair_node_publishes_odometry_and_names_a_slow_driver(tmp_path):
    x, y, logged = run(CHAIR, tmp_path).split(maxsplit=2)
    assert abs(float(x)) < 0.3 and abs(float(y)) < 0.3  # the chair has moved on for half a second
    assert "publish_interval_ms:=20" in logged


def test_chair_whose_rider_moves_the_joystick_is_left_to_its_rider(tmp_path):
    commands, _ = json.loads(run(DRIVE, tmp_path, "--image-topic", "camera", "--whill-state", "whill/states/model_cr2"))
    assert [0.2, 0.1] in commands and [0.0, 0.0] not in commands  # the last state but one had the joystick moved


@pytest.mark.parametrize("topic", ["camera", "camera_of_a_base_with_stamped_commands"])
def test_nodes_drive_on_the_names_of_humble_alone(tmp_path, topic):
    commands, asked = json.loads(run(DRIVE, tmp_path, "--image-topic", topic))
    assert [0.2, 0.1] in commands and commands[-5:] == [[0.0, 0.0]] * 5 and asked == []


def test_joystick_is_locked_while_the_vehicle_is_armed_and_unlocked_when_its_rider_moves_it(tmp_path):
    words = ("--image-topic", "camera", "--whill-state", "whill/states/model_cr2", "--joystick-lock")
    commands, asked = json.loads(run(DRIVE, tmp_path, *words))
    assert [0.2, 0.1] in commands and asked == [[1, 0]]


def test_frame_that_comes_right_after_arming_does_not_drive_before_the_joystick_is_locked(tmp_path):
    said = run(ARM, tmp_path, "--image-topic", "camera", "--require-arm", "--resume", "arm", "--joystick-lock")
    assert said.strip() == 'standing ["the chair\'s joystick is not locked"] []'


def test_policy_whose_steps_come_one_upon_the_other_still_reports_its_status(tmp_path):
    assert run(FAST, tmp_path, "--image-topic", "camera").strip() == "3"

"""Every cause is named with its remedy while it lasts, and only then."""

import dataclasses

import pytest

from bridge.driving.diagnosis import Evidence, FrameLog, causes, input_cause, is_mixed
from bridge.nodes.commands import Endpoint
from bridge.policy import SensorInput
from bridge.sensing.sense_topics import topics_of
from bridge.sensing.senses import Stream

pytestmark = pytest.mark.quick
IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
TWIST, STAMPED = "geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"


def frames(rate=10.0, age=0.01, pace=1.0, changing=True, lost=0, pause_at=None, seconds=2.0, set_at=None):
    log = FrameLog()
    now = 100.0
    while now < 100.0 + seconds:
        step = 10.0 if set_at is not None and now > 100.0 + set_at else 0.0
        log.frame(now, now * pace + step, age, int(now * 1000) if changing else 7)
        now += 1 / rate + (0.5 if pause_at is not None and abs(now - 100 - pause_at) < 0.5 / rate else 0)
    if lost:
        log.lost(now, lost)
    log.trim(now)
    return log


GOOD = Evidence(
    image_topic="/camera", image_type=IMAGE, cameras=[Endpoint("/camera_driver", IMAGE)], frames=frames(), rate_hz=10.0,
    stamp_limit=0.3, command_topic="/cmd_vel", command_type="Twist", listeners=[Endpoint("/base", TWIST)], guard="")


def found(**changes):
    return causes(dataclasses.replace(GOOD, **changes))


def test_nothing_is_named_where_all_is_well():
    assert found() == []
    assert found(frames=frames(rate=30)) == [] and found(frames=frames(pause_at=1.0)) == []


@pytest.mark.parametrize("changes, texts", [
    ({"cameras": [], "frames": FrameLog()}, ["no publisher on /camera", "ROS_DOMAIN_ID"]),
    ({"frames": FrameLog()}, ["1 publisher(s) matched but no frame arrives", "fastdds.xml"]),
    ({"frames": FrameLog(), "incompatible": True}, ["quality of service", "change it"]),
    ({"cameras": [Endpoint("/x", COMPRESSED)], "frames": FrameLog()}, [COMPRESSED, "--compressed"]),
    ({"cameras": [Endpoint("/x", "std_msgs/msg/String")], "frames": FrameLog()}, ["std_msgs/msg/String", "own topic"]),
    ({"cameras": GOOD.cameras * 2}, ["2 publishers", "/camera_driver", "stop or remap"]),
    ({"frames": frames(rate=5)}, ["5.0 frames/s arrive, the policy needs 10", "raise"]),
    ({"frames": frames(rate=1), "image_bytes": 921600}, ["1.0 frames/s arrive", "fastdds.xml"]),
    ({"frames": frames(lost=4)}, ["4 were reported lost", "fastdds.xml"]),
    ({"frames": frames(age=10.0)}, ["10.00 s behind", "chrony"]),
    ({"frames": frames(age=-10.0)}, ["10.00 s ahead of", "--stamp-age inf"]),
    ({"frames": frames(pace=0.5)}, ["0.50 times real time", "--pace stamp"]),
    ({"frames": frames(pace=0.0, age=1e9)}, ["the same stamp", "header.stamp"]),
    ({"frames": frames(changing=False)}, ["do not change", "frozen"]),
    ({"unusable": "image encoding '8UC3'"}, ["8UC3"]),
    ({"blind": True}, ["uniformly black or white", "exposure"]),
    ({"silence": 1.2}, ["fell silent 1.2 s ago"]),
    ({"listeners": [], "command_type": ""}, ["no base listens on /cmd_vel", "start its driver"]),
    ({"listeners": [Endpoint("/base", STAMPED)]}, [STAMPED, "the bridge sends Twist", "--command-type auto"]),
    ({"listeners": [Endpoint("/base", "std_msgs/msg/String")], "command_type": ""}, ["cannot send"]),
    ({"listeners": [Endpoint("/base", TWIST, hears=False)]}, ["the base on /cmd_vel asks for a quality of service"]),
    ({"commanders": ["/joystick"]}, ["/joystick", "twist_mux"]),
    ({"guard": "no guard is running"}, ["no guard is running"]),
])
def test_cause_is_named_once_with_its_remedy(changes, texts):
    (text,) = found(**changes)
    assert all(part in text for part in texts)


@pytest.mark.parametrize("set_at", [0.05, 1.0, 1.85])
def test_clock_that_is_set_once_is_no_simulator_off_real_time(set_at):
    assert found(frames=frames(set_at=set_at)) == []


def test_several_causes_are_all_named():
    assert len(found(frames=frames(rate=5, age=10.0), commanders=["/joystick"], listeners=[])) == 4


def test_first_seconds_excuse_what_the_graph_may_not_know_yet():
    assert found(cameras=[], frames=FrameLog(), listeners=[], command_type="", guard="no guard is running",
                 starting=True) == []


def test_camera_that_has_just_come_is_not_judged_yet():
    assert found(frames=FrameLog(), settled=False) == []
    assert found(frames=frames(seconds=0.15), settled=False) == []
    log = FrameLog()
    assert not log.is_full(100.0)
    log.frame(100.0, 0.0, 0.0, 1)
    assert not log.is_full(101.9) and log.is_full(102.0)


def test_simulator_off_real_time_is_no_fault_where_the_stamps_set_the_pace():
    assert found(frames=frames(rate=3, pace=0.3), pace_by_stamp=True) == []


def test_cause_is_gone_when_the_window_has_passed():
    log = frames(lost=3)
    log.trim(105.0)
    assert log.losses == 0 and log.count == 0


SENSORS = {"camera": SensorInput("camera", "camera", (8, 8, 3)), "lidar": SensorInput("lidar", "lidar", (4,)),
           "odometry": SensorInput("odometry", "odometry", (5,))}
KINDS = {name: topic.full_kind for name, topic in topics_of(SENSORS).items()}
OTHER = "std_msgs/msg/String"


def publishers(**more):
    """One publisher of each input, and more of those that are named."""
    return {name: [Endpoint("/robot", kind), *more.get(name, [])] for name, kind in KINDS.items()}


def cause_of(name, found):
    return input_cause(name, f"/{name}", KINDS[name], found[name], Stream(SENSORS[name], 0.5, 0.3), 100.0)


def test_one_publisher_of_each_input_drives():
    assert not is_mixed(publishers(), KINDS) and not is_mixed(dict.fromkeys(KINDS, []), KINDS)


@pytest.mark.parametrize("name", ["lidar", "odometry"])
@pytest.mark.parametrize("node", ["/second", "/robot"])
@pytest.mark.parametrize("third", [[], [Endpoint("/third", OTHER)]])
def test_two_publishers_of_an_input_hold_and_are_named_whatever_else_is_sent_there(name, node, third):
    found = publishers(**{name: [Endpoint(node, KINDS[name]), *third]})
    assert is_mixed(found, KINDS)
    assert f"2 publishers (/robot, {node}): their messages mix" in cause_of(name, found)


@pytest.mark.parametrize("name", ["lidar", "odometry"])
def test_a_publisher_of_a_wrong_type_is_named_and_holds_nothing(name):
    found = publishers(**{name: [Endpoint("/second", OTHER)]})
    assert not is_mixed(found, KINDS)
    assert f"carries {OTHER}" in cause_of(name, found)


@pytest.mark.parametrize("kind, other", [(IMAGE, COMPRESSED), (COMPRESSED, IMAGE)])
@pytest.mark.parametrize("node", ["/second", "/camera"])
def test_two_cameras_hold_where_both_send_what_is_read(kind, other, node):
    first, third = Endpoint("/camera", kind), Endpoint("/third", other)
    for more, held in (([Endpoint(node, kind)], True), ([Endpoint(node, kind), third], True), ([third], False)):
        cameras = [first, *more]
        assert is_mixed({"camera": cameras}, {"camera": kind}) is held
        said = f"2 publishers (/camera, {node}): their images mix" in " ".join(found(cameras=cameras, image_type=kind))
        assert said is held

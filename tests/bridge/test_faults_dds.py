"""Faults of camera, clock and base, injected on real DDS while the policy drives."""

import time

import pytest

from benchmarks.bridge_robot import message_type


def driven(graph, policy, *options):
    """A robot that the bridge has begun to drive."""
    robot = graph.peer("robot")
    robot.whole()
    graph.start("drive", policy, *options)
    robot.wait_for_status(driving=True)
    return robot


def test_frozen_camera_stops_the_vehicle_until_its_pixels_change(graph, policy):
    robot = driven(graph, policy)
    robot.frozen = True
    robot.wait_for_status(reason="frozen pixels", causes="do not change")
    robot.frozen = False
    robot.wait_for_status(driving=True)


@pytest.mark.parametrize("resume", ["auto", "arm"])
def test_camera_that_restarts_is_found_again_and_driving_resumes_only_as_allowed(graph, policy, resume):
    robot = graph.peer("robot")
    robot.base(), robot.watch(), robot.e_stop()
    graph.start("drive", policy, "--resume", resume)
    robot.wait_until(lambda robot: robot.statuses)
    for number in range(5):  # where a pause of the guard, say, has stopped it for good before the camera: once more
        camera = graph.peer(f"camera_{number}")
        camera.camera()
        if resume == "arm":
            robot.drive_again()
        robot.wait_for_status(driving=True, since=0)
        camera.close()
        graph.peers.remove(camera)
        stopped = robot.wait_for_status(driving=False)
        if resume == "auto" or "frame age" in stopped["reason"]:
            break
    robot.wait_for_status(driving=False, reason="frame age")
    robot.wait_until(lambda robot: robot.commands[-1][1:] == (0.0, 0.0))
    graph.peer("camera_again").camera()
    if resume == "arm":
        robot.wait_for_status(state="disarmed", reason="frame age", causes="[]")
        robot.drive_again()
    else:
        robot.wait_for_status(driving=True)


def test_base_that_is_gone_is_named(graph, policy):
    robot = graph.peer("robot")
    robot.watch(), robot.camera(), robot.e_stop()
    base = graph.peer("base")
    base.base()
    graph.start("drive", policy)
    robot.wait_for_status(driving=True)
    base.close()
    graph.peers.remove(base)
    robot.wait_for_status(state="standing", reason="no base listens", causes="no base listens")


def test_base_whose_quality_of_service_does_not_fit_is_named_and_nothing_drives(graph, policy):
    from bridge.nodes import ros

    robot = graph.peer("robot")
    robot.watch(), robot.camera(), robot.e_stop()
    twist, heard = message_type("geometry_msgs/Twist"), []
    robot.node.create_subscription(twist, "whill/controller/cmd_vel", heard.append, ros.latched())
    graph.start("drive", policy)
    robot.wait_for_status(state="standing", holds="no base listens", causes="asks for a quality of service")
    robot.base()
    robot.wait_for_status(driving=True)
    assert not heard


def clock(robot):
    """Publish /clock as the wall clock; the offset of the result moves it."""
    kind = message_type("rosgraph_msgs/Clock")
    state = type("Clock", (), {"offset": 0.0})()

    def make():
        message, now = kind(), time.time() + state.offset
        message.clock.sec, message.clock.nanosec = int(now), int(now % 1 * 1e9)
        return message

    state.timer = robot.repeat(robot.publisher("rosgraph_msgs/Clock", "/clock"), 0.01, make)
    return state


def test_simulated_clock_that_stops_stops_the_vehicle_by_the_steady_clock(graph, policy):
    robot = graph.peer("robot")
    robot.whole()
    state = clock(robot)
    graph.start("drive", policy, "--ros-args", "-p", "use_sim_time:=true")
    robot.wait_for_status(driving=True)
    state.timer.cancel()  # the camera goes on
    robot.wait_for_status(driving=False, reason="simulated time stands")
    robot.wait_until(lambda robot: robot.commands[-1][1:] == (0.0, 0.0))


@pytest.mark.parametrize("jump", [-32.0, 90.0])
def test_simulated_clock_that_jumps_stops_the_vehicle_and_frames_of_the_new_time_resume(graph, policy, jump):
    robot = graph.peer("robot")
    robot.whole()
    state = clock(robot)
    graph.start("drive", policy, "--ros-args", "-p", "use_sim_time:=true")
    robot.wait_for_status(driving=True)
    for _ in range(10):  # where a pause had just stopped the vehicle, a jump stops nothing: once more
        state.offset = robot.clock_offset = state.offset + jump
        try:
            robot.wait_for_status(seconds=10, counts="stop: clock jump")
            break
        except AssertionError:
            robot.wait_for_status(driving=True)
    robot.wait_for_status(counts="stop: clock jump", driving=True)


def test_rider_of_a_standing_whill_can_drive_with_its_joystick(graph, policy):
    from fake_chair import FakeChair

    robot = graph.peer("robot")
    robot.watch(), robot.camera()
    stop = robot.e_stop()
    chair = FakeChair()
    robot.node.create_subscription(message_type("geometry_msgs/Twist"), "whill/controller/cmd_vel",
                                   lambda message: chair.command(message.linear.x, message.angular.z), 10)
    robot.node.create_timer(0.01, lambda: chair.advance(0.01))
    graph.start("drive", policy)
    robot.wait_until(lambda _: chair.x > 0.02 and not chair.joystick_works)
    stop.value = True
    robot.wait_for_status(state="disarmed")
    robot.wait_until(lambda _: chair.v == 0 and chair.joystick_works)
    chair.joystick, before = (50, 0), chair.x
    robot.wait_until(lambda _: chair.x > before + 0.05)


def test_lifecycle_node_drives_only_while_it_is_active(graph, policy):
    from lifecycle_msgs.msg import Transition
    from lifecycle_msgs.srv import ChangeState

    robot = graph.peer("robot")
    robot.whole()
    client = robot.node.create_client(ChangeState, "bridge_drive/change_state")
    graph.start("drive", policy, "--lifecycle")
    robot.wait_for_status(state="standing", holds="['not activated']")
    robot.wait_until(lambda _: client.service_is_ready())

    def change(transition):
        answer = client.call_async(ChangeState.Request(transition=Transition(id=transition)))
        robot.wait_until(lambda _: answer.done())
        assert answer.result().success

    change(Transition.TRANSITION_CONFIGURE)
    assert not robot.moving()
    change(Transition.TRANSITION_ACTIVATE)
    robot.wait_for_status(driving=True)
    change(Transition.TRANSITION_DEACTIVATE)
    robot.wait_for_status(state="standing", reason="not activated")
    robot.wait_until(lambda robot: robot.commands[-1][1:] == (0.0, 0.0))
    change(Transition.TRANSITION_ACTIVATE)
    robot.wait_for_status(driving=True)


@pytest.mark.parametrize("succeeds", [True, False])
def test_lifecycle_node_keeps_its_hold_where_activation_fails(graph, monkeypatch, succeeds):
    from rclpy.lifecycle import LifecycleNode
    from rclpy.lifecycle import TransitionCallbackReturn as Result

    from bridge.nodes import ros

    monkeypatch.setenv("ROS_DOMAIN_ID", str(graph.domain))
    changes = []
    with ros.node_session("managed", [], managed=True) as node:
        node.on_active_change = changes.append
        monkeypatch.setattr(LifecycleNode, "on_activate", lambda *_: Result.SUCCESS if succeeds else Result.FAILURE)
        node.trigger_configure()
        node.trigger_activate()
    assert changes == ([True] if succeeds else [])

"""The WHILL's units, signs and behaviours, on a fake chair behind its maker's driver."""

import math
import types

import numpy as np
import pytest
from fake_chair import FakeChair

from bridge.chair import ChairNode, parse_arguments
from bridge.driving.bases import WHILL
from bridge.driving.whill import (
    WHEEL_RADIUS,
    ChairGate,
    ChairState,
    WheelOdometry,
    command_of_words,
    command_words,
    reported_speed,
)
from bridge.safeguards.safety import SafetyConfig, State, Supervisor

pytestmark = pytest.mark.quick


def drive(chair, commands, interval=0.5, dt=0.005):
    """Send (seconds, v, omega) at 10 Hz; return the odometry computed from states at an interval."""
    odometry, since_state, since_command = WheelOdometry(), interval, 1.0
    for seconds, v, omega in commands:
        for _ in range(round(seconds / dt)):
            since_state, since_command = since_state + dt, since_command + dt
            if since_command >= 0.1 - 1e-9:
                chair.command(v, omega)
                since_command = 0.0
            chair.advance(dt)
            if since_state >= interval - 1e-9:
                odometry.update(chair.now, chair.state())
                since_state = 0.0
    return odometry


def test_right_wheel_counts_down_and_speeds_are_km_per_hour_when_the_chair_drives_forward():
    chair = FakeChair()
    drive_for(chair, 1.0, 0.5, 0.0)
    state = chair.state()
    assert state.left_motor_speed == pytest.approx(1.8, abs=0.02) and state.right_motor_speed == -state.left_motor_speed
    assert reported_speed(state) == pytest.approx((0.5, 0.0), abs=0.01)


def drive_for(chair, seconds, v, omega):
    for i in range(round(seconds / 0.01)):
        if i % 10 == 0:
            chair.command(v, omega)
        chair.advance(0.01)


def test_left_turn_is_positive_in_command_and_report():
    chair = FakeChair()
    drive_for(chair, 1.0, 0.0, 0.8)
    assert chair.yaw > 0.3 and reported_speed(chair.state())[1] == pytest.approx(0.8, abs=0.02)


@pytest.mark.parametrize("interval", [0.02, 0.1, 0.5])
@pytest.mark.parametrize("v, omega", [(0.3, 0.0), (-0.5, 0.0), (0.0, 1.0), (0.5, -0.6), (1.5, 0.3)])
def test_odometry_follows_the_chair_through_every_wrap_also_at_the_drivers_slow_default(interval, v, omega):
    chair = FakeChair()
    odometry = drive(chair, [(4.0, v, omega), (2.0, 0.0, 0.0)], interval)
    pose = odometry.pose
    path = max(abs(v), 0.1) * 4
    assert math.hypot(pose.x - chair.x, pose.y - chair.y) < 0.02 * path and abs(pose.yaw - chair.yaw) < 0.02
    assert odometry.gaps == 0 and (pose.v, pose.omega) == (0.0, 0.0)


def test_state_that_was_held_up_and_comes_with_the_next_one_makes_no_speed_of_its_own():
    chair, odometry = FakeChair(), WheelOdometry()
    speeds = []
    for i in range(400):
        chair.command(0.5, 0.0)
        for _ in range(4):
            chair.advance(0.005)
        held_up = 0.0199 if i % 10 == 3 else 0.0
        pose = odometry.update(chair.now + held_up, chair.state())
        speeds.append(pose.v)
    assert max(speeds) < 0.55 and min(speeds[100:]) > 0.2 and sorted(speeds)[200] == pytest.approx(0.5, abs=0.01)
    assert abs(pose.x - chair.x) < 0.01


def test_odometry_of_a_long_gap_keeps_the_pose_counts_it_and_takes_the_speed_that_the_chair_reports():
    odometry = WheelOdometry()
    odometry.update(0.0, ChairState())
    odometry.update(0.5, ChairState(left_motor_angle=0.5, right_motor_angle=-0.5))
    before = odometry.pose
    after = odometry.update(9.0, ChairState(left_motor_angle=2.5, right_motor_angle=-2.0, left_motor_speed=1.8,
                                            right_motor_speed=-1.8))
    assert (after.x, after.y, after.yaw) == (before.x, before.y, before.yaw) and before.x == pytest.approx(0.06625)
    assert odometry.gaps == 1 and (after.v, after.omega) == pytest.approx((0.5, 0.0)) and before.v != after.v
    odometry.update(9.5, ChairState(left_motor_angle=2.6, right_motor_angle=-2.1))
    assert odometry.pose.x > before.x


@pytest.mark.parametrize("v, omega, words", [
    (0.0, 0.0, (0, 0)), (1.0, 0.0, (900, 0)), (0.0019, 0.0, (1, 0)), (-0.0019, 0.0, (-1, 0)), (0.0, 1.0, (0, -446)),
    (0.0, -0.0044, (0, 1)), (0.0011, 0.0022, (0, 0)),
])
def test_commands_are_truncated_towards_zero_in_the_drivers_units(v, omega, words):
    assert command_words(v, omega) == words


def test_truncation_never_enlarges_a_command_and_loses_less_than_one_unit():
    for v, omega in np.random.default_rng(0).uniform([-0.55, -1.6], [1.6, 1.6], (1000, 2)):
        got = command_of_words(*command_words(v, omega))
        assert abs(got[0]) <= abs(v) and abs(got[1]) <= abs(omega)
        assert abs(got[0] - v) < 1 / 900 and abs(got[1] - omega) < 1 / 446.4


def test_range_of_the_base_is_the_words_range_and_commands_beyond_it_do_nothing_sensible():
    for corner in ((WHILL.low[0], WHILL.low[1]), (WHILL.high[0], WHILL.high[1])):
        forward, turn = command_words(*corner)
        assert -500 <= forward <= 1500 and -750 <= turn <= 750
    chair = FakeChair()
    drive_for(chair, 1.0, 40.0, 0.0)  # 36,000 wraps around to a negative word: never send it
    assert chair.v <= 0.0


def test_command_expires_after_200_ms_and_the_joystick_works_again():
    chair = FakeChair()
    drive_for(chair, 1.0, 0.3, 0.0)
    chair.joystick = (50, 0)
    assert not chair.joystick_works
    for _ in range(60):
        chair.advance(0.01)
    assert chair.joystick_works and chair.v == pytest.approx(0.25)
    chair.joystick = (0, 0)
    for _ in range(60):
        chair.advance(0.01)
    assert chair.v == 0.0


def ready():
    """A supervisor that drives a healthy chair."""
    supervisor = Supervisor(SafetyConfig((-0.5, -1.0), (0.5, 1.0), hold_zeros=False))
    gate = ChairGate(supervisor)
    gate.take(0.0, ChairState())
    for i in range(3):
        supervisor.frame(i / 10, i / 10, i)
    assert supervisor.state is State.DRIVING
    return supervisor, gate


@pytest.mark.parametrize("change, reason", [
    ({"power_on": 0}, "the chair's power is off"), ({"error": 7}, "the chair reports an error"),
    ({"battery_power": 19}, "battery low"),
])
def test_chair_that_is_off_broken_or_empty_is_not_driven(change, reason):
    supervisor, gate = ready()
    gate.take(0.3, ChairState(**change))
    assert not supervisor.may_drive and reason in supervisor.reason and not supervisor.arm()
    gate.take(0.5, ChairState())
    assert supervisor.arm()


def test_chair_that_is_not_heard_of_is_not_driven():
    supervisor, gate = ready()
    gate.watch(1.4)
    assert supervisor.may_drive
    gate.watch(1.6)
    assert supervisor.reason == "chair state unknown"
    assert Supervisor(SafetyConfig((-1.0, -1.0), (1.0, 1.0))).holds == []
    assert ChairGate(Supervisor(SafetyConfig((-1.0, -1.0), (1.0, 1.0)))).supervisor.holds == ["chair state unknown"]


@pytest.mark.parametrize("joystick", [{"joy_front": -15}, {"joy_side": 100}])
def test_rider_who_moves_the_joystick_takes_over_at_once_and_the_bridge_needs_arming_afterwards(joystick):
    supervisor, gate = ready()
    gate.take(0.3, ChairState(**joystick))
    assert supervisor.state is State.YIELDED and not supervisor.take_turn()
    gate.take(0.8, ChairState(**joystick))
    for now in np.arange(0.8, 3.0, 0.01):
        gate.watch(now) if now < 2.2 else None
        supervisor.tick(now)
    assert supervisor.state is State.DISARMED and supervisor.reason == "another node drove"


def test_resting_joystick_is_no_driver():
    supervisor, gate = ready()
    gate.take(0.3, ChairState(joy_front=3, joy_side=-4))
    assert supervisor.may_drive


def test_state_of_an_older_driver_lacks_the_joystick_and_is_read_all_the_same():
    fields = {name: 1 for name in ChairState.__dataclass_fields__ if not name.startswith("joy")}
    state = ChairState.of(types.SimpleNamespace(**fields))
    assert state.error == 1 and state.joy_front == 0


@pytest.mark.parametrize("change", [{"left_motor_angle": math.inf}, {"right_motor_angle": math.nan},
                                    {"right_motor_speed": -math.inf}])
def test_state_that_is_not_finite_gives_no_odometry_and_those_after_it_go_on(monkeypatch, change):
    pytest.importorskip("nav_msgs.msg")
    time = pytest.importorskip("builtin_interfaces.msg").Time
    now, published, said = [0.0], [], []
    monkeypatch.setattr("bridge.chair.ros.chair_state_type", lambda: None)
    monkeypatch.setattr("bridge.chair.time.monotonic", lambda: now[0])
    node = types.SimpleNamespace(
        create_publisher=lambda *_: types.SimpleNamespace(publish=published.append),
        create_subscription=lambda *_: None, get_logger=lambda: types.SimpleNamespace(warning=said.append),
        get_clock=lambda: types.SimpleNamespace(now=lambda: types.SimpleNamespace(to_msg=time)))
    chair = ChairNode(node, parse_arguments([]))
    for k in range(4):
        now[0] = 0.1 * k
        state = {"left_motor_angle": 0.2 * k, "right_motor_angle": -0.2 * k}
        chair._on_state(types.SimpleNamespace(**(state | change if k == 2 else state)))
    assert len(published) == 3 and chair.unusable == 1 and len(said) == 1
    assert published[-1].pose.pose.position.x == pytest.approx(0.6 * WHEEL_RADIUS)

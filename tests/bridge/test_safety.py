"""Every rule of the supervisor and every edge of its machine, with made-up times."""

import dataclasses
import itertools
import re
from pathlib import Path

import numpy as np
import pytest

from bridge.safeguards.safety import EDGES, Event, SafetyConfig, State, Supervisor

CONFIG = SafetyConfig(low=(-0.5, -1.0), high=(1.0, 1.0))
GO = np.array([0.4, 0.2])
pytestmark = pytest.mark.quick


class Drive:
    """A supervisor and the story it is told: one frame each 100 ms."""

    def __init__(self, config=CONFIG, frames=5):
        self.supervisor = Supervisor(config)
        self.now, self.digest = 100.0, 0
        for _ in range(frames):
            self.frame()

    def frame(self, action=GO, dt=0.1, **changes):
        """One frame and, where allowed, one action; returns the command in force."""
        self.now += dt
        self.digest += 1
        verdict = self.supervisor.frame(self.now, **{"stamp": self.now, "digest": self.digest, **changes})
        if verdict == "fresh" and self.supervisor.may_drive:
            return self.supervisor.action(self.now, np.asarray(action, float))
        return self.supervisor.tick(self.now)

    def tick(self, dt):
        self.now += dt
        return self.supervisor.tick(self.now)


def speeds(command):
    return command.v, command.omega


def test_vehicle_stands_until_three_fresh_frames_have_come():
    drive = Drive(frames=0)
    assert speeds(drive.tick(0.0)) == (0, 0) and drive.supervisor.reason == "no frame yet"
    assert [speeds(drive.frame()) for _ in range(3)] == [(0, 0), (0, 0), (0.4, 0.2)]


@pytest.mark.parametrize("action, expected", [
    ([2.0, 0.3], (1.0, 0.3)), ([-1.0, 0.0], (-0.5, 0.0)), ([0.1, -9.0], (0.1, -1.0)), ([1e300, -1e300], (1.0, -1.0)),
])
def test_commands_are_clamped_to_the_vehicle_and_counted(action, expected):
    drive = Drive()
    assert speeds(drive.frame(action)) == expected
    assert drive.supervisor.counts["clamped"] == 1


def test_no_output_of_any_policy_leaves_the_limits():
    rng = np.random.default_rng(0)
    drive = Drive()
    for bits in rng.integers(0, 2**64, (20_000, 2), np.uint64):
        command = drive.frame(bits.view(np.float64))
        assert -0.5 <= command.v <= 1.0 and -1.0 <= command.omega <= 1.0
        drive.supervisor.arm()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_non_finite_action_is_zero_in_the_same_tick_and_resets_the_policy(bad):
    drive = Drive()
    assert drive.supervisor.take_reset() and not drive.supervisor.take_reset()
    command = drive.frame([0.3, bad])
    assert speeds(command) == (0, 0) and command.reason == "non-finite action"
    assert drive.supervisor.take_reset()
    assert [speeds(drive.frame()) for _ in range(3)] == [(0, 0), (0, 0), (0.4, 0.2)]


@pytest.mark.parametrize("elapsed, driven", [(0.06, True), (0.3, False)])
def test_action_is_not_sent_where_its_frame_has_grown_too_old_meanwhile(elapsed, driven):
    drive = Drive()
    drive.now += 0.1
    assert drive.supervisor.frame(drive.now, drive.now, 99) == "fresh"
    command = drive.supervisor.action(drive.now, GO, elapsed)
    assert (speeds(command), command.reason) == (((0.4, 0.2), "") if driven else ((0, 0), "frame age"))


def test_three_non_finite_actions_in_ten_seconds_latch_until_rearmed():
    drive = Drive()
    for _ in range(3):
        drive.frame([np.nan, 0.0])
        for _ in range(2):
            drive.frame()
    assert drive.supervisor.latched == "repeated non-finite actions"
    assert all(speeds(drive.frame()) == (0, 0) for _ in range(20))
    assert drive.supervisor.arm()
    assert speeds(drive.frame()) == (0.4, 0.2)


def test_non_finite_actions_further_apart_do_not_latch():
    drive = Drive()
    for _ in range(5):
        drive.frame([np.nan, 0.0])
        for _ in range(60):
            command = drive.frame()
        assert speeds(command) == (0.4, 0.2)
    assert not drive.supervisor.latched


def test_command_is_held_while_its_frame_is_young_and_zero_after_250_ms():
    drive = Drive()
    drive.supervisor.take_reset()
    assert speeds(drive.tick(0.24)) == (0.4, 0.2)
    command = drive.tick(0.02)
    assert speeds(command) == (0, 0) and command.reason == "frame age"
    assert drive.supervisor.take_reset()


def test_driving_resumes_after_three_fresh_frames_in_a_row_only():
    drive = Drive()
    drive.tick(0.3)
    drive.frame(), drive.frame()
    drive.tick(0.3)
    assert [speeds(drive.frame()) for _ in range(3)] == [(0, 0), (0, 0), (0.4, 0.2)]


def test_frames_further_apart_than_the_age_limit_never_resume():
    drive = Drive(frames=0)
    assert all(speeds(drive.frame(dt=0.3)) == (0, 0) for _ in range(10))


def test_gap_before_a_late_frame_stops_even_if_no_tick_saw_it():
    drive = Drive()
    assert speeds(drive.frame(dt=0.4)) == (0, 0)
    assert drive.supervisor.counts["stop: frame age"] == 1


def test_same_stamp_sent_again_is_no_new_frame():
    drive = Drive()
    stamp = drive.now
    drive.frame(stamp=stamp), drive.frame(stamp=stamp)
    command = drive.frame(stamp=stamp)
    assert speeds(command) == (0, 0) and command.reason == "frame age"
    assert drive.supervisor.counts["repeated"] == 3


def test_identical_pixels_for_five_frames_while_moving_stop_the_vehicle_until_they_change():
    drive = Drive()
    commands = [speeds(drive.frame(digest=-1)) for _ in range(5)]
    assert commands == [(0.4, 0.2)] * 4 + [(0, 0)]
    assert all(drive.frame(digest=-1).reason == "frozen pixels" for _ in range(20))
    assert drive.supervisor.counts["stop: frozen pixels"] == 1
    assert [speeds(drive.frame()) for _ in range(3)] == [(0, 0), (0, 0), (0.4, 0.2)]


def test_parked_vehicle_may_look_at_one_picture_for_ever():
    drive = Drive()
    drive.frame([0.0, 0.0])
    assert all(drive.frame([0.01, 0.0], digest=-1).reason == "" for _ in range(50))
    commands = [speeds(drive.frame(digest=-1)) for _ in range(5)]  # and then drives off with a frozen camera
    assert commands[0] == (0.4, 0.2) and commands[-1] == (0, 0)


def test_out_of_order_frame_is_discarded_and_counted():
    drive = Drive()
    before = drive.supervisor.counts["frames"]
    drive.frame(stamp=drive.now - 0.05)
    assert drive.supervisor.counts["out of order"] == 1 and drive.supervisor.counts["frames"] == before


def test_restarted_camera_whose_stamps_begin_again_is_accepted_after_the_stop():
    drive = Drive()
    drive.tick(0.5)
    assert [speeds(drive.frame(stamp=float(i))) for i in range(3)] == [(0, 0), (0, 0), (0.4, 0.2)]


@pytest.mark.parametrize("age", [0.31, -0.31, 32.0, float("nan")])
def test_frame_from_another_time_is_discarded_and_counted(age):
    drive = Drive()
    for _ in range(3):
        command = drive.frame(stamp_age=age)
    assert drive.supervisor.counts["late"] == 3 and speeds(command) == (0, 0)


def test_clock_jump_stops_resets_and_accepts_older_stamps():
    drive = Drive()
    drive.supervisor.take_reset()
    drive.supervisor.clock_jump()
    assert speeds(drive.tick(0.0)) == (0, 0) and drive.supervisor.take_reset()
    assert [speeds(drive.frame(stamp=drive.now - 32)) for _ in range(3)] == [(0, 0), (0, 0), (0.4, 0.2)]


def test_third_overrun_in_a_row_stops():
    drive = Drive()
    commands = [drive.supervisor.action(drive.now, GO, elapsed) for elapsed in (0.09, 0.09, 0.01, 0.09, 0.09, 0.09)]
    assert [command.reason for command in commands] == [""] * 5 + ["policy too slow"]
    assert drive.supervisor.counts["overrun"] == 5


def test_collision_stops_at_once_and_only_the_operator_releases_it():
    drive = Drive()
    drive.supervisor.latch("collision")
    drive.supervisor.block("collision", True)
    assert speeds(drive.tick(0.0)) == (0, 0) and drive.supervisor.counts["collision"] == 1
    assert not drive.supervisor.arm()  # still touching
    drive.supervisor.block("collision", False)
    assert all(drive.frame().reason == "collision" for _ in range(10))
    assert drive.supervisor.arm() and speeds(drive.frame()) == (0.4, 0.2)


def test_condition_holds_the_vehicle_as_long_as_it_lasts():
    drive = Drive()
    drive.supervisor.block("second commander", True)
    assert all(drive.frame().reason == "second commander" for _ in range(5))
    drive.supervisor.block("second commander", False)
    assert speeds(drive.frame()) == (0.4, 0.2)


def test_thousand_jittering_but_healthy_frames_never_stop():
    rng = np.random.default_rng(1)
    drive = Drive()
    for _ in range(1000):
        assert drive.frame(dt=0.1 + rng.uniform(-0.09, 0.09)).reason == ""
        assert drive.supervisor.tick(drive.now + 0.05).reason == ""


@pytest.mark.parametrize("low, high", [((0.1, -1.0), (1.0, 1.0)), ((0.0, -1.0), (float("inf"), 1.0))])
def test_limits_that_forbid_stopping_are_refused(low, high):
    with pytest.raises(ValueError, match="include 0"):
        SafetyConfig(low=low, high=high)


RELEASE = dataclasses.replace(CONFIG, hold_zeros=False)


def in_state(state, config=CONFIG):
    """A drive that has come to a state."""
    drive = Drive(config)
    if state is State.STANDING:
        drive.tick(0.3)
    elif state is State.DISARMED:
        drive.supervisor.latch("collision")
    elif state is State.YIELDED:
        drive.supervisor.foreign_command(drive.now)
    assert drive.supervisor.state is state
    return drive


def cause(drive, event):
    """Let an event happen in the world of a drive."""
    supervisor = drive.supervisor
    if event is Event.ARM:
        supervisor.arm()
    elif event is Event.FRAMES:
        for _ in range(3):
            drive.frame()
    elif event is Event.FAULT:
        supervisor.fault("policy too slow")
    elif event is Event.LATCH:
        supervisor.latch("emergency stop")
    elif event is Event.FOREIGN:
        supervisor.foreign_command(drive.now)
    elif event is Event.QUIET:
        drive.now += supervisor.config.quiet + 0.01
        supervisor.tick(drive.now)


@pytest.mark.parametrize("state, event", EDGES, ids=lambda x: x.value)
def test_edge_leads_where_the_table_says_and_only_driving_moves_the_vehicle(state, event):
    drive = in_state(state)
    cause(drive, event)
    assert drive.supervisor.state is EDGES[state, event]
    assert (drive.supervisor.reason == "") == drive.supervisor.may_drive == (drive.supervisor.state is State.DRIVING)
    if not drive.supervisor.may_drive:
        assert speeds(drive.supervisor.tick(drive.now)) == (0, 0)


STAYS = [pair for pair in itertools.product(State, Event) if pair not in EDGES and pair[1] is not Event.QUIET]


@pytest.mark.parametrize("state, event", STAYS, ids=lambda x: x.value)
def test_event_without_an_edge_leaves_the_state(state, event):
    drive = in_state(state)
    cause(drive, event)
    assert drive.supervisor.state is state


def test_no_state_reaches_driving_but_by_fresh_frames_while_standing():
    assert [pair for pair, after in EDGES.items() if after is State.DRIVING] == [(State.STANDING, Event.FRAMES)]
    assert {after for (_, event), after in EDGES.items() if event is Event.FOREIGN} == {State.YIELDED}


def test_drawing_in_the_documentation_is_the_machine():
    text = (Path(__file__).resolve().parents[2] / "docs" / "bridge.md").read_text(encoding="utf-8")
    drawn = re.findall(r"^ +([A-Z]+) --> ([A-Z]+): ([a-z ]+)$", text, re.MULTILINE)
    assert {((State[a], Event(label)), State[b]) for a, b, label in drawn} == set(EDGES.items())


def test_base_that_stops_by_itself_gets_a_few_zeros_and_then_silence():
    drive = in_state(State.STANDING, RELEASE)
    assert [drive.supervisor.take_turn() for _ in range(8)] == [True] * 6 + [False] * 2


def test_base_without_a_time_out_of_its_own_gets_zeros_for_as_long_as_the_bridge_stands():
    for state in (State.STANDING, State.DISARMED):
        drive = in_state(state)
        assert all(drive.supervisor.take_turn() for _ in range(100))


@pytest.mark.parametrize("config", [CONFIG, RELEASE])
def test_bridge_that_yielded_never_speaks(config):
    drive = in_state(State.YIELDED, config)
    assert not any(drive.supervisor.take_turn() for _ in range(10))
    assert not drive.supervisor.arm() and drive.supervisor.state is State.YIELDED


def test_abandoned_base_without_a_time_out_is_stopped_when_the_other_driver_falls_silent():
    drive = in_state(State.YIELDED)
    cause(drive, Event.QUIET)
    assert drive.supervisor.take_turn() and speeds(drive.tick(0.0)) == (0, 0)


def test_emergency_stop_while_another_node_drives_is_remembered():
    drive = in_state(State.YIELDED)
    drive.supervisor.latch("emergency stop")
    assert drive.supervisor.state is State.YIELDED
    cause(drive, Event.QUIET)
    assert drive.supervisor.reason == "emergency stop"


def test_arming_is_refused_while_a_condition_holds_the_vehicle():
    drive = in_state(State.DISARMED)
    drive.supervisor.block("no guard", True)
    assert not drive.supervisor.arm() and drive.supervisor.state is State.DISARMED
    drive.supervisor.block("no guard", False)
    assert drive.supervisor.arm() and drive.supervisor.state is State.STANDING


def test_bridge_that_must_be_armed_begins_disarmed():
    drive = Drive(dataclasses.replace(CONFIG, require_arm=True))
    assert drive.supervisor.state is State.DISARMED and drive.supervisor.reason == "not armed"
    assert drive.supervisor.arm() and speeds(drive.frame()) == (0.4, 0.2)


def test_without_automatic_resumption_every_stop_needs_an_operator():
    drive = Drive(dataclasses.replace(CONFIG, auto_resume=False))
    drive.tick(0.3)
    assert all(drive.frame().reason == "frame age" for _ in range(10))
    assert drive.supervisor.state is State.DISARMED
    assert drive.supervisor.arm() and speeds(drive.frame()) == (0.4, 0.2)


def test_latching_condition_latches_only_a_drive_that_it_ends():
    drive = in_state(State.STANDING)
    drive.supervisor.block("emergency stop unknown", True, latching=True)
    assert drive.supervisor.state is State.STANDING
    drive.supervisor.block("emergency stop unknown", False)
    cause(drive, Event.FRAMES)
    drive.supervisor.block("emergency stop unknown", True, latching=True)
    assert drive.supervisor.state is State.DISARMED


def test_slew_limits_bound_each_change_of_the_command_but_not_a_stop():
    drive = Drive(dataclasses.replace(CONFIG, slew=(1.0, 0.5)))
    before = (0.4, 0.2)
    drive.frame()
    for action in ([1.0, 1.0], [1.0, 1.0], [-0.5, -1.0], [0.0, 0.0]):
        before = speeds(drive.supervisor.tick(drive.now))
        command = drive.frame(action)
        assert abs(command.v - before[0]) <= 0.1 + 1e-9 and abs(command.omega - before[1]) <= 0.05 + 1e-9
    assert speeds(drive.tick(0.3)) == (0, 0)
    assert [round(drive.frame([1.0, 1.0]).v, 6) for _ in range(4)] == [0, 0, 0, 0.1]  # from rest again


def test_slow_driving_scales_the_command_while_it_is_asked_for():
    drive = Drive()
    drive.supervisor.slow.add("dark or saturated camera")
    assert speeds(drive.frame()) == pytest.approx((0.12, 0.06))
    drive.supervisor.slow.clear()
    assert speeds(drive.frame()) == (0.4, 0.2)


def test_slew_limits_that_forbid_moving_are_refused():
    with pytest.raises(ValueError, match="never moves"):
        SafetyConfig(low=(-1.0, -1.0), high=(1.0, 1.0), slew=(0.0, 1.0))


def test_reason_of_a_stop_is_not_given_for_what_follows_once_it_is_over():
    drive = Drive()
    drive.supervisor.latch("emergency stop")
    drive.frame()
    assert drive.supervisor.reason == "emergency stop" and drive.supervisor.arm()
    assert (drive.supervisor.state, drive.supervisor.reason) == (State.STANDING, "waiting for fresh frames")
    drive = Drive()
    drive.supervisor.block("no guard", True)
    assert drive.supervisor.reason == "no guard"
    drive.supervisor.block("no guard", False)
    assert (drive.supervisor.state, drive.supervisor.reason) == (State.STANDING, "waiting for fresh frames")

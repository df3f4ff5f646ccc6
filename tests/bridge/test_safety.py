"""Every rule of the supervisor, with made-up times."""

import numpy as np
import pytest

from bridge.safety import SafetyConfig, Supervisor

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
    for bits in rng.integers(0, 2**64, (2000, 2), np.uint64):
        command = drive.frame(bits.view(np.float64))
        assert -0.5 <= command.v <= 1.0 and -1.0 <= command.omega <= 1.0
        drive.supervisor.rearm()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_non_finite_action_is_zero_in_the_same_tick_and_resets_the_policy(bad):
    drive = Drive()
    assert drive.supervisor.take_reset() and not drive.supervisor.take_reset()
    command = drive.frame([0.3, bad])
    assert speeds(command) == (0, 0) and command.reason == "non-finite action"
    assert drive.supervisor.take_reset()
    assert [speeds(drive.frame()) for _ in range(3)] == [(0, 0), (0, 0), (0.4, 0.2)]


def test_three_non_finite_actions_in_ten_seconds_latch_until_rearmed():
    drive = Drive()
    for _ in range(3):
        drive.frame([np.nan, 0.0])
        for _ in range(2):
            drive.frame()
    assert drive.supervisor.latched == "repeated non-finite actions"
    assert all(speeds(drive.frame()) == (0, 0) for _ in range(20))
    assert drive.supervisor.rearm()
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
    assert not drive.supervisor.rearm()  # still touching
    drive.supervisor.block("collision", False)
    assert all(drive.frame().reason == "collision" for _ in range(10))
    assert drive.supervisor.rearm() and speeds(drive.frame()) == (0.4, 0.2)


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

"""A manoeuvre through the safety state machine, with made-up times."""

import math
import os
import sys

import numpy as np
import pytest

from bridge.driving.command_table import make_table
from bridge.driving.manoeuvre_node import _enter_was_pressed
from bridge.driving.player import BACK, FINISHED, Player
from bridge.driving.vehicle_time import VehicleTime
from bridge.safeguards.safety import SafetyConfig

pytestmark = pytest.mark.quick


class Drive:
    def __init__(self, repeat=1, hold_zeros=True):
        rows = np.array([[0, 0.4, 0.2], [2, 0, 0]], float)
        table = make_table(rows, (-1, -1), (1, 1), (math.inf, math.inf))
        safety = SafetyConfig((-1, -1), (1, 1), require_arm=True, auto_resume=False, stamp_age=math.inf,
                              hold_zeros=hold_zeros)
        self.player, self.now, self.sent = Player(table, safety, repeat), 50.0, []

    def run(self, seconds, dt=0.01):
        for _ in range(round(seconds / dt)):
            self.now += dt
            command = self.player.on_tick(self.now)
            if command is not None:
                self.sent.append((self.now, command.v, command.omega))

    def moving(self):
        return [(t, v, omega) for t, v, omega in self.sent if v or omega]


def test_nothing_moves_before_an_operator_arms():
    drive = Drive()
    drive.run(2)
    assert not drive.moving()
    assert drive.player.supervisor.arm()
    drive.run(6)
    assert drive.player.finished and drive.player.supervisor.reason == FINISHED
    times = [t for t, _, _ in drive.moving()]
    assert times[-1] - times[0] == pytest.approx(2.0, abs=0.06) and {v for _, v, _ in drive.moving()} == {0.4}
    assert drive.sent[-1][1:] == (0, 0)


def test_commands_come_at_their_period():
    drive = Drive()
    drive.player.supervisor.arm()
    drive.run(6)
    gaps = np.diff([t for t, _, _ in drive.moving()])
    assert np.all((gaps > 0.035) & (gaps < 0.065))


def test_each_replicate_needs_arming_and_the_last_one_ends_the_drive():
    drive = Drive(repeat=2)
    drive.player.supervisor.arm()
    drive.run(6)
    assert (drive.player.driven, drive.player.finished, drive.player.supervisor.reason) == (1, False, BACK)
    moved = len(drive.moving())
    drive.run(2)
    assert len(drive.moving()) == moved
    drive.player.supervisor.arm()
    drive.run(6)
    assert drive.player.finished and len(drive.moving()) == pytest.approx(2 * moved, abs=2)
    drive.player.supervisor.arm()
    drive.run(4)
    assert len(drive.moving()) == pytest.approx(2 * moved, abs=2)  # nothing is driven a third time


def test_a_stopped_replicate_is_not_counted_and_begins_again_from_its_start():
    drive = Drive()
    drive.player.supervisor.arm()
    drive.run(2)
    drive.player.supervisor.block("dead-man button released", True)
    drive.run(0.02)
    assert drive.sent[-1][1:] == (0, 0) and (drive.player.aborted, drive.player.driven) == (1, 0)
    drive.player.supervisor.block("dead-man button released", False)
    stopped = drive.now
    drive.run(3)
    assert drive.moving()[-1][0] < stopped  # the button alone does not go on
    drive.player.supervisor.arm()
    drive.run(6)
    again = [t for t, _, _ in drive.moving() if t > stopped]
    assert drive.player.finished and again[-1] - again[0] == pytest.approx(2.0, abs=0.06)


def test_a_process_that_was_held_up_stops_instead_of_driving_on_late():
    drive = Drive()
    drive.player.supervisor.arm()
    drive.run(2)
    drive.now += 0.4
    drive.run(0.05)
    assert drive.player.aborted == 1 and drive.sent[-1][1:] == (0, 0)


def test_a_person_who_takes_over_silences_the_manoeuvre():
    drive = Drive()
    drive.player.supervisor.arm()
    drive.run(2)
    drive.player.supervisor.foreign_command(drive.now)
    before = len(drive.sent)
    drive.run(0.3)
    assert len(drive.sent) == before and drive.player.aborted == 1


def simulated(speed):
    """A drive whose table counts in simulated time."""
    drive = Drive()
    drive.began = drive.now
    drive.player.clock = lambda now: (now - drive.began) * speed
    return drive


def test_in_simulated_time_the_table_follows_the_clock():
    drive = simulated(4.0)
    drive.player.supervisor.arm()
    drive.run(2, dt=0.0025)
    times = [t for t, _, _ in drive.moving()]
    assert drive.player.finished and times[-1] - times[0] == pytest.approx(0.5, abs=0.02)
    assert np.all(np.diff(times) < 0.02)


def test_a_simulation_that_begins_again_at_zero_can_be_driven_at_once():
    drive = simulated(1.0)
    drive.run(60, dt=0.05)
    drive.began = drive.now
    drive.player.supervisor.clock_jump()
    drive.player.supervisor.arm()
    drive.run(6)
    assert drive.player.finished


@pytest.mark.parametrize("typed, pressed", [("\n", True), ("\x04", False), ("no\n", False), ("", False)])
def test_only_enter_alone_arms_and_not_the_end_of_the_input(typed, pressed, monkeypatch):
    master, slave = os.openpty()
    with open(slave, encoding="utf-8") as terminal:
        monkeypatch.setattr(sys, "stdin", terminal)
        assert not _enter_was_pressed()  # it is not the terminal of this session
        monkeypatch.setattr(os, "tcgetpgrp", lambda _: os.getpgrp())
        os.write(master, typed.encode())
        assert _enter_was_pressed() == pressed
    os.close(master)


def test_a_simulation_that_waits_for_its_driver_stops_no_manoeuvre():
    drive = simulated(1.0)
    steady = [drive.now]
    vehicle = VehicleTime(lambda: steady[0])
    drive.player.supervisor.arm()

    def run(seconds, clock_runs):
        for _ in range(round(seconds / 0.01)):
            steady[0] += 0.01
            if clock_runs:
                vehicle.on_clock()
            drive.player.on_tick(vehicle())

    run(1.0, clock_runs=True)
    run(30.0, clock_runs=False)
    assert drive.player.elapsed is not None and drive.player.aborted == 0
    run(4.0, clock_runs=True)
    assert drive.player.finished and drive.player.aborted == 0

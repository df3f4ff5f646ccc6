"""Outer inputs with made-up times: unknown is stop."""

import argparse

import numpy as np
import pytest

from bridge.safeguards.inputs import SafetyInputs, Signal, add_options
from bridge.safeguards.safety import SafetyConfig, State, Supervisor

pytestmark = pytest.mark.quick


class World:
    """A supervisor before a good camera, and its inputs."""

    def __init__(self, *arguments):
        parser = argparse.ArgumentParser()
        add_options(parser)
        self.supervisor = Supervisor(SafetyConfig((-1.0, -1.0), (1.0, 1.0)))
        self.inputs = SafetyInputs(self.supervisor, parser.parse_args(arguments))
        self.now, self.beat = 10.0, None

    def drive(self, seconds=0.5):
        """Let frames come each 100 ms and `beat` be called; return the state."""
        for _ in range(round(seconds * 10)):
            self.now += 0.1
            if self.beat:
                self.beat(self.now)
            self.inputs.watch(self.now)
            if self.supervisor.frame(self.now, self.now, int(self.now * 1000)) and self.supervisor.may_drive:
                self.supervisor.action(self.now, np.array([0.1, 0.0]))
            self.supervisor.tick(self.now)
        return self.supervisor.state


def test_signal_is_unknown_until_it_is_heard_and_when_it_is_old():
    signal = Signal(0.5)
    assert signal.read(0.0) is None
    signal.take(1.0, False)
    assert signal.read(1.4) is False and signal.read(1.6) is None
    signal.take(2.0, True)
    assert signal.read(2.0) is True


def test_emergency_stop_is_required_unless_it_is_given_up_by_name():
    assert World().drive() is State.STANDING
    assert World("--e-stop", "watch").drive() is State.DRIVING
    assert World("--e-stop", "ignore").drive() is State.DRIVING


@pytest.mark.parametrize("mode", ["require", "watch"])
def test_emergency_stop_that_falls_silent_while_driving_latches(mode):
    world = World("--e-stop", mode)
    world.beat = lambda now: world.inputs.on_e_stop(now, False)
    assert world.drive() is State.DRIVING
    world.beat = None
    assert world.drive(1.0) is State.DISARMED and world.supervisor.reason == "emergency stop unknown"
    assert not world.supervisor.arm()
    world.beat = lambda now: world.inputs.on_e_stop(now, False)
    assert world.drive() is State.DISARMED and world.supervisor.arm() and world.drive() is State.DRIVING


def test_pulled_emergency_stop_zeroes_the_command_within_the_callback_and_holds_until_released():
    world = World()
    world.beat = lambda now: world.inputs.on_e_stop(now, False)
    world.drive()
    world.inputs.on_e_stop(world.now, True)
    command = world.supervisor.tick(world.now)
    assert (command.v, command.omega, command.reason) == (0.0, 0.0, "emergency stop")
    assert not world.supervisor.arm()
    assert world.drive() is State.DISARMED and world.supervisor.arm() and world.drive() is State.DRIVING


@pytest.mark.parametrize("option, take", [
    (("--enable", "require"), lambda inputs, now, on: inputs.on_enable(now, on)),
    (("--dead-man-button", "1"), lambda inputs, now, on: inputs.on_joy(now, [0, int(on)])),
])
def test_vehicle_drives_only_while_enabled_and_stands_when_the_signal_stops(option, take):
    world = World("--e-stop", "ignore", *option)
    assert world.drive() is State.STANDING
    world.beat = lambda now: take(world.inputs, now, True)
    assert world.drive() is State.DRIVING
    world.beat = lambda now: take(world.inputs, now, False)
    assert world.drive(0.2) is State.STANDING
    world.beat = lambda now: take(world.inputs, now, True)
    assert world.drive() is State.DRIVING
    world.beat = None
    assert world.drive(1.0) is State.STANDING


def test_joystick_without_the_button_does_not_enable():
    world = World("--e-stop", "ignore", "--dead-man-button", "7")
    world.beat = lambda now: world.inputs.on_joy(now, [1, 1])
    assert world.drive() is State.STANDING


@pytest.mark.parametrize("mode, during, after", [("latch", State.DISARMED, State.DISARMED),
                                                 ("release", State.STANDING, State.DRIVING)])
def test_collision_latches_or_holds_as_asked(mode, during, after):
    world = World("--e-stop", "ignore", "--collision", mode)
    world.drive()
    world.inputs.on_collision(True)
    assert world.drive() is during
    world.inputs.on_collision(False)
    assert world.drive() is after

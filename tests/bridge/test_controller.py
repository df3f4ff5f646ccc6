"""Frames in, commands out: the controller with a scripted policy and made-up times."""

import math
from dataclasses import dataclass, field

import numpy as np
import pytest

from bridge.controller import Controller
from bridge.safety import SafetyConfig

pytestmark = pytest.mark.quick


@dataclass
class FakeContract:
    height: int = 8
    width: int = 8
    rate_hz: float = 10.0
    action_repeat: int = 1


@dataclass
class ScriptedPolicy:
    """Wants to drive, or whatever `action` says; counts its steps since the last reset."""

    contract: FakeContract = field(default_factory=FakeContract)
    action: tuple = (0.4, 0.0)
    steps: int = 0
    resets: int = 0

    def reset(self):
        self.steps = 0
        self.resets += 1

    def step(self, image):
        self.steps += 1
        return np.array(self.action)


class World:
    """A camera, a steady clock and a wall clock."""

    def __init__(self, **contract):
        self.policy = ScriptedPolicy(FakeContract(**contract))
        self.controller = Controller(self.policy, SafetyConfig((-0.5, -1.0), (1.0, 1.0)), clock=lambda: 0.0)
        self.now, self.count = 10.0, 0

    def image(self, dt=0.1, **changes):
        self.now += dt
        self.count += 1
        data = bytes([self.count % 200 + 20]) * 192
        fields = dict(stamp=self.now, stamp_age=0.0, height=8, width=8, encoding="rgb8", step=24, data=data)
        return self.controller.on_image(self.now, **{**fields, **changes})

    def tick(self, dt):
        self.now += dt
        return self.controller.on_tick(self.now)

    def drive(self):
        return [self.image() for _ in range(4)][-1]


def test_each_frame_gives_one_command_and_a_new_episode_begins_with_a_fresh_state():
    world = World()
    assert [world.image().v for _ in range(4)] == [0.0, 0.0, 0.4, 0.4]
    assert world.policy.steps == 2 and world.policy.resets >= 1


@pytest.mark.parametrize("bad", [
    {"encoding": "16UC1"}, {"height": 9}, {"data": b"short"}, {"step": 23}, {"width": 0}, {"stamp_age": 5.0},
])
def test_unusable_frame_reaches_neither_policy_nor_wheels_and_stops_the_vehicle_in_time(bad):
    world = World()
    world.drive()
    steps = world.policy.steps
    assert [world.image(dt=0.05, **bad) for _ in range(5)] == [None] * 5
    assert world.policy.steps == steps
    stop = world.tick(0.011)
    assert (stop.v, stop.omega, stop.reason) == (0.0, 0.0, "frame age")
    if "stamp_age" not in bad:
        assert world.controller.supervisor.counts["unusable"] == 5 and world.controller.unusable


def test_silent_camera_stops_the_vehicle_within_260_ms_of_its_last_frame():
    world = World()
    assert world.drive().v == 0.4
    commands = [(i, world.tick(0.01)) for i in range(1, 40)]
    sent = [(i, command.v) for i, command in commands if command is not None]
    assert sent[0] == (13, 0.4)  # the backstop holds the last command while its frame is young
    assert [i for i, v in sent if v == 0][0] == 26
    world.image(), world.image()
    assert world.policy.steps == 0  # nothing is fed while standing
    world.image()
    assert world.policy.steps == 1  # after a reset


def test_backstop_repeats_zero_at_about_the_control_rate_while_standing():
    world = World()
    sent = [command for command in (world.tick(0.01) for _ in range(200)) if command is not None]
    assert 14 <= len(sent) <= 21 and all((command.v, command.omega) == (0, 0) for command in sent)


@pytest.mark.parametrize("action", [(math.nan, 0.0), (0.0, math.inf)])
def test_bad_action_gives_zero_for_the_same_frame(action):
    world = World()
    world.drive()
    world.policy.action = action
    command = world.image()
    assert (command.v, command.omega) == (0.0, 0.0) and "non-finite" in command.reason


def test_repeated_action_is_held_between_policy_steps():
    world = World(action_repeat=3)
    world.drive()
    steps = world.policy.steps
    commands = [world.image() for _ in range(9)]
    assert world.policy.steps == steps + 3 and all(command.v == 0.4 for command in commands)


@pytest.mark.parametrize("camera_hz, low, high", [(10.0, 100, 100), (10.2, 102, 102), (9.8, 98, 98), (30.0, 97, 103),
                                                  (25.0, 95, 110), (20.0, 97, 103), (60.0, 97, 106)])
def test_policy_runs_at_its_own_rate_whatever_the_camera_sends(camera_hz, low, high):
    world = World()
    world.drive()
    steps = world.policy.steps
    for _ in range(round(10 * camera_hz)):
        world.image(dt=1 / camera_hz)
    assert low <= world.policy.steps - steps <= high


def test_jitter_of_a_camera_at_the_policy_rate_never_skips_a_frame():
    rng = np.random.default_rng(0)
    world = World()
    world.drive()
    steps, jitter = world.policy.steps, 0.0
    for _ in range(500):
        new = rng.uniform(-0.01, 0.01)
        world.image(dt=0.1 + new - jitter)
        jitter = new
    assert world.policy.steps == steps + 500


def test_dark_camera_is_counted_once_per_run_of_frames():
    world = World()
    world.drive()
    for _ in range(8):
        world.image(data=bytes(192))
    assert world.controller.supervisor.counts["dark or saturated"] == 1

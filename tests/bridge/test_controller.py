"""Frames in, commands out: the controller with a scripted policy and made-up times."""

import math
from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
import pytest

from bridge.driving.controller import Caution, Controller
from bridge.policy import SensorInput
from bridge.safeguards.safety import SafetyConfig

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
    novelty: float = 0.0

    @property
    def commands(self):
        return self.contract

    @property
    def sensors(self):
        return {"image": self.pacer}

    @property
    def pacer(self):
        return SensorInput("image", "camera", (self.contract.height, self.contract.width, 3))

    def reset(self):
        self.steps = 0
        self.resets += 1

    def prepare(self):
        pass

    def step(self, image):
        self.steps += 1
        return np.array(self.action)


class World:
    """A camera, a steady clock and a wall clock."""

    def __init__(self, options=None, hold_zeros=True, limits=None, **contract):
        self.policy = ScriptedPolicy(FakeContract(**contract))
        safety = SafetyConfig((-0.5, -1.0), (1.0, 1.0), hold_zeros=hold_zeros, **(limits or {}))
        self.controller = Controller(self.policy, safety, clock=lambda: 0.0, **(options or {}))
        self.now, self.count = 10.0, 0

    def image(self, dt=0.1, **changes):
        self.now += dt
        self.count += 1
        data = bytes([self.count % 200 + 20]) * 192
        fields = dict(stamp=self.now, stamp_age=0.0, height=8, width=8, encoding="rgb8", step=24, data=data) | changes
        stamp, age = fields.pop("stamp"), fields.pop("stamp_age")
        return self.controller.on_image(self.now, stamp, age, SimpleNamespace(**fields))

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


def test_silent_camera_stops_the_vehicle_within_250_ms_of_its_last_frame():
    world = World()
    assert world.drive().v == 0.4
    commands = [(i, world.tick(0.01)) for i in range(1, 40)]
    sent = [(i, command.v) for i, command in commands if command is not None]
    assert sent[0] == (13, 0.4)  # the backstop holds the last command while its frame is young
    assert [i for i, v in sent if v == 0][0] == 25
    world.image(), world.image()
    assert world.policy.steps == 0  # nothing is fed while standing
    world.image()
    assert world.policy.steps == 1  # after a reset


def test_command_of_a_slow_policy_is_sent_again_before_the_base_forgets_it():
    world = World(limits={"frame_age": 1.0, "expiry": 0.2}, rate_hz=2.0)
    assert [world.image(dt=0.5) for _ in range(4)][-1].v == 0.4
    again = [i for i in range(1, 50) if (command := world.tick(0.01)) is not None and command.v == 0.4]
    assert len(again) == 3 and max(np.diff([0, *again])) < 20


def test_base_that_stops_by_itself_gets_no_packet_before_the_first_drive_and_six_zeros_after_it():
    world = World(hold_zeros=False)
    assert [world.tick(0.01) for _ in range(100)] == [None] * 100
    world.drive()
    sent = [command for command in (world.tick(0.01) for _ in range(300)) if command is not None]
    assert [command.v for command in sent] == [0.4] + [0.0] * 6


def test_vehicle_that_was_moving_gets_a_farewell_and_a_released_one_does_not():
    world = World(hold_zeros=False)
    assert not world.controller.farewell()
    world.drive()
    assert world.controller.farewell()
    world.controller.supervisor.foreign_command(world.now)
    assert not world.controller.farewell()


def test_policy_that_raises_an_error_is_zero_for_the_same_frame_and_named():
    world = World()
    world.drive()
    world.policy.step = None  # not callable
    command = world.image()
    assert (command.v, command.reason) == (0.0, "non-finite action") and "not callable" in world.controller.unusable
    for _ in range(10):
        world.image()
    assert world.controller.supervisor.latched == "repeated non-finite actions"


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


@pytest.mark.parametrize("action, blind_speed", [("warn", 0.4), ("slow", 0.12), ("stop", 0.0)])
def test_dark_camera_warns_slows_or_stops_as_asked_and_only_while_it_lasts(action, blind_speed):
    world = World({"caution": Caution(blind=action)})
    world.drive()
    speeds = []
    for i in range(8):  # the frames differ, or they would count as frozen
        speeds.append(world.image(data=bytes([i % 2]) + bytes(191)).v)
    assert speeds[3] == 0.4 and speeds[-1] == pytest.approx(blind_speed) and world.controller.is_blind
    assert [world.image().v for _ in range(4)][-1] == 0.4


@pytest.mark.parametrize("pace", [0.5, 2.0])
def test_simulator_off_real_time_gets_one_step_per_frame_where_its_stamps_set_the_pace(pace):
    world = World({"pace_by_stamp": True})
    stamp = 100.0
    for i in range(54):
        stamp += 0.1
        if i == 4:
            steps = world.policy.steps
        world.image(dt=0.1 / pace, stamp=stamp)
    assert world.policy.steps - steps == 50


def test_stamps_that_begin_again_do_not_stall_a_policy_paced_by_them():
    world = World({"pace_by_stamp": True})
    world.drive()
    world.tick(0.3)
    commands = [world.image(stamp=i / 10) for i in range(6)]
    assert commands[-1] is not None and commands[-1].v == 0.4


def test_compressed_image_is_decoded_and_a_damaged_one_named():
    import io

    image = pytest.importorskip("PIL.Image")
    world = World()
    for i in range(5):
        buffer = io.BytesIO()
        image.fromarray(np.full((8, 8, 3), 100 + i, np.uint8)).save(buffer, "PNG")
        world.now += 0.1
        command = world.controller.on_compressed(world.now, world.now, 0.0, buffer.getvalue())
    assert command.v == 0.4
    assert world.controller.on_compressed(world.now + 0.1, world.now + 0.1, 0.0, buffer.getvalue()[:-9]) is None
    assert "its end is missing" in world.controller.unusable


@pytest.mark.parametrize("action, speeds", [("ignore", (0.4, 0.4, 0.4)), ("slow", (0.4, 0.12, 0.12)),
                                            ("stop", (0.4, 0.12, 0.0))])  # fmt: skip
def test_surroundings_unlike_the_training_slow_down_and_then_stop_until_an_operator_rearms(action, speeds):
    world = World({"caution": Caution(novel=action)})
    world.policy.contract.novelty = (10.0, 20.0)
    world.drive()
    for novelty, speed in zip((5.0, 15.0, 25.0), speeds, strict=True):
        world.policy.novelty = novelty
        assert world.image().v == pytest.approx(speed)
    world.policy.novelty = 5.0
    again = [world.image().v for _ in range(5)][-1]
    assert again == (0.0 if action == "stop" else 0.4)
    if action == "stop":
        assert world.controller.supervisor.arm()
        assert [world.image().v for _ in range(5)][-1] == 0.4


@pytest.mark.quick
def test_step_whose_beginning_takes_too_long_counts_as_too_slow():
    world = World()
    world.drive()
    times = iter(np.cumsum([0.0, 0.07, 0.0, 0.02] * 3))  # beginning and end of both parts: 90 ms of 80 allowed
    world.controller._clock = lambda: next(times)
    commands = []
    for _ in range(3):
        world.controller.prepare()
        commands.append(world.image())
    assert [command.reason for command in commands] == ["", "", "policy too slow"]


@pytest.mark.quick
def test_step_that_cannot_be_begun_fails_when_its_frame_comes(monkeypatch):
    world = World()
    world.drive()

    def fail(*_):
        raise RuntimeError("no memory")

    monkeypatch.setattr(world.policy, "prepare", fail)
    world.controller.prepare()
    monkeypatch.setattr(world.policy, "step", fail)
    assert world.image().reason == "non-finite action" and world.controller.supervisor.counts["policy error"] == 1

"""Policies that read more than one camera image: two cameras, a lidar, odometry, the last command."""

import dataclasses
import json
from types import SimpleNamespace

import numpy as np
import pytest
import tiny_policy

from bridge.drive import main
from bridge.driving.controller import Controller
from bridge.nodes.exits import Exit
from bridge.policy import Policy, PolicyFileError, SensorInput
from bridge.safeguards.safety import SafetyConfig, Supervisor
from bridge.sensing.sense_topics import reader_of
from bridge.sensing.senses import Scan, SenseError, Senses, rays_of

pytestmark = pytest.mark.quick
LIDAR = SensorInput("lidar", "lidar", (4,), {"reach": 8.0})
"""Rays at -135, -45, 45 and 135 degrees."""


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    return Policy.load(tiny_policy.write_sensing(tmp_path_factory.mktemp("policy") / "senses"))


class Drive:
    """Sensors that measure at 10 Hz, and the controller of the policy."""

    def __init__(self, policy):
        policy.reset()
        self.controller = Controller(policy, SafetyConfig((0.0, -0.6), (0.3, 0.6)), clock=lambda: 0.0)
        self.now, self.count, self.start = 5.0, 0, 7.0

    def sense(self, name, value=None, **changes):
        fields = dict(stamp=self.now, stamp_age=0.0, digest=self.count, **changes)
        usual = {"rear": np.full((6, 8, 3), self.count % 100, np.uint8), "lidar": np.full(4, 8.0, np.float32),
                 "odometry": np.array([self.start, 0.0, 0.0, 0.0, 0.0])}
        return self.controller.on_sensed(self.now, name, value=usual[name] if value is None else value, **fields)

    def see(self):
        image = np.full((8, 8, 3), self.count % 100, np.uint8)
        return self.controller.on_paced(self.now, self.now, 0.0, image, self.count)

    def period(self, without=(), **values):
        """One period in which all sensors measure, the pacer last; return the command."""
        self.now += 0.1
        self.count += 1
        for name in ("rear", "lidar", "odometry"):
            if name not in without:
                self.sense(name, values.get(name))
        return self.see()

    def tick(self, seconds=0.01):
        self.now += seconds
        return self.controller.on_tick(self.now)

    @property
    def holds(self):
        return self.controller.supervisor.holds


def test_policy_acts_on_all_its_sensors_and_knows_its_last_command(trained):
    drive = Drive(trained)
    commands = [drive.period() for _ in range(5)]
    assert [command.v for command in commands[2:]] == pytest.approx([0.3] * 3)  # after three fresh frames
    assert trained._carry[0] == pytest.approx([0.3, commands[3].omega])
    near = np.array([8.0, 0.3, 8.0, 8.0], np.float32)
    assert drive.period(lidar=near).v == pytest.approx(0.0)
    there = np.array([drive.start + 0.3, 0.0, 0.0, 0.0, 0.0])
    assert drive.period(odometry=there).v == pytest.approx(0.0)  # counted from where the episode began, not from 0


def test_odometry_counts_from_the_place_and_heading_of_the_start():
    senses = Drive(FakePolicy()).controller.senses
    senses.begin()
    first = senses.unwrapped("odometry", np.array([1.0, 2.0, 3.1, 0.0, 0.0]))
    assert senses._from_start("odometry", first) == pytest.approx([0.0] * 5)
    turned = senses.unwrapped("odometry", np.array([1.0 - 0.5, 2.0, -3.1, 0.2, 0.1]))
    ahead, left = 0.5 * np.cos(np.pi - 3.1), 0.5 * np.sin(np.pi - 3.1)
    assert senses._from_start("odometry", turned) == pytest.approx([ahead, left, 2 * np.pi - 6.2, 0.2, 0.1], abs=1e-6)


@pytest.mark.parametrize("kind", ["odometry", "goal"])
def test_what_stays_the_same_until_the_vehicle_moves_is_new_by_its_stamp(kind):
    read = reader_of(SensorInput(kind, kind, (5,)), lambda name, pose: pose)
    messages = [SimpleNamespace(
        header=SimpleNamespace(frame_id="base_link", stamp=SimpleNamespace(sec=1, nanosec=nanosec)),
        pose=SimpleNamespace(pose=SimpleNamespace(position=SimpleNamespace(x=1.0, y=2.0),
                                                  orientation=SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0))),
        twist=SimpleNamespace(twist=SimpleNamespace(linear=SimpleNamespace(x=0.0), angular=SimpleNamespace(z=0.0))),
        point=SimpleNamespace(x=3.0, y=0.0)) for nanosec in (1, 1, 2)]
    (_, first), (_, again), (_, later) = map(read, messages)
    assert first == again != later


def test_odometry_alone_is_read_from_the_start_as_in_training():
    policy = FakePolicy()
    policy.sensors = {"odometry": SensorInput("odometry", "odometry", (5,))}
    policy.pacer = policy.sensors["odometry"]
    senses = Senses(policy.sensors, policy.pacer, 0.1, Drive(FakePolicy()).controller.supervisor)
    seen = senses.observation(np.array([1.0, 2.0, 0.5, 0.0, 0.0]))
    assert seen["odometry"].dtype == np.float32 and seen["odometry"].tolist() == [0.0] * 5


def test_frame_age_slows_the_limits_of_all_sensors():
    limits = [Senses(FakePolicy.sensors, FakePolicy.pacer, 0.1, Supervisor(SafetyConfig(
        (0.0, -0.6), (0.3, 0.6), frame_age=age))).streams["rear"].limit for age in (0.25, 1.0)]
    assert limits[1] == pytest.approx(4 * limits[0])


class FakePolicy:
    """Names and shapes of a policy."""

    sensors = {"camera": SensorInput("camera", "camera", (8, 8, 3)), "rear": SensorInput("rear", "camera", (6, 8, 3)),
               "odometry": SensorInput("odometry", "odometry", (5,))}
    pacer = sensors["camera"]
    commands = contract = type("Commands", (), {"rate_hz": 10.0, "action_repeat": 1})
    reset = staticmethod(lambda: None)


@pytest.mark.parametrize("silent", ["rear", "lidar", "odometry"])
def test_each_sensor_that_falls_silent_stops_the_vehicle_by_its_own_limit_and_is_named(trained, silent):
    drive = Drive(trained)
    for _ in range(5):
        last = drive.period()
    assert last.v > 0 and drive.holds == []
    drive.period(without=[silent])
    drive.tick(0.021)  # a missing camera is waited for, shortly
    drive.period(without=[silent])
    assert drive.controller.supervisor.may_drive
    assert drive.tick(0.021).v == 0 and drive.holds == [f"{silent} too old"]  # before 250 ms have passed
    for _ in range(4):
        last = drive.period()
    assert last.v > 0 and drive.holds == []


def test_nothing_moves_before_each_sensor_has_spoken(trained):
    drive = Drive(trained)
    assert drive.holds == ["no lidar", "no odometry", "no rear"]
    for _ in range(6):
        drive.period(without=["lidar"])
        drive.tick()
    assert drive.holds == ["no lidar"] and not drive.controller.supervisor.may_drive


def test_step_waits_for_the_other_camera_of_the_period_but_not_for_long(trained):
    drive = Drive(trained)
    for _ in range(4):
        drive.period()
    assert drive.period(without=["rear"]) is None
    drive.now += 0.005
    assert drive.sense("rear").v > 0  # the second image makes the step
    assert drive.period(without=["rear"]) is None
    assert drive.tick(0.01) is None and drive.tick(0.011).v > 0


@pytest.mark.parametrize("wrong, why", [(dict(stamp_age=3.0), "late"), (dict(stamp=1.0), "out of order")])
def test_values_with_wrong_stamps_do_not_count(trained, wrong, why):
    drive = Drive(trained)
    for _ in range(4):
        drive.period()
    fields = dict(stamp=drive.now + 0.1, stamp_age=0.0, digest=99) | wrong
    drive.now += 0.1
    drive.controller.on_sensed(drive.now, "lidar", value=np.zeros(4, np.float32), **fields)
    stream = drive.controller.senses.streams["lidar"]
    assert why in stream.unusable and stream.value.min() == 8.0


def scan(ranges, **changes):
    """A scanner that looks around in steps of 90 degrees, beginning behind."""
    fields = dict(angle_min=-0.75 * np.pi, angle_increment=np.pi / 2, range_min=0.1, range_max=20.0)
    return Scan(ranges=np.array(ranges, np.float32), **{**fields, **changes})


@pytest.mark.parametrize("given, rays", [
    (scan([1, 2, 3, 4]), [1, 2, 3, 4]),
    (scan([1, 2, 3, 4], angle_min=0.25 * np.pi), [3, 4, 1, 2]),  # its first beam looks elsewhere
    (scan([1, 2, 3, 4], angle_min=0.75 * np.pi, angle_increment=-np.pi / 2), [4, 3, 2, 1]),  # it turns to the right
    (scan([np.inf, np.nan, 0.0, 12.0]), [8, 8, 8, 8]),  # no return, an error, below the least range, beyond the reach
    (scan([-np.inf, 2, 3, 25]), [0.1, 2, 3, 8]),
    (scan(np.arange(1, 9), angle_increment=np.pi / 4), [1, 3, 5, 7]),
])  # fmt: skip
def test_scan_shows_the_beam_nearest_to_each_ray(given, rays):
    assert rays_of(given, LIDAR) == pytest.approx(rays)


@pytest.mark.parametrize("given, why", [
    (scan([1, 2, 3]), "the scan looks from -2.36 to 0.79 rad"), (scan([]), "scan of 0 beams"),
    (scan([np.nan] * 4), "without a single valid range"), (scan([1] * 4, angle_increment=0.0), "scan of 4 beams"),
    (scan([0.0, np.nan, 0.05, 0.0]), "scanner is blind"),  # it is covered or hangs: no wide room
])  # fmt: skip
def test_scan_that_cannot_serve_is_refused(given, why):
    with pytest.raises(SenseError, match=why):
        rays_of(given, LIDAR)


def sensors(**changes):
    return {"sensors": {**tiny_policy.SENSORS, **changes}}


@pytest.mark.parametrize("changes, why", [
    (sensors(lidar={"kind": "odometry"}), r"lidar: kind = .odometry., but it must suit an observation of shape"),
    (sensors(lidar={"kind": "lidar", "settings": {"reach": -1}}), r"reach = -1, but it must be above 0"),
    (sensors(lidar={"kind": "lidar", "settings": {"rate_hz": 0}}), r"rate_hz = 0, but it must be from 0.01"),
    (sensors(rear={"kind": "camera", "camera": {"pitch": 9}}), r"sensors rear camera: pitch = 9"),
    (sensors(odometry={"kind": "docking:Heading"}), r"odometry: kind = .docking:Heading., which no vehicle"),
    ({"sensors": {"lidar": {"kind": "lidar"}}}, r"sensors = .*but it must have an entry for each of"),
    ({"sensors": 3}, "sensors = 3, but it must have an entry"),
])  # fmt: skip
def test_file_with_wrong_sensors_is_refused_by_name(tmp_path, changes, why):
    with pytest.raises(PolicyFileError, match=why):
        Policy.load(tiny_policy.write_sensing(tmp_path / "policy", **changes))


def test_file_that_does_not_name_its_sensors_is_refused(tmp_path):
    path = tiny_policy.write_sensing(tmp_path / "policy")
    table = json.loads((path / "policy.json").read_text())
    del table["sensors"]
    (path / "policy.json").write_text(json.dumps(table))
    with pytest.raises(PolicyFileError, match="has no field sensors, which says what measures camera, commands"):
        Policy.load(path)


def test_observation_of_the_wrong_shape_is_named(trained):
    seen = trained.zeros()
    with pytest.raises(ValueError, match=r"lidar is \(5,\) float32; the policy needs \(4,\) float32"):
        trained.step({**seen, "lidar": np.zeros(5, np.float32)})
    with pytest.raises(ValueError, match="rear is none"):
        trained.step({name: value for name, value in seen.items() if name != "rear"})


def test_policy_without_a_camera_is_paced_by_its_lidar():
    from bridge.policy import pacer_of

    found = {name: SensorInput(name, kind, shape) for name, kind, shape in
             (("goal", "goal", (2,)), ("scan", "lidar", (36,)), ("commands", "commands", (2,)))}  # fmt: skip
    assert pacer_of(found).name == "scan" and pacer_of({"commands": found["commands"]}) is None
    assert dataclasses.replace(found["scan"], settings={"rate_hz": 5.0, "latency_s": 0.1}).age == pytest.approx(0.3)


def test_an_image_topic_is_refused_where_the_policy_has_no_camera(monkeypatch, capsys):
    lidar = SimpleNamespace(pacer=LIDAR, sensors={"lidar": LIDAR})
    monkeypatch.setattr("bridge.drive.Policy.load", lambda path, **options: lidar)
    assert main(["walls", "--image-topic", "scanner/scan"]) == Exit.REFUSED
    assert "--image-topic scanner/scan: walls has no camera" in capsys.readouterr().err

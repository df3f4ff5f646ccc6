"""The guard's decisions and both sides of the heartbeat, with made-up times."""

import json
import os
import signal
import subprocess
import types

import pytest

from bridge.driving.vehicle_node import VehicleNode
from bridge.nodes import ros
from bridge.nodes.commands import CommandTopic, Endpoint
from bridge.safeguards.guard_link import GuardLink
from bridge.safeguards.guard_node import GuardNode
from bridge.safeguards.heartbeat import read_beat
from bridge.safeguards.watchdog import Watchdog

pytestmark = pytest.mark.quick


def beats(guard, start, stop, driving=True, session="a"):
    """Heartbeats each 50 ms and a watch each 10 ms; the times [10 ms] at which a zero was sent."""
    sent = []
    for t in range(start, stop):
        if t % 5 == 0:
            guard.heartbeat(t / 100, session, driving)
        if guard.tick(t / 100):
            sent.append(t)
    return sent


def silence(guard, start, stop):
    return [t for t in range(start, stop) if guard.tick(t / 100)]


def test_guard_sends_zeros_only_after_a_driving_node_fell_silent():
    guard = Watchdog()
    assert not silence(guard, 0, 100) and not beats(guard, 100, 200)
    guard.command(True)
    sent = silence(guard, 200, 300)
    assert sent[0] in (210, 211) and len(sent) == 10 and guard.stops == 1


def test_guard_stops_a_node_that_died_before_its_first_command_was_heard():
    guard = Watchdog()
    guard.command(False)  # of an earlier drive
    guard.heartbeat(1.0, "a", True)
    assert len(silence(guard, 100, 200)) == 10


@pytest.mark.parametrize("driving, moves", [(False, True), (True, False)])
def test_guard_leaves_a_node_alone_that_does_not_drive_or_has_stopped_the_vehicle(driving, moves):
    guard = Watchdog()
    beats(guard, 0, 100, driving)
    guard.command(moves)
    assert not silence(guard, 100, 300)


def test_guard_yields_to_whoever_moves_the_vehicle():
    guard = Watchdog()
    beats(guard, 0, 100)
    assert len(silence(guard, 100, 115)) == 1
    guard.command(True)
    assert not silence(guard, 115, 200)


def test_guard_watches_each_of_two_nodes():
    guard = Watchdog()
    for t in range(0, 100, 5):
        guard.heartbeat(t / 100, "a", True)
        guard.heartbeat(t / 100, "b", True)
    assert len(beats(guard, 100, 200, session="b")) == 10 and guard.stops == 1


def test_guard_forgets_a_node_that_stays_silent():
    guard = Watchdog()
    guard.heartbeat(0.0, "a", False)
    guard.tick(1.0)
    assert "a" in guard.heard
    guard.tick(3.0), guard.tick(3.01)  # the first of them comes late itself, and has not read yet
    assert "a" not in guard.heard


@pytest.mark.parametrize("matched, ready", [(2, False), (3, True)])
def test_guard_is_ready_when_every_reader_is_matched_the_bases_among_them(matched, ready, monkeypatch):
    node = types.SimpleNamespace(get_logger=lambda: types.SimpleNamespace(info=lambda text: None))
    guard = GuardNode.__new__(GuardNode)
    names = ("bridge_drive", "bridge_guard", "base")  # the node's and the guard's own ears are matched first
    guard.node, guard._ready, topic = node, False, CommandTopic.__new__(CommandTopic)
    guard._matched, guard.watchdog, guard.now = 0, Watchdog(), lambda: 1.0
    topic.name, topic.kind, topic._known = "/cmd_vel", "Twist", ["/bridge_drive", "/bridge_guard"]
    topic.publisher = types.SimpleNamespace(get_subscription_count=lambda: matched)
    monkeypatch.setattr(topic, "readers", lambda: [Endpoint(f"/{name}", "geometry_msgs/msg/Twist") for name in names])
    guard.topic = topic
    guard._on_look()
    assert guard._ready == ready
    matched = 2  # a reader that comes to a guard that is ready ends nothing
    guard._on_look()
    assert guard._ready == ready


GOOD = {"guard": "ours", "topic": "/cmd_vel", "type": "Twist", "ready": True, "stops": 0, "hears": ["me"]}


@pytest.mark.parametrize("change, problem", [
    ({}, ""), ({"topic": "/other"}, "follows /other"), ({"hears": ["you"]}, "does not hear"),
    ({"ready": False}, "would not reach"),
])
def test_bridge_trusts_only_a_guard_that_hears_it_and_reaches_its_base(change, problem):
    link = GuardLink("me", "/cmd_vel", None)
    assert link.problem(0.0) == "no guard is running"
    link.heard(1.0, json.dumps({**GOOD, **change}))
    assert problem in link.problem(1.1) and bool(problem) == bool(link.problem(1.1))
    assert link.problem(2.0) == "no guard is running"


def test_guard_that_sends_another_type_than_the_base_hears_is_none_and_is_started_again():
    """A tool that listens in another type had misled it: its zeros would reach the tool alone."""
    started = []

    def start():
        process = Process()
        process.terminate = lambda: setattr(process, "returncode", 0)
        started.append(process)
        return process

    link = GuardLink("me", "/cmd_vel", start)
    link.kind = "TwistStamped"
    link.keep(0.0, 0.0)
    link.heard(1.0, json.dumps({**GOOD, "type": ""}))
    assert link.problem(1.0) == ""
    link.heard(1.1, json.dumps(GOOD))
    assert "no TwistStamped" in link.problem(1.1)
    link.keep(1.2, 1.2)
    assert started[0].returncode == 0 and "ended" in link.problem(1.3)
    link.keep(2.1, 2.1)
    link.heard(2.2, json.dumps({**GOOD, "guard": "second", "type": "TwistStamped"}))
    assert len(started) == 2 and link.problem(2.2) == "" and started[1].returncode is None


def test_guard_of_another_type_is_ended_in_simulated_time_too():
    """Vehicle time stands while the simulation does, so it falls behind the steady clock."""
    process = Process()
    process.terminate = lambda: setattr(process, "returncode", 0)
    link = GuardLink("me", "/cmd_vel", lambda: process, simulated=True)
    link.kind = "TwistStamped"
    link.keep(1.0, 1.0)
    link.heard(2.0, json.dumps(GOOD))
    link.keep(2.1, 60.0)
    assert process.returncode == 0


def test_guard_of_an_earlier_node_on_the_same_topics_does_not_disturb():
    link = GuardLink("me", "/cmd_vel", None)
    dead = {**GOOD, "guard": "other", "hears": ["dead"], "ready": False}
    for i in range(20):
        assert not link.heard(1 + i / 20, json.dumps(GOOD))
        assert not link.heard(1 + i / 20, json.dumps({**dead, "stops": i}))
        assert link.problem(1 + i / 20) == ""
    link.heard(3.0, json.dumps(dead))
    assert "does not hear" in link.problem(3.0)


def test_each_of_two_guards_counts_its_own_stops_and_one_that_serves_is_enough():
    link = GuardLink("me", "/cmd_vel", None)
    further = {**GOOD, "guard": "further", "stops": 3, "ready": False}
    for i in range(20):
        assert not link.heard(1 + i / 20, json.dumps(GOOD))
        assert not link.heard(1 + i / 20, json.dumps(further))
        assert link.problem(1 + i / 20) == ""
    assert link.heard(2.0, json.dumps({**further, "stops": 4}))
    assert not link.heard(2.0, json.dumps({**further, "stops": 4}))
    assert link.heard(2.0, json.dumps({**GOOD, "stops": 1}))
    link.heard(3.0, json.dumps(further))
    assert "would not reach" in link.problem(3.0)


def test_guard_that_has_forgotten_a_paused_node_meanwhile_still_says_that_it_stopped_it():
    link = GuardLink("me", "/cmd_vel", None)
    assert not link.heard(1.0, json.dumps(GOOD))
    assert link.heard(9.0, json.dumps({**GOOD, "hears": [], "stops": 1}))
    assert not link.heard(9.0, json.dumps({**GOOD, "hears": [], "stops": 1}))


class Process:
    """A child process that has, or has not, ended."""

    returncode = None

    def poll(self):
        return self.returncode


def test_guard_that_ended_is_started_again_after_a_pause():
    started = []

    def start():
        started.append(Process())
        return started[-1]

    link = GuardLink("me", "/cmd_vel", start)
    link.keep(0.0, 0.0), link.keep(1.0, 1.0)
    assert len(started) == 1
    started[0].returncode = 1
    assert link.problem(1.1) == "the guard ended with code 1"
    link.keep(1.2, 1.2)
    assert len(started) == 1
    link.heard(2.05, json.dumps(GOOD))
    link.keep(2.1, 2.1)
    assert len(started) == 2 and link.problem(2.11) == "no guard is running"  # whatever the dead one said


def test_guard_that_does_not_end_when_it_is_asked_is_killed():
    class Stopped(Process):
        told = ()

        def terminate(self):
            self.told = (*self.told, "terminate")

        def kill(self):
            self.told, self.returncode = (*self.told, "kill"), -9

        def wait(self, seconds=None):
            if self.returncode is None:
                raise subprocess.TimeoutExpired("guard", seconds)

    process = Stopped()
    link = GuardLink("me", "/cmd_vel", lambda: process)
    link.keep(0.0, 0.0)
    link.close()
    assert process.told == ("terminate", "kill") and process.poll() == -9


@pytest.mark.parametrize("text", ["", "nonsense", "[]", "{}", '{"session": 3, "driving": true}', '{"session": "a"}'])
def test_damaged_heartbeat_is_no_heartbeat(text):
    assert read_beat(text, session=str, driving=bool) == {}


@pytest.mark.quick
def test_a_guard_that_comes_late_itself_first_reads_what_has_arrived():
    watchdog = Watchdog()
    watchdog.tick(0.0)
    watchdog.heartbeat(0.01, "a", driving=True)
    watchdog.command(True)
    assert not watchdog.tick(1.0)  # it had no processor, and has not read yet
    watchdog.heartbeat(1.005, "a", driving=True)
    assert not watchdog.tick(1.01) and watchdog.stops == 0
    assert not watchdog.tick(1.04) and not watchdog.tick(1.08) and not watchdog.tick(1.12) and not watchdog.tick(1.15)
    assert watchdog.tick(1.16) and watchdog.stops == 1


def test_a_guard_that_always_comes_late_still_stops_a_dead_node():
    watchdog = Watchdog()
    for tick in range(20):  # each 80 ms: it shares its processor with others
        watchdog.heartbeat(0.08 * tick, "a", driving=True)
        watchdog.command(True)
        assert not watchdog.tick(0.08 * tick)
    assert not watchdog.stops and any(watchdog.tick(0.08 * tick) for tick in range(20, 25)) and watchdog.stops == 1


class Executor:
    """Serves a node by sending this process a signal."""

    def __init__(self, number):
        self.number, self.served = number, 0

    add_node = remove_node = lambda self, node: None

    def shutdown(self):
        self.number = None

    def spin_once(self, timeout_sec):
        self.served += 1
        os.kill(os.getpid(), self.number)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_each_signal_leaves_the_spin_so_that_the_node_can_say_goodbye(number, monkeypatch):
    executor = Executor(number)
    monkeypatch.setattr(ros, "make_executor", lambda: executor)
    found = signal.signal(number, signal.SIG_DFL)  # under nohup it would be ignored, and stay so
    try:
        ros.spin(object(), done=lambda: executor.served > 3)
        assert executor.served == 1 and executor.number is None and signal.getsignal(number) == signal.SIG_DFL
    finally:
        signal.signal(number, found)


def test_guard_sends_the_zeros_of_a_stop_again_to_a_listener_that_it_finds_just_after_it():
    guard = Watchdog()
    beats(guard, 0, 100)
    guard.command(True)
    assert len(silence(guard, 100, 200)) == 10
    guard.new_listener(2.0)
    assert len(silence(guard, 200, 300)) == 10
    guard.new_listener(3.2)  # long after the stop, a listener is a rider's tool
    assert not silence(guard, 320, 400)


def test_guard_sends_nothing_to_a_new_listener_when_somebody_drives_or_nobody_was_stopped():
    guard = Watchdog()
    guard.new_listener(0.5)
    beats(guard, 0, 100)
    guard.new_listener(0.99)
    guard.command(True)
    assert len(silence(guard, 100, 200)) == 10
    guard.command(True)
    guard.new_listener(2.0)
    assert not silence(guard, 200, 300)


@pytest.mark.parametrize("moves", [True, False])
def test_guard_hears_that_a_drive_is_over_only_after_the_zeros(moves):
    """So that it stops the vehicle where the goodbye is cut short."""
    said, node = [], VehicleNode.__new__(VehicleNode)
    node.decider = types.SimpleNamespace(farewell=lambda: moves)
    node.commands = types.SimpleNamespace(publish_stops=lambda: said.append("zeros"))
    node.guard = types.SimpleNamespace(session="me", close=lambda: said.append("guard ends"))
    node._heartbeat = types.SimpleNamespace(publish=lambda beat: said.append(json.loads(beat)["driving"]))
    node._string, node._lock = (lambda data: data), None
    node.close()
    assert said == ["zeros"] * moves + [False, "guard ends"]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_further_signal_does_not_disturb_a_goodbye(number):
    found = signal.getsignal(number)
    with ros.undisturbed():
        os.kill(os.getpid(), number)
    assert signal.getsignal(number) == found

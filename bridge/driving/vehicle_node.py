"""What every node that commands the vehicle shares: command topic, guard, stops from outside, arming and status.

A controller decides (`Decider`); the node carries its commands to the base and everything that may stop the vehicle to
its supervisor. A 100 Hz watch stops the vehicle within 10 ms of any limit.
"""

import argparse
import json
import math
import subprocess
import sys
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Protocol

from bridge.driving.bases import BASES
from bridge.driving.diagnosis import fitting, mixed
from bridge.driving.vehicle_time import VehicleTime
from bridge.driving.whill import ChairGate, ChairState
from bridge.nodes import ros
from bridge.nodes.commands import Commanders, CommandListener, CommandTopic, Ear, Endpoint, endpoints
from bridge.nodes.exits import OptionError
from bridge.nodes.options import in_range, topic_name, whole
from bridge.safeguards import inputs
from bridge.safeguards.guard_link import GuardLink
from bridge.safeguards.heartbeat import BEAT_PERIOD
from bridge.safeguards.joystick_lock import JoystickLock
from bridge.safeguards.safety import Command, State, Supervisor

WATCH_PERIOD = 0.01
LOOK_PERIOD = 0.2
"""Seconds between two looks at the graph."""
STATUS_PERIOD = 1.0
OVERDUE = 2.0
"""Seconds after which graph and status get their turn although it delays a command: a policy whose steps come one upon
the other leaves no time, and yet it needs a guard, and its operator a status."""
CLOCK_STEP = 0.1
"""Difference [s] of wall and steady clock between two watches that counts as a clock jump."""
NO_GUARD, NO_BASE, COMMANDERS = "no guard", "no base listens", "another node publishes commands"
LOOKING = "looking for other nodes that publish commands"
MIXED_SIGNALS = "a safety signal has two publishers"
"""ROS does not name the sender of a message, so one that says "released" would hide another that says "pulled"."""
NOT_ACTIVE = "not activated"
GUARD_STOPPED = "the guard stopped the vehicle"
UNLOCKING = 1.0
"""Seconds for which the end of a node waits for the driver to unlock the joystick."""


class Decider(Protocol):
    """What decides on the commands; pure, with injected time."""

    @property
    def supervisor(self) -> Supervisor:
        """The safety state of the drive."""

    def on_tick(self, now: float) -> Command | None:
        """Return a command where one is due at this steady time [s]."""

    def farewell(self) -> bool:
        """Return whether the vehicle needs zeros before the node ends."""


def clock_offset() -> float | None:
    """Seconds by which the wall clock is ahead of the steady one; None where a pause fell between the readings."""
    before = time.monotonic()
    offset = time.time() - before
    return offset if time.monotonic() - before < CLOCK_STEP / 2 else None


class VehicleNode:
    """Connects one decider to the ROS graph."""

    name = ""
    """Full name of the node; its guard takes it for no base."""

    def __init__(self, node: Any, decider: Decider, options: argparse.Namespace,
                 now: Callable[[], float] = time.monotonic) -> None:
        """Join the graph; call `start` when the rest of the node is made.

        Args:
            node: of the graph.
            decider: whose commands are sent.
            options: those of `add_options`.
            now: seconds in which all limits count: the steady clock, or a `VehicleTime`.
        """
        from std_msgs.msg import Empty, String

        self.node, self.decider, self.options, self.now = node, decider, options, now
        self.supervisor, self.name = decider.supervisor, ros.full_name(node)
        self.commands = CommandTopic(node, options.command_topic, options.command_type, self._on_command)
        for topic in options.yield_to:
            if node.resolve_topic_name(topic) == self.commands.name:
                raise OptionError(f"--yield-to {topic}: is the command topic {self.commands.name}, on which this node "
                                  "would yield to itself. It yields there to others anyway: leave the topic out.")
        self._drivers = [CommandListener(node, topic, "auto", self._on_driver) for topic in options.yield_to]
        self.guard = GuardLink(uuid.uuid4().hex, self.commands.name,
                               self._start_guard if options.guard == "own" else None, isinstance(now, VehicleTime))
        self._inputs = inputs.SafetyInputs(self.supervisor, options)
        self._mixed: list[str] = []  # sentences on signals with more than one publisher
        self._ear = Ear()
        self._string = String
        self._status = node.create_publisher(String, ros.STATUS_TOPIC, ros.reliable())
        self._heartbeat = node.create_publisher(String, ros.HEARTBEAT_TOPIC, ros.reliable())
        self._said_driving = False
        self._started = now()
        self._looked = self._said = -math.inf
        self._clock_offset = clock_offset()
        self._reported: tuple[str, ...] = ()
        self._others = Commanders(time.monotonic())
        self._commanders: list[str] = []
        self._listeners: list[Endpoint] = []
        node.create_subscription(Empty, ros.REARM_TOPIC, self._on_rearm, ros.reliable())
        ros.subscribe_own(node, String, ros.GUARD_TOPIC, self._on_guard, ros.reliable(10))
        self._inputs.subscribe(node, now, self._on_input)
        self._chair = ChairGate(self.supervisor) if options.whill_state else None
        if self._chair is not None:
            node.create_subscription(ros.chair_state_type(), options.whill_state, self._on_chair, ros.best_effort(10))
        self._lock = JoystickLock(ros.joystick_locker(node)) if options.joystick_lock else None
        self._jump = self._watch_clock()
        self._diagnose = ros.diagnostics(node)

    def start(self) -> None:
        """Begin to watch; the vehicle stands until its base was found."""
        self.supervisor.block(NO_BASE, True)
        self.supervisor.block(LOOKING, not self.options.allow_other_commanders)
        self._on_watch()
        ros.steady_timer(self.node, WATCH_PERIOD, self._on_watch)
        ros.steady_timer(self.node, BEAT_PERIOD, self._on_beat)

    def causes(self) -> list[str]:
        """Return what is wrong now, each with its remedy."""
        return self._mixed

    def has_time(self, now: float) -> bool:
        """Return whether looking at the graph would delay nothing now."""
        return True

    def details(self) -> dict[str, Any]:
        """Return what the status says beyond what all nodes say."""
        return {}

    def close(self) -> None:
        """Leave the vehicle standing, the base to its rider, and no guard behind.

        The guard hears last that the drive is over, so it stops the vehicle where this is cut short.
        """
        with ros.undisturbed():
            if self.decider.farewell():
                self.commands.publish_stops()
            self._beat(driving=False)
            if self._lock is not None:
                self.supervisor.latch("the node ends")  # callbacks run while the driver's answer is waited for
                self._unlock(self._lock)
            self.guard.close()

    def _unlock(self, lock: JoystickLock) -> None:
        """Give the chair its joystick back, and wait shortly for the driver's answer."""
        end = time.monotonic() + UNLOCKING
        while lock.locked is not False and time.monotonic() < end:
            lock.want(self.now(), False)
            ros.spin_some(self.node, 0.05)
        if lock.locked is not False:
            self.node.get_logger().error("the chair's joystick may still be locked: the driver did not answer. Call "
                                         f"{ros.JOYSTICK_LOCK_SERVICE} with d0: 0")

    def _on_active_change(self, active: bool) -> None:
        self.supervisor.block(NOT_ACTIVE, not active)
        self._publish(self.decider.on_tick(self.now()))

    def _watch_clock(self) -> Any:
        """Report jumps of the node's clock to the supervisor."""
        from rclpy.clock import JumpThreshold
        from rclpy.duration import Duration

        jump = JumpThreshold(min_forward=Duration(seconds=0.5), min_backward=Duration(seconds=-0.01),
                             on_clock_change=True)
        return self.node.get_clock().create_jump_callback(jump, post_callback=lambda _: self.supervisor.clock_jump())

    def _start_guard(self) -> Any:
        """Start a guard that outlives this process, its terminal included, by some seconds."""
        arguments = ["--command-topic", self.commands.name,
                     "--command-type", self.commands.kind or self.options.command_type,
                     "--follow", self.guard.session, "--realtime", str(self.options.realtime)]
        arguments += ["--joystick-lock"] if self.options.joystick_lock else []
        simulated = str(isinstance(self.now, VehicleTime)).lower()  # the guard counts in the same time
        return subprocess.Popen([sys.executable, "-m", "bridge.guard", *arguments, "--ros-args", "-r",
                                 f"__ns:={self.node.get_namespace()}", "-p", f"use_sim_time:={simulated}"],
                                start_new_session=True,
                                cwd=Path(__file__).resolve().parents[2])  # so that -m finds this very package

    def _on_watch(self) -> None:
        now, before, offset = self.now(), self._clock_offset, clock_offset()
        if offset is not None:
            self._clock_offset = offset
            if before is not None and abs(offset - before) > CLOCK_STEP:
                self.supervisor.clock_jump()
        self._inputs.watch(now)
        if self._chair is not None:
            self._chair.watch(now)
        if self._lock is not None:
            self._lock.follow(now, self.supervisor)
        self.supervisor.block(NO_GUARD, bool(self.guard.problem(now)))
        self._publish(self.decider.on_tick(now))
        steady = time.monotonic()
        if self.has_time(now) or steady - min(self._looked, self._said) > OVERDUE:
            self._keep_house(steady)

    def _keep_house(self, now: float) -> None:
        """Look at the graph and report, where it is time: by the steady clock, since a graph does not wait."""
        if now - self._looked >= LOOK_PERIOD:
            self._looked = now
            self._on_look()
        elif now - self._said >= STATUS_PERIOD:
            self._on_status()

    def _on_command(self, v: float, omega: float, marked: bool) -> None:
        if self._ear.heard(v, omega, marked):
            self.supervisor.foreign_command(self.now())

    def _on_driver(self, v: float, omega: float, marked: bool) -> None:
        self.supervisor.foreign_command(self.now())

    def _on_guard(self, message: Any) -> None:
        if not self.guard.heard(self.now(), message.data):
            return
        if self._lock is not None:
            self._lock.forget()  # the guard has unlocked it
        if self.supervisor.may_drive:
            self.supervisor.fault(GUARD_STOPPED)

    def _on_input(self, now: float) -> None:
        self._publish(self.decider.on_tick(now))

    def _on_chair(self, state: Any) -> None:
        now = self.now()
        if self._chair is not None:
            self._chair.take(now, ChairState.of(state))
        self._publish(self.decider.on_tick(now))

    def _on_rearm(self, _: Any) -> None:
        if not self.supervisor.arm():
            why = ", ".join(self.supervisor.holds) or self.supervisor.reason
            self.node.get_logger().error(f"not armed: {why} still holds")
        elif self._lock is not None:
            self._lock.follow(self.now(), self.supervisor)  # now: a frame may come before the next watch

    def _on_beat(self) -> None:
        self._beat(self.supervisor.may_drive)

    def _beat(self, driving: bool) -> None:
        self._said_driving = driving
        beat = {"session": self.guard.session, "driving": driving, "node": self.name}
        self._heartbeat.publish(self._string(data=json.dumps(beat)))

    def _on_look(self) -> None:
        """Look at the graph: who listens, who else commands; keep the guard running."""
        now = time.monotonic()
        for topic in (self.commands, *self._drivers):
            topic.look()
        self.guard.kind = self.commands.kind  # a tool that listens in another type must not mislead the guard
        self.guard.keep(self.now(), now)
        self._listeners = self.commands.listeners()
        self.supervisor.block(NO_BASE, not any(map(self.commands.hears_us, self._listeners)))
        self._mixed = [mixed(topic, found, "values") for topic, found in self._signals() if len(found) > 1]
        self.supervisor.block(MIXED_SIGNALS, bool(self._mixed))
        self._others.look(now, self.commands.commanders())
        self._commanders = self._others.names(now)
        alone = not self.options.allow_other_commanders
        self.supervisor.block(COMMANDERS, alone and bool(self._commanders))
        self.supervisor.block(LOOKING, alone and not self.supervisor.may_drive and not self._others.settled(now))
        if (self.supervisor.state.value, self.supervisor.reason) != self._reported[:2]:
            self._on_status()

    def _signals(self) -> Iterator[tuple[str, list[Endpoint]]]:
        """The topics of the safety signals, each with those who publish what is read there."""
        for name, kind in self._inputs.topics.items():
            topic = self.node.resolve_topic_name(name)
            yield topic, fitting(endpoints(self.node.get_publishers_info_by_topic(topic)), kind)

    def _on_status(self) -> None:
        self._said = time.monotonic()
        supervisor = self.supervisor
        state, reason, found = supervisor.state, supervisor.reason, self.causes()
        status: dict[str, Any] = {"state": state.value, "driving": state is State.DRIVING, "reason": reason,
                                  "holds": supervisor.holds, "causes": found, "counts": dict(supervisor.counts),
                                  **self.details()}
        self._status.publish(self._string(data=json.dumps(status)))
        text = ". ".join(part.rstrip(".") for part in [f"{state.value}: {reason}" if reason else state.value, *found])
        self._diagnose(state is State.DRIVING and not found, text, status["counts"])
        report = (state.value, reason, *found)
        if report != self._reported:
            log = self.node.get_logger()
            log.warning(text) if reason or found else log.info(text)
        self._reported = report

    def _publish(self, command: Command | None) -> None:
        if command is not None:
            if self.supervisor.may_drive and not self._said_driving:
                self._on_beat()  # before the first motion: if this process dies now, the guard must know of it
            self._ear.sent(command.v, command.omega)
            self.commands.publish(command.v, command.omega)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the base, the command topic, the guard and the stops from outside."""
    parser.add_argument("--base", choices=sorted(BASES), default="whill",
                        help="what is below the command topic: its range, and whether it needs zeros held after a stop")
    parser.add_argument("--whill-state", type=topic_name, default="", metavar="TOPIC",
                        help="whill_msgs/ModelCr2State: drive only a chair that is on, sound, charged and not driven "
                             f"by its joystick; such as {ros.CHAIR_STATE_TOPIC}")
    parser.add_argument("--joystick-lock", action="store_true",
                        help="lock the chair's joystick while the vehicle is armed, by the driver's service "
                             f"{ros.JOYSTICK_LOCK_SERVICE}; it is unlocked at each stop that needs an operator, at the "
                             "end, and by the guard where this node dies")
    parser.add_argument("--v-limits", type=in_range(-100, 100), nargs=2, metavar=("LOW", "HIGH"),
                        help="[m/s]; default: those of policy and base")
    parser.add_argument("--omega-limits", type=in_range(-100, 100), nargs=2, metavar=("LOW", "HIGH"),
                        help="[rad/s]; default: those of policy and base")
    parser.add_argument("--command-topic", type=topic_name, default=ros.COMMAND_TOPIC,
                        help="topic of the commands that drive the vehicle")
    parser.add_argument("--command-type", choices=("auto", "Twist", "TwistStamped"), default="auto",
                        help="auto: as the base listens")
    parser.add_argument("--guard", choices=("own", "other"), default="own",
                        help="own: start a guard process; other: wait for one, such as a guard of another computer")
    parser.add_argument("--allow-other-commanders", action="store_true",
                        help="drive although another node could send commands; when it does, it drives")
    parser.add_argument("--yield-to", type=topic_name, nargs="+", default=(), metavar="TOPIC",
                        help="who sends commands on one of these topics drives, and an operator arms afterwards: of a "
                             "twist_mux, each source that goes before this node")
    parser.add_argument("--realtime", type=whole(0, 99), default=0, metavar="PRIORITY",
                        help="SCHED_FIFO priority, like 20; it also keeps the processor awake")
    inputs.add_options(parser)


def limits(low: tuple[float, float], high: tuple[float, float], options: argparse.Namespace
           ) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the smallest and largest command: these, narrowed by base and command line, zero always included.

    Raises:
        OptionError: limits of the command line that leave out zero.
    """
    base = BASES[options.base]
    lows = [max(min(a, 0.0), b) for a, b in zip(low, base.low, strict=True)]
    highs = [min(max(a, 0.0), b) for a, b in zip(high, base.high, strict=True)]
    for i, (name, narrower) in enumerate((("--v-limits", options.v_limits), ("--omega-limits", options.omega_limits))):
        if narrower and not narrower[0] <= 0 <= narrower[1]:
            raise OptionError(f"{name} {narrower[0]:g} {narrower[1]:g}: the first must be at most 0 and the second at "
                              "least, because stopping is a zero command. Correct them.")
        if narrower:
            lows[i], highs[i] = max(lows[i], narrower[0]), min(highs[i], narrower[1])
    return (lows[0], lows[1]), (highs[0], highs[1])

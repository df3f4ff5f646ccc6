"""The ROS node of the guard: hears policy nodes and commands, and publishes zeros where its watchdog says so."""

import argparse
import json
import time
import uuid
from collections.abc import Callable
from typing import Any

from bridge.driving.vehicle_time import VehicleTime
from bridge.nodes import ros
from bridge.nodes.commands import CommandTopic
from bridge.safeguards.heartbeat import BEAT_PERIOD, SIMULATED, read_beat
from bridge.safeguards.joystick_lock import JoystickLock
from bridge.safeguards.watchdog import FORGET, SILENCE, Watchdog

WATCH_PERIOD = 0.01
PATIENCE = 30.0
"""Seconds that a guard waits for the first heartbeat of the node that it follows."""


class GuardNode:
    """Connects one watchdog to the ROS graph."""

    def __init__(self, node: Any, options: argparse.Namespace) -> None:
        from std_msgs.msg import String

        self.node, self.watchdog = node, Watchdog()
        self._follow = options.follow
        self._followed = time.monotonic() + PATIENCE
        self.now: Callable[[], float] = time.monotonic
        if ros.uses_simulated_time(node):
            self.now, self.watchdog = (vehicle_time := VehicleTime()), Watchdog(SIMULATED * SILENCE)
            ros.subscribe_clock(node, lambda _: vehicle_time.on_clock())
        self._ready, self._matched = False, 0
        self._name = uuid.uuid4().hex
        self._lock = JoystickLock(ros.joystick_locker(node)) if options.joystick_lock else None
        self._type = String
        self.topic = CommandTopic(node, options.command_topic, options.command_type, self._on_command)
        self._beat = node.create_publisher(String, ros.GUARD_TOPIC, ros.reliable())
        ros.subscribe_own(node, String, ros.HEARTBEAT_TOPIC, self._on_heartbeat, ros.reliable(10))
        ros.steady_timer(node, WATCH_PERIOD, self._on_watch)
        ros.steady_timer(node, BEAT_PERIOD, self._on_beat)
        ros.steady_timer(node, 0.1, self._on_look)

    def finished(self) -> bool:
        """Return whether the one node that this guard follows is gone."""
        return bool(self._follow) and time.monotonic() - self._followed > 2 * FORGET

    def _on_command(self, v: float, omega: float, marked: bool) -> None:
        self.watchdog.command(v != 0 or omega != 0)  # not-finite values compare unequal to 0: they count as motion

    def _on_heartbeat(self, message: Any) -> None:
        beat = read_beat(message.data, session=str, driving=bool)
        if isinstance(name := beat.get("node"), str) and self.topic.know(name):  # of another name than usual: no base
            self._ready = False  # until the next look
        if beat and self._follow in ("", beat["session"]):
            self._followed = time.monotonic()
            self.watchdog.heartbeat(self.now(), beat["session"], beat["driving"])

    def _on_watch(self) -> None:
        stops = self.watchdog.stops
        if self.watchdog.tick(self.now()):
            self.topic.publish(0.0, 0.0, marked=True)
        if self._lock is not None and self.watchdog.abandoned:
            self._lock.want(time.monotonic(), False)  # it outlives the node that asked for it
        elif self._lock is not None:
            self._lock.forget()
        if self.watchdog.stops != stops:
            self.node.get_logger().error(f"the policy node gave no sign of life for {self.watchdog.silence:g} s: "
                                         "vehicle stopped")

    def _on_beat(self) -> None:
        watchdog = self.watchdog
        beat = {"guard": self._name, "topic": self.topic.name, "type": self.topic.kind, "ready": self._ready,
                "stops": watchdog.stops, "hears": sorted(watchdog.heard)}
        self._beat.publish(self._type(data=json.dumps(beat)))

    def _on_look(self) -> None:
        """Find out whether a zero would reach the base."""
        before, topic = self._ready, self.topic
        there = topic.look() and any(map(topic.hears_us, topic.listeners()))
        self._ready = there and (before or topic.reaches_all())  # a further reader does not end a drive
        matched = topic.publisher.get_subscription_count() if topic.publisher is not None else 0
        if matched > self._matched:
            self.watchdog.new_listener(self.now())
        self._matched = matched
        if self._ready and not before:
            self.node.get_logger().info(f"guarding {self.topic.name} ({self.topic.kind})")

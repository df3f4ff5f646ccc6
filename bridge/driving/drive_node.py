"""The ROS node that drives a vehicle with a policy: frames in, commands out, and what is wrong with either."""

import argparse
import time
from collections.abc import Callable
from typing import Any

from bridge.driving.controller import Controller
from bridge.driving.diagnosis import Evidence, FrameLog, causes, input_cause, is_mixed
from bridge.driving.vehicle_node import NOT_ACTIVE, WATCH_PERIOD, VehicleNode
from bridge.nodes import ros
from bridge.nodes.commands import Endpoint, endpoints
from bridge.policy import SensorInput
from bridge.safeguards.safety import Command
from bridge.sensing.image import ImageError
from bridge.sensing.sense_topics import SenseTopic, reader_of, topics_of
from bridge.sensing.senses import SenseError

PAUSE = (0.01, 0.06)
"""Seconds after a step between which there is time for housekeeping: the last command is out, the next step far."""
IDLE = 0.3
"""Seconds without a step after which there is always time."""
CLOCK_STANDS = "simulated time stands"
MIXED = "an input has two publishers"
STARTING = 2.0
"""Seconds that the discovery of other nodes may take."""


class DriveNode(VehicleNode):
    """Connects one controller to the ROS graph."""

    def __init__(self, node: Any, controller: Controller, options: argparse.Namespace) -> None:
        super().__init__(node, controller, options)
        self.controller = controller
        self._frames = FrameLog()
        self._incompatible = False
        self._publishers: dict[str, list[Endpoint]] = {}
        self._camera_since = self._started
        pacer = controller.policy.pacer
        self._topics = {name: SenseTopic(node.resolve_topic_name(self._topic_name(name, topic)), topic.kind)
                        for name, topic in topics_of(controller.policy.sensors).items()}
        if pacer.kind == "camera" and options.compressed:
            self._topics[pacer.name] = SenseTopic(self._topics[pacer.name].topic, "sensor_msgs/CompressedImage")
        self._pacer = self._topics[pacer.name]
        heard = self._on_image if pacer.kind == "camera" else self._on_paced(pacer)
        ros.subscribe_images(node, self._pacer.message, self._pacer.topic, heard, self._on_incompatible, self._on_lost)
        for name, stream in controller.senses.streams.items():
            topic = self._topics[name]
            node.create_subscription(topic.message, topic.topic, self._on_sensed(stream.sensor), ros.best_effort())
        self._ticked, self._simulated = self._started, 0
        if ros.uses_simulated_time(node):
            ros.steady_timer(node, WATCH_PERIOD, self._watch_simulated_time)
        if options.lifecycle:
            self.supervisor.block(NOT_ACTIVE, True)
            node.on_active_change = self._on_active_change
        self.start()

    def _topic_name(self, name: str, topic: SenseTopic) -> str:
        """Return the topic of a sensor before remapping: that of the first camera is an option."""
        paces = name == self.controller.policy.pacer.name and topic.topic == ros.IMAGE_TOPIC
        return self.options.image_topic if paces else topic.topic

    def has_time(self, now: float) -> bool:
        """Return whether the last command is out and the next step far."""
        since = now - self.controller.stepped
        return PAUSE[0] <= since <= PAUSE[1] or since > IDLE

    def _watch_simulated_time(self) -> None:
        """Hold the vehicle while /clock stands: no stamp says how old a frame is then."""
        now, simulated = time.monotonic(), self.node.get_clock().now().nanoseconds
        if simulated != self._simulated:
            self._ticked, self._simulated = now, simulated
        self.supervisor.block(CLOCK_STANDS, now + WATCH_PERIOD - self._ticked > self.options.frame_age)

    def _on_look(self) -> None:
        """Look at the graph, also for who sends the policy's inputs: it does not drive on a mixture of two sources."""
        self._publishers = {name: endpoints(self.node.get_publishers_info_by_topic(topic.topic))
                            for name, topic in self._topics.items()}
        kinds = {name: topic.full_kind for name, topic in self._topics.items()}
        self.supervisor.block(MIXED, is_mixed(self._publishers, kinds))
        super()._on_look()

    def causes(self) -> list[str]:
        """Return what is wrong with sensors, base and guard now, each with its remedy."""
        now = time.monotonic()
        found = causes(self._evidence()) + super().causes()
        for name, stream in self.controller.senses.streams.items():
            topic = self._topics[name]
            publishers = self._publishers.get(name, [])
            cause = input_cause(name, topic.topic, topic.full_kind, publishers, stream, now)
            if cause and (publishers or now - self._started > STARTING):
                found.append(cause)
        return found

    def _on_image(self, message: Any) -> None:
        now = time.monotonic()
        stamp, age = self._stamp_of(message)
        if self.options.compressed:
            command = self.controller.on_compressed(now, stamp, age, message.data)
        else:
            command = self.controller.on_image(now, stamp, age, message)
        self._took_paced(now, stamp, age, command)

    def _on_paced(self, sensor: SensorInput) -> Callable[[Any], None]:
        """Return what takes the messages of a pacer that is no camera."""
        read = reader_of(sensor, self.controller.senses.unwrapped)

        def heard(message: Any) -> None:
            now, command = time.monotonic(), None
            stamp, age = self._stamp_of(message)
            try:
                value, digest = read(message)
                command = self.controller.on_paced(now, stamp, age, value, digest)
            except (SenseError, ImageError) as error:
                self.controller.refuse(str(error))
            self._took_paced(now, stamp, age, command)

        return heard

    def _on_sensed(self, sensor: SensorInput) -> Callable[[Any], None]:
        """Return what takes the messages of a sensor beside the pacer."""
        read = reader_of(sensor, self.controller.senses.unwrapped)

        def heard(message: Any) -> None:
            now = time.monotonic()
            try:
                value, digest = read(message)
            except (SenseError, ImageError) as error:
                self.controller.senses.streams[sensor.name].refuse(now, str(error))
                return
            stamp, age = self._stamp_of(message)
            self._publish(self.controller.on_sensed(now, sensor.name, stamp, age, value, digest))

        return heard

    def _publish(self, command: Command | None) -> None:
        """Send a command, and then begin the next step: its frame is still far."""
        super()._publish(command)
        self.controller.prepare()

    def _stamp_of(self, message: Any) -> tuple[float, float]:
        """Return the stamp of a message and its age [s], on the node's clock."""
        stamp = ros.stamp_seconds(message.header.stamp)
        return stamp, self.node.get_clock().now().nanoseconds * 1e-9 - stamp

    def _took_paced(self, now: float, stamp: float, age: float, command: Command | None) -> None:
        """Send what a message of the pacer gave, and note the message."""
        self._publish(command)
        self._incompatible = False
        digest = -self.supervisor.counts["unusable"] if self.controller.unusable else self.controller.digest
        self._frames.frame(now, stamp, age, digest)

    def _on_incompatible(self, _: Any) -> None:
        self._incompatible = True

    def _on_lost(self, event: Any) -> None:
        self._frames.lost(time.monotonic(), event.total_count_change)

    def _evidence(self) -> Evidence:
        now = time.monotonic()
        self._frames.trim(now)
        cameras = self._publishers.get(self.controller.policy.pacer.name, [])
        if not cameras:
            self._camera_since = now
        settled = self._frames.is_full(now) if self._frames.count else now - self._camera_since > STARTING
        return Evidence(
            image_topic=self._pacer.topic, image_type=self._pacer.full_kind, cameras=cameras,
            sensor=self.controller.policy.pacer.kind, frames=self._frames,
            rate_hz=self.controller.policy.commands.rate_hz, stamp_limit=self.options.stamp_age,
            command_topic=self.commands.name, command_type=self.commands.kind, listeners=self._listeners,
            guard=self.guard.problem(now), settled=settled, silence=self._frames.silence(now),
            image_bytes=self.controller.image_bytes, incompatible=self._incompatible,
            unusable=self.controller.unusable, blind=self.controller.is_blind,
            pace_by_stamp=self.options.pace == "stamp", commanders=self._commanders,
            starting=now - self._started < STARTING)

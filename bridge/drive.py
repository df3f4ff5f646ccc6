"""Run the policy node: camera image, or whatever else the policy reads, in; wheel command out.

    python -m bridge.drive runs/corridor/policy

Commands are computed when a frame arrives; a 100 Hz watch stops the vehicle within 10 ms of any limit. The node's state
is published as JSON on bridge/status once a second and whenever it changes; a message on bridge/rearm arms it.
"""

import argparse
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from bridge import parameters, ros, scheduling
from bridge.bases import BASES
from bridge.commands import Endpoint, endpoints
from bridge.controller import Caution, Controller
from bridge.diagnosis import Evidence, FrameLog, causes, input_cause, is_mixed
from bridge.exits import Exit, OptionError, refusal
from bridge.image import ImageError
from bridge.options import Parser, ends_at_ctrl_c, in_range, result_file, topic_name, whole
from bridge.policy import Policy, SensorInput
from bridge.safety import Command, SafetyConfig
from bridge.sense_topics import SenseTopic, reader_of, topics_of
from bridge.senses import SenseError
from bridge.vehicle_node import NOT_ACTIVE, WATCH_PERIOD, VehicleNode, add_options, limits
from bridge.view import view_of

PAUSE = (0.01, 0.06)
"""Seconds after a step between which there is time for housekeeping: the last command is out, the next step far."""
SILENCE = 0.3
"""Seconds without a step after which there is always time."""
CLOCK_STANDS = "simulated time stands"
MIXED = "an input has two publishers"
STARTING = 2.0
"""Seconds that the discovery of other nodes may take."""


def parse_arguments(arguments: list[str]) -> argparse.Namespace:
    """Return the options of the command line."""
    parser = Parser(prog="bridge.drive", description="Drive a vehicle with a policy file.")
    parser.add_argument("policy", nargs="+", help="policy file: a folder or a zip of it; of several the last counts")
    parser.add_argument("--slew", type=in_range(0, infinite=True), nargs=2, metavar=("V", "OMEGA"),
                        default=(math.inf, math.inf),
                        help="largest change of commands [m/s2, rad/s2]; a stop is not slowed")
    parser.add_argument("--image-topic", type=topic_name, default=ros.IMAGE_TOPIC,
                        help="topic of the camera's images")
    parser.add_argument("--compressed", action="store_true",
                        help="the image topic carries sensor_msgs/CompressedImage (JPEG or PNG)")
    parser.add_argument("--crop", type=whole(0, 100_000), nargs=4, metavar=("TOP", "LEFT", "HEIGHT", "WIDTH"),
                        help="the part of the camera's image that the policy sees [pixels]")
    parser.add_argument("--calibration", type=Path, metavar="FILE",
                        help="of the camera's lens (YAML of camera_calibration): the policy sees what the camera of "
                        "its training would see")
    parser.add_argument("--stamp-age", type=in_range(0, infinite=True), default=SafetyConfig.stamp_age,
                        help="largest age of a stamp [s]; inf where camera and bridge share no clock")
    parser.add_argument("--frame-age", type=in_range(0, infinite=True), default=SafetyConfig.frame_age,
                        help="largest age of a frame since its receipt [s]")
    parser.add_argument("--pace", choices=("wall", "stamp"), default="wall",
                        help="clock of the policy's rate; stamp: for a simulator that is not in real time")
    parser.add_argument("--blind", choices=("warn", "slow", "stop"), default="warn",
                        help="what a black or saturated camera causes")
    parser.add_argument("--novel", choices=("ignore", "slow", "stop"), default="stop",
                        help="what surroundings unlike the training cause, where the policy file has a score for them")
    parser.add_argument("--resume", choices=("auto", "arm"), default="auto",
                        help="after a stop that passes by itself: drive again, or wait for an operator")
    parser.add_argument("--require-arm", action="store_true", help="stand until a first message on bridge/rearm")
    parser.add_argument("--lifecycle", action="store_true",
                        help="be a lifecycle node, which stands until it is configured and activated")
    parser.add_argument("--results", type=result_file("counts", "reason"),
                        help="JSON file for the counts of the drive, written at its end")
    add_options(parser)
    options = parser.parse_intermixed_args(arguments)
    options.policy = options.policy[-1]  # the first ones come from parameter files
    return options


def safety_config(policy: Policy, options: argparse.Namespace) -> SafetyConfig:
    """Return the limits in force: the policy's own, narrowed by base and command line, zero always included."""
    low, high = limits(policy.commands.low, policy.commands.high, options)
    if not all(options.slew):
        raise OptionError(f"--slew {options.slew[0]:g} {options.slew[1]:g}: both must be above 0, or the vehicle never "
                          "moves. Correct them or leave them out.")
    return SafetyConfig(low=low, high=high, slew=(options.slew[0], options.slew[1]),
                        frame_age=options.frame_age, stamp_age=options.stamp_age,
                        hold_zeros=BASES[options.base].hold_zeros, expiry=BASES[options.base].expiry,
                        require_arm=options.require_arm, auto_resume=options.resume == "auto")


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
        return PAUSE[0] <= since <= PAUSE[1] or since > SILENCE

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


@ends_at_ctrl_c
def main(arguments: list[str] | None = None) -> int:
    """Run the node until SIGTERM or Ctrl-C; return an `Exit`: FAULT where the policy file is refused."""
    own, ros_arguments = ros.split_ros_arguments(sys.argv[1:] if arguments is None else arguments)
    try:
        options = parse_arguments(parameters.with_options(ros_arguments, ros.DRIVE_NAME, "policy", own))
        # First the scheduling, which the policy's second thread takes over. In the normal one a step takes one thread.
        alone = bool(options.realtime) and scheduling.set_realtime(ros.DRIVE_NAME, options.realtime)
        policy = Policy.load(options.policy, threads=2 if alone else 1)
        if options.joystick_lock and not options.require_arm:
            raise OptionError("--joystick-lock takes the joystick from the rider, so an operator must arm. Give "
                              "--require-arm too.")
        if options.compressed and policy.pacer.kind != "camera":
            raise OptionError(f"--compressed is of camera images, and {options.policy} is paced by a "
                              f"{policy.pacer.kind}. Leave it out.")
        if options.image_topic != ros.IMAGE_TOPIC and policy.pacer.kind != "camera":
            raise OptionError(f"--image-topic {options.image_topic}: {options.policy} has no camera. Leave it out, and "
                              f"remap the topic of its {policy.pacer.kind} with --ros-args -r.")
        safety = safety_config(policy, options)
        view = view_of(policy.pacer, options.crop and tuple(options.crop), options.calibration)
    except ValueError as error:
        print(f"bridge.drive: {error}", file=sys.stderr)
        return refusal(error)
    with ros.node_session(ros.DRIVE_NAME, ros_arguments, managed=options.lifecycle) as node:
        controller = Controller(policy, safety, caution=Caution(options.blind, options.novel),
                                pace_by_stamp=options.pace == "stamp", view=view)
        drive = DriveNode(node, controller, options)
        try:
            ros.spin(node)
        finally:
            drive.close()
        if options.results:
            supervisor = drive.supervisor
            ros.write_json(options.results, {"counts": dict(supervisor.counts), "reason": supervisor.reason})
    return Exit.DONE


if __name__ == "__main__":
    sys.exit(main())

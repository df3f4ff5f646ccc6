"""The policy node: camera image in, wheel command out.

    python -m bridge.drive runs/corridor/policy

Commands are computed when a frame arrives; a 100 Hz watch stops the vehicle within 10 ms of any limit. The node's state
is published as JSON on bridge/status once a second and whenever it changes; a message on bridge/rearm arms it.
"""

import argparse
import json
import math
import subprocess
import sys
import time
import uuid
from pathlib import Path
from typing import Any

from bridge import inputs, parameters, ros
from bridge.bases import BASES
from bridge.commands import CommandTopic, Ear, Endpoint, endpoints
from bridge.controller import Controller
from bridge.diagnosis import Evidence, FrameLog, causes
from bridge.guard import BEAT_PERIOD, GuardLink
from bridge.policy import Policy, PolicyFileError
from bridge.safety import Command, SafetyConfig, State
from bridge.whill import ChairGate, ChairState

WATCH_PERIOD = 0.01
LOOK_PERIOD = 0.2
"""Seconds between two looks at the graph."""
STATUS_PERIOD = 1.0
PAUSE = (0.01, 0.06)
"""Seconds after a frame between which there is time for housekeeping: the last command is out, the next frame far."""
SILENCE = 0.3
"""Seconds without a frame after which there is always time."""
STARTING = 2.0
"""Seconds that the discovery of other nodes may take."""
CLOCK_STEP = 0.1
"""Difference [s] of wall and steady clock between two watches that counts as a clock jump."""
NO_GUARD, NO_BASE, COMMANDERS = "no guard", "no base listens", "another node publishes commands"
NOT_ACTIVE = "not activated"
GUARD_STOPPED = "the guard stopped the vehicle"


def parse_arguments(arguments: list[str]) -> argparse.Namespace:
    """Return the options of the command line."""
    parser = argparse.ArgumentParser(prog="bridge.drive", description="Drive a vehicle with a policy file.")
    parser.add_argument("policy", nargs="+", help="policy file: a folder or a zip of it; of several the last counts")
    parser.add_argument("--base", choices=sorted(BASES), default="whill",
                        help="what is below the command topic: its range, and whether it needs zeros held after a stop")
    parser.add_argument("--whill-state", default="", metavar="TOPIC",
                        help="whill_msgs/ModelCr2State: drive only a chair that is on, sound, charged and not driven "
                             f"by its joystick; such as {ros.CHAIR_STATE_TOPIC}")
    parser.add_argument("--v-limits", type=float, nargs=2, metavar=("LOW", "HIGH"), help="[m/s]; default: the policy's")
    parser.add_argument("--omega-limits", type=float, nargs=2, metavar=("LOW", "HIGH"), help="[rad/s]")
    parser.add_argument("--slew", type=float, nargs=2, metavar=("V", "OMEGA"), default=(math.inf, math.inf),
                        help="largest change of commands [m/s2, rad/s2]; a stop is not slowed")
    parser.add_argument("--image-topic", default=ros.IMAGE_TOPIC)
    parser.add_argument("--compressed", action="store_true",
                        help="the image topic carries sensor_msgs/CompressedImage (JPEG or PNG)")
    parser.add_argument("--crop", type=int, nargs=4, metavar=("TOP", "LEFT", "HEIGHT", "WIDTH"),
                        help="the part of the camera's image that the policy sees [pixels]")
    parser.add_argument("--command-topic", default=ros.COMMAND_TOPIC)
    parser.add_argument("--command-type", choices=("auto", "Twist", "TwistStamped"), default="auto",
                        help="auto: as the base listens")
    parser.add_argument("--guard", choices=("own", "other"), default="own",
                        help="own: start a guard process; other: wait for one, such as a guard of another computer")
    parser.add_argument("--stamp-age", type=float, default=SafetyConfig.stamp_age,
                        help="largest age of a stamp [s]; inf where camera and bridge share no clock")
    parser.add_argument("--frame-age", type=float, default=SafetyConfig.frame_age,
                        help="largest age of a frame since its receipt [s]")
    parser.add_argument("--pace", choices=("wall", "stamp"), default="wall",
                        help="clock of the policy's rate; stamp: for a simulator that is not in real time")
    parser.add_argument("--blind", choices=("warn", "slow", "stop"), default="warn",
                        help="what a black or saturated camera causes")
    parser.add_argument("--novel", choices=("ignore", "slow", "stop"), default="stop",
                        help="what surroundings unlike the training cause, where the policy file has a score for them")
    parser.add_argument("--resume", choices=("auto", "arm"), default="auto",
                        help="after a stop that passes by itself: drive again, or wait for an operator")
    parser.add_argument("--allow-other-commanders", action="store_true",
                        help="drive although another node could send commands; when it does, it drives")
    parser.add_argument("--realtime", type=int, default=0, metavar="PRIORITY", help="SCHED_FIFO priority, like 20")
    parser.add_argument("--require-arm", action="store_true", help="stand until a first message on bridge/rearm")
    parser.add_argument("--lifecycle", action="store_true",
                        help="be a lifecycle node, which stands until it is configured and activated")
    parser.add_argument("--results", type=Path, help="JSON file for the counts of the drive, written at its end")
    inputs.add_options(parser)
    options = parser.parse_intermixed_args(arguments)
    options.policy = options.policy[-1]  # the first ones come from parameter files
    return options


def safety_config(policy: Policy, options: argparse.Namespace) -> SafetyConfig:
    """Return the limits in force: the policy's own, narrowed by base and command line, zero always included."""
    contract, base = policy.contract, BASES[options.base]
    low = [max(min(a, 0.0), b) for a, b in zip(contract.low, base.low, strict=True)]
    high = [min(max(a, 0.0), b) for a, b in zip(contract.high, base.high, strict=True)]
    for i, limits in enumerate((options.v_limits, options.omega_limits)):
        if limits:
            low[i], high[i] = max(low[i], limits[0]), min(high[i], limits[1])
    return SafetyConfig(low=(low[0], low[1]), high=(high[0], high[1]), slew=(options.slew[0], options.slew[1]),
                        frame_age=options.frame_age, stamp_age=options.stamp_age, hold_zeros=base.hold_zeros,
                        require_arm=options.require_arm, auto_resume=options.resume == "auto")


class DriveNode:
    """Connects one controller to the ROS graph."""

    def __init__(self, node: Any, controller: Controller, options: argparse.Namespace) -> None:
        from sensor_msgs.msg import CompressedImage, Image
        from std_msgs.msg import Empty, String

        self.node, self.controller, self.options = node, controller, options
        self.supervisor = controller.supervisor
        self.commands = CommandTopic(node, options.command_topic, options.command_type, self._on_command)
        self.guard = GuardLink(uuid.uuid4().hex, self.commands.name,
                               self._start_guard if options.guard == "own" else None)
        self._inputs = inputs.SafetyInputs(self.supervisor, options)
        self._ear = Ear()
        self._frames = FrameLog()
        self._image_topic = node.resolve_topic_name(options.image_topic)
        self._string = String
        self._status = node.create_publisher(String, ros.STATUS_TOPIC, ros.reliable())
        self._heartbeat = node.create_publisher(String, ros.HEARTBEAT_TOPIC, ros.reliable())
        self._incompatible = self._said_driving = False
        self._started = time.monotonic()
        self._camera_since = self._started
        self._last_frame = self._looked = self._said = -math.inf
        self._clock_offset = time.time() - self._started
        self._reported: tuple[str, ...] = ()
        self._commanders: list[str] = []
        self._listeners: list[Endpoint] = []
        self._guard_stops = 0
        self._image_type = CompressedImage if options.compressed else Image
        ros.subscribe_images(node, self._image_type, self._image_topic, self._on_image, self._on_incompatible,
                             self._on_lost)
        node.create_subscription(Empty, ros.REARM_TOPIC, self._on_rearm, ros.reliable())
        ros.subscribe_own(node, String, ros.GUARD_TOPIC, self._on_guard, ros.reliable(10))
        self._inputs.subscribe(node, self._on_input)
        self._chair = ChairGate(self.supervisor) if options.whill_state else None
        if self._chair is not None:
            node.create_subscription(ros.chair_state_type(), options.whill_state, self._on_chair, ros.best_effort(10))
        self._jump = self._watch_clock()
        self._diagnose = ros.diagnostics(node)
        if options.lifecycle:
            self.supervisor.block(NOT_ACTIVE, True)
            node.on_active_change = self._on_active_change
        self.supervisor.block(NO_BASE, True)
        self._on_watch()
        ros.steady_timer(node, WATCH_PERIOD, self._on_watch)
        ros.steady_timer(node, BEAT_PERIOD, self._on_beat)

    def close(self) -> None:
        """Leave the vehicle standing, the base to its rider, and no guard behind."""
        stop = self.controller.farewell()
        self._beat(driving=False)
        if stop:
            self.commands.publish_stops()
        self.guard.close()

    def _on_active_change(self, active: bool) -> None:
        self.supervisor.block(NOT_ACTIVE, not active)
        self._publish(self.controller.on_tick(time.monotonic()))

    def _watch_clock(self) -> Any:
        """Report jumps of the node's clock to the supervisor."""
        from rclpy.clock import JumpThreshold
        from rclpy.duration import Duration

        jump = JumpThreshold(min_forward=Duration(seconds=0.5), min_backward=Duration(seconds=-0.01),
                             on_clock_change=True)
        return self.node.get_clock().create_jump_callback(jump, post_callback=lambda _: self.supervisor.clock_jump())

    def _start_guard(self) -> Any:
        """Start a guard that outlives this process, its terminal included, by some seconds."""
        arguments = ["--command-topic", self.commands.name, "--command-type", self.options.command_type,
                     "--follow", self.guard.session, "--realtime", str(self.options.realtime)]
        return subprocess.Popen([sys.executable, "-m", "bridge.guard", *arguments, "--ros-args", "-r",
                                 f"__ns:={self.node.get_namespace()}"], start_new_session=True,
                                cwd=Path(__file__).resolve().parents[1])  # so that -m finds this very package

    def _on_image(self, message: Any) -> None:
        now = time.monotonic()
        stamp = ros.stamp_seconds(message.header.stamp)
        age = self.node.get_clock().now().nanoseconds * 1e-9 - stamp
        if self.options.compressed:
            command = self.controller.on_compressed(now, stamp, age, message.data)
        else:
            command = self.controller.on_image(now, stamp, age, message.height, message.width, message.encoding,
                                               message.step, message.data)
        self._publish(command)
        self._last_frame, self._incompatible = now, False
        digest = -self.supervisor.counts["unusable"] if self.controller.unusable else self.controller.digest
        self._frames.frame(now, stamp, age, digest)

    def _on_watch(self) -> None:
        now = time.monotonic()
        offset = time.time() - now
        if abs(offset - self._clock_offset) > CLOCK_STEP:
            self.supervisor.clock_jump()
        self._clock_offset = offset
        self._inputs.watch(now)
        if self._chair is not None:
            self._chair.watch(now)
        self.supervisor.block(NO_GUARD, bool(self.guard.problem(now)))
        if self._ear.foreign_zero():
            self.supervisor.foreign_command(now)
        self._publish(self.controller.on_tick(now))
        since = now - self._last_frame
        if PAUSE[0] <= since <= PAUSE[1] or since > SILENCE:
            self._keep_house(now)

    def _keep_house(self, now: float) -> None:
        """Look at the graph and report, where it is time."""
        if now - self._looked >= LOOK_PERIOD:
            self._looked = now
            self._on_look()
        elif now - self._said >= STATUS_PERIOD:
            self._on_status()

    def _on_command(self, v: float, omega: float) -> None:
        if self._ear.heard(v, omega):
            self.supervisor.foreign_command(time.monotonic())

    def _on_guard(self, message: Any) -> None:
        now = time.monotonic()
        self.guard.heard(now, message.data)
        self._ear.guard_reports(self.guard.zeros)
        if self.guard.stops > self._guard_stops and self.supervisor.may_drive:
            self.supervisor.fault(GUARD_STOPPED)
        self._guard_stops = self.guard.stops

    def _on_input(self, now: float) -> None:
        self._publish(self.controller.on_tick(now))

    def _on_chair(self, state: Any) -> None:
        now = time.monotonic()
        if self._chair is not None:
            self._chair.take(now, ChairState.of(state))
        self._publish(self.controller.on_tick(now))

    def _on_rearm(self, _: Any) -> None:
        if not self.supervisor.arm():
            why = ", ".join(self.supervisor.holds) or self.supervisor.reason
            self.node.get_logger().error(f"not armed: {why} still holds")

    def _on_incompatible(self, _: Any) -> None:
        self._incompatible = True

    def _on_lost(self, event: Any) -> None:
        self._frames.lost(time.monotonic(), event.total_count_change)

    def _on_beat(self) -> None:
        self._beat(self.supervisor.may_drive)

    def _beat(self, driving: bool) -> None:
        self._said_driving = driving
        beat = {"session": self.guard.session, "driving": driving}
        self._heartbeat.publish(self._string(data=json.dumps(beat)))

    def _on_look(self) -> None:
        """Look at the graph: who listens, who else commands; keep the guard running."""
        self.guard.keep(time.monotonic())
        self.commands.look()
        self._listeners = self.commands.listeners()
        fitting = [end for end in self._listeners if end.type.endswith("/" + self.commands.kind)]
        self.supervisor.block(NO_BASE, not (self.commands.kind and fitting))
        before, self._commanders = self._commanders, self.commands.commanders()
        # seen twice: at first a node's name, the guard's too, is not known yet
        others = bool(before and self._commanders) and not self.options.allow_other_commanders
        self.supervisor.block(COMMANDERS, others)
        if (self.supervisor.state.value, self.supervisor.reason) != self._reported[:2]:
            self._on_status()

    def _on_status(self) -> None:
        self._said = time.monotonic()
        supervisor = self.supervisor
        state, reason, found = supervisor.state, supervisor.reason, causes(self._evidence())
        status: dict[str, Any] = {"state": state.value, "driving": state is State.DRIVING, "reason": reason,
                                  "holds": supervisor.holds, "causes": found, "counts": dict(supervisor.counts)}
        self._status.publish(self._string(data=json.dumps(status)))
        text = ". ".join([f"{state.value}: {reason}" if reason else state.value, *found])
        self._diagnose(state is State.DRIVING and not found, text, status["counts"])
        report = (state.value, reason, *found)
        if report != self._reported:
            log = self.node.get_logger()
            log.warning(text) if reason or found else log.info(text)
        self._reported = report

    def _evidence(self) -> Evidence:
        now = time.monotonic()
        self._frames.trim(now)
        cameras = endpoints(self.node.get_publishers_info_by_topic(self._image_topic))
        if not cameras:
            self._camera_since = now
        settled = self._frames.is_full(now) if self._frames.count else now - self._camera_since > STARTING
        return Evidence(
            image_topic=self._image_topic, image_type=f"sensor_msgs/msg/{self._image_type.__name__}", cameras=cameras,
            frames=self._frames, rate_hz=self.controller.policy.contract.rate_hz, stamp_limit=self.options.stamp_age,
            command_topic=self.commands.name, command_type=self.commands.kind, listeners=self._listeners,
            guard=self.guard.problem(now), settled=settled, silence=self._frames.silence(now),
            image_bytes=self.controller.image_bytes, incompatible=self._incompatible,
            unusable=self.controller.unusable, blind=self.controller.is_blind,
            pace_by_stamp=self.options.pace == "stamp", commanders=self._commanders,
            starting=now - self._started < STARTING)

    def _publish(self, command: Command | None) -> None:
        if command is not None:
            if self.supervisor.may_drive and not self._said_driving:
                self._on_beat()  # before the first motion: if this process dies now, the guard must know of it
            self._ear.sent(command.v, command.omega)
            self.commands.publish(command.v, command.omega)


def main(arguments: list[str] | None = None) -> int:
    """Run the node until SIGTERM or Ctrl-C; return 2 where the policy file or an option is refused."""
    own, ros_arguments = ros.split_ros_arguments(sys.argv[1:] if arguments is None else arguments)
    try:
        options = parse_arguments(parameters.as_options(ros_arguments, ros.DRIVE_NAME, "policy") + own)
        policy = Policy.load(options.policy)
        safety = safety_config(policy, options)
    except (PolicyFileError, ValueError) as error:
        print(f"bridge.drive: {error}", file=sys.stderr)
        return 2
    with ros.node_session(ros.DRIVE_NAME, ros_arguments, options.realtime, options.lifecycle) as node:
        controller = Controller(policy, safety, on_blind=options.blind, on_novel=options.novel,
                                pace_by_stamp=options.pace == "stamp",
                                crop=options.crop and tuple(options.crop))
        drive = DriveNode(node, controller, options)
        try:
            ros.spin(node)
        finally:
            drive.close()
        if options.results:
            supervisor = drive.supervisor
            ros.write_json(options.results, {"counts": dict(supervisor.counts), "reason": supervisor.reason})
    return 0


if __name__ == "__main__":
    sys.exit(main())

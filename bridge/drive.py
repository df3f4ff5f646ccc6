"""Run the policy node: camera image, or whatever else the policy reads, in; wheel command out.

    python -m bridge.drive runs/corridor/policy

Commands are computed when a frame arrives; a 100 Hz watch stops the vehicle within 10 ms of any limit. The node's state
is published as JSON on bridge/status once a second and whenever it changes; a message on bridge/rearm arms it.
"""

import argparse
import math
import sys
from pathlib import Path

from bridge.driving.bases import BASES
from bridge.driving.controller import Caution, Controller
from bridge.driving.drive_node import DriveNode
from bridge.driving.vehicle_node import add_options, limits
from bridge.nodes import parameters, ros, scheduling
from bridge.nodes.exits import Exit, OptionError, refusal
from bridge.nodes.options import Parser, ends_at_ctrl_c, in_range, result_file, topic_name, whole
from bridge.policy import Policy
from bridge.safeguards.safety import SafetyConfig
from bridge.sensing.view import view_of


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
    parser.add_argument("--stamp-age", type=in_range(0, infinite=True, above=True), default=SafetyConfig.stamp_age,
                        help="largest age of a stamp [s]; inf where camera and bridge share no clock")
    parser.add_argument("--frame-age", type=in_range(0, infinite=True, above=True), default=SafetyConfig.frame_age,
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
        supervisor = drive.supervisor
        results = {"counts": dict(supervisor.counts), "reason": supervisor.reason}
        written = not options.results or ros.write_results("bridge.drive", options.results, results)
    return Exit.DONE if written else Exit.FAULT


if __name__ == "__main__":
    sys.exit(main())

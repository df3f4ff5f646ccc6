"""Run the simulator behind the vehicle's topics; the policy node sees no difference from the chair.

    python -m bridge.simulate RUN/policy --episodes 10

Time runs like the wall clock, or `--speed` times as fast. With `--clock` the simulated time is published on /clock, and
stamps count in it. The command received by the middle of a control period drives the whole period; an image shows its
end. All publishers are reliable and drop the oldest, so default and best-effort subscribers hear them.

Between two episodes the camera is silent for RESET_SILENCE, which is longer than the age the policy node tolerates: so
it stops, forgets, and no frame of an episode can reach the next one.
"""

import argparse
import ast
import contextlib
import os
import sys
from pathlib import Path
from typing import Any

from bridge.episodes import EpisodeServer
from bridge.nodes import ros
from bridge.nodes.exits import Exit
from bridge.nodes.options import Parser, ends_at_ctrl_c, in_range, result_file, whole
from bridge.nodes.parameters import command_line
from bridge.policy import PolicyFileError
from bridge.simulation.simulate_node import RESULTS, SimulateNode
from bridge.simulation.simulator_choice import SIMULATOR, ready_vehicle

TOKEN_VARIABLE = "BRIDGE_TOKEN"
"""Environment variable with the token of episode control; on a command line everybody could read it."""


def field(text: str) -> tuple[str, Any]:
    """Name and value of a NAME=VALUE option; values are Python literals or plain words."""
    name, equals, value = text.partition("=")
    if not equals or not name.isidentifier():
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=VALUE, such as gates=1")
    try:
        return name, ast.literal_eval(value)
    except (ValueError, SyntaxError):
        return name, value


def parse_arguments(arguments: list[str]) -> argparse.Namespace:
    """Return the options of the command line."""
    parser = Parser(prog="bridge.simulate", description="Serve the simulator on the vehicle's topics.")
    parser.add_argument("policy", nargs="?", type=Path, help="folder of a policy or of its training: task, gates, "
                        "vehicle and camera are those that it was trained with")
    parser.add_argument("--task", help="default: that of the policy, or corridor")
    parser.add_argument("--set", type=field, action="append", default=[], metavar="NAME=VALUE",
                        help="change a field of the task, such as gates=1 or layout=fixed; repeat for more")
    parser.add_argument("--vehicle", help="vehicle file or built-in vehicle; default: that of the policy, "
                        "or the task's own")
    parser.add_argument("--robot", type=Path, metavar="FILE",
                        help="an MJCF, URDF or xacro file, which drives in place of the vehicle; the camera stays that "
                        "of --vehicle")
    parser.add_argument("--wheels", nargs="+", metavar="NAME",
                        help="of --robot: joints or actuators of its driven wheels, left and right")
    parser.add_argument("--episodes", type=whole(0), default=0, help="end after this many episodes; 0: never")
    parser.add_argument("--seed", type=whole(0), default=0, help="of the first episode; each next one adds 1")
    parser.add_argument("--wait", type=in_range(0), default=10.0,
                        help="wait this long for a driver before the first episode [s]")
    parser.add_argument("--linger", type=in_range(0), default=1.0, help="listen this long after the last episode [s]")
    parser.add_argument("--results", type=result_file(*RESULTS), help="JSON file for the outcome of the episodes")
    parser.add_argument("--image-size", type=whole(1, 10_000), nargs=2, metavar=("HEIGHT", "WIDTH"),
                        help="enlarge the camera image")
    parser.add_argument("--clock", action="store_true", help="publish the simulated time on /clock and stamp with it")
    parser.add_argument("--speed", type=in_range(0.01, 100), default=1.0,
                        help="simulated seconds per second, such as 0.5; default 1")
    parser.add_argument("--port", type=whole(0, 65535), metavar="PORT",
                        help="serve episode control over TCP: resets and lock-step (bridge.episodes); 0: any free port")
    parser.add_argument("--bind", default="127.0.0.1", metavar="ADDRESS",
                        help=f"address of the port; another than the loopback needs a token in {TOKEN_VARIABLE}")
    parser.add_argument("--command-type", choices=("Twist", "TwistStamped"), default="Twist",
                        help="message that the simulated vehicle listens to")
    parser.add_argument("--realtime", type=whole(0, 99), default=0, metavar="PRIORITY",
                        help="SCHED_FIFO priority, like 20")
    parser.add_argument("--simulator", default=SIMULATOR, metavar="MODULE:FACTORY",
                        help="another simulator behind the same topics")
    return parser.parse_args(arguments)


@ends_at_ctrl_c
def main(arguments: list[str] | None = None) -> int:
    """Run the node until its episodes are over, SIGTERM or Ctrl-C; return an `Exit`."""
    own, ros_arguments = command_line(arguments, "bridge.simulate", "policy")
    options = parse_arguments(own)
    compiling: Any = contextlib.nullcontext()
    if options.simulator == SIMULATOR:  # others may abort with it
        os.environ.setdefault("JAX_PLATFORMS", "cpu")  # one vehicle is ready earlier and steps faster there
        from whill_mjx.io.command_line import guarded
        from whill_mjx.io.compiled import keep_compiled
        from whill_mjx.processor import share_results

        share_results()
        keep_compiled()
        compiling = guarded("bridge.simulate: stopped")  # a signal ends it while XLA compiles, too
    with compiling:
        try:
            vehicle = ready_vehicle(options)
        except (ValueError, FileNotFoundError) as error:
            print(f"bridge.simulate: {error}", file=sys.stderr)
            return Exit.FAULT if isinstance(error, PolicyFileError) else Exit.REFUSED
    with ros.node_session("bridge_simulate", ros_arguments, options.realtime) as node:
        simulate = SimulateNode(node, vehicle, options)
        try:
            server = None if options.port is None else EpisodeServer(
                simulate.calls(), options.bind, options.port, os.environ.get(TOKEN_VARIABLE, ""))
        except (ValueError, OSError, OverflowError) as error:
            print(f"bridge.simulate: --port {options.port}: {error}", file=sys.stderr)
            return Exit.REFUSED
        if server is not None:
            node.get_logger().info(f"episode control on {options.bind}, port {server.port}")
        ros.spin(node, simulate.finished)
        if server is not None:
            server.close()
        written = not options.results or ros.write_results("bridge.simulate", options.results, simulate.results())
    return Exit.DONE if written else Exit.FAULT


if __name__ == "__main__":
    sys.exit(main())

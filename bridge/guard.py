"""Stop the vehicle when the policy node dies: an independent process.

    python -m bridge.guard

`bridge.drive` starts one by itself. The two exchange heartbeats: the policy node says whether it drives, the guard says
whom it hears and that its zeros would reach the base; without that the policy node does not drive. When a driving node
gives no sign of life for SILENCE seconds (`bridge/safeguards/watchdog.py`), the guard publishes zeros. It never
publishes anything else.
"""

import argparse
import sys

from bridge.nodes import ros
from bridge.nodes.exits import Exit
from bridge.nodes.options import Parser, ends_at_ctrl_c, topic_name, whole
from bridge.nodes.parameters import command_line
from bridge.safeguards.guard_node import GuardNode


def parse_arguments(arguments: list[str]) -> argparse.Namespace:
    """Return the options of the command line."""
    parser = Parser(prog="bridge.guard", description="Stop the vehicle if the policy node is killed.")
    parser.add_argument("--command-topic", type=topic_name, default=ros.COMMAND_TOPIC,
                        help="topic of the commands that drive the vehicle")
    parser.add_argument("--command-type", choices=("auto", "Twist", "TwistStamped"), default="auto",
                        help="auto: as the base listens")
    parser.add_argument("--follow", default="", metavar="SESSION", help="guard this node only, and end after it")
    parser.add_argument("--joystick-lock", action="store_true",
                        help="unlock the chair's joystick where the policy node has died: it may have locked it")
    parser.add_argument("--realtime", type=whole(0, 99), default=0, metavar="PRIORITY",
                        help="SCHED_FIFO priority, like 20")
    return parser.parse_args(arguments)


@ends_at_ctrl_c
def main(arguments: list[str] | None = None) -> int:
    """Guard until SIGTERM, Ctrl-C or the end of the node that is followed."""
    own, ros_arguments = command_line(arguments, "bridge.guard")
    options = parse_arguments(own)
    with ros.node_session(ros.GUARD_NAME, ros_arguments, options.realtime) as node:
        ros.spin(node, GuardNode(node, options).finished)
    return Exit.DONE


if __name__ == "__main__":
    sys.exit(main())

"""Drive a command file on the vehicle and record it: the manoeuvres of sysid.design, sysid.close_loop or your own.

    python -m bridge.manoeuvre command.csv --space 6 4 --dataset logs/monday --trial circle --repeat 3

Before anything moves, the commands are checked against the limits and the path against the free floor. The vehicle
stands until an operator arms it (a message on bridge/rearm, or Enter in this terminal), once for each replicate. With
`--ros-args -p use_sim_time:=true` the manoeuvre runs in simulated time, such as that of `bridge.simulate --clock`.
Whatever stops `bridge.drive` stops a manoeuvre too. A stopped replicate is put aside and begins again from its start.
"""

import argparse
import math
import sys
from pathlib import Path

from bridge.driving.bases import BASES
from bridge.driving.command_table import CommandTable, check_space, make_table, reach_of, read_commands
from bridge.driving.fitted_reach import simulate_reach
from bridge.driving.manoeuvre_node import ManoeuvreNode
from bridge.driving.player import Player
from bridge.driving.vehicle_node import add_options, limits
from bridge.nodes import parameters, ros
from bridge.nodes.exits import Exit, OptionError, refusal
from bridge.nodes.options import Parser, ends_at_ctrl_c, in_range, said, whole
from bridge.recording.dataset_file import add_dataset_options, check_dataset, write_dataset_file
from bridge.recording.trial_writer import TrialWriter
from bridge.safeguards.safety import SafetyConfig

NAME = "bridge.manoeuvre"
WIDEST = (2.0, 4.0)
"""Commands that no manoeuvre exceeds: v [m/s], omega [rad/s]."""


def parse_arguments(arguments: list[str]) -> argparse.Namespace:
    """Return the options of the command line."""
    parser = Parser(prog=NAME, description="Drive a command file and record it.")
    parser.add_argument("commands", type=Path, help="CSV file with the columns t,v,omega")
    parser.add_argument("--space", type=in_range(1e-3, 1e3), nargs=2, required=True, metavar=("LENGTH", "WIDTH"),
                        help="free floor [m]; nothing else may stand or walk on it")
    parser.add_argument("--radius", type=in_range(1e-3, 1e3), default=0.9,
                        help="of the vehicle around its drive-axle centre [m]; default: a WHILL with its rider's feet")
    parser.add_argument("--uncertainty", type=in_range(1e-3, 0.999), default=0.15,
                        help="how much faster or slower the vehicle may be than commanded; default 0.15")
    parser.add_argument("--vehicle-file", type=Path, metavar="FILE",
                        help="vehicle file of sysid.fit: the path is simulated for vehicles drawn from its intervals, "
                             "in place of --uncertainty")
    parser.add_argument("--draws", type=whole(1, 10_000), default=64, help="how many; default 64")
    parser.add_argument("--slew", type=in_range(1e-3, 1e3), nargs=2, metavar=("V", "OMEGA"), default=(1.0, 2.0),
                        help="steepest change of the commands [m/s2, rad/s2]; default 1 2")
    parser.add_argument("--repeat", type=whole(), default=1, help="replicates, each of them armed by an operator")
    parser.add_argument("--first", type=whole(), default=1, help="number of the first replicate")
    parser.add_argument("--dataset", type=Path, help="folder of the dataset to record into; default: do not record")
    parser.add_argument("--trial", default="", help="name of the trials before their number; default: the file's name")
    parser.add_argument("--check", action="store_true", help="only check, and say where to put the vehicle")
    add_dataset_options(parser)
    add_options(parser)
    options = parser.parse_args(arguments)
    options.trial = options.trial or options.commands.stem
    return options


def prepare(options: argparse.Namespace) -> tuple[CommandTable, SafetyConfig, str]:
    """Return what is driven, its limits, and where to put the vehicle.

    Raises:
        ValueError: the file, the limits or the floor do not fit.
    """
    low, high = limits((-WIDEST[0], -WIDEST[1]), WIDEST, options)
    table = make_table(read_commands(options.commands), low, high, tuple(options.slew), str(options.commands))
    if options.vehicle_file is None:
        place = check_space(reach_of(table, options.radius, options.uncertainty), tuple(options.space))
    else:
        print(f"{NAME}: simulating the manoeuvre with {options.vehicle_file} ...", file=sys.stderr)
        fitted = simulate_reach(table, options.vehicle_file, options.radius, options.draws)
        try:
            place = f"{check_space(fitted.widest, tuple(options.space))} In simulation {fitted}."
        except OptionError as error:
            raise OptionError(f"{options.commands}: in simulation {fitted}. So {error}") from None
    safety = SafetyConfig(low=low, high=high, hold_zeros=BASES[options.base].hold_zeros, frame_age=0.25,
                          stamp_age=math.inf, require_arm=True, auto_resume=False)
    return table, safety, place


def trial_names(options: argparse.Namespace) -> list[str]:
    """Return the names of replicates that must be checked: the first one, and those that the dataset has already."""
    def name(number: int) -> str:
        return f"{options.trial}_{number}"

    ends = (one.name.rpartition("_")[2] for one in (options.dataset / "trials").glob("*"))
    numbers = {int(end) for end in ends if end.isdecimal() and end.isascii()}
    wanted = range(options.first, options.first + options.repeat)
    return [name(number) for number in sorted({options.first, *(one for one in numbers if one in wanted)})]


@ends_at_ctrl_c
def main(arguments: list[str] | None = None) -> int:
    """Drive until all replicates are done, SIGTERM or Ctrl-C.

    Returns an `Exit`: REFUSED where the manoeuvre does not fit, SHORT where it ended before its last replicate.
    """
    own, ros_arguments = ros.split_ros_arguments(sys.argv[1:] if arguments is None else arguments)
    try:
        options = parse_arguments(parameters.with_options(ros_arguments, ros.MANOEUVRE_NAME, "commands", own))
        table, safety, place = prepare(options)
        if options.dataset and not options.check:
            for name in trial_names(options):
                TrialWriter.check(options.dataset, name)
            check_dataset(options.dataset)
            options.dataset.mkdir(parents=True, exist_ok=True)
            write_dataset_file(options.dataset, options)
    except (ValueError, OSError) as error:
        print(f"{NAME}: {said(error)}", file=sys.stderr)
        return refusal(error)
    print(f"{NAME}: {place}", file=sys.stderr)
    if options.check:
        return Exit.DONE
    print(f"{NAME}: {table.seconds:.0f} s, {options.repeat} times. Arm each with Enter, or with a message on "
          f"{ros.REARM_TOPIC}.", file=sys.stderr)
    with ros.node_session(ros.MANOEUVRE_NAME, ros_arguments, options.realtime) as node:
        player = Player(table, safety, options.repeat)
        manoeuvre = ManoeuvreNode(node, player, options)
        try:
            ros.spin(node, manoeuvre.finished)
        finally:
            manoeuvre.close()
    if manoeuvre.failure:
        print(f"{NAME}: {manoeuvre.failure}", file=sys.stderr)
        return Exit.FAULT
    return Exit.DONE if player.finished else Exit.SHORT


if __name__ == "__main__":
    sys.exit(main())

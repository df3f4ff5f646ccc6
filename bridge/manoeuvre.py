"""Drive a command file on the vehicle and record it: the manoeuvres of sysid.design, sysid.close_loop or your own.

    python -m bridge.manoeuvre command.csv --space 6 4 --dataset logs/monday --trial circle --repeat 3

Before anything moves, the commands are checked against the limits and the path against the free floor. The vehicle
stands until an operator arms it (a message on bridge/rearm, or Enter in this terminal), once for each replicate. With
`--ros-args -p use_sim_time:=true` the manoeuvre runs in simulated time, such as that of `bridge.simulate --clock`.
Whatever stops `bridge.drive` stops a manoeuvre too. A stopped replicate is put aside and begins again from its start.
"""

import argparse
import math
import os
import select
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from bridge import parameters, ros
from bridge.bases import BASES
from bridge.command_table import PERIOD, CommandTable, check_space, make_table, reach_of, read_commands
from bridge.dataset_file import add_dataset_options, check_dataset, write_dataset_file
from bridge.exits import Exit, OptionError, refusal
from bridge.fitted_reach import simulate_reach
from bridge.options import Parser, ends_at_ctrl_c, in_range, said, whole
from bridge.record_node import RecordNode
from bridge.safety import Command, SafetyConfig, State, Supervisor
from bridge.trial_writer import TrialWriter
from bridge.vehicle_node import VehicleNode, add_options, limits
from bridge.vehicle_time import VehicleTime

NAME = "bridge.manoeuvre"
BACK = "bring the vehicle back to its start, then arm"
FINISHED = "all replicates are driven"
WIDEST = (2.0, 4.0)
"""Commands that no manoeuvre exceeds: v [m/s], omega [rad/s]."""


class Player:
    """Plays a command table through the safety state machine; pure, with injected time.

    A `frame` of the supervisor is a row of the table, so a player that is not called for a while stops the vehicle, as
    a silent camera would.
    """

    def __init__(self, table: CommandTable, safety: SafetyConfig, repeat: int = 1) -> None:
        self.table, self.repeat = table, repeat
        self.clock: Callable[[float], float] = lambda now: now
        """Seconds of the clock that the table counts in, from the steady time; simulated time may be another one. What
        stops the vehicle is timed by the clock of `now`."""
        self.supervisor = Supervisor(safety)
        self.driven = 0
        """Replicates driven to their end."""
        self.aborted = 0
        """Replicates that were stopped on the way."""
        self.elapsed: float | None = None
        """Seconds since the start of the replicate; None while none is driven."""
        self._due = -math.inf
        self._rows = 0
        self._began = 0.0

    @property
    def finished(self) -> bool:
        """True when all replicates are driven."""
        return self.driven >= self.repeat

    def on_tick(self, now: float) -> Command | None:
        """Return the next row of the table where it is due, zero where the vehicle must stand."""
        supervisor = self.supervisor
        if self.elapsed is not None:
            command = supervisor.tick(now)  # sees that the rows have stopped, too
            if not supervisor.may_drive:
                self.elapsed, self.aborted = None, self.aborted + 1
                return self._send(command)
        if self.finished:
            return self._send(supervisor.tick(now))
        at = self.clock(now)
        if 1e-6 < self._due - at < 2 * PERIOD:  # stamps of simulated time are not exact sums of the period
            return None
        self._due = at + PERIOD if abs(at - self._due) > PERIOD else self._due + PERIOD  # also where time began again
        self._rows += 1
        supervisor.frame(now, now, self._rows)
        if not supervisor.may_drive:
            return self._send(supervisor.tick(now))
        if self.elapsed is None:
            self._began = at
        self.elapsed = at - self._began
        if self.elapsed >= self.table.seconds:
            self.elapsed, self.driven = None, self.driven + 1
            supervisor.latch(FINISHED if self.finished else BACK)
            return self._send(supervisor.tick(now))
        return self._send(supervisor.action(now, np.array(self.table.at(self.elapsed))))

    def since_start(self, now: float) -> float:
        """Return the seconds from the start of the replicate to the steady time `now`, by the table's clock."""
        return self.clock(now) - self._began

    def farewell(self) -> bool:
        """Return whether the vehicle needs zeros before the node ends."""
        return self.supervisor.state is not State.YIELDED and self.supervisor.take_turn()

    def _send(self, command: Command) -> Command | None:
        return command if self.supervisor.take_turn() else None


class ManoeuvreNode(VehicleNode):
    """Connects a player to the ROS graph, and records each replicate."""

    def __init__(self, node: Any, player: Player, options: argparse.Namespace) -> None:
        simulated = VehicleTime() if ros.uses_simulated_time(node) else None
        super().__init__(node, player, options, simulated or time.monotonic)
        self.player = player
        self._recorder = RecordNode(node, None, options) if options.dataset else None
        self.trials: list[Path] = []
        """Folders of the replicates that were driven to their end."""
        self._over_since = time.monotonic()
        self._driven_before = 0
        self.failure = ""
        """Why the drive ended early, such as a full disk."""
        self._simulated = 0.0
        if simulated is not None:
            player.clock = lambda _: self._simulated
            ros.subscribe_clock(node, lambda seconds: self._on_clock(simulated, seconds))
        ros.steady_timer(node, PERIOD / 2, self._on_progress)
        self.start()

    def finished(self) -> bool:
        """Return whether all is driven and the vehicle has stood for a moment."""
        over = self.player.finished and self._recording is None
        if not over:
            self._over_since = time.monotonic()
        return bool(self.failure) or time.monotonic() - self._over_since > 1.0

    def _on_clock(self, vehicle_time: VehicleTime, seconds: float) -> None:
        """Take the simulated time, and send the row that is due."""
        vehicle_time.on_clock()
        self._simulated = seconds
        self._on_input(self.now())
        self._on_progress()

    def details(self) -> dict[str, Any]:
        """Return the progress of the manoeuvre."""
        player = self.player
        return {"manoeuvre": {"replicate": min(player.driven + 1, player.repeat), "of": player.repeat,
                              "elapsed": player.elapsed, "seconds": player.table.seconds,
                              "driven": player.driven, "aborted": player.aborted}}

    @property
    def _recording(self) -> TrialWriter | None:
        return self._recorder.writer if self._recorder else None

    def _on_progress(self) -> None:
        """Open a recording when a replicate begins, close it when it ends; heed Enter in the terminal."""
        player, recorder = self.player, self._recorder
        if _enter_was_pressed():
            self._on_rearm(None)
        if recorder is None:
            return
        if recorder.failure:
            self.supervisor.latch("the recording failed")
            self.failure = str(recorder.failure)
        elif player.elapsed is not None and recorder.writer is None:
            self._driven_before = player.driven
            try:
                recorder.writer = TrialWriter(self.options.dataset, self._trial_name())
                recorder.writer.begin(recorder.now() - player.since_start(self.now()))
            except (OSError, ValueError) as error:
                self.supervisor.latch("the recording failed")
                self.failure = str(error)
        elif recorder.writer is not None and player.elapsed is None:
            self._end_recording(recorder)

    def _end_recording(self, recorder: RecordNode) -> None:
        """Make a trial of a replicate that was driven to its end, and put any other one aside."""
        writer, recorder.writer = recorder.writer, None
        try:
            if self.player.driven > self._driven_before:
                self.trials.append(writer.close())
                self.node.get_logger().info(f"{self.trials[-1]}: rows {writer.rows}")
            else:
                aside = writer.put_aside()
                self.node.get_logger().warning(f"stopped on the way; what was recorded is in {aside}")
        except OSError as error:
            self.supervisor.latch("the recording failed")
            self.failure = self.failure or str(error)

    def close(self) -> None:
        """End the node, and the recording of a replicate that is on its way."""
        with ros.undisturbed():
            super().close()
            if self._recorder is not None and self._recorder.writer is not None:
                self._end_recording(self._recorder)

    def _trial_name(self) -> str:
        return f"{self.options.trial}_{self.options.first + self.player.driven}"


def _enter_was_pressed() -> bool:
    """Return whether the operator pressed Enter in the terminal; False where there is no terminal."""
    if not sys.stdin or not sys.stdin.isatty():
        return False
    try:
        in_front = os.getpgrp() == os.tcgetpgrp(sys.stdin.fileno())
    except OSError:  # not the terminal of this session, as after setsid
        return False
    ready, _, _ = select.select([sys.stdin], [], [], 0) if in_front else ([], [], [])
    line = sys.stdin.readline() if ready else ""
    return line.endswith("\n") and not line.strip()  # the end of the input, Ctrl-D, is no Enter


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
            for number in range(options.first, options.first + options.repeat):
                TrialWriter.check(options.dataset, f"{options.trial}_{number}")
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

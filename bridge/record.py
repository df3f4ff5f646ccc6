"""Record one drive as a trial of a driving-log dataset, which `sysid.fit` reads.

    python -m bridge.record logs/monday figure_eight_1
    python -m bridge.record logs/monday afternoon --split 3      # afternoon_1, afternoon_2, ...: one for each drive

Every message counts: readers fit the publishers' quality of service and let many messages wait. `t` is the time of
receipt on the steady clock; the column `stamp` keeps the message's own stamp.

Rows are written as they come into a hidden folder of the dataset, which moves to its place when the recording ends. A
killed recorder leaves the hidden folder with all rows but the last second's; `--recover` gives it its place.
"""

import argparse
import sys
from collections.abc import Mapping
from pathlib import Path

from bridge.nodes import ros
from bridge.nodes.exits import Exit, refusal
from bridge.nodes.options import Parser, ends_at_ctrl_c, in_range, said, topic_name
from bridge.nodes.parameters import command_line
from bridge.recording.dataset_file import add_dataset_options, check_dataset, write_dataset_file
from bridge.recording.record_node import RecordNode
from bridge.recording.recovery import recover
from bridge.recording.split_writer import SplitWriter
from bridge.recording.trial_writer import PARTIAL, TrialWriter, left_out


def parse_arguments(arguments: list[str]) -> argparse.Namespace:
    """Return the options of the command line. The geometry's defaults are those of the WHILL Model CR."""
    parser = Parser(prog="bridge.record", description="Record one drive as a trial of a dataset.")
    parser.add_argument("dataset", type=Path, help="folder of the dataset; made where it does not exist")
    parser.add_argument("trial", nargs="?", help="name of the trial, like circle_1")
    parser.add_argument("--recover", action="store_true", help="only give recordings of killed recorders their place")
    parser.add_argument("--split", type=in_range(0.5, 600), metavar="SECONDS",
                        help="make a trial of each drive, TRIAL_1, TRIAL_2 and so on; a drive is over when the vehicle "
                        "has stood this long")
    parser.add_argument("--seconds", type=in_range(0, 1e7), default=0.0,
                        help="end after this long; 0: at Ctrl-C or SIGTERM")
    parser.add_argument("--command-topic", type=topic_name, default=ros.COMMAND_TOPIC,
                        help="topic of the commands that drive the vehicle")
    add_dataset_options(parser)
    options = parser.parse_args(arguments)
    if (options.trial is None) != options.recover:
        parser.error("give either the name of a trial or --recover")
    return options


def finish(writer: TrialWriter | SplitWriter) -> bool:
    """End a recording and say what it holds; return whether its end could be written."""
    try:
        if isinstance(writer, TrialWriter) and writer.is_empty:
            writer.drop()
            for line in ["nothing was recorded, so there is no trial", *left_out(writer.left_out)]:
                print(f"bridge.record: {line}", file=sys.stderr)
            return True
        folder = writer.close()
    except OSError as error:
        print(f"bridge.record: {said(error)}", file=sys.stderr)
        return False
    if isinstance(writer, TrialWriter):
        say_trial(folder, writer.rows)
    elif not writer.trials:
        print("bridge.record: nothing was recorded: the vehicle never moved", file=sys.stderr)
    for line in left_out(writer.left_out):
        print(f"bridge.record: {line}", file=sys.stderr)
    return True


def say_trial(folder: Path | None, rows: Mapping[str, int]) -> None:
    """Say what a whole trial holds."""
    print(f"bridge.record: {folder}: rows {dict(rows)}", file=sys.stderr)


def main_recover(dataset: Path) -> int:
    """Recover what killed recorders left, and say what became of it."""
    try:
        found = recover(dataset)
    except (ValueError, OSError) as error:
        print(f"bridge.record: {said(error)}", file=sys.stderr)
        return refusal(error)
    for folder in found:
        print(f"bridge.record: {folder}: recovered", file=sys.stderr)
    for left in sorted(dataset.glob(".*.partial-*")):
        if match := PARTIAL.fullmatch(left.name):
            print(f"bridge.record: {left}: left alone, because a process {match['process']} runs. End it, or where it "
                  "is another program, rename the folder", file=sys.stderr)
            return Exit.DONE
    if not found:
        print(f"bridge.record: {dataset}: no recording of a killed recorder is there", file=sys.stderr)
    return Exit.DONE


@ends_at_ctrl_c
def main(arguments: list[str] | None = None) -> int:
    """Record until the time is over, SIGTERM or Ctrl-C.

    Returns an `Exit`: FAULT where nothing can be written, also on the way, SHORT without odometry.
    """
    own, ros_arguments = command_line(arguments, "bridge.record")
    options = parse_arguments(own)
    if options.recover:
        return main_recover(options.dataset)
    try:
        check_dataset(options.dataset)
        TrialWriter.check(options.dataset, f"{options.trial}_0" if options.split else options.trial)
        with ros.node_session(ros.RECORD_NAME, ros_arguments) as node:
            options.dataset.mkdir(parents=True, exist_ok=True)
            writer: TrialWriter | SplitWriter = (
                SplitWriter(options.dataset, options.trial, options.split, say_trial) if options.split
                else TrialWriter(options.dataset, options.trial))
            try:
                write_dataset_file(options.dataset, options)
                recorder = RecordNode(node, writer, options, options.seconds)
                ros.spin(node, recorder.finished)
            finally:
                whole = finish(writer)
    except (ValueError, OSError) as error:
        print(f"bridge.record: {said(error)}", file=sys.stderr)
        return refusal(error)
    for topic, count in recorder.lost().items():
        print(f"bridge.record: {topic}: {count} messages were lost on the way. Record on the vehicle's own computer, "
              "or let the publisher be reliable.", file=sys.stderr)
    if recorder.failure is not None or not whole:
        print("bridge.record: the recording ended early, because nothing could be written any more", file=sys.stderr)
        return Exit.FAULT
    if not writer.rows["odometry"]:
        why = ("none of its messages could be used" if writer.left_out["odometry"] else
               f"no message came on {options.odometry_topic}, or the vehicle never moved")
        print(f"bridge.record: no odometry was recorded: {why}. A fit needs it; name the vehicle's topic with "
              "--odometry-topic.", file=sys.stderr)
        return Exit.SHORT
    return Exit.DONE


if __name__ == "__main__":
    sys.exit(main())

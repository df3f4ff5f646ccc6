"""Record one drive as a trial of a driving-log dataset, which `sysid.fit` reads.

    python -m bridge.record logs/monday figure_eight_1
    python -m bridge.record logs/monday afternoon --split 3      # afternoon_1, afternoon_2, ...: one for each drive

Every message counts: readers fit the publishers' quality of service and let many messages wait. `t` is the time of
receipt on the steady clock; the column `stamp` keeps the message's own stamp.

Rows are written as they come into a hidden folder of the dataset, which moves to its place when the recording ends. A
killed recorder leaves the hidden folder with all rows but the last second's; `--recover` gives it its place.
"""

import argparse
import importlib
import math
import os
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from bridge import ros
from bridge.commands import CommandListener
from bridge.exits import Exit, OptionError, refusal
from bridge.mcap_file import mend
from bridge.options import Parser, ends_at_ctrl_c, in_range, said, topic_name
from bridge.parameters import command_line
from bridge.split_writer import SplitWriter
from bridge.streams import DEPTH, Stream
from bridge.trial_writer import MCAP, PARTIAL, TrialWriter

IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/PointCloud2")
"""Types that are kept whole on request only: they take megabytes a second."""
AHEAD = 1.0
"""Seconds by which a stamp may be ahead of this node's clock; one that is further is of another clock."""
LOOK_PERIOD = 0.1
"""Seconds between two looks for publishers."""


def check_dataset(dataset: Path) -> None:
    """Raise OptionError for a folder that holds somebody's files and no dataset."""
    if dataset.is_dir() and not (dataset / "dataset.toml").exists():
        others = sorted(one.name for one in dataset.iterdir() if one.name != "trials" and not one.name.startswith("."))
        if others:
            raise OptionError(f"{dataset}: holds {others[0]} and no dataset.toml. Give the folder of a dataset, or "
                             "a new one.")


def write_dataset_file(dataset: Path, options: argparse.Namespace) -> None:
    """Write dataset.toml unless the dataset has one: what was driven, and its nominal geometry."""
    path = dataset / "dataset.toml"
    if path.exists():
        return
    mass = f"mass = {options.mass}                # kg, nominal\n" if options.mass else ""
    text = (
        "schema = 1\n"
        f"vehicle = {toml_text(options.vehicle)}\n"
        f"wheel_radius = {options.wheel_radius}      # m, nominal\n"
        f"track = {options.track}              # m, nominal, between drive wheels\n"
        f"wheelbase = {options.wheelbase}           # m, drive axle to front axle\n"
        f"{mass}"
        f"command_limits = [{options.v_limit}, {options.omega_limit}]  # m/s, rad/s\n"
        'reference_point = "drive axle centre"\n'
        f"odometry = {toml_text(options.odometry_topic)}\n"
        f"ground_truth = {toml_text(options.ground_truth_topic)}\n"
        f"held_out = [{', '.join(map(toml_text, options.held_out))}]   # trials to be predicted, never fitted\n"
    )
    temporary = path.with_name(".dataset.toml.tmp")
    temporary.write_text(text, encoding="utf-8")
    os.replace(temporary, path)


def toml_text(text: str) -> str:
    """Return the text as a TOML basic string."""
    return '"' + "".join(f"\\u{ord(c):04x}" if ord(c) < 32 or c in '"\\\x7f' else c for c in text) + '"'


class StampedListener(CommandListener):
    """Hears commands with their own time, and whole; best effort, so that no recorder ever holds up a command."""

    def __init__(self, node: Any, topic: str, on_message: Callable[[Any, float, float, float], None]) -> None:
        """Listen in the type that the base hears.

        `on_message` gets the message, its stamp [s] (0 where it has none), v [m/s] and omega [rad/s].
        """
        self._on_message = on_message
        self.lost = 0
        """Commands that the middleware reports as lost."""
        super().__init__(node, topic, "auto", lambda v, omega, marked: None)

    def _open(self, kind: str) -> None:
        from geometry_msgs import msg

        def heard(message: Any) -> None:
            planar, stamp = message, 0.0
            if kind == "TwistStamped":
                planar, stamp = message.twist, ros.stamp_seconds(message.header.stamp)
            self._on_message(message, stamp, planar.linear.x, planar.angular.z)

        def count(event: Any) -> None:
            self.lost += event.total_count_change

        self.kind = kind
        topic = ros.Topic(getattr(msg, kind), self.name, ros.best_effort(DEPTH))
        ros.subscribe_counting_losses(self.node, topic, heard, count, use_default_callbacks=False)


class RecordNode:
    """Writes the streams of the graph to one trial.

    Times are those of receipt on the steady clock. With `--time stamp` they are the messages' own; a command without
    one has the node's time at its receipt.
    """

    def __init__(self, node: Any, writer: TrialWriter | SplitWriter | None, options: argparse.Namespace,
                 seconds: float = 0.0) -> None:
        """Listen on the graph, for so long [s] or without end. What comes is dropped while `writer` is None."""
        from nav_msgs.msg import Odometry
        from sensor_msgs.msg import Imu

        self.writer: Any = writer
        """What takes the rows; None while nothing is recorded."""
        self.failure: OSError | None = None
        """Why the recording ended early, such as a full disk."""
        self._started = time.monotonic()
        self._seconds = seconds
        self._node, self._by_stamp = node, options.time == "stamp"
        self._commands = StampedListener(node, options.command_topic, self._on_command)
        self.streams = [Stream(node, Odometry, options.odometry_topic, self._on_odometry),
                        Stream(node, Odometry, options.ground_truth_topic, self._on_ground_truth),
                        Stream(node, Imu, options.imu_topic, self._on_imu)]
        self._images = options.images
        self._whole: dict[str, Stream] | None = {} if options.mcap or options.images else None
        ros.steady_timer(node, LOOK_PERIOD, self._look)
        ros.steady_timer(node, 1.0, self._flush)

    def finished(self) -> bool:
        """Return whether the recording time is over, or nothing can be written any more."""
        return self.failure is not None or bool(self._seconds) and time.monotonic() - self._started > self._seconds

    def lost(self) -> dict[str, int]:
        """Return how many messages of each topic the middleware lost, where it lost any."""
        heard: list[StampedListener | Stream] = [self._commands, *self.streams, *(self._whole or {}).values()]
        return {stream.name: stream.lost for stream in heard if stream.lost}

    def _look(self) -> None:
        self._commands.look()
        for stream in self.streams:
            stream.look()
        if self._whole is not None:
            self._look_for_topics(self._whole)

    def _look_for_topics(self, known: dict[str, Stream]) -> None:
        """Listen to every topic of the graph, whose messages go whole into the MCAP file."""
        for topic, kinds in self._node.get_topic_names_and_types():
            kind = message_class(kinds[0])
            own = topic == self._commands.name  # a second reader of commands would look like a base that listens
            if topic in known or own or kind is None or (kinds[0] in IMAGES and not self._images):
                continue
            if self._node.get_publishers_info_by_topic(topic):
                known[topic] = Stream(self._node, kind, topic, self._keeper(topic, kind), raw=True)
        for stream in known.values():
            stream.look()

    def _keeper(self, topic: str, kind: Any) -> Callable[[bytes], None]:
        def keep(data: bytes) -> None:
            self._write(lambda writer: writer.message(topic, kind, data))

        return keep

    def _flush(self) -> None:
        self._write(lambda writer: writer.flush())

    def now(self) -> float:
        """Return the present time of what is recorded [s]."""
        return float(self._node.get_clock().now().nanoseconds * 1e-9) if self._by_stamp else time.monotonic()

    def _time(self, stamp: float) -> float:
        """Return the time that a message of this stamp gets."""
        return believed(stamp, self.now()) if self._by_stamp else self.now()

    def _on_command(self, message: Any, stamp: float, v: float, omega: float) -> None:
        t = self._time(stamp)
        self._write(lambda writer: writer.command(t, v, omega))
        if self._whole is not None:
            from rclpy.serialization import serialize_message

            self._keeper(self._commands.name, type(message))(serialize_message(message))

    def _on_odometry(self, message: Any) -> None:
        speed, stamp = message.twist.twist, ros.stamp_seconds(message.header.stamp)
        t = self._time(stamp)
        self._write(lambda writer: writer.odometry(t, planar_pose(message), (speed.linear.x, speed.angular.z), stamp))

    def _on_ground_truth(self, message: Any) -> None:
        stamp = ros.stamp_seconds(message.header.stamp)
        t = self._time(stamp)
        self._write(lambda writer: writer.ground_truth(t, *planar_pose(message), stamp))

    def _on_imu(self, message: Any) -> None:
        stamp = ros.stamp_seconds(message.header.stamp)
        t = self._time(stamp)
        self._write(lambda writer: writer.imu(t, message.angular_velocity.z, stamp))

    def _write(self, write: Callable[[Any], None]) -> None:
        """Write, and end the recording where that fails; the vehicle's nodes are other processes and drive on."""
        try:
            if self.writer is not None:
                write(self.writer)
        except OSError as error:
            self.failure = self.failure or error


def believed(stamp: float, now: float) -> float:
    """Return a stamp [s], or the receiver's time where there is none or it is from the future.

    Such a one counts on another clock, as that of a guard beside a simulation.
    """
    return stamp if 0 < stamp < now + AHEAD else now


def message_class(name: str) -> Any:
    """Return the class of a message such as nav_msgs/msg/Odometry; None where its package is not installed."""
    package, _, kind = name.partition("/msg/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), kind)
    except (ImportError, AttributeError):
        return None


def recover(dataset: Path) -> list[Path]:
    """Give the recordings of killed recorders their place as trials; return their folders.

    Raises:
        ValueError: a trial of that name exists already.
    """
    found = []
    for partial in sorted(dataset.glob(".*.partial-*")):
        match = PARTIAL.fullmatch(partial.name)
        if match is None or is_running(int(match["process"])):
            continue
        folder = dataset / "trials" / match["trial"]
        if folder.exists():
            raise ValueError(f"{partial}: cannot become {folder}, which exists already. Rename one of them.")
        folder.parent.mkdir(parents=True, exist_ok=True)
        for path in partial.glob("*.csv"):
            drop_torn_row(path)
        for path in partial.glob(MCAP):
            mend(path)
        os.replace(partial, folder)
        found.append(folder)
    return found


def drop_torn_row(path: Path) -> None:
    """Cut a row off that a killed recorder had only begun; every whole row ends with a line feed."""
    content = path.read_bytes()
    whole = content[: content.rfind(b"\n") + 1]
    if len(whole) < len(content):
        temporary = path.with_name(f".{path.name}.tmp")
        temporary.write_bytes(whole)
        os.replace(temporary, path)


def is_running(process: int) -> bool:
    """Return whether a process of this number exists on this computer."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):  # somebody else's, or no number that a process can have: left alone
        return True
    return True


def planar_pose(message: Any) -> tuple[float, float, float]:
    """Return x [m], y [m], yaw [rad] of nav_msgs/Odometry."""
    position, q = message.pose.pose.position, message.pose.pose.orientation
    yaw = math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z))
    return position.x, position.y, yaw


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


def add_dataset_options(parser: argparse.ArgumentParser) -> None:
    """Declare the topics that are recorded, and what dataset.toml says of the vehicle."""
    parser.add_argument("--odometry-topic", type=topic_name, default=ros.ODOMETRY_TOPIC,
                        help="the vehicle's own odometry")
    parser.add_argument("--ground-truth-topic", type=topic_name, default=ros.GROUND_TRUTH_TOPIC,
                        help="an outside measurement")
    parser.add_argument("--imu-topic", type=topic_name, default=ros.IMU_TOPIC, help="sensor_msgs/Imu, for its yaw rate")
    parser.add_argument("--time", choices=("receipt", "stamp"), default="receipt",
                        help="what `t` is: when a message came, or its own stamp, for sensors that share one clock")
    parser.add_argument("--mcap", action="store_true",
                        help=f"also keep every message of every topic in the trial's {MCAP}, which Foxglove, ros2 bag "
                             "and sysid.convert read; without images and point clouds")
    parser.add_argument("--images", action="store_true", help="the same with images and point clouds")
    parser.add_argument("--held-out", nargs="+", default=[], metavar="TRIAL",
                        help="trials that dataset.toml names as never to be fitted")
    parser.add_argument("--vehicle", default="WHILL Model CR", help="name or short description, for dataset.toml")
    parser.add_argument("--wheel-radius", type=in_range(0.001, 2), default=0.1325, help="nominal radius [m]")
    parser.add_argument("--track", type=in_range(0.01, 5), default=0.496, help="distance between the driven wheels [m]")
    parser.add_argument("--wheelbase", type=in_range(0, 5), default=0.45, help="distance between the axles [m]")
    parser.add_argument("--mass", type=in_range(0.01, 1e4), help="[kg], where known")
    parser.add_argument("--v-limit", type=in_range(0.01, 100), default=1.0,
                        help="largest speed that the vehicle drives [m/s], for dataset.toml")
    parser.add_argument("--omega-limit", type=in_range(0.01, 100), default=1.0,
                        help="its largest yaw rate [rad/s]")


def finish(writer: TrialWriter | SplitWriter) -> bool:
    """End a recording and say what it holds; return whether its end could be written."""
    try:
        folder = writer.close()
    except OSError as error:
        print(f"bridge.record: {error}", file=sys.stderr)
        return False
    if isinstance(writer, TrialWriter):
        say_trial(folder, writer.rows)
    elif not writer.trials:
        print("bridge.record: nothing was recorded: the vehicle never moved", file=sys.stderr)
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
        writer: TrialWriter | SplitWriter
        if options.split:
            writer = SplitWriter(options.dataset, options.trial, options.split, say_trial)
        else:
            writer = TrialWriter(options.dataset, options.trial)
        options.dataset.mkdir(parents=True, exist_ok=True)
        write_dataset_file(options.dataset, options)
    except (ValueError, OSError) as error:
        print(f"bridge.record: {said(error)}", file=sys.stderr)
        return refusal(error)
    failed = False
    try:
        with ros.node_session(ros.RECORD_NAME, ros_arguments) as node:
            recorder = RecordNode(node, writer, options, options.seconds)
            ros.spin(node, recorder.finished)
            failed = recorder.failure is not None
            for topic, count in recorder.lost().items():
                print(f"bridge.record: {topic}: {count} messages were lost on the way. Record on the vehicle's own "
                      "computer, or let the publisher be reliable.", file=sys.stderr)
    finally:
        whole = finish(writer)
    if failed or not whole:
        print("bridge.record: the recording ended early, because nothing could be written any more", file=sys.stderr)
        return Exit.FAULT
    if not writer.rows["odometry"]:
        print(f"bridge.record: no odometry was recorded: no message came on {options.odometry_topic}, or the vehicle "
              "never moved. A fit needs it; name the vehicle's topic with --odometry-topic.", file=sys.stderr)
        return Exit.SHORT
    return Exit.DONE


if __name__ == "__main__":
    sys.exit(main())

"""What dataset.toml says of a recorded dataset: its options, and the file, which is written once."""

import argparse
import errno
import os
from pathlib import Path

from bridge.nodes import ros
from bridge.nodes.exits import OptionError
from bridge.nodes.options import in_range, topic_name
from bridge.recording.trial_writer import MCAP


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


def check_dataset(dataset: Path) -> None:
    """Raise OptionError for a folder that holds somebody's files and no dataset, NotADirectoryError for a file."""
    if dataset.exists() and not dataset.is_dir():
        raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), str(dataset / "trials"))
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

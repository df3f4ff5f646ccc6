"""One recording: where it is, its streams, and the topics and types that hold them."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

CHAIR_STATE = "ModelCr2State"
TOPICS = {
    "command": ("/whill/controller/cmd_vel", "/cmd_vel", "/whill/cmd_vel"),
    "odometry": ("/whill/odom", "/odom", "/whill/odometry", "/whill/states/model_cr2"),
    "ground_truth": ("/ground_truth/odom", "/ground_truth/pose"),
    "imu": ("/whill/imu", "/imu/data", "/imu", "/imu/data_raw"),
}
"""Names that are looked for, the first found is taken. Odometry topics are never guessed to be ground truth."""
TRUTH = re.compile(r"truth|(?<![a-z])(?:gt|true)(?![a-z])", re.IGNORECASE)
"""In the names of what simulators publish of the vehicle itself."""
TRACKERS = re.compile(r"mocap|motion_?capture|vicon|opti_?track|qualisys|vrpn|natnet", re.IGNORECASE)
"""In the names of what tracking systems publish of any body."""
TYPES = {
    "command": ("Twist", "TwistStamped"),
    "odometry": ("Odometry", CHAIR_STATE, "JointState"),
    "ground_truth": ("Odometry", "PoseStamped", "PoseWithCovarianceStamped", "TransformStamped"),
    "imu": ("Imu",),
}
COLUMNS = {"command": ("v", "omega"), "odometry": ("x", "y", "yaw", "v", "omega"), "ground_truth": ("x", "y", "yaw"),
           "imu": ("gyro",)}
OPTIONS = {"command": "--command-topic", "odometry": "--odometry-topic", "ground_truth": "--truth-topic",
           "imu": "--imu-topic"}
SUFFIXES = (".db3", ".mcap", ".bag")
PACKED = (".zst", ".zstd")


@dataclass(frozen=True)
class BagStream:
    topic: str
    kind: str  # message type, like "nav_msgs/msg/Odometry"
    received: np.ndarray  # (T,) s, Unix time at which the recorder got the message
    stamped: np.ndarray  # (T,) s, of the header; nan where the type has none
    values: np.ndarray  # (T, C) columns of COLUMNS


@dataclass(frozen=True)
class Bag:
    """The streams of one recording, and what was noteworthy in reading them."""

    path: Path
    streams: dict[str, BagStream]
    notes: list[str] = field(default_factory=list)


def is_bag(path: Path) -> bool:
    """Whether a path is one recording: a folder with metadata.yaml, or a file of a known kind."""
    packed = path.suffix in PACKED and Path(path.stem).suffix in SUFFIXES
    return (path / "metadata.yaml").is_file() or (path.is_file() and (path.suffix in SUFFIXES or packed))


def find_bags(source: Path) -> list[Path]:
    """The recordings at a path or directly under it, in order of their names; empty where there is none.

    A folder under it without metadata.yaml, whose recorder was killed, counts by its files that are named after it.
    """
    if is_bag(source) or not source.is_dir():
        return [source] if is_bag(source) else []
    entries = sorted(source.iterdir())
    bags = [path for path in entries if is_bag(path)]
    killed = [file for folder in entries if folder.is_dir() and not is_bag(folder) for file in sorted(folder.iterdir())
              if file.is_file() and is_bag(file) and re.match(rf"{re.escape(folder.name)}_\d+\.", file.name)]
    return sorted([*bags, *killed])


def from_outside(topic: str) -> bool:
    """Whether a topic's name says that it is measured from outside, so that it is no vehicle's odometry."""
    return bool(TRUTH.search(topic) or TRACKERS.search(topic))


def short_type(kind: str) -> str:
    """Odometry of nav_msgs/msg/Odometry."""
    return kind.rsplit("/", 1)[-1]

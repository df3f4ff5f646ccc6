"""Reads the three streams of a driving log out of a ROS bag (rosbag2 .db3 or .mcap, ROS 1 .bag), without ROS.

Known are the paper's topics, the maker's, and those of `bridge.ros`; others are named by the caller or found by their
type where only one topic has it. Messages: Twist and TwistStamped as commands, Odometry as odometry, Odometry,
PoseStamped, PoseWithCovarianceStamped and TransformStamped as outside pose, and the yaw rate of an Imu. Where there is
no pose, the transforms between frames (TFMessage) are chained to one.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from sysid.logs import transforms
from sysid.logs.bag_clocks import find_bursts, find_step
from sysid.logs.wheel_states import (
    CHAIR_DEFINITION,
    CHAIR_STATE,
    COARSE,
    JOYSTICK_FIELDS,
    chair_odometry,
    chair_row,
    integrate_speeds,
    joint_row,
    joint_twist,
)
from whill_mjx.io.reading import LONGEST_REASON

TOPICS = {
    "command": ("/whill/controller/cmd_vel", "/cmd_vel", "/whill/cmd_vel"),
    "odometry": ("/whill/odom", "/odom", "/whill/odometry", "/whill/states/model_cr2"),
    "ground_truth": ("/ground_truth/odom", "/ground_truth/pose"),
    "imu": ("/whill/imu", "/imu/data", "/imu", "/imu/data_raw"),
}
"""Names that are looked for, the first found is taken. Odometry topics are never guessed to be ground truth."""
TYPES = {
    "command": ("Twist", "TwistStamped"),
    "odometry": ("Odometry", CHAIR_STATE, "JointState"),
    "ground_truth": ("Odometry", "PoseStamped", "PoseWithCovarianceStamped", "TransformStamped"),
    "imu": ("Imu",),
}
COLUMNS = {"command": ("v", "omega"), "odometry": ("x", "y", "yaw", "v", "omega"), "ground_truth": ("x", "y", "yaw"),
           "imu": ("gyro",)}
WHAT = {"command": "commands that reached the vehicle", "odometry": "vehicle's odometry"}
SIDEWAYS = 0.01  # m/s of a command that is none
NOT_READ = {"AckermannDriveStamped": "which steers as cars do, and is not read",
            "AckermannDrive": "which steers as cars do, and is not read",
            "Path": "which is not read: record its poses as PoseStamped"}
"""Types that hold a motion, and why none is taken from them."""
WHEELS = ("JointState", CHAIR_STATE, "Odometry")
"""Types of the input where wheel speeds stand for commands, the first found is taken."""
OPTIONS = {"command": "--command-topic", "odometry": "--odometry-topic", "ground_truth": "--truth-topic",
           "imu": "--imu-topic"}
SUFFIXES = (".db3", ".mcap", ".bag")
PACKED = (".zst", ".zstd")
UNPACKED_BYTES = 20_000_000_000  # of one packed bag at most
STATIC = "_static"  # after the name of a topic of transforms: those of it that never change
DAY, STRAY = 86400.0, 0.01  # s from most messages, and the share of them, up to which a time of receipt is no clock's
MAX_SET_BACK = 0.5  # s that a stamp may run back by before the clock counts as set


@dataclass(frozen=True)
class BagStream:
    """One topic of a bag."""

    topic: str
    kind: str
    """Message type, like "nav_msgs/msg/Odometry"."""
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
    """The recordings at a path or directly under it, in order of their names; empty where there is none."""
    if is_bag(source):
        return [source]
    return sorted(path for path in source.iterdir() if is_bag(path)) if source.is_dir() else []


def read_bag(
    path: Path, topics: dict[str, str] | None = None, geometry: tuple[float, float] = (0.1325, 0.496),
    wheels: bool = False,
) -> Bag:
    """Streams of a recording.

    Args:
        path: folder of a rosbag2, or a .db3, .mcap or .bag file.
        topics: "command", "odometry", "ground_truth", "imu" -> topic; those left out are looked for, "" leaves one out.
        geometry: nominal wheel radius and track [m], for angles and rates of wheels.
        wheels: take measured wheel speeds in place of the commands.

    Raises:
        ValueError: naming the file, the topic, the rule and the remedy.
    """
    if path.suffix in PACKED:
        with TemporaryDirectory() as folder:
            unpacked = _unpacked(path, Path(folder))
            try:
                return replace(read_bag(unpacked, topics, geometry, wheels), path=path)
            except ValueError as error:
                raise ValueError(str(error).replace(str(unpacked), str(path))) from None
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError as error:
        raise ValueError(f"{path}: reading ROS bags needs the package rosbags ({error}). "
                         "Run `pip install rosbags`.") from None
    notes: list[str] = []
    try:
        store = get_typestore(Stores.ROS2_HUMBLE)
        store.register(get_types_from_msg(CHAIR_DEFINITION + JOYSTICK_FIELDS, f"whill_msgs/msg/{CHAIR_STATE}"))
        with _opened(AnyReader, path, store, notes) as reader:
            known = {name: str(about.msgtype) for name, about in reader.topics.items() if about.msgcount}
            asked = topics or {}
            chosen = choose_topics(path, known, {**asked, **dict.fromkeys(_framed(known, asked), "")}, notes, wheels)
            rows = _rows(reader, {topic: stream for stream, topic in chosen.items()}, notes)
            streams = _of_frames(path, reader, known, asked, _unposed(chosen, asked, wheels), notes)
            if not {"odometry", "ground_truth"} & {*chosen, *streams}:
                raise _no_pose(path, known, asked)
            notes += [] if "ground_truth" in {*chosen, *streams} else _not_read(known, "odometry" in chosen)
    except Exception as error:  # the library lets out whatever a damaged recording leads to
        if isinstance(error, ValueError) and str(error).startswith(f"{path}: "):
            raise
        raise ValueError(f"{path}: cannot be read as a ROS bag ({str(error)[:LONGEST_REASON]}). Give the folder with "
                         "metadata.yaml, or a .db3, .mcap or .bag file that was closed properly; `ros2 bag reindex` or "
                         "`mcap recover` repairs one.") from None
    spare = {"imu"} if asked.get("imu") is None else set()  # found by itself, and nothing depends on it
    for stream, topic in chosen.items():
        kept = _usable(path, stream, topic, short_type(known[topic]), rows[stream], notes)
        if len(kept) >= 2:
            found = BagStream(topic, known[topic], kept[:, 0], kept[:, 1], kept[:, 2:])
            streams[stream] = found if kept.shape[1] - 2 == len(COLUMNS[stream]) else _of_wheels(
                stream, found, geometry, notes)
        elif stream not in spare:
            raise _too_few(path, topic, len(kept), stream)
        elif len(kept):
            notes.append(f"{topic}: {len(kept)} usable messages; it is left out")
    return Bag(path, streams, notes)


@contextmanager
def _opened(reader: Any, path: Path, store: Any, notes: list[str]) -> Iterator[Any]:
    """A reader of a recording; of the files in its folder where metadata.yaml does not go with them, with a note."""
    files = sorted(one for one in path.iterdir() if one.suffix in SUFFIXES) if path.is_dir() else []
    opened = reader([path], default_typestore=store)
    try:
        opened.open()
    except Exception as error:  # as of any damaged recording
        if not files:
            raise
        opened = reader(files, default_typestore=store)
        opened.open()
        notes.append(f"metadata.yaml does not go with its files ({str(error)[:LONGEST_REASON]}): what is in "
                     f"{', '.join(one.name for one in files)} is read without it")
    try:
        yield opened
    finally:
        opened.close()


def _framed(known: Mapping[str, str], asked: Mapping[str, str]) -> dict[str, tuple[str, str]]:
    """Stream -> topic, and "" or "PARENT:CHILD", where transforms were named, as /tf or /tf:PARENT:CHILD."""
    split = {stream: asked[stream].partition(":") for stream in ("odometry", "ground_truth") if stream in asked}
    return {stream: (topic, frames) for stream, (topic, _, frames) in split.items()
            if short_type(known.get(topic, "")) in transforms.KINDS}


def _namespaces(known: Mapping[str, str]) -> list[tuple[str, ...]]:
    """The topics of transforms that belong together: those that move, then the static ones beside them, if any."""
    topics = sorted((topic for topic, kind in known.items() if short_type(kind) in transforms.KINDS),
                    key=lambda topic: (len(topic), topic))  # /tf first
    moving = [topic for topic in topics if not topic.endswith(STATIC)]
    found = [(topic, *[one for one in (topic + STATIC, f"/tf{STATIC}") if one in topics][:1]) for topic in moving]
    return found + [(topic,) for topic in topics if not any(topic in one for one in found)]


def _unposed(chosen: Mapping[str, str], asked: Mapping[str, str], wheels: bool) -> list[str]:
    """The streams of which transforms may be one, where no topic has a pose."""
    if {"odometry", "ground_truth"} & set(chosen):
        return []
    return [stream for stream in ("odometry", "ground_truth")
            if asked.get(stream) != "" and not (wheels and stream == "odometry")]


def _of_frames(
    path: Path, reader: Any, known: Mapping[str, str], asked: Mapping[str, str], wanted: list[str], notes: list[str]
) -> dict[str, BagStream]:
    """Streams out of transforms: those that were named, or the one that there is of those that are wanted."""
    framed, trees = _framed(known, asked), _namespaces(known)
    if framed:
        trees = [one for one in trees if any(topic in one for topic, _ in framed.values())]
    if not trees or not framed and not wanted:
        return {}
    links, broken = {one: transforms.Links(one) for one in trees}, Counter[str]()
    topics = {topic for one in trees for topic in one}
    for connection, received, raw in reader.messages(connections=[one for one in reader.connections
                                                                  if one.topic in topics]):
        try:
            message = reader.deserialize(raw, connection.msgtype)
            for one in trees:
                if connection.topic in one:
                    links[one].add(received * 1e-9, message)
        except Exception:  # as of any damaged message
            broken[connection.topic] += 1
    notes += [f"{topic}: {count} damaged messages are left out" for topic, count in broken.items()]
    try:
        found = transforms.chosen_poses(list(links.values()), framed, wanted, notes)
    except transforms.NoChain as error:
        option = OPTIONS[next(iter(framed), wanted[0] if wanted else "ground_truth")]
        topic = next((topic for topic, _ in framed.values()), trees[0][0])
        said = (f"{', '.join(sorted(topics))}: {error}. Name the frames, {option} {topic}:PARENT:CHILD; or record the "
                "pose as Odometry or PoseStamped.")
        raise ValueError(f"{path}: {said}") if framed else _no_pose(path, known, asked, said) from None
    return {stream: BagStream(f"{one.topic}:{one.parent}:{one.child}", known[one.topic], one.received, one.stamped,
                              one.with_speeds() if stream == "odometry" else one.pose)
            for stream, one in found.items()}


def _no_pose(path: Path, known: Mapping[str, str], asked: Mapping[str, str], frames: str = "") -> ValueError:
    """The error where nothing measures the motion; `frames`: why the transforms give no pose."""
    poses = [] if asked.get("ground_truth") == "" else [
        name for name, kind in sorted(known.items()) if short_type(kind) in TYPES["ground_truth"]]
    more = [*_not_read(known), *([f"{', '.join(poses)} may be the outside pose: {OPTIONS['ground_truth']} {poses[0]}"]
                                 if poses else [])]
    return ValueError(f"{path}: neither odometry nor outside pose found (topics with messages: {_listing(known)})."
                      f"{''.join(f' {one}.' for one in more)} Name one with --odometry-topic or --truth-topic."
                      f"{' ' + frames if frames else ''}")


def _listing(known: Mapping[str, str]) -> str:
    return ", ".join(f"{name} ({short_type(kind)})" for name, kind in sorted(known.items())) or "none"


def _not_read(known: Mapping[str, str], frames: bool = False) -> list[str]:
    """Notes on topics that hold a motion which is not read.

    Args:
        frames: transforms are none of the streams, though they might be the outside pose.
    """
    kinds = {short_type(kind): topic for topic, kind in known.items()}
    held = [topics[0] for topics in _namespaces(known) if frames]
    return [*(f"{kinds[kind]} is {kind}, {why}" for kind, why in NOT_READ.items() if kind in kinds),
            *(f"{topic} holds frames, which are not looked at: --truth-topic {topic} takes the pose in map or world "
              "from them, if it measures the vehicle from outside" for topic in held[:1])]


def _rows(reader: Any, names: dict[str, str], notes: list[str]) -> dict[str, list[tuple[float, ...]]]:
    """Time of receipt and of the header [s] and columns of every message, by stream; damaged messages are left out.

    Args:
        names: topic -> stream.
    """
    rows: dict[str, list[tuple[float, ...]]] = {stream: [] for stream in names.values()}
    broken: Counter[str] = Counter()
    sideways = 0.0
    said = ""
    for connection, received, raw in reader.messages(connections=[one for one in reader.connections
                                                                  if one.topic in names]):
        stream = names[connection.topic]
        try:
            message: Any = reader.deserialize(raw, connection.msgtype)
            sideways = max(sideways, _sideways(message) if stream == "command" else 0.0)
            rows[stream].append((received * 1e-9, header_time(message), *read_message(
                stream, short_type(connection.msgtype), message)))
        except Exception as error:  # the library lets out whatever a damaged message leads to
            broken[connection.topic] += 1
            said = said or str(error)
    if broken and not any(rows.values()):
        raise ValueError(said)
    if sideways > SIDEWAYS:
        notes.append(f"commands also ask for up to {sideways:.2g} m/s sideways (linear.y): forward speed and yaw rate "
                     "alone are read, and no model drives sideways. Leave such drives out")
    notes += [f"{topic}: {count} damaged messages are left out" for topic, count in broken.items()]
    return rows


def _usable(
    path: Path, stream: str, topic: str, kind: str, rows: list[tuple[float, ...]], notes: list[str]
) -> np.ndarray:
    """The rows of a stream as a table, without those that say nothing; notes count these."""
    if not rows:
        return np.zeros((0, 2))
    table = np.array(rows, float)
    unset = np.isinf(table[:, 2:]).any(axis=1)
    finite = np.isfinite(table[:, 2:]).all(axis=1) | (kind == "JointState") & ~unset
    far = np.abs(table[:, 0] - np.median(table[:, 0])) > DAY
    far &= far.mean() < STRAY
    if unset.all():
        if kind == "JointState":
            raise ValueError(f"{path}: topic {topic}: no joint is called left or right. Name another topic with "
                             f"{OPTIONS[stream]}.")
        raise ValueError(f"{path}: topic {topic}: the orientation is all zero, which is no quaternion. Record a "
                         f"topic with an orientation, or leave this one out: {OPTIONS[stream]} ''.")
    notes += [f"{topic}: {which.sum()} messages {what} are left out" for which, what in (
        (unset, "with an orientation that is all zero"), (~finite & ~unset, "with numbers that are not finite"),
        (finite & far, "whose time is more than a day from the others'")) if which.any()]
    return table[finite & ~far]


def _too_few(path: Path, topic: str, count: int, stream: str) -> ValueError:
    return ValueError(f"{path}: topic {topic} has {count} usable messages; at least 2 are needed. Name another topic "
                      f"with {OPTIONS[stream]}, or '' to go without.")


def _of_wheels(stream: str, found: BagStream, geometry: tuple[float, float], notes: list[str]) -> BagStream:
    """A stream of wheel angles and rates (T, 4) as motion, in order of time."""
    later = np.append(True, np.diff(np.maximum.accumulate(found.received)) > 1e-6)
    received, rows = found.received[later], found.values[later]
    if (step := float(np.median(np.diff(received)))) > COARSE:
        notes.append(f"{found.topic}: a state each {step:.2g} s is coarse: delays and lags below that do not show. Ask "
                     "the driver for 20 ms (publish_interval_ms)")
    if short_type(found.kind) == CHAIR_STATE:
        values = chair_odometry(received, rows, *geometry)
        values = values if stream == "odometry" else values[:, 3:]
    else:
        values = joint_twist(received, rows, *geometry)
        if stream == "odometry":
            values = np.column_stack([*integrate_speeds(received, *values.T), values])
    return replace(found, received=received, stamped=found.stamped[later], values=values)


def _unpacked(path: Path, folder: Path) -> Path:
    """A packed bag, as a recorder leaves it that was killed before it wrote metadata.yaml, unpacked into a folder."""
    from rosbags.rosbag2.reader import zstd  # the standard library's, or what stands for it in older Pythons

    target = folder / path.stem
    try:
        with zstd.open(path, "rb") as source, target.open("wb") as out:
            while part := source.read(1 << 20):
                if out.tell() > UNPACKED_BYTES:
                    raise ValueError(f"{path}: is larger than {UNPACKED_BYTES / 1e9:g} GB unpacked. Split it.")
                out.write(part)
    except (zstd.ZstdError, EOFError) as error:
        raise ValueError(f"{path}: cannot be unpacked ({error}). Copy it again, or unpack it with zstd -d.") from None
    return target


def choose_topics(
    path: Path, known: dict[str, str], asked: dict[str, str], notes: list[str], wheels: bool = False
) -> dict[str, str]:
    """Topic of each stream, from what the bag has, what was asked for, and the names that are usual.

    Args:
        wheels: the input is measured wheel speeds.
    """
    listing = _listing(known)
    chosen: dict[str, str] = {}
    types = {**TYPES, "command": WHEELS} if wheels else TYPES
    for stream in TOPICS:
        if wheels and stream == "command" and stream not in asked:
            chosen.update(_wheel_topic(path, known, listing))
            continue
        if wheels and stream == "odometry":
            continue
        if stream in asked:
            topic = asked[stream]
            if not topic:
                continue
            if topic not in known:
                raise ValueError(f"{path}: no topic {topic!r} (topics with messages: {listing}). Correct "
                                 f"{OPTIONS[stream]}.")
            if short_type(known[topic]) not in types[stream]:
                raise ValueError(f"{path}: topic {topic} is {known[topic]}; {stream} must be one of "
                                 f"{', '.join(types[stream])}. Name another topic with {OPTIONS[stream]}.")
            chosen[stream] = topic
            continue
        usual = [name for name in TOPICS[stream] if short_type(known.get(name, "")) in TYPES[stream]]
        fitting = [name for name, kind in known.items() if short_type(kind) in TYPES[stream]
                   and name not in (*chosen.values(), *asked.values())
                   and (stream == "ground_truth" or name not in TOPICS["ground_truth"])]
        fitting = [name for name in fitting if short_type(known[name]) != "JointState"] or fitting
        if usual:
            chosen[stream] = usual[0]
        elif stream != "ground_truth" and len(fitting) == 1 and fitting[0] not in TOPICS["ground_truth"]:
            chosen[stream] = fitting[0]
            notes.append(f"{stream} is taken from {fitting[0]}, the only topic of a fitting type")
        elif stream == "ground_truth" and (others := [name for name in fitting if "odom" not in name]):
            notes.append(f"no outside pose is taken. {', '.join(others)} may be one: {OPTIONS[stream]} {others[0]}, if "
                         "it measures the vehicle from outside")
        elif stream in ("command", "odometry") and len(fitting) > 1:
            said = (f"any of {', '.join(sorted(fitting))} may be the {WHAT[stream]}. Name one: {OPTIONS[stream]} "
                    f"{sorted(fitting)[0]}")
            if stream == "command" or not {*TOPICS["ground_truth"], asked.get("ground_truth")} & set(known):
                raise ValueError(f"{path}: {said}")
            notes.append(f"no odometry is taken: {said}")
    if "command" not in chosen and "command" not in asked:
        more = "".join(f" {one}." for one in _not_read(known))
        raise ValueError(f"{path}: no command topic found (topics with messages: {listing}).{more} Name the Twist or "
                         "TwistStamped that was sent to the vehicle with --command-topic; or take the measured wheel "
                         "speeds in its place, with an outside pose: --input wheels.")
    if "command" not in chosen:
        raise ValueError(f"{path}: --command-topic is empty; a trial needs its commands. Name their topic.")
    return chosen


def _wheel_topic(path: Path, known: dict[str, str], listing: str) -> dict[str, str]:
    """The topic whose wheel speeds are the input."""
    for kind in WHEELS:
        fitting = [name for name, one in known.items()
                   if short_type(one) == kind and name not in TOPICS["ground_truth"]]
        usual = [name for name in TOPICS["odometry"] if name in fitting]
        if len(fitting) == 1 or usual:
            return {"command": (usual or fitting)[0]}
    raise ValueError(f"{path}: no topic with wheel speeds found (topics with messages: {listing}). Name a JointState "
                     "or an Odometry with --command-topic.")


def read_message(stream: str, kind: str, message: Any) -> tuple[float, ...]:
    """Columns of one message: v, omega; x, y, yaw, v, omega; or x, y, yaw; all of them nan where a number is not
    finite, and infinite where the orientation was never set."""
    row = _columns(stream, kind, message)
    whole = all(map(math.isfinite, row)) or all(map(math.isinf, row)) or kind == "JointState"
    return row if whole else (math.nan,) * len(row)


def _columns(stream: str, kind: str, message: Any) -> tuple[float, ...]:
    if kind == CHAIR_STATE:
        return chair_row(message)
    if kind == "Imu":
        return (float(message.angular_velocity.z),)
    if kind == "JointState":
        return joint_row(message)
    if kind == "Odometry" and stream == "command":
        return float(message.twist.twist.linear.x), float(message.twist.twist.angular.z)
    if stream == "command":
        twist = message.twist if kind == "TwistStamped" else message
        return float(twist.linear.x), float(twist.angular.z)
    pose = _POSE[kind](message)
    position = getattr(pose, "position", None) or pose.translation
    q = getattr(pose, "orientation", None) or pose.rotation
    if abs(q.w) + abs(q.x) + abs(q.y) + abs(q.z) < 1e-6:
        return (float("inf"),) * len(COLUMNS[stream])
    planar = float(position.x), float(position.y), yaw_of(q.w, q.x, q.y, q.z)
    if stream == "ground_truth":
        return planar
    speed = message.twist.twist
    return *planar, float(speed.linear.x), float(speed.angular.z)


_POSE: dict[str, Callable[[Any], Any]] = {
    "Odometry": lambda message: message.pose.pose, "PoseStamped": lambda message: message.pose,
    "PoseWithCovarianceStamped": lambda message: message.pose.pose,
    "TransformStamped": lambda message: message.transform,
}


def yaw_of(w: float, x: float, y: float, z: float) -> float:
    """Heading [rad] of a quaternion of any length."""
    return math.atan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)


def header_time(message: Any) -> float:
    """Header stamp [s]; nan where the message has none."""
    header = getattr(message, "header", None)
    return float("nan") if header is None else header.stamp.sec + header.stamp.nanosec * 1e-9


def _sideways(message: Any) -> float:
    """Size of the speed to the side that a command asks for [m/s]; 0 where it has none."""
    twist = getattr(message, "twist", message)
    size = abs(float(getattr(getattr(twist, "linear", None), "y", 0.0)))
    return size if math.isfinite(size) else 0.0


def short_type(kind: str) -> str:
    """Odometry of nav_msgs/msg/Odometry."""
    return kind.rsplit("/", 1)[-1]


def stream_times(bag: Bag, stamp: str) -> dict[str, np.ndarray]:
    """Times [s] of each stream's messages.

    Args:
        stamp: "receive" (all on the recorder's clock) or "header" (when measured; commands, which have no header, keep
            the time of receipt, so both clocks must agree).

    Raises:
        ValueError: a stream has no stamps, or they run back.
    """
    times = {}
    for name, stream in bag.streams.items():
        has_header = bool(np.isfinite(stream.stamped).all())
        if stamp == "header" and has_header and (stream.stamped <= 0).all():
            raise ValueError(f"{bag.path}: topic {stream.topic}: all header stamps are zero. Use --stamp receive.")
        if stamp == "header" and not has_header and name != "command":
            raise ValueError(f"{bag.path}: topic {stream.topic} is {stream.kind}, without a header. Use --stamp "
                             "receive.")
        t = stream.stamped if stamp == "header" and has_header else stream.received
        if len(t) > 2 and np.ptp(t) == 0:
            whose, other = ("of receipt", "header") if t is stream.received else ("in the header", "receive")
            raise ValueError(f"{bag.path}: topic {stream.topic}: all {len(t)} messages have one time {whose}: the "
                             "clock stood still, such as a simulation's that nobody published. "
                             + (f"Use --stamp {other}." if has_header else "They have no other: record them again."))
        back = np.diff(t)
        if (back < -MAX_SET_BACK).any():
            k = int(np.argmin(back))
            raise ValueError(f"{bag.path}: topic {stream.topic}: its time goes back by {-back[k]:.3g} s after message "
                             f"{k + 1}; it must increase. Split the bag there, or use the other --stamp.")
        times[name] = t
    if stamp == "header" and times:
        late = {name: float(np.median(bag.streams[name].received - t)) for name, t in times.items()}
        own = float(np.median(list(late.values()))) if all(map(_has_stamps, bag.streams.values())) else 0.0
        for name, seconds in late.items():
            if abs(seconds - own) > 5.0:  # from that of receipt, which commands without a header keep
                raise ValueError(f"{bag.path}: topic {bag.streams[name].topic}: header stamps are {seconds:.3g} s from "
                                 "the time of receipt: another clock. Use --stamp receive.")
    return times


def in_order(bag: Bag, stamp: str) -> Bag:
    """The bag with its messages in the order in which they were sent, where the recorder's clock was set meanwhile."""
    streams = dict(bag.streams)
    for name, stream in streams.items():
        step = find_step(stream.received, stream.stamped) if stamp == "header" and _has_stamps(stream) else None
        if step is not None and step.clock == "receive":
            order = np.argsort(stream.stamped, kind="stable")
            streams[name] = replace(stream, received=stream.received[order], stamped=stream.stamped[order],
                                    values=stream.values[order])
    return replace(bag, streams=streams)


def clock_notes(bag: Bag, stamp: str) -> list[str]:
    """Notes on clocks that disagree without harm to the times that are used.

    Raises:
        ValueError: a clock that is used was set in the middle of the recording.
    """
    notes = []
    all_stamped = all(_has_stamps(stream) for stream in bag.streams.values())
    for name, stream in bag.streams.items():
        if not _has_stamps(stream):
            continue
        if step := find_step(stream.received, stream.stamped):
            way = f"{'back' if step.seconds < 0 else 'forward'} by {abs(step.seconds):.3g} s"
            whose = "the recorder's clock" if step.clock == "receive" else f"the header's clock of {stream.topic}"
            other = f"the header stamps of {stream.topic}" if step.clock == "receive" else "the times of receipt"
            said = f"{whose} was set {way}, {step.after:.1f} s into the recording, as {other} show"
            if step.clock == stamp or step.clock == "receive" and not all_stamped:
                better = "receive" if step.clock == "header" else "header" if all_stamped else None
                mixed = "commands and measurements of two moments are mixed" if step.seconds < 0 else (
                    "the drive seems to pause there")
                raise ValueError(f"{bag.path}: {said}: {mixed}. " + (
                    f"Use --stamp {better}." if better else "Cut the bag there, or record again without setting it."))
            notes.append(f"{said}; --stamp {stamp} does not depend on it")
        elif stamp == "receive" and (spread := find_bursts(stream.received, stream.stamped)):
            notes.append(f"{name}: messages of {stream.topic} came in bursts: their times of receipt vary by "
                         f"{spread:.2g} s, while their header stamps are regular. Convert again with --stamp header")
    return notes


def _has_stamps(stream: BagStream) -> bool:
    return bool(np.isfinite(stream.stamped).all() and (stream.stamped > 0).all())

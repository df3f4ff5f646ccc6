"""Reads the streams of a driving log out of a ROS bag (rosbag2 .db3 or .mcap, ROS 1 .bag), without ROS.

Known are the paper's topics, the maker's, and those of `bridge.nodes.ros`; others are named by the caller or found by
their type where only one topic has it. Messages: Twist and TwistStamped as commands, Odometry as odometry, Odometry,
PoseStamped, PoseWithCovarianceStamped and TransformStamped as outside pose, and the yaw rate of an Imu. Where there is
no pose, the transforms between frames (TFMessage) are chained to one.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Container, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from sysid.logs.bags import transforms
from sysid.logs.bags.messages import (
    CHAIR_DEFINITION,
    COARSE,
    JOYSTICK_FIELDS,
    chair_odometry,
    frames_of,
    header_time,
    joint_twist,
    read_message,
    sideways_speed,
    usable_joints,
    without_stamp,
)
from sysid.logs.bags.recording import CHAIR_STATE, COLUMNS, OPTIONS, PACKED, SUFFIXES, Bag, BagStream, short_type
from sysid.logs.bags.topics import choose_topics, framed, namespaces, no_pose, not_read
from sysid.logs.planar import integrate_speeds
from whill_mjx.io.fields import shown
from whill_mjx.io.reading import LONGEST_REASON

SIDEWAYS = 0.01  # m/s of a command that is none
UNPACKED_BYTES = 20_000_000_000  # of one packed bag at most
DAY, STRAY = 86400.0, 0.01  # s from most messages, and the share of them, up to which a time of receipt is no clock's


def read_bag(
    path: Path, topics: dict[str, str] | None = None, geometry: tuple[float, float] = (0.1325, 0.496),
    wheels: bool = False, stamp: str = "receive",
) -> Bag:
    """Streams of a recording: the folder of a rosbag2, or a .db3, .mcap or .bag file.

    Args:
        topics: "command", "odometry", "ground_truth", "imu" -> topic; those left out are looked for, "" leaves one out.
        geometry: nominal wheel radius and track [m], for angles and rates of wheels.
        wheels: take measured wheel speeds in place of the commands.
        stamp: "receive" or "header", the times over which angles of wheels are differenced and their rates add up.
    """
    if path.suffix in PACKED:
        with TemporaryDirectory() as folder:
            unpacked = _unpacked(path, Path(folder))
            try:
                return replace(read_bag(unpacked, topics, geometry, wheels, stamp), path=path)
            except ValueError as error:
                raise ValueError(str(error).replace(str(unpacked), str(path))) from None
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    notes: list[str] = []
    try:
        store = get_typestore(Stores.ROS2_HUMBLE)
        store.register(get_types_from_msg(CHAIR_DEFINITION + JOYSTICK_FIELDS, f"whill_msgs/msg/{CHAIR_STATE}"))
        with _opened(AnyReader, path, store, notes) as reader:
            known = {name: about.msgtype or _types_of(about) for name, about in reader.topics.items() if about.msgcount}
            asked = topics or {}
            chosen = choose_topics(path, known, {**asked, **dict.fromkeys(framed(known, asked), "")}, notes, wheels)
            rows = _rows(reader, {topic: stream for stream, topic in chosen.items()}, notes)
            unposed = [] if {"odometry", "ground_truth"} & set(chosen) else [
                stream for stream in ("odometry", "ground_truth")
                if asked.get(stream) != "" and not (wheels and stream == "odometry")]
            streams = _of_frames(path, reader, known, asked, unposed, notes)
            if not {"odometry", "ground_truth"} & {*chosen, *streams}:
                raise no_pose(path, known, asked)
            notes += [] if "ground_truth" in {*chosen, *streams} else not_read(known, "odometry" in chosen)
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
                stream, found, geometry, notes, stamp)
        elif stream not in spare:
            raise ValueError(f"{path}: topic {topic} has {len(kept)} usable messages; at least 2 are needed. Name "
                             f"another topic with {OPTIONS[stream]}, or '' to go without.")
        elif len(kept):
            notes.append(f"{topic}: {len(kept)} usable messages; it is left out")
    return Bag(path, streams, notes)


def _types_of(topic: Any) -> str:
    """The types of a topic that has several, joined by "and"."""
    return " and ".join(sorted({short_type(one.msgtype) for one in topic.connections}))


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


def _rows(reader: Any, names: dict[str, str], notes: list[str]) -> dict[str, list[tuple[float, ...]]]:
    """Time of receipt and of the header [s] and columns of every message by stream; `names`: topic -> stream."""
    rows: dict[str, list[tuple[float, ...]]] = {stream: [] for stream in names.values()}
    frames: dict[str, list[str]] = {stream: [] for stream in rows}
    sideways = 0.0

    def take(topic: str, kind: str, received: float, message: Any) -> None:
        nonlocal sideways
        if (stream := names[topic]) == "command":
            sideways = max(sideways, sideways_speed(message))
        rows[stream].append((received, header_time(message), *read_message(stream, kind, message)))
        frames[stream].append(frames_of(message) if stream != "command" and kind != "JointState" else "")

    broken, said = _each_message(reader, names, take)
    if broken and not any(rows.values()):
        raise ValueError(said)
    if sideways > SIDEWAYS:
        notes.append(f"commands also ask for up to {sideways:.2g} m/s sideways (linear.y): forward speed and yaw rate "
                     "alone are read, and no model drives sideways. Leave such drives out")
    notes += broken
    for topic, stream in names.items():
        (usual, _), *others = Counter(frames[stream]).most_common() or [("", 0)]
        if others:  # a mixture of two poses is none
            said = " and ".join(f"{shown(frame)} ({count})" for frame, count in others)
            notes.append(f"{topic}: messages in the frames {said} are left out, since most are in {shown(usual)}: more "
                         "than one node may send there")
            rows[stream] = [row for row, one in zip(rows[stream], frames[stream], strict=True) if one == usual]
    return rows


def _each_message(
    reader: Any, topics: Container[str], take: Callable[[str, str, float, Any], None]
) -> tuple[list[str], str]:
    """Give topic, type, time of receipt [s] and content of each message to `take`; a note on each topic with damaged
    ones, which are left out, and what was wrong with the first."""
    broken, said = Counter[str](), ""
    for connection, received, raw in reader.messages(connections=[one for one in reader.connections
                                                                  if one.topic in topics]):
        try:
            message = reader.deserialize(raw, connection.msgtype)
            take(connection.topic, short_type(connection.msgtype), received * 1e-9, message)
        except Exception as error:  # the library lets out whatever a damaged message leads to
            broken[connection.topic] += 1
            said = said or str(error)
    return [f"{topic}: {count} damaged messages are left out" for topic, count in broken.items()], said


def _of_frames(
    path: Path, reader: Any, known: Mapping[str, str], asked: Mapping[str, str], wanted: list[str], notes: list[str]
) -> dict[str, BagStream]:
    """Streams out of transforms: those that were named, or the one that there is of those that are wanted."""
    named, trees = framed(known, asked), namespaces(known)
    if named:
        trees = [one for one in trees if any(topic in one for topic, _ in named.values())]
    if not trees or not named and not wanted:
        return {}
    links = {one: transforms.Links(one) for one in trees}

    def take(topic: str, kind: str, received: float, message: Any) -> None:
        for one in trees:
            if topic in one:
                links[one].add(received, message)

    topics = {topic for one in trees for topic in one}
    notes += _each_message(reader, topics, take)[0]
    try:
        found = transforms.chosen_poses(list(links.values()), named, wanted, notes)
    except transforms.NoChain as error:
        option = OPTIONS[next(iter(named), wanted[0] if wanted else "ground_truth")]
        topic = next((topic for topic, _ in named.values()), trees[0][0])
        said = (f"{', '.join(sorted(topics))}: {error}. Name the frames, {option} {topic}:PARENT:CHILD; or record the "
                "pose as Odometry or PoseStamped.")
        raise ValueError(f"{path}: {said}") if named else no_pose(path, known, asked, said) from None
    return {stream: BagStream(f"{one.topic}:{one.parent}:{one.child}", known[one.topic], one.received, one.stamped,
                              one.with_speeds() if stream == "odometry" else one.pose)
            for stream, one in found.items()}


def _usable(
    path: Path, stream: str, topic: str, kind: str, rows: list[tuple[float, ...]], notes: list[str]
) -> np.ndarray:
    """The rows of a stream as a table, without those that say nothing; notes count these."""
    if not rows:
        return np.zeros((0, 2))
    table = np.array(rows, float)
    unset = np.isinf(table[:, 2:]).any(axis=1)
    finite = usable_joints(table[:, 2:]) if kind == "JointState" else np.isfinite(table[:, 2:]).all(axis=1)
    far = np.abs(table[:, 0] - np.median(table[:, 0])) > DAY
    far &= far.mean() < STRAY
    blank = without_stamp(table[:, 1])
    if stream == "command" and blank.any():  # what was sent counts
        number, late, good = np.arange(len(table)), table[:, 0] - table[:, 1], ~blank & ~far
        table[blank, 1] = table[blank, 0] - np.interp(number[blank], number[good], late[good])
        notes.append(f"{topic}: {blank.sum()} messages with a header stamp of zero are stamped like those around them")
        blank[:] = False
    if unset.all():
        if kind == "JointState":
            raise ValueError(f"{path}: topic {topic}: no joint is called left or right. Name another topic with "
                             f"{OPTIONS[stream]}.")
        raise ValueError(f"{path}: topic {topic}: the orientation is all zero, which is no quaternion. Record a "
                         f"topic with an orientation, or leave this one out: {OPTIONS[stream]} ''.")
    odd = "without a wheel" if kind == "JointState" else "with an orientation that is all zero"
    notes += [f"{topic}: {which.sum()} messages {what} are left out" for which, what in (
        (unset, odd), (~finite & ~unset, "with numbers that are not finite"),
        (finite & far, "whose time is more than a day from the others'"),
        (finite & ~far & blank, "with a header stamp of zero, though the others have one,")) if which.any()]
    return table[finite & ~far & ~blank]


def _of_wheels(
    stream: str, found: BagStream, geometry: tuple[float, float], notes: list[str], stamp: str
) -> BagStream:
    """A stream of wheel angles and rates (T, 4) as motion, in order of time."""
    by_header = stamp == "header" and bool(np.isfinite(found.stamped).all()) and bool((found.stamped > 0).all())
    t = found.stamped if by_header else found.received
    order = np.argsort(t, kind="stable") if by_header else np.arange(len(t))
    order = order[np.append(True, np.diff(np.maximum.accumulate(t[order])) > 1e-6)]
    if len(order) < 2:  # all at one time, which is refused later with the reason
        return replace(found, values=np.zeros((len(t), len(COLUMNS[stream]))))
    t, rows = t[order], found.values[order]
    if (step := float(np.median(np.diff(t)))) > COARSE:
        notes.append(f"{found.topic}: a state each {step:.2g} s is coarse: delays and lags below that do not show. Ask "
                     "the driver for 20 ms (publish_interval_ms)")
    if short_type(found.kind) == CHAIR_STATE:
        values = chair_odometry(t, rows, *geometry)
        values = values if stream == "odometry" else values[:, 3:]
    else:
        values = joint_twist(t, rows, *geometry)
        if stream == "odometry":
            values = np.column_stack([*integrate_speeds(t, *values.T), values])
    return replace(found, received=found.received[order], stamped=found.stamped[order], values=values)


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

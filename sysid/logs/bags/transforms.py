"""The vehicle's pose out of transforms between frames (/tf, /tf_static), chained link by link.

A pose in `odom` is odometry. One in `map`, `world` or another fixed frame is an outside pose. Links may be used
against their direction, as where a lidar odometry publishes `odom` as a child of the base.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from sysid.logs.bags.messages import without_stamp
from sysid.logs.planar import DIFFERENCED, pose_speeds, yaw_of
from whill_mjx.io.fields import shown

KINDS = ("TFMessage", "tfMessage")
BASES = ("base_footprint", "base_link", "base", "base_frame", "chassis", "robot", "robot_base")
"""Names of the frame that moves with the vehicle, the first found is taken."""
FIXED = ("map", "world", "earth", "mocap", "vicon", "optitrack", "qualisys", "global", "utm")
"""Names of frames that stand still outside of the vehicle."""
STANDING = 1e-6  # m, and of a quaternion, that a link may change by and not count as moving
LISTED = 12  # links that an error names
HELD = (1.0, 5.0)  # s and usual intervals of a link: the longest time after its end for which it is held without a note


class NoChain(ValueError):
    """Frames without the chain that is needed."""


@dataclass
class Links:
    """The transforms of one namespace: (parent, child) -> rows of receipt, stamp [s], x, y, z [m], qx, qy, qz, qw."""

    topics: tuple[str, ...] = ("/tf", "/tf_static")  # that they come from; options name the first
    rows: dict[tuple[str, str], list[tuple[float, ...]]] = field(default_factory=dict)
    unset: int = 0  # transforms that are left out: their numbers are not finite, or their quaternion is zero

    def add(self, received: float, message: Any) -> None:
        """Take the transforms of a message."""
        for one in message.transforms:
            moved, turned = one.transform.translation, one.transform.rotation
            row = tuple(map(float, (moved.x, moved.y, moved.z, turned.x, turned.y, turned.z, turned.w)))
            if not np.isfinite(row).all() or sum(map(abs, row[3:])) < 1e-6:
                self.unset += 1
                continue
            key = str(one.header.frame_id).strip("/"), str(one.child_frame_id).strip("/")
            stamp = one.header.stamp.sec + one.header.stamp.nanosec * 1e-9
            self.rows.setdefault(key, []).append((received, stamp, *row))

    def frames(self) -> list[str]:
        return list(dict.fromkeys(frame for key in self.rows for frame in key))

    def __str__(self) -> str:
        """The links, as errors show them."""
        listed = list(map(_arrow, self.rows))
        return ", ".join(listed[:LISTED]) + (f" and {len(listed) - LISTED} more" if len(listed) > LISTED else "")


@dataclass(frozen=True)
class Chained:
    """Pose of one frame in another."""

    topic: str  # of its transforms
    parent: str
    child: str
    received: np.ndarray  # (T,) s
    stamped: np.ndarray  # (T,) s
    pose: np.ndarray  # (T, 3) x, y [m], yaw [rad]

    def with_speeds(self) -> np.ndarray:
        """(T, 5) the pose and its forward speed and yaw rate."""
        t = self.stamped if (self.stamped > 0).all() and (np.diff(self.stamped) > 0).all() else self.received
        order = np.argsort(t, kind="stable")
        rising = order[np.append(True, np.diff(t[order]) > 1e-6)]
        x, y, yaw = self.pose[rising].T
        speeds = pose_speeds(t[rising], x, y, np.unwrap(yaw))
        return np.column_stack([self.pose, *(np.interp(t, t[rising], one) for one in speeds)])


def base_frame(links: Links) -> str:
    """The frame that moves with the vehicle; NoChain where there is none, or several have its name."""
    for name in BASES:
        found = [frame for frame in links.frames() if _last(frame) == name]
        if len(found) > 1:
            raise NoChain(f"{', '.join(map(shown, found))} may be the vehicle's frame (frames: {links})")
        if found:
            return found[0]
    moving = [child for (_, child), rows in links.rows.items() if _moves(rows)]
    ends = [frame for frame in moving if not any(parent == frame for parent, _ in links.rows)]
    if len(ends) != 1:
        raise NoChain(f"no frame is called {', '.join(BASES[:3])} (frames: {links or 'none'})")
    return ends[0]


def odometry_frame(links: Links, base: str) -> str | None:
    """The frame in which the odometry counts; None where none is linked with the base."""
    able = [frame for frame in links.frames() if "odom" in _last(frame).lower() and chain(links, frame, base)]
    return next((frame for frame in able if _last(frame) == "odom"), able[0] if able else None)


def outside_frame(links: Links, base: str) -> str | None:
    """The fixed frame in which the base is known, besides the odometry's; None where there is none."""
    able = [frame for frame in links.frames() if frame != base and "odom" not in _last(frame).lower()
            and chain(links, frame, base)]
    for name in FIXED:
        if found := [frame for frame in able if _last(frame).lower() == name]:
            return found[0]
    children = {child for _, child in links.rows}
    roots = [frame for frame in able if frame not in children]
    return roots[0] if roots and any(_moves(links.rows[key]) for key, _ in chain(links, roots[0], base) or ()) else None


FRAME_OF = {"odometry": odometry_frame, "ground_truth": outside_frame}  # stream -> the frame in which its poses are
USUAL = {"odometry": "odom", "ground_truth": "map or world"}


def chain(links: Links, parent: str, child: str) -> list[tuple[tuple[str, str], bool]] | None:
    """The links from `parent` to `child`, the fewest, and whether each is used along its direction; None without."""
    came: dict[str, tuple[str, tuple[str, str], bool]] = {}
    waiting = deque([parent])
    while waiting and child not in came:
        here = waiting.popleft()
        for key in links.rows:
            if here in key and (there := key[1] if here == key[0] else key[0]) not in (parent, *came):
                came[there] = here, key, here == key[0]
                waiting.append(there)
    if child not in came:
        return None
    found = []
    while child != parent:
        child, key, along = came[child]
        found.append((key, along))
    return found[::-1]


def pose_of(links: Links, parent: str, child: str, notes: list[str]) -> Chained:
    """The pose of a frame in another, each time that the link which moves most often was sent.

    Other moving links are interpolated to these times, as tf2 does. Before one of them was first sent there is no pose.
    After its last row a link is held; a note says so where that is long. NoChain where there is no such pose.
    """
    found = chain(links, parent, child)
    if found is None:
        raise NoChain(f"no links lead from {shown(parent)} to {shown(child)} (frames: {links})")
    tables = {}
    for key, _ in found:  # by their stamps where these are set, else by receipt; single rows without one are left out
        table = np.array(links.rows[key])
        table = table[~without_stamp(table[:, 1])]
        tables[key] = table[np.argsort(table[:, 1 if (table[:, 1] > 0).all() else 0], kind="stable")]
    moving = [key for key, _ in found if len(tables[key]) > 1 and _moves(links.rows[key])]
    clock = tables[max(moving or tables, key=lambda key: len(tables[key]))]
    if len(clock) < 2:
        raise NoChain(f"{shown(child)} in {shown(parent)} was sent once: it never moves (frames: {links})")
    by_stamp = all((tables[key][:, 1] > 0).all() for key in moving)
    times = {key: table[:, 1 if by_stamp else 0] for key, table in tables.items()}
    t = clock[:, 1 if by_stamp else 0]
    kept = t >= max((times[key][0] for key in moving), default=t[0]) - 1e-6
    if kept.sum() < 2:
        begin = min(times[key][0] for key in moving)
        spans = ", ".join(f"{_arrow(key)} from {times[key][0] - begin:.1f} to {times[key][-1] - begin:.1f} s"
                          for key in moving)
        raise NoChain(f"the links from {shown(parent)} to {shown(child)} share no time: {spans}")
    for key in moving:
        held = float(t[-1] - times[key][-1])
        if held > max(HELD[0], HELD[1] * float(np.median(np.diff(times[key])))):
            notes.append(f"{links.topics[0]}: {_arrow(key)} was last sent {held:.1f} s before the end and is held from "
                         "there on. Cut the recording there if it should have moved")
    place, turn = np.zeros((kept.sum(), 3)), Rotation.identity(int(kept.sum()))
    for key, along in found:
        rows = slice(None) if key in moving else slice(1)
        moved, turned = _at(times[key][rows], tables[key][rows, 2:], t[kept])
        if not along:
            turned = turned.inv()
            moved = -turned.apply(moved)
        place, turn = place + turn.apply(moved), turn * turned
    x, y, z, w = turn.as_quat().T
    return Chained(links.topics[0], parent, child, clock[kept, 0], clock[kept, 1],
                   np.column_stack([place[:, :2], yaw_of(w, x, y, z)]))


def chosen_poses(
    trees: Sequence[Links], asked: Mapping[str, tuple[str, str]], wanted: Iterable[str], notes: list[str]
) -> dict[str, Chained]:
    """The poses that stand for streams; NoChain, which names the frames, where there is none.

    Args:
        trees: the links of each namespace; robots in namespaces may give the same names to their frames.
        asked: stream -> topic, and "" or "PARENT:CHILD", as the caller named them.
        wanted: further streams, of which the one that there is may be taken.
        notes: what was chosen is added.
    """
    if unset := sum(links.unset for links in trees):
        notes.append(f"{unset} transforms whose numbers are not finite, or with an orientation that is all zero, "
                     "are left out")
    found = {}
    for stream, (topic, frames) in asked.items():
        links = next(one for one in trees if topic in one.topics)
        parent, _, child = frames.partition(":")
        child = child.strip("/") or base_frame(links)
        named = parent.strip("/") or FRAME_OF[stream](links, child)
        if named is None:
            raise NoChain(f"no frame of the {'odometry' if stream == 'odometry' else 'room'} leads to {shown(child)} "
                          f"(frames: {links})")
        found[stream] = pose_of(links, named, child, notes)
    wanted = [stream for stream in wanted if stream not in found]
    if not found and wanted:
        found = _only_pose(trees, wanted, notes)
    for stream, one in found.items():
        more = f"; v and omega are its differences over {DIFFERENCED:g} s" if stream == "odometry" else ""
        notes.append(f"{stream} is {shown(one.child)} in {shown(one.parent)}, of the transforms of {one.topic}{more}")
    return found


def _only_pose(trees: Sequence[Links], wanted: Sequence[str], notes: list[str]) -> dict[str, Chained]:
    """The pose that nobody named: the odometry, else the outside pose, of the one namespace that has it."""
    for one, other in combinations(trees, 2):
        if both := [key for key in one.rows if _moves(one.rows[key]) and _moves(other.rows.get(key, ()))]:
            raise NoChain(f"{one.topics[0]} and {other.topics[0]} both have {_arrow(both[0])}: they may be two robots")
    offers: dict[str, list[tuple[Links, str, str]]] = {stream: [] for stream in FRAME_OF}
    refused = []
    for links in trees:
        try:
            base = base_frame(links)
        except NoChain as error:
            refused.append(error)
            continue
        able = [(stream, frame) for stream, find in FRAME_OF.items()
                if stream in wanted and (frame := find(links, base)) is not None]
        for stream, frame in able:
            offers[stream].append((links, frame, base))
        if not able:
            parents = ", ".join(USUAL[stream] for stream in FRAME_OF if stream in wanted)
            refused.insert(0, NoChain(f"no links lead from {parents} to {shown(base)} (frames: {links})"))
    if not any(offers.values()):
        raise refused[0]
    stream = next(one for one in offers if offers[one])
    if len(offers[stream]) > 1:
        named = " and ".join(links.topics[0] for links, _, _ in offers[stream])
        raise NoChain(f"{named} each have the pose of a vehicle")
    found = {stream: pose_of(*offers[stream][0], notes)}
    if stream == "odometry":
        for links, outside, base in offers["ground_truth"][:1]:
            notes.append(f"no outside pose is taken. {shown(base)} in {shown(outside)} may be one: --truth-topic "
                         f"{links.topics[0]}:{outside}:{base}, if it measures the vehicle from outside")
    return found


def _arrow(link: tuple[str, str]) -> str:
    return f"{shown(link[0])} to {shown(link[1])}"


def _last(frame: str) -> str:
    """The name of a frame without its namespace."""
    return frame.rpartition("/")[2]


def _moves(rows: Sequence[tuple[float, ...]]) -> bool:
    return bool(len(rows) > 1 and np.ptp(np.array(rows)[:, 2:], axis=0).max() > STANDING)


def _at(when: np.ndarray, moved: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, Rotation]:
    """Translation (T, 3) and turn of a link at times t (T,), between its rows; at its end it stays."""
    turns = moved[:, 3:] / np.linalg.norm(moved[:, 3:], axis=1, keepdims=True)
    flips = np.cumprod(np.append(1.0, np.where((turns[1:] * turns[:-1]).sum(1) < 0, -1.0, 1.0)))
    turns = turns * flips[:, None]  # of the two quaternions of a turn the one near the last
    columns = np.stack([np.interp(t, when, one) for one in (*moved[:, :3].T, *turns.T)], axis=1)
    return columns[:, :3], Rotation.from_quat(columns[:, 3:])

"""Streams out of the transforms between frames, where no topic has a pose or the caller names them."""

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sysid.logs.bags import transforms
from sysid.logs.bags.recording import OPTIONS, BagStream
from sysid.logs.bags.topics import framed, namespaces, no_pose


def unposed(chosen: Mapping[str, str], asked: Mapping[str, str], wheels: bool) -> list[str]:
    """The streams of which transforms may be one, where no topic has a pose."""
    if {"odometry", "ground_truth"} & set(chosen):
        return []
    return [stream for stream in ("odometry", "ground_truth")
            if asked.get(stream) != "" and not (wheels and stream == "odometry")]


def frame_streams(
    path: Path, reader: Any, known: Mapping[str, str], asked: Mapping[str, str], wanted: list[str], notes: list[str]
) -> dict[str, BagStream]:
    """Streams out of transforms: those that were named, or the one that there is of those that are wanted."""
    named, trees = framed(known, asked), namespaces(known)
    if named:
        trees = [one for one in trees if any(topic in one for topic, _ in named.values())]
    if not trees or not named and not wanted:
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

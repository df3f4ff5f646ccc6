"""Which topic is which stream: by name, by type, or as the caller says."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from sysid.logs.bags import transforms
from sysid.logs.bags.recording import CHAIR_STATE, OPTIONS, TOPICS, TRUTH, TYPES, from_outside, short_type

WHAT = {"command": "commands that reached the vehicle", "odometry": "vehicle's odometry"}
NOT_READ = {**dict.fromkeys(("AckermannDriveStamped", "AckermannDrive"), "which steers as cars do, and is not read"),
            "Path": "which is not read: record its poses as PoseStamped"}
"""Types that hold a motion, and why none is taken from them."""
WHEELS = ("JointState", CHAIR_STATE, "Odometry")
"""Types of the input where wheel speeds stand for commands, the first found is taken."""
STATIC = "_static"  # after the name of a topic of transforms: those of it that never change


def framed(known: Mapping[str, str], asked: Mapping[str, str]) -> dict[str, tuple[str, str]]:
    """Stream -> topic, and "" or "PARENT:CHILD", where transforms were named, as /tf or /tf:PARENT:CHILD."""
    split = {stream: asked[stream].partition(":") for stream in ("odometry", "ground_truth") if stream in asked}
    return {stream: (topic, frames) for stream, (topic, _, frames) in split.items()
            if short_type(known.get(topic, "")) in transforms.KINDS}


def namespaces(known: Mapping[str, str]) -> list[tuple[str, ...]]:
    """The topics of transforms that belong together: those that move, then the static ones beside them, if any."""
    topics = sorted((topic for topic, kind in known.items() if short_type(kind) in transforms.KINDS),
                    key=lambda topic: (len(topic), topic))  # /tf first
    moving = [topic for topic in topics if not topic.endswith(STATIC)]
    found = [(topic, *[one for one in (topic + STATIC, f"/tf{STATIC}") if one in topics][:1]) for topic in moving]
    return found + [(topic,) for topic in topics if not any(topic in one for one in found)]


def no_pose(path: Path, known: Mapping[str, str], asked: Mapping[str, str], frames: str = "") -> ValueError:
    """The error where nothing measures the motion; `frames`: why the transforms give no pose."""
    poses = [] if asked.get("ground_truth") == "" else [
        name for name in sorted(known, key=lambda one: (not from_outside(one), one))
        if short_type(known[name]) in TYPES["ground_truth"]]
    more = [*not_read(known), *([f"{', '.join(poses)} may be the outside pose: {OPTIONS['ground_truth']} {poses[0]}"]
                                 if poses else [])]
    return ValueError(f"{path}: neither odometry nor outside pose found (topics with messages: {listed(known)})."
                      f"{''.join(f' {one}.' for one in more)} Name one with --odometry-topic or --truth-topic."
                      f"{' ' + frames if frames else ''}")


def listed(known: Mapping[str, str]) -> str:
    return ", ".join(f"{name} ({short_type(kind)})" for name, kind in sorted(known.items())) or "none"


def not_read(known: Mapping[str, str], frames: bool = False) -> list[str]:
    """Notes on topics that hold a motion which is not read; `frames`: neither are transforms, though they might be."""
    kinds = {short_type(kind): topic for topic, kind in known.items()}
    held = [topics[0] for topics in namespaces(known) if frames]
    return [*(f"{kinds[kind]} is {kind}, {why}" for kind, why in NOT_READ.items() if kind in kinds),
            *(f"{topic} holds frames, which are not looked at: --truth-topic {topic} takes the pose in map or world "
              "from them, if it measures the vehicle from outside" for topic in held[:1])]


def choose_topics(
    path: Path, known: dict[str, str], asked: dict[str, str], notes: list[str], wheels: bool = False
) -> dict[str, str]:
    """Topic of each stream, from what the bag has, what was asked for, and the names that are usual; `wheels`: the
    input is measured wheel speeds."""
    chosen: dict[str, str] = {}
    types = {**TYPES, "command": WHEELS} if wheels else TYPES
    truths = _truths(known, asked)
    for stream in TOPICS:
        if wheels and stream == "command" and stream not in asked:
            chosen[stream] = _wheel_topic(path, known)
            continue
        if wheels and stream == "odometry":
            continue
        if stream in asked:
            if topic := asked[stream]:
                _check_asked(path, known, stream, topic, types[stream])
                chosen[stream] = topic
            continue
        mixed = next((name for name in TOPICS[stream] if " and " in known.get(name, "") and stream in WHAT), "")
        if mixed:
            raise ValueError(f"{path}: topic {mixed} has messages of {known[mixed]}, and a vehicle takes one. Copy "
                             f"one of them to a bag of its own, or name another topic with {OPTIONS[stream]}.")
        usual = [name for name in TOPICS[stream] if short_type(known.get(name, "")) in TYPES[stream]]
        fitting = [name for name, kind in known.items() if short_type(kind) in TYPES[stream]
                   and name not in (*chosen.values(), *asked.values())]
        inside = [name for name in fitting if not from_outside(name)]
        if stream != "ground_truth":  # a namespace such as /gt is of all topics; no odometry is measured from outside
            fitting = inside if stream == "odometry" else inside or fitting
        fitting = [name for name in fitting if short_type(known[name]) != "JointState"] or fitting
        if usual:
            chosen[stream] = usual[0]
        elif stream == "ground_truth" and len(truths) == 1 and (TRUTH.search(truths[0]) or "odometry" not in chosen):
            chosen[stream] = truths[0]
            notes.append(f"{stream} is taken from {truths[0]}, as its name says that it is measured from outside. If "
                         f"it is not, leave it out: {OPTIONS[stream]} ''")
        elif stream != "ground_truth" and len(fitting) == 1:
            chosen[stream] = fitting[0]
            notes.append(f"{stream} is taken from {fitting[0]}, the only topic of a fitting type")
        elif stream == "ground_truth" and (others := truths or [name for name in fitting if "odom" not in name]):
            notes.append(f"no outside pose is taken. {', '.join(others)} may be one: {OPTIONS[stream]} {others[0]}, if "
                         "it measures the vehicle from outside")
        elif stream in ("command", "odometry") and len(fitting) > 1:
            said = (f"any of {', '.join(sorted(fitting))} may be the {WHAT[stream]}. Name one: {OPTIONS[stream]} "
                    f"{sorted(fitting)[0]}")
            if stream == "command" or len(truths) != 1 and not asked.get("ground_truth"):
                raise ValueError(f"{path}: {said}")
            notes.append(f"no odometry is taken: {said}")
    if "command" not in chosen and "command" not in asked:
        more = "".join(f" {one}." for one in not_read(known))
        raise ValueError(f"{path}: no command topic found (topics with messages: {listed(known)}).{more} Name the "
                         "Twist or TwistStamped that was sent to the vehicle with --command-topic; or take the "
                         "measured wheel speeds in its place, with an outside pose: --input wheels.")
    if "command" not in chosen:
        raise ValueError(f"{path}: --command-topic is empty; a trial needs its commands. Name their topic.")
    return chosen


def _check_asked(path: Path, known: Mapping[str, str], stream: str, topic: str, types: Sequence[str]) -> None:
    """Refuse a topic that was named for a stream where the bag lacks it, or its type cannot be the stream."""
    if topic not in known:
        raise ValueError(f"{path}: no topic {topic!r} (topics with messages: {listed(known)}). Correct "
                         f"{OPTIONS[stream]}.")
    if short_type(known[topic]) not in types:
        raise ValueError(f"{path}: topic {topic} is {known[topic]}; {stream} must be one of {', '.join(types)}. Name "
                         f"another topic with {OPTIONS[stream]}.")


def _truths(known: Mapping[str, str], asked: Mapping[str, str]) -> list[str]:
    """The topics that are an outside pose of the vehicle by their names; the usual one alone, where there is one.

    Of what trackers publish only an Odometry is one: their poses are of any body.
    """
    if asked.get("ground_truth") == "":
        return []
    found = [name for name, kind in sorted(known.items()) if short_type(kind) in TYPES["ground_truth"]
             and from_outside(name) and (TRUTH.search(name) or short_type(kind) == "Odometry")
             and name not in asked.values()]
    return [name for name in TOPICS["ground_truth"] if name in found][:1] or found


def _wheel_topic(path: Path, known: dict[str, str]) -> str:
    """The topic whose wheel speeds are the input."""
    for kind in WHEELS:
        fitting = [name for name, one in known.items() if short_type(one) == kind and not from_outside(name)]
        usual = [name for name in TOPICS["odometry"] if name in fitting]
        if len(fitting) == 1 or usual:
            return (usual or fitting)[0]
    raise ValueError(f"{path}: no topic with wheel speeds found (topics with messages: {listed(known)}). Name a "
                     "JointState or an Odometry with --command-topic.")

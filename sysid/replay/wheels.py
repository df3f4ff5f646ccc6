"""Which wheels of a robot file drive it: two, or two or three on each side of a skid-steered robot."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from sysid.replay.stated_drive import ROLLERS, StatedDrive

CASTER = re.compile(r"cast[eo]r|swivel", re.I)
PASSIVE = re.compile(r"cast[eo]r|swivel|ball|idler|passive|steer|omni|roller|fork|track", re.I)
"""Words in the names of what rolls along, or turns another wheel about the vertical."""
STEERING = re.compile(r"steer", re.I)
LEFT = {"left", "l", "fl", "rl", "bl", "ml", "lf", "lr", "lb", "lm", "lh", "lw", "wl"}
RIGHT = {"right", "r", "fr", "rr", "br", "mr", "rf", "rb", "rm", "rh", "rw", "wr"}
WHEEL = re.compile(r"wheel|tyre|tire|whl", re.I)
LEVEL = 0.5  # of an axis along the vertical, or less than which it does not lie across
UPRIGHT = 0.9  # of an axis along the vertical, from which it steers
SWIVELS = np.radians(300.0)  # range of a hinge from which a caster turns on it
MANY_TURNS = 200 * np.pi  # rad of a range that is no end


def wheel_joints(path: Path, spec: Any, wheels: Sequence[str], stated: StatedDrive) -> tuple[str, ...]:
    """Names of the joints of the driven wheels: those on the left from front to rear, then those on the right.

    `wheels`: joints or actuators that were named; `stated`: what the file says of its drive. Two that neither names nor
    places show a side of are left and right as they were named.
    ValueError where neither the file nor names show them, or they do not stand in pairs.
    """
    hinges = {joint.name: joint for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_HINGE and joint.name}
    driven = {actuator.name: actuator.target for actuator in spec.actuators}
    if wheels:
        found = [driven.get(name, name) for name in wheels]
        if len(set(found)) % 2 or len(found) != len(set(found)) or not set(found) <= set(hinges):
            raise ValueError(f"{path}: wheels are {' and '.join(wheels)}; they must be two hinge joints or "
                             f"their actuators, left and right, or four, six or more of a skid-steered robot "
                             f"(joints: {', '.join(hinges)}; actuators: {', '.join(driven)}).")
        return _paired(path, spec, wheels, found)
    standing = _standing(spec, hinges)
    if standing is not None:
        sides_of_plugin = _plugin_wheels(path, standing, stated)
        _refuse_steering(path, hinges, standing, "" if sides_of_plugin else stated.steering)
        if (found_sides := sides_of_plugin or _stated_wheels(standing, stated)) is not None:
            return _with_followers(spec, standing, found_sides)
    pulled = [name for name in hinges if name in driven.values()]
    for among in (pulled, list(hinges)):
        sides = [[name for name in among if side in name.lower() and _may_roll(hinges[name])]
                 for side in ("left", "right")]
        if all(len(side) == 1 for side in sides):
            return sides[0][0], sides[1][0]
    rolling = [name for name, joint in hinges.items() if _rolls(joint)]
    active = [name for name in hinges if not PASSIVE.search(f"{name} {hinges[name].parent.name}")]
    wheels_alone = [name for name in rolling if name in active]
    level = [name for name in active if standing and name in standing and standing[name].is_wheel]
    for names in ([name for name in pulled if name in rolling], wheels_alone, level, rolling):
        if names and standing is not None and (in_order := _by_side(standing, names)) is not None:
            return in_order
    axles = [name for name in hinges if standing and standing[name].is_wheel]
    if standing and len(axles) > 2 and len({standing[name].direction for name in axles}) > 1:
        raise ValueError(f"{path}: the axles of its wheels ({', '.join(axles)}) point in different "
                         "directions: it is no differential or skid-steered robot. Fit a function of your own "
                         "(docs/models.md), or name the wheels that drive with --wheels.")
    if not hinges:
        raise ValueError(f"{path}: no joint turns, so it has no wheels. The joints of wheels are of type continuous in "
                         "a URDF, hinge in MJCF. Tracks that slide along a robot are not read.")
    if standing is None:
        spec.copy().compile()  # MuJoCo says where the mistake is
    if not any(map(_may_roll, hinges.values())):
        raise ValueError(f"{path}: all joints end within a turn ({', '.join(hinges)}), as on a robot with legs or an "
                         "arm: it has no wheels. Joints of wheels are of type continuous in a URDF, without a range in "
                         "MJCF.")
    raise ValueError(f"{path}: the names do not show which wheels are driven (joints: {', '.join(hinges)}). Name "
                     "them: wheels=(left, right), on the command line --wheels LEFT RIGHT, or all four, six or more.")


def as_plain_wheels(path: Path, spec: Any, joints: Sequence[str], stated: StatedDrive) -> list[str]:
    """Let driven wheels turn without an end; notes on ends that are left out, on wheels that are no plain ones, and on
    what the file says of its drive that is of no use."""
    notes, odd = _unused(path, spec, joints, stated), []
    for joint in [one for one in spec.joints if one.name in joints]:
        if _has_end(joint):
            low, high = joint.range
            notes.append(f"{path.name}: wheel joint {joint.name} ends at {low:.3g} and {high:.3g} rad: a wheel turns "
                         "on, so its ends are left out")
            joint.limited, joint.range = mujoco.mjtLimited.mjLIMITED_FALSE, [0.0, 0.0]
        body = joint.parent
        rollers = [one for one in body.find_all("joint") if one.name != joint.name
                   and one.type == mujoco.mjtJoint.mjJNT_HINGE]
        named = (joint.name, body.name, *(str(geom.meshname) for geom in body.geoms))
        if (stated.sideways or body.name in stated.rollers or len(rollers) > 2
                or any(ROLLERS.search(one) for one in named)):
            odd.append(joint.name)
    if odd:
        plugin = f" ({stated.sideways})" if stated.sideways else ""
        notes.append(f"{path.name}: {', '.join(odd)}{plugin}: mecanum or omni wheels are taken for plain ones. The "
                     "model does not drive sideways, and turns as a skid-steered robot; fit drives without sideways "
                     "commands")
    return notes


def _unused(path: Path, spec: Any, joints: Sequence[str], stated: StatedDrive) -> list[str]:
    """Notes on joints that the file says are driven, where others were taken."""
    notes, taken = [], f"the driven wheels are taken to be {', '.join(joints)}"
    if len(stated.left) != len(stated.right):
        sides = " and ".join(f"{', '.join(side) or 'no joint'} on the {name}"
                             for name, side in (("left", stated.left), ("right", stated.right)))
        notes.append(f"{path.name}: a plugin drives {sides}, which are no pairs: {taken}")
    absent = [name for name in stated.by_speed if name not in {joint.name for joint in spec.joints}]
    if absent and not set(stated.by_speed) & set(joints):
        notes.append(f"{path.name}: a controller drives {', '.join(absent)}, which the file lacks: {taken}")
    return notes


@dataclass(frozen=True)
class _Stand:
    """Where a hinge stands in the chassis's frame."""

    place: np.ndarray  # (3,) m
    axis: np.ndarray  # (3,)
    is_wheel: bool  # whether it turns without an end about a level axis across the chassis, and hangs on no other hinge

    @property
    def direction(self) -> int:
        """Of a level axle, either way [10 degrees]."""
        return round(float(np.degrees(np.arctan2(self.axis[1], self.axis[0]))) / 10) % 18


def _standing(spec: Any, hinges: Mapping[str, Any]) -> dict[str, _Stand] | None:
    """Where hinges stand by name; None for a model that does not compile."""
    try:
        model = spec.copy().compile()
    except (ValueError, mujoco.FatalError):
        return None
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    found = {}
    for name, joint in hinges.items():
        number = model.joint(name).id
        body = int(model.jnt_bodyid[number])
        root = int(model.body_rootid[body])
        root = 0 if root == body else root  # the chassis of a URDF is part of the world until it gets a free joint
        turn = data.xmat[root].reshape(3, 3)
        axis, above = data.xaxis[number] @ turn, int(model.body_parentid[body])
        hangs = int(model.body_weldid[above]) not in (0, int(model.body_weldid[root]))
        found[name] = _Stand((data.xanchor[number] - data.xpos[root]) @ turn, axis,
                             not _has_end(joint) and not hangs and abs(float(axis[2])) < LEVEL)
    return found


def _plugin_wheels(path: Path, standing: Mapping[str, _Stand], stated: StatedDrive) -> tuple[str, ...] | None:
    """Joints that a plugin drives, in order; None where it names none, or not as many on each side."""
    remedy = "Correct the plugin, or name the wheels that drive with --wheels."
    for name in (*stated.left, *stated.right):
        if name not in standing:
            raise ValueError(f"{path}: a plugin drives joint {name}, which is no joint of the file that turns "
                             f"({', '.join(standing)}). {remedy}")
        if name in stated.left and name in stated.right:
            raise ValueError(f"{path}: a plugin drives joint {name} on both sides. {remedy}")
    if not stated.left or len(stated.left) != len(stated.right):
        return None
    return tuple(name for side in (stated.left, stated.right)
                 for name in sorted(side, key=lambda one: -standing[one].place[0]))


def _stated_wheels(standing: Mapping[str, _Stand], stated: StatedDrive) -> tuple[str, ...] | None:
    """Joints that controllers drive by their speed, in order; None where these are no wheels in pairs."""
    names = [name for name in stated.by_speed if name in standing and standing[name].is_wheel]
    return _by_side(standing, names) if names else None


def _with_followers(spec: Any, standing: Mapping[str, _Stand], joints: tuple[str, ...]) -> tuple[str, ...]:
    """Driven joints and those of wheels that mimic them, in order; without these where they are not in pairs."""
    half, sides = len(joints) // 2, list[list[str]]()
    for side in (joints[:half], joints[half:]):
        names, before = set(side), set[str]()
        while names != before:  # one may mimic another that mimics the driven one
            before = set(names)
            names |= {one.name1 for one in spec.equalities
                      if one.type == mujoco.mjtEq.mjEQ_JOINT and one.name2 in before
                      and one.name1 in standing and standing[one.name1].is_wheel}
        sides.append(sorted(names, key=lambda one: (-standing[one].place[0], one)))
    if set(sides[0]) & set(sides[1]):
        return joints
    return (*sides[0], *sides[1]) if len(sides[0]) == len(sides[1]) else joints


def _refuse_steering(
    path: Path, hinges: Mapping[str, Any], standing: Mapping[str, _Stand], plugin: str
) -> None:  # fmt: skip
    """Refuse wheels that are steered: what turns them is not in the file, and held straight they would skid."""
    remedy = ("robots that steer as cars and tricycles do are not read. Fit a function of your own (docs/models.md), "
              "or name the wheels that drive with --wheels to hold the steering straight.")
    upright = {name: joint for name, joint in hinges.items() if abs(float(standing[name].axis[2])) > UPRIGHT}
    steered = {joint.parent.name: name for name, joint in upright.items()
               if _has_end(joint) and np.ptp(joint.range) < SWIVELS
               or STEERING.search(name) and not CASTER.search(f"{name} {joint.parent.name}")}
    for name, joint in hinges.items():
        above = joint.parent.parent
        while _rolls(joint) and above.name != "world":
            if above.name in steered:
                raise ValueError(f"{path}: wheel {name} is steered by joint {steered[above.name]}; {remedy}")
            above = above.parent
    if plugin:
        raise ValueError(f"{path}: its plugin {plugin} steers its wheels; {remedy}")


def _has_end(joint: Any) -> bool:
    """Whether a hinge turns less than a hundred turns."""
    return bool(0 < np.ptp(joint.range) < MANY_TURNS) and joint.limited != mujoco.mjtLimited.mjLIMITED_FALSE


def _may_roll(joint: Any) -> bool:
    """Whether a hinge has no end, or is of a wheel by its name: fingers have sides too."""
    return not _has_end(joint) or WHEEL.search(f"{joint.name} {joint.parent.name}") is not None


def _rolls(joint: Any) -> bool:
    """Whether a hinge has no end and is of a wheel by its name, or that of its body."""
    return not _has_end(joint) and WHEEL.search(f"{joint.name} {joint.parent.name}") is not None


def swapped(path: Path, spec: Any, wheels: Sequence[str], joints: Sequence[str]) -> list[str]:
    """A note where the wheels of the right side were named first."""
    targets = {actuator.name: actuator.target for actuator in spec.actuators}
    half = len(joints) // 2
    named = [targets.get(name, name) for name in wheels]
    if not named or set(named[:half]) != set(joints[half:]):
        return []
    first, left = (" and ".join(one[:half]) for one in (wheels, joints))
    return [f"{path.name}: --wheels names {first} first, but {left} {'is' if half == 1 else 'are'} on the left, with x "
            "ahead, and taken so. Where the robot's front is -x, turn its first body by 180 degrees in the file"]


def leftwards(path: Path, joints: Sequence[str], tyres: np.ndarray) -> tuple[np.ndarray, float]:
    """Vector (3,) of length 1 from the right wheels to the left ones, and the distance between them [m].

    `joints`: those on the left, then those on the right; `tyres`: (W, 3) where they stand. ValueError where a wheel of
    the left stands to the right of one of the right: names, or a plugin, say what places deny.
    """
    half = len(joints) // 2
    left = tyres[:half].mean(0) - tyres[half:].mean(0)
    distance = float(np.linalg.norm(left))
    left = left / max(distance, 1e-12)
    along = tyres @ left
    worst, other = int(along[:half].argmin()), half + int(along[half:].argmax())
    if half > 1 and not along[worst] > along[other]:
        raise ValueError(f"{path}: {joints[worst]} is taken for a wheel of the left and {joints[other]} for one of the "
                         "right, but they stand the other way round. Correct their names, or those in the plugin.")
    return left, distance


def turned_round(path: Path, joints: Sequence[str], ahead: float) -> list[str]:
    """A note where the left wheels stand on the right with x ahead, `ahead` being the cosine between x and the
    front."""
    if ahead > -LEVEL:
        return []
    left = ", ".join(joints[: len(joints) // 2])
    return [f"{path.name}: {left} on the left: so the robot's front is taken to be -x. If it is +x, names or plugin "
            "exchange the sides; name the wheels with --wheels, those at y > 0 first"]


def _paired(path: Path, spec: Any, wheels: Sequence[str], names: Sequence[str]) -> tuple[str, ...]:
    """Joints of named wheels by their sides: as they were named, where places or names agree with that."""
    standing, half = _standing(spec, {name: spec.joint(name) for name in names}), len(names) // 2
    placed = None if standing is None else _by_side(standing, names, [0] * len(names))
    if placed is not None and set(placed[:half]) == set(names[:half]):
        return placed
    if len(names) == 2:
        as_named = _sides(wheels) != [-1, 1] if placed is None else _sides(wheels) == [1, -1]
        return (names[0], names[1]) if as_named else (names[1], names[0])
    found = None if standing is None else _by_side(standing, names)
    if found is None:
        raise ValueError(f"{path}: wheels {', '.join(names)} do not stand in pairs, one left and one right. Name the "
                         "driven wheels of both sides.")
    return found


def _by_side(
    standing: Mapping[str, _Stand], names: Sequence[str], sides: Sequence[int] | None = None
) -> tuple[str, ...] | None:  # fmt: skip
    """Left ones, then right ones, both from front to rear; None where they do not stand in pairs with level axles.

    `sides`: 1 for one known to be on the left, -1 on the right, 0 where its place says; by default as their names do.
    """
    ours = [standing[name] for name in names]
    place = np.array([one.place for one in ours])
    across = [abs(float(one.axis[1])) > LEVEL for one in ours]
    stated = _sides(names) if sides is None else list(sides)
    if any(abs(float(one.axis[2])) > LEVEL for one in ours) or not (all(stated) or all(across)):
        return None
    sides = [one or (1 if y > place[:, 1].mean() else -1) for one, y in zip(stated, place[:, 1], strict=True)]
    if len(names) == 2 and not all(stated) and abs(place[0, 1] - place[1, 1]) < np.abs(place[0] - place[1]).max():
        return None  # one behind the other
    order = sorted(range(len(names)), key=lambda i: (-sides[i], -place[i, 0]))
    return tuple(names[i] for i in order) if sum(sides) == 0 else None


def _sides(names: Sequence[str]) -> list[int]:
    """1 for a name of the left, -1 of the right, 0 of neither; what all names share, as a robot's own, says nothing."""
    words = [{word for word in re.split(r"[^a-z0-9]+", name.lower()) if word} for name in names]
    shared = set.intersection(*words) if len(words) > 1 else set()
    found = []
    for name, mine in zip(names, words, strict=True):
        parts = {part for word in mine - shared for part in re.split(r"[^a-z]+", word) if part}
        parts |= {side for side in ("left", "right") if side in name.lower()}
        found.append(bool(parts & LEFT) - bool(parts & RIGHT))
    return found

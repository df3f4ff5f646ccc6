"""Which wheels of a robot file drive it: two, or two or three on each side of a skid-steered robot."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

PASSIVE = re.compile(r"cast[eo]r|swivel|ball|idler|passive|steer|omni|roller|fork|track", re.I)
"""Words in the names of what rolls along, or turns another wheel about the vertical."""
LEFT = {"left", "l", "fl", "rl", "bl", "ml", "lf", "lr", "lb", "lm", "lh"}
RIGHT = {"right", "r", "fr", "rr", "br", "mr", "rf", "rb", "rm", "rh"}
WHEEL = re.compile(r"wheel|tyre|tire|whl", re.I)
SIDEWAYS = re.compile(r"mec[ac]num|omni|swedish", re.I)
"""Words in the names of wheels, their joints and meshes that let a robot drive sideways."""
MOST = 3  # wheels on each side
LEVEL = 0.5  # of an axis along the vertical, or less than which it does not lie across
UPRIGHT = 0.9  # of an axis along the vertical, from which it steers
SWIVELS = np.radians(300.0)  # range of a hinge from which a caster turns on it
MANY_TURNS = 200 * np.pi  # rad of a range that is no end


def wheel_joints(path: Path, spec: Any, wheels: Sequence[str]) -> tuple[str, ...]:
    """Names of the joints of the driven wheels: those on the left from front to rear, then those on the right.

    Args:
        path: of the file, for errors.
        spec: mujoco.MjSpec.
        wheels: joints or actuators that were named; of two the first is the left one.

    Raises:
        ValueError: their names do not show them, or they do not stand in pairs.
    """
    hinges = {joint.name: joint for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_HINGE and joint.name}
    driven = {actuator.name: actuator.target for actuator in spec.actuators}
    if wheels:
        found = [driven.get(name, name) for name in wheels]
        if len(set(found)) not in (2, 4, 6) or len(found) != len(set(found)) or not set(found) <= set(hinges):
            raise ValueError(f"{path}: wheels are {' and '.join(wheels)}; they must be two hinge joints or "
                             f"their actuators, left and right, or four or six of a skid-steered robot "
                             f"(joints: {', '.join(hinges)}; actuators: {', '.join(driven)}).")
        return (found[0], found[1]) if len(found) == 2 else _paired(path, spec, found)
    standing = _standing(spec, hinges)
    if standing is not None:
        _refuse_steering(path, spec, hinges, standing)
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
    for names in ([name for name in pulled if name in rolling], wheels_alone, rolling, level):
        if len(names) in (2, 4, 6) and standing is not None and (in_order := _by_side(standing, names)) is not None:
            return in_order
    axles = [name for name in hinges if standing and standing[name].is_wheel]
    if standing and len(axles) > 2 and len({standing[name].direction for name in axles}) > 1:
        raise ValueError(f"{path}: the axles of its wheels ({', '.join(axles)}) point in different "
                         "directions: it is no differential or skid-steered robot. Fit a function of your own "
                         "(docs/models.md), or name the wheels that drive with --wheels.")
    if not hinges:
        raise ValueError(f"{path}: no joint turns, so it has no wheels. The joints of wheels are of type continuous in "
                         "a URDF, hinge in MJCF.")
    raise ValueError(f"{path}: the names do not show which wheels are driven (joints: {', '.join(hinges)}). Name "
                     "them: wheels=(left, right), on the command line --wheels LEFT RIGHT, or all four or six.")


def as_plain_wheels(path: Path, spec: Any, joints: Sequence[str]) -> list[str]:
    """Let driven wheels turn without an end; notes on ends that are left out, and on wheels that are no plain ones."""
    notes, odd = [], []
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
        if len(rollers) > 2 or any(SIDEWAYS.search(one) for one in named):
            odd.append(joint.name)
    if odd:
        notes.append(f"{path.name}: {', '.join(odd)}: mecanum or omni wheels are taken for plain ones. The model does "
                     "not drive sideways, and turns as a skid-steered robot; fit drives without sideways commands")
    return notes


@dataclass(frozen=True)
class _Stand:
    """Where a hinge stands in the chassis's frame."""

    place: np.ndarray  # (3,) m
    axis: np.ndarray  # (3,)
    is_wheel: bool
    """Whether it turns without an end about a level axis across the chassis, and hangs on no other hinge."""

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


def _refuse_steering(path: Path, spec: Any, hinges: Mapping[str, Any], standing: Mapping[str, _Stand]) -> None:
    """Refuse wheels that are steered: what turns them is not in the file, and held straight they would skid."""
    steered = {joint.parent.name: name for name, joint in hinges.items()
               if _has_end(joint) and np.ptp(joint.range) < SWIVELS and abs(float(standing[name].axis[2])) > UPRIGHT}
    for name, joint in hinges.items():
        above = joint.parent.parent
        while _rolls(joint) and above.name != "world":
            if above.name in steered:
                raise ValueError(f"{path}: wheel {name} is steered by joint {steered[above.name]}; robots that steer "
                                 "as cars do are not read. Fit a function of your own (docs/models.md), or name the "
                                 "wheels that drive with --wheels to hold the steering straight.")
            above = above.parent


def _has_end(joint: Any) -> bool:
    """Whether a hinge turns less than a hundred turns."""
    return bool(0 < np.ptp(joint.range) < MANY_TURNS) and joint.limited != mujoco.mjtLimited.mjLIMITED_FALSE


def _may_roll(joint: Any) -> bool:
    """Whether a hinge has no end, or is of a wheel by its name: fingers have sides too."""
    return not _has_end(joint) or WHEEL.search(f"{joint.name} {joint.parent.name}") is not None


def _rolls(joint: Any) -> bool:
    """Whether a hinge has no end and is of a wheel by its name, or that of its body."""
    return not _has_end(joint) and WHEEL.search(f"{joint.name} {joint.parent.name}") is not None


def _paired(path: Path, spec: Any, names: Sequence[str]) -> tuple[str, ...]:
    standing = _standing(spec, {name: spec.joint(name) for name in names})
    found = None if standing is None else _by_side(standing, names)
    if found is None:
        raise ValueError(f"{path}: wheels {', '.join(names)} do not stand in pairs, one left and one right. Name the "
                         "driven wheels of both sides.")
    return found


def _by_side(standing: Mapping[str, _Stand], names: Sequence[str]) -> tuple[str, ...] | None:
    """Left ones, then right ones, both from front to rear; None where they do not stand in pairs with level axles."""
    ours = [standing[name] for name in names]
    place = np.array([one.place for one in ours])
    across = [abs(float(one.axis[1])) > LEVEL for one in ours]
    named = all(map(_side, names))
    if any(abs(float(one.axis[2])) > LEVEL for one in ours) or not (named or all(across)):
        return None
    sides = [_side(name) or (1 if y > place[:, 1].mean() else -1) for name, y in zip(names, place[:, 1], strict=True)]
    if len(names) == 2 and not named and abs(place[0, 1] - place[1, 1]) < np.abs(place[0] - place[1]).max():
        return None  # one behind the other
    order = sorted(range(len(names)), key=lambda i: (-sides[i], -place[i, 0]))
    return tuple(names[i] for i in order) if sum(sides) == 0 and len(names) // 2 <= MOST else None


def _side(name: str) -> int:
    """1 for a name of the left, -1 of the right, 0 of neither."""
    words = {word for word in re.split(r"[^a-z]+", name.lower()) if word}
    words |= {side for side in ("left", "right") if side in name.lower()}
    return bool(words & LEFT) - bool(words & RIGHT)

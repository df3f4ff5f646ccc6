"""Which wheels of a robot file drive it: two, or two or three on each side of a skid-steered robot."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

PASSIVE = re.compile(r"cast[eo]r|swivel|ball|idler|passive|steer|omni|roller|fork|track", re.I)
"""Words in the names of what rolls along, or turns another wheel about the vertical."""
LEFT = {"left", "l", "fl", "rl", "bl", "ml", "lf", "lr", "lb", "lm", "lh"}
RIGHT = {"right", "r", "fr", "rr", "br", "mr", "rf", "rb", "rm", "rh"}
MOST = 3  # wheels on each side


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
    pulled = [name for name in hinges if name in driven.values()]
    for among in (pulled, list(hinges)):
        sides = [[name for name in among if side in name.lower()] for side in ("left", "right")]
        if all(len(side) == 1 for side in sides):
            return sides[0][0], sides[1][0]
    rolling = [name for name, joint in hinges.items() if _rolls(joint)]
    wheels_alone = [name for name in rolling if not PASSIVE.search(f"{name} {hinges[name].parent.name}")]
    for names in ([name for name in pulled if name in rolling], wheels_alone, rolling):
        sided = all(map(_side, names)) if len(names) == 2 else len(names) in (4, 6)
        if sided and (in_order := _by_side(spec, names)) is not None:
            return in_order
    raise ValueError(f"{path}: the names do not show which wheels are driven (joints: {', '.join(hinges)}). Name "
                     "them: wheels=(left, right), on the command line --wheels LEFT RIGHT, or all four or six.")


def _rolls(joint: Any) -> bool:
    """Whether a hinge has no end and is of a wheel by its name, or that of its body."""
    limited = joint.limited == mujoco.mjtLimited.mjLIMITED_TRUE or bool(np.ptp(joint.range))
    return not limited and re.search(r"wheel|tyre|tire|whl", f"{joint.name} {joint.parent.name}", re.I) is not None


def _paired(path: Path, spec: Any, names: Sequence[str]) -> tuple[str, ...]:
    found = _by_side(spec, names)
    if found is None:
        raise ValueError(f"{path}: wheels {', '.join(names)} do not stand in pairs, one left and one right. Name the "
                         "driven wheels of both sides.")
    return found


def _by_side(spec: Any, names: Sequence[str]) -> tuple[str, ...] | None:
    """Left ones, then right ones, both from front to rear; None where they do not stand in pairs with level axles."""
    try:
        model = spec.copy().compile()
    except (ValueError, mujoco.FatalError):
        return None
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    ids = [model.joint(name).id for name in names]
    wheel = int(model.jnt_bodyid[ids[0]])
    root = int(model.body_rootid[wheel])
    root = 0 if root == wheel else root  # the chassis of a URDF is part of the world until it gets a free joint
    turn = data.xmat[root].reshape(3, 3)
    place = (data.xanchor[ids] - data.xpos[root]) @ turn
    if (np.abs((data.xaxis[ids] @ turn)[:, 2]) > 0.5).any():
        return None
    sides = [_side(name) or (1 if y > place[:, 1].mean() else -1) for name, y in zip(names, place[:, 1], strict=True)]
    order = sorted(range(len(names)), key=lambda i: (-sides[i], -place[i, 0]))
    ok = sum(sides) == 0 and len(names) // 2 <= MOST
    return tuple(names[i] for i in order) if ok else None


def _side(name: str) -> int:
    """1 for a name of the left, -1 of the right, 0 of neither."""
    words = {word for word in re.split(r"[^a-z]+", name.lower()) if word}
    words |= {side for side in ("left", "right") if side in name.lower()}
    return bool(words & LEFT) - bool(words & RIGHT)

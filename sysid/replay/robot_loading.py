"""A robot from its file: completed with what the file lacks, compiled, and at rest on its floor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from sysid.replay.robot import Robot
from sysid.replay.robot_contacts import (
    as_in_gazebo,
    as_round_wheels,
    below_wheels,
    leave_out_contacts,
    radius_of,
    tyre_places,
)  # fmt: skip
from sysid.replay.robot_files import read_robot
from sysid.replay.robot_rest import NEAR, falls, near_floor, raise_supports, settle, sliding
from sysid.replay.robot_servos import (
    add_servos,
    are_motors,
    drive_gain,
    drop_others,
    integrals,
    is_stable,
    regulate,
    wheel_inertias,
)  # fmt: skip
from sysid.replay.stated_drive import StatedDrive
from sysid.replay.wheels import as_plain_wheels, leftwards, swapped, turned_round, wheel_joints
from whill_mjx.io.fields import Field, check

TIMESTEP = Field("option timestep", "s", 1e-5, 0.1, remedy="Give the model an option timestep such as 0.002.")
WHEEL_RADIUS = Field("wheel radius", "m", 1e-3, 2.0,
                     remedy='Sizes are in metres; a mesh in millimetres needs scale="0.001 0.001 0.001".')
DISTANCE = Field("distance between the wheels", "m", 1e-3, 10.0,
                 remedy="Correct the places of these joints, or name other wheels with --wheels.")
LIGHTEST = 0.5  # m/s^2 of gravity
ALIKE = 0.01  # share by which two statements of one size may differ
STIFF = 10.0  # of its friction over that of its contacts (impratio): wheels creep by 0.05 %, with 1 by 0.4 %
SLIDING = 0.05  # friction of what a URDF lets slide on the floor: mostly the ball of a caster, without its bearing
URDF_STEP = 0.0025  # s; a URDF states none


def load_robot(
    path: Path, wheels: Sequence[str] = (), wheel_radius: float | None = None, track: float | None = None,
    timestep: float | None = None, regulated: bool = False,
) -> Robot:
    """Read, complete and compile a differential drive; errors as of `sysid.replay.mjcf.mjcf_model`.

    `regulated`: its wheels are driven as by the controller of a usual robot, with an integral part and a limit.
    """
    try:
        draft = _read(path, wheels, wheel_radius, timestep)
        radius = float(radius_of(path, draft.host, draft.bodies[0]) if wheel_radius is None else wheel_radius)
        check(str(path), WHEEL_RADIUS, round(radius, 6))
        bare = _drive(draft, radius, regulated)
        _ground(draft, radius)
    except (ValueError, KeyError, mujoco.FatalError, mujoco.UnexpectedError) as error:
        text = " ".join(str(error).split())
        raise ValueError(text if text.startswith(str(path)) else f"{path}: MuJoCo cannot use it: {text}. Correct the "
                         "model.") from None
    host, data, ids = draft.host, draft.data, draft.ids
    body = int(host.body_rootid[draft.bodies[0]])
    tyres = tyre_places(host, data, ids)
    left, distance = leftwards(path, draft.joints, tyres)
    check(str(path), DISTANCE, round(distance, 6), f"the distance between {' and '.join(draft.joints)}")
    rotation = data.xmat[body].reshape(3, 3).copy()  # the data moves on
    middle = tyres.mean(0) - data.xpos[body]
    forward = rotation.T @ np.cross(left, [0.0, 0.0, 1.0])
    draft.notes += [*turned_round(path, draft.joints, float(forward[0])), *_other_sizes(draft, distance)]
    sign = tuple(float(np.sign(data.xaxis[one] @ left)) for one in ids)
    actuators = tuple(int(np.flatnonzero(host.actuator_trnid[:, 0] == one)[0]) for one in ids)
    free = int(host.body_jntadr[body])
    root, speed, turning = int(host.jnt_qposadr[free]), int(host.jnt_dofadr[free]), host.jnt_dofadr[ids].tolist()
    supports = _rest(draft, speed, turning, radius)
    inertias = [wheel_inertias(host, one, radius, len(ids)) for one in ids]
    spin, load = (float(one) for one in np.mean(inertias, axis=0))
    return Robot(path, draft.spec, host, root, speed, tuple(turning), actuators, sign,
                 are_motors(path, host, actuators), drive_gain(host, actuators, inertias), rotation.T @ middle,
                 forward, radius, distance if track is None else track,
                 data.qpos.copy(), tuple(actuators[one] for one in bare), supports, distance, tuple(draft.notes),
                 integrals(host, ids), spin, load,
                 falls=len(ids) == 2 and falls(host, data.qpos.copy(), speed, body, rotation.T @ left))


def _other_sizes(draft: _Draft, distance: float) -> list[str]:
    """Notes on sizes that a plugin of the file takes, where its shapes have others."""
    shapes = {"wheel radius": (draft.drive.radius, radius_of(draft.path, draft.host, draft.bodies[0], 0.0)),
              "distance between the wheels": (draft.drive.track, distance)}
    return [f"{draft.path.name}: a plugin takes {stated:.4g} m for the {name}, but its shapes have {own:.4g} m, which "
            "counts here. What controller and odometry take is stated in dataset.toml"
            for name, (stated, own) in shapes.items() if stated and own and abs(stated / own - 1) > ALIKE]


def count_wheels(path: Path, wheels: Sequence[str] = ()) -> int:
    """How many driven wheels a file has; 0 where it cannot be used, which `load_robot` explains."""
    try:
        file = read_robot(path, wheels, None)
        return len(wheel_joints(path, file.spec, wheels, file.drive))
    except (ValueError, KeyError, OSError, mujoco.FatalError, mujoco.UnexpectedError):
        return 0


@dataclass
class _Draft:
    """A robot while it is completed."""

    path: Path
    spec: Any
    joints: tuple[str, ...]  # of the driven wheels
    stated: dict[str, float] | None  # friction of links as a URDF states it for Gazebo; None for MJCF
    notes: list[str]
    drive: StatedDrive  # what a URDF says of it
    host: mujoco.MjModel = field(init=False)
    data: mujoco.MjData = field(init=False)

    def compile(self) -> None:
        """Renew the model and where its bodies are."""
        self.host = self.spec.compile()
        self.data = mujoco.MjData(self.host)
        mujoco.mj_kinematics(self.host, self.data)

    @property
    def ids(self) -> list[int]:
        """Of the driven wheels' joints."""
        return [self.host.joint(name).id for name in self.joints]

    @property
    def bodies(self) -> list[int]:
        """Of the driven wheels."""
        return [int(self.host.jnt_bodyid[one]) for one in self.ids]


def _read(path: Path, wheels: Sequence[str], wheel_radius: float | None, timestep: float | None) -> _Draft:
    """The file with its free joint and names, compiled."""
    file = read_robot(path, wheels, wheel_radius)
    spec, notes, stated = file.spec, file.notes, file.friction
    try:
        joints = wheel_joints(path, spec, wheels, file.drive)
    except ValueError as error:
        missing = "; ".join(note for note in notes if note.endswith("left out"))
        raise ValueError(f"{error}{f' ({missing}.)' if missing else ''}") from None
    notes += [*swapped(path, spec, wheels, joints), *as_plain_wheels(path, spec, joints, file.drive),
              *_with_weight(path, spec)]
    if stated is not None:
        if len(joints) == 2:  # the file has none
            spec.option.impratio, spec.option.cone = STIFF, mujoco.mjtCone.mjCONE_ELLIPTIC
        notes += as_in_gazebo(path, spec, joints)
        spec.option.timestep = URDF_STEP
    notes += drop_others(path, spec, joints)
    _complete(path, spec, joints)
    if timestep is not None:
        spec.option.timestep = timestep
    check(str(path), TIMESTEP, float(spec.option.timestep))
    draft = _Draft(path, spec, joints, stated, notes, file.drive)
    draft.compile()
    if stated is not None and (rounded := as_round_wheels(path, spec, draft.host, draft.bodies)):
        notes += rounded
        draft.compile()
    return draft


def _with_weight(path: Path, spec: Any) -> list[str]:
    """Let a vehicle stand on its floor by its weight; notes on bodies whose weight a model holds up."""
    x, y, z = spec.option.gravity
    if not -z > max(LIGHTEST, abs(x), abs(y)):
        raise ValueError(f"{path}: option gravity is {x:g} {y:g} {z:g}; a vehicle stands on its floor by gravity along "
                         "-z. Give it 0 0 -9.81, and z as the axis that points up.")
    held = [body for body in spec.bodies if body.gravcomp]
    for body in held:
        body.gravcomp = 0.0
    return [f"{path.name}: gravcomp of body {body.name} is left out: it would hold up weight that wheels carry"
            for body in held]


def _drive(draft: _Draft, radius: float, regulated: bool) -> list[int]:
    """Give wheels what turns them; numbers of those that the file has nothing for."""
    spec, host, joints = draft.spec, draft.host, draft.joints
    inertias = [wheel_inertias(host, one, radius, len(joints)) for one in draft.ids]
    bare, notes = add_servos(draft.path, spec, joints, inertias)
    draft.notes += notes
    if regulated and is_stable(host, joints, inertias):
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    if regulated:
        regulate(spec, host, joints, inertias, radius)
    if bare or regulated:
        draft.compile()
    return bare


def _ground(draft: _Draft, radius: float) -> None:
    """Put the robot on a floor, without contacts that would lift its wheels and those that MJX lacks."""
    path, spec, bodies = draft.path, draft.spec, draft.bodies
    if not (draft.host.geom_type == int(mujoco.mjtGeom.mjGEOM_PLANE)).any():
        bottom = float(draft.data.xanchor[draft.ids[0], 2]) - radius_of(path, draft.host, bodies[0], radius)
        taken = {geom.name for geom in spec.geoms}
        name = next(one for one in ("floor", *(f"floor_{k}" for k in range(len(taken) + 1))) if one not in taken)
        spec.worldbody.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], pos=[0, 0, bottom],
                                friction=[0, 0, 0])  # MuJoCo takes the larger one of two geoms
        draft.compile()
    if draft.stated is not None and (low := below_wheels(path, draft.host, draft.data, bodies, radius)):
        for name in low:
            spec.geom(name).conaffinity = 0
        draft.notes += list(low.values())
        draft.compile()
    if left_out := leave_out_contacts(path, spec, draft.host):
        draft.notes += left_out
        draft.compile()


def _rest(draft: _Draft, speed: int, turning: Sequence[int], radius: float) -> tuple[int, ...]:
    """Let the robot settle; geoms that slide on the floor, with the friction of a URDF."""
    path, spec, host, data = draft.path, draft.spec, draft.host, draft.data
    root = int(host.body_rootid[draft.bodies[0]])
    settle(path, host, data, speed, turning, radius)
    if draft.stated is None:
        return sliding(host, data, root)
    supports = near_floor(host, data, root, NEAR * radius)
    if raised := raise_supports(path, host, data, spec, supports, draft.bodies):
        draft.notes += raised
        mujoco.mj_resetData(host, data)
        settle(path, host, data, speed, turning, radius)
    for geom in {*supports, *sliding(host, data, root, swivelling=True)}:
        name = host.body(host.geom_bodyid[geom]).name
        friction = min(draft.stated.get(name, 0.0) or SLIDING, 1.0)  # authors write 0 for a caster that rolls
        host.geom_friction[geom, 0] = friction
        spec.geom(host.geom(geom).name).friction[0] = friction
    return sliding(host, data, root)


def _complete(path: Path, spec: Any, joints: Sequence[str]) -> None:
    """Give the model a free joint and names to its bodies and geoms, where it has none."""
    spec.compiler.fusestatic = False
    for key in list(spec.keys):  # of the file's own coordinates and actuators, which change
        spec.delete(key)
    named = {body.name for body in spec.bodies}
    for k, body in enumerate(spec.bodies):
        if not body.name:
            body.name = next(name for name in (f"body_{k}", f"body_{k}_unnamed") if name not in named)
    top = next(body for body in spec.bodies if any(joint.name == joints[0] for joint in body.joints))
    while top.parent.name != "world":
        top = top.parent
    if not len(top.joints):
        top.add_freejoint()
    elif top.joints[0].type != mujoco.mjtJoint.mjJNT_FREE:
        raise ValueError(f"{path}: body {top.name!r} hangs on joint {top.joints[0].name!r}; a vehicle moves freely. "
                         "Give it a freejoint, or no joint.")
    acting = {one.name for one in spec.actuators}
    for one in spec.actuators:
        if not one.name:
            one.name = next(name for name in (one.target, *(f"{one.target}_{k}" for k in range(len(acting) + 1)))
                            if name not in acting)
            acting.add(one.name)
    for body in spec.bodies:
        taken = {geom.name for geom in spec.geoms}
        for k, geom in enumerate(body.geoms):
            plain = body.name if k == 0 else f"{body.name}_{k}"
            if not geom.name and plain and plain not in taken:
                geom.name = plain

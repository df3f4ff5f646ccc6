"""A robot at rest on its floor: how it settles, and what it stands on beside its wheels."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from sysid.replay.robot_contacts import lowest

SETTLE = 1.0  # s in which the model comes to rest on the ground before it is driven
REST_SPEED = 1.0  # m/s; a model that is faster after SETTLE falls, rolls away or shakes
UPRIGHT = 0.9  # cosine of the angle between a hinge and the vertical, at least, of a caster's swivel
FALLEN = 0.8  # cosine of the angle by which a vehicle tilts when it lies on its body
PUSH, WAIT = 0.3, 3.0  # rad/s of a push about the axle, and s after it
FALLS = ("it stands on its two driven wheels alone and falls over: the file has no caster, or the robot balances by a "
         "controller of its own, which is not in the file. Add the caster, or fit a function of your own "
         "(docs/models.md)")
NEAR = 0.05  # of the wheel radius above the floor, within which a support may touch it in a drive
LEVEL = 0.01  # of its distance from the axle by which a support is raised where others stand on the other side


def settle(path: Path, host: mujoco.MjModel, data: Any, speed: int, wheels: Sequence[int], radius: float) -> None:
    """Let the model come to rest on its floor, without a command; ValueError where it does not."""
    remedy = "Check its contacts, the gains and inertias of its wheels, and its timestep."
    faults = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)
    steps = round(SETTLE / host.opt.timestep)
    fastest = 0.0
    for step in range(steps):
        mujoco.mj_step(host, data)
        if any(data.warning[int(fault)].number for fault in faults) or not np.isfinite(data.qpos).all():
            raise ValueError(f"{path}: the model explodes while it settles on its floor, after "
                             f"{(step + 1) * host.opt.timestep:.3f} s (a position, speed or acceleration is not "
                             f"finite or huge). {remedy}")
        if step >= 0.8 * steps:  # a wheel that shakes passes through 0
            rims = np.abs(data.qvel[list(wheels)]) * radius
            fastest = max(fastest, float(np.linalg.norm(data.qvel[speed : speed + 3])), *map(float, rims))
    if fastest > REST_SPEED:
        raise ValueError(f"{path}: after {SETTLE:g} s on its floor, without a command, the model still moves at "
                         f"{fastest:.3g} m/s (at most {REST_SPEED:g}): it falls, rolls away or shakes. {remedy}")


def falls(host: mujoco.MjModel, rest: np.ndarray, speed: int, root: int, axle: np.ndarray) -> bool:
    """Whether a vehicle falls over after a push forwards or backwards, without a command.

    `rest`: qpos; `speed`: address of the free joint in qvel; `root`: body that moves freely; `axle`: (3,) in its frame.
    """
    data = mujoco.MjData(host)
    for push in (PUSH, -PUSH):
        mujoco.mj_resetData(host, data)
        data.qpos[:] = rest
        mujoco.mj_kinematics(host, data)
        upright = data.xmat[root].reshape(3, 3).T @ [0.0, 0.0, 1.0]  # in its own frame, at rest
        data.qvel[speed + 3 : speed + 6] = push * axle
        for _ in range(round(WAIT / host.opt.timestep)):
            mujoco.mj_step(host, data)
            if data.xmat[root].reshape(3, 3)[2] @ upright < FALLEN:
                return True
    return False


def sliding(host: mujoco.MjModel, data: mujoco.MjData, root: int, swivelling: bool = False) -> tuple[int, ...]:
    """Geoms fixed to the vehicle's main body that touch the world at rest; with `swivelling` also on upright hinges."""
    pairs = [(int(one.geom1), int(one.geom2)) for one in data.contact[: data.ncon]]
    touching = {geom for pair in pairs for geom in pair if any(host.geom_bodyid[other] == 0 for other in pair)}
    return tuple(sorted(geom for geom in touching if _holds(host, data, int(host.geom_bodyid[geom]), root, swivelling)))


def near_floor(host: mujoco.MjModel, data: mujoco.MjData, root: int, reach: float) -> tuple[int, ...]:
    """Geoms fixed to the main body that touch the world at rest, or are within `reach` [m] of a level floor: a vehicle
    on two wheels leans on one of its supports, and on the other one when it brakes."""
    planes = np.flatnonzero((host.geom_bodyid == 0) & (host.geom_type == int(mujoco.mjtGeom.mjGEOM_PLANE)))
    found = set(sliding(host, data, root))
    for geom in range(host.ngeom) if len(planes) else ():
        solid = bool(host.geom_contype[geom] | host.geom_conaffinity[geom])
        if solid and int(host.body_weldid[host.geom_bodyid[geom]]) == root and (
                lowest(host, data, geom) - data.geom_xpos[planes, 2].max() < reach):
            found.add(geom)
    return tuple(sorted(found))


def _holds(host: mujoco.MjModel, data: mujoco.MjData, body: int, root: int, swivelling: bool) -> bool:
    """Whether a body is fixed to another one, or hangs on it by upright hinges alone."""
    while swivelling and (body := int(host.body_weldid[body])) not in (0, root):
        joints = range(host.body_jntadr[body], host.body_jntadr[body] + host.body_jntnum[body])
        if any(abs(data.xaxis[joint, 2]) < UPRIGHT for joint in joints):
            return False
        body = int(host.body_parentid[body])
    return int(host.body_weldid[body]) == root


def raise_supports(
    path: Path, host: mujoco.MjModel, data: mujoco.MjData, spec: Any, sliding: Sequence[int], bodies: Sequence[int],
) -> list[str]:  # fmt: skip
    """Raise what slides before and behind the axle, with a note: at one height with the driven wheels it would share
    their load by the stiffness of contacts, where a real vehicle has springs or a gap."""
    axle = data.xpos[list(bodies)].mean(0)
    place = (data.geom_xpos[list(sliding)] - axle).reshape(-1, 3)
    ahead = place @ np.cross(data.xaxis[host.body_jntadr[bodies[0]]], [0.0, 0.0, 1.0])
    if not (ahead > 0).any() or not (ahead < 0).any():
        return []
    for geom, distance in zip(sliding, np.abs(ahead), strict=True):
        up = data.xmat[host.geom_bodyid[geom]].reshape(3, 3).T @ np.array([0.0, 0.0, LEVEL * distance])
        host.geom_pos[geom] += up
        host.geom_sameframe[geom] = int(mujoco.mjtSameFrame.mjSAMEFRAME_NONE)
        spec.geom(host.geom(geom).name).pos = host.geom_pos[geom]
    return [f"{path.name}: {', '.join(host.geom(one).name for one in sliding)} are raised by up to "
            f"{1000 * LEVEL * np.abs(ahead).max():.2g} mm: they stand before and behind the axle, at the height of the "
            "driven wheels"]

"""A picture of a robot file as it was understood: from above and from the side."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np

from sysid.pages.plots import pyplot, save
from sysid.replay.robot import Robot

DRIVEN, FLOOR, REST = "#d95f02", "#1b9e77", "#bbbbbb"
AROUND = 32  # points of a rim


def write_robot(path: Path, robot: Robot, loads: dict[str, float]) -> None:
    """Write a PNG: driven wheels, what else stands on the floor, and the rest of the shapes that may touch."""
    host, data, joints = robot.host, robot.resting, robot.joints
    wheels = {int(host.body_weldid[host.jnt_bodyid[joint]]) for joint in joints}
    figure, axes = pyplot().subplots(1, 2, figsize=(10, 5), constrained_layout=True)
    for geom in range(host.ngeom):
        if host.geom_bodyid[geom] == 0 or not host.geom_contype[geom] | host.geom_conaffinity[geom]:
            continue
        driven = int(host.body_weldid[host.geom_bodyid[geom]]) in wheels
        on_floor = host.geom(geom).name in loads
        colour = DRIVEN if driven else FLOOR if on_floor else REST
        points = _outline(host, geom) @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
        for axis, columns in zip(axes, ((0, 1), (0, 2)), strict=True):
            hull = _hull(points[:, columns])
            axis.fill(*hull.T, facecolor=colour, alpha=0.35, edgecolor=colour)
    for side, name in ((robot.sides == 0, "L"), (robot.sides == 1, "R")):
        for joint in np.array(joints)[side]:
            axes[0].annotate(name, data.xanchor[joint][:2], ha="center", va="center")
    middle = data.qpos[robot.root : robot.root + 3] + _turned(data, robot.root, robot.point)
    ahead = _turned(data, robot.root, robot.forward) * robot.track
    axes[0].annotate("", middle[:2] + ahead[:2], middle[:2], arrowprops={"arrowstyle": "->", "lw": 1.5})
    axes[0].plot(*middle[:2], "k+")
    axes[0].set(title="from above (arrow: forward)", xlabel="x [m]", ylabel="y [m]", aspect="equal")
    axes[1].set(title="from the side", xlabel="x [m]", ylabel="z [m]", aspect="equal")
    axes[1].axhline(float(data.geom_xpos[_floor(host), 2]), color="k", lw=0.8)
    figure.suptitle(f"{robot.path.name}: driven wheels orange, other supports green")
    save(figure, path, 110)


def _floor(host: mujoco.MjModel) -> int:
    return int(np.flatnonzero(host.geom_type == int(mujoco.mjtGeom.mjGEOM_PLANE))[0])


def _turned(data: mujoco.MjData, root: int, vector: np.ndarray) -> np.ndarray:
    found = np.zeros(3)
    mujoco.mju_rotVecQuat(found, vector, data.qpos[root + 3 : root + 7])
    return found


def _outline(host: mujoco.MjModel, geom: int) -> np.ndarray:
    """Points (N, 3) on a geom, in its frame."""
    kind, size = int(host.geom_type[geom]), host.geom_size[geom]
    angle = np.linspace(0, 2 * np.pi, AROUND)
    if kind == int(mujoco.mjtGeom.mjGEOM_MESH):
        mesh = int(host.geom_dataid[geom])
        first = int(host.mesh_vertadr[mesh])
        return np.asarray(host.mesh_vert[first : first + int(host.mesh_vertnum[mesh])])
    if kind == int(mujoco.mjtGeom.mjGEOM_BOX):
        return np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, 8).T * size
    if kind == int(mujoco.mjtGeom.mjGEOM_CYLINDER):
        ring = np.stack([size[0] * np.cos(angle), size[0] * np.sin(angle)], axis=-1)
        return np.concatenate([np.column_stack([ring, np.full(AROUND, z)]) for z in (-size[1], size[1])])
    rim = np.linspace(0, np.pi, AROUND // 2)
    ball = np.array([[np.sin(b) * np.cos(a), np.sin(b) * np.sin(a), np.cos(b)] for a in angle for b in rim])
    if kind == int(mujoco.mjtGeom.mjGEOM_ELLIPSOID):
        return ball * size
    ball = ball * size[0]
    if kind == int(mujoco.mjtGeom.mjGEOM_CAPSULE):
        return np.concatenate([ball + [0, 0, z] for z in (-size[1], size[1])])
    return ball


def _hull(points: np.ndarray) -> np.ndarray:
    """Corners (K, 2) of the convex hull of points (N, 2)."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        return np.asarray(points[ConvexHull(points).vertices])
    except QhullError:  # all on one line
        return points

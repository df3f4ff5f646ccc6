"""A picture of a robot file as it was understood: from above and from the side."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np

from sysid.replay.robot import Robot
from sysid.replay.robot_contacts import ROUND, corners
from whill_mjx.io.png import pyplot, save_figure

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
    middle = data.qpos[robot.root : robot.root + 3] + data.xmat[robot.base].reshape(3, 3) @ robot.point
    ahead = robot.axes[0] * robot.track
    axes[0].annotate("", middle[:2] + ahead[:2], middle[:2], arrowprops={"arrowstyle": "->", "lw": 1.5})
    axes[0].plot(*middle[:2], "k+")
    axes[0].set(title="from above (arrow: forward)", xlabel="x [m]", ylabel="y [m]", aspect="equal")
    axes[1].set(title="from the side", xlabel="x [m]", ylabel="z [m]", aspect="equal")
    floor = int(np.flatnonzero(host.geom_type == int(mujoco.mjtGeom.mjGEOM_PLANE))[0])
    axes[1].axhline(float(data.geom_xpos[floor, 2]), color="k", lw=0.8)
    figure.suptitle(f"{robot.path.name}: driven wheels orange, other supports green")
    save_figure(figure, path, 110)


def _outline(host: mujoco.MjModel, geom: int) -> np.ndarray:
    """Points (N, 3) on a geom, in its frame."""
    kind, radius = int(host.geom_type[geom]), host.geom_size[geom, 0]
    if kind not in map(int, ROUND):
        return corners(host, geom)
    angle, tilt = (one.ravel() for one in np.meshgrid(np.linspace(0, 2 * np.pi, AROUND), np.linspace(0, np.pi, AROUND)))
    tilt = np.full_like(tilt, np.pi / 2) if kind == int(mujoco.mjtGeom.mjGEOM_CYLINDER) else tilt
    around = radius * np.column_stack([np.sin(tilt) * np.cos(angle), np.sin(tilt) * np.sin(angle), np.cos(tilt)])
    return np.concatenate([around + middle for middle in np.unique(corners(host, geom), axis=0)])


def _hull(points: np.ndarray) -> np.ndarray:
    """Corners (K, 2) of the convex hull of points (N, 2)."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        return np.asarray(points[ConvexHull(points).vertices])
    except QhullError:  # all on one line
        return points

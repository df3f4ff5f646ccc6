"""True sizes of a robot's driven wheels, which its file only believes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import mujoco
import numpy as np

from sysid.replay.arrays import added
from sysid.replay.robot import Robot
from sysid.replay.robot_contacts import ROUND, parts, touches_ground, tyre_places

SIZES = ("wheels.radius", "wheels.difference", "wheels.track")


@dataclass(frozen=True, eq=False)
class Size:
    """A true size of the driven wheels, which the file only believes: of their round geoms and places."""

    path: str
    """`wheels.radius` or `wheels.track` [m], `wheels.difference` [-], left radius less right one over their mean."""
    unit: str
    nominal: float  # what the file says
    geoms: tuple[tuple[int, ...], ...]  # of each wheel, those on the left first
    bodies: tuple[int, ...]
    rolling: float  # radius on which a wheel rolls over that of its geom: contacts are soft, and wheels sink [-]
    along: tuple[np.ndarray, ...]
    """(3,) in the frames of the wheels' parents: a wheel that grows rises, a track that grows moves it outwards."""

    def changes(self, model: Any, value: Any) -> dict[str, Any]:
        """Arrays of a model, of NumPy or JAX, with the value put in; what rolls on the floor stays on it."""
        half = (value - self.nominal) / 2
        signs = np.repeat([1, -1], len(self.bodies) // 2)
        move = {"wheels.track": half, "wheels.radius": 2 * half}.get(self.path, half * self._radius(model))
        place = model.body_pos
        for body, sign, along in zip(self.bodies, signs, self.along, strict=True):
            place = _added(place, body, move * along * (sign if self.path == "wheels.difference" else 1))
        if self.path == "wheels.track":
            return {"body_pos": place}
        size, reach = model.geom_size, model.geom_rbound  # beyond its reach a geom meets nothing
        for sign, geoms in zip(signs, self.geoms, strict=True):
            factor = value / self.nominal / self.rolling if self.path == "wheels.radius" else 1 + sign * half
            for geom in geoms:
                reach = _added(reach, geom, abs(factor - 1) * size[geom, 0])
                size = _added(size, (geom, 0), (factor - 1) * size[geom, 0])
        return {"body_pos": place, "geom_size": size, "geom_rbound": reach}

    def _radius(self, model: Any) -> Any:
        return model.geom_size[self.geoms[0][0], 0]

    def read(self, model: Any) -> float:
        """What the file says."""
        return self.nominal


def sizes_of(robot: Robot, rolling: float = 1.0) -> dict[str, Size]:
    """The true sizes that may be fitted, of round wheels; `rolling`: radius rolled on over that of geoms."""
    host, data = robot.host, mujoco.MjData(robot.host)
    mujoco.mj_kinematics(host, data)
    joints = robot.joints
    bodies = [int(host.jnt_bodyid[joint]) for joint in joints]
    touching = [[int(one) for one in parts(host, body) if touches_ground(host, int(one))] for body in bodies]
    kinds = [int(one) for one in ROUND]
    if not all(geoms and all(int(host.geom_type[one]) in kinds for one in geoms) for geoms in touching):
        return {}
    geoms, half = tuple(tuple(one) for one in touching), len(joints) // 2
    tyres = tyre_places(host, data, joints)
    out = tyres[:half].mean(0) - tyres[half:].mean(0)
    out, up = out / np.linalg.norm(out), np.array([0.0, 0.0, 1.0])
    frames = [data.xmat[host.body_parentid[body]].reshape(3, 3).T for body in bodies]
    raised = tuple(frame @ up for frame in frames)
    apart = tuple(frame @ out * (1 - 2 * side) for frame, side in zip(frames, robot.sides, strict=True))
    radius = max(float(host.geom_size[one, 0]) for one in geoms[0])
    known = (("wheels.radius", "m", radius, raised), ("wheels.difference", "-", 0.0, raised),
             ("wheels.track", "m", robot.distance, apart))
    return {path: Size(path, unit, value, geoms, tuple(map(int, bodies)), rolling, along)
            for path, unit, value, along in known}


def _added(array: Any, index: Any, change: Any) -> Any:
    """As `added`, with NumPy's array left as it is."""
    return added(array if isinstance(array, jax.Array) else np.array(array), index, change)

"""What only the simulator knows: for critics and for targets of a world model, never for a policy that is to drive.

The vector is in the body frame, centred on the footprint (x ahead, y to the left): goal, speeds, and the free distance
in `RAYS` directions, from the footprint's middle or from its outline. Lengths are in units of `UNIT`, so that the
learner's symlog resolves the near ones.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from whill_mjx.sensors.base import Reading, Sensor, View
from whill_mjx.sensors.lidar import distances
from whill_mjx.vehicle.kinematics import body_twist, reference_pose
from whill_mjx.world.collision import from_above
from whill_mjx.world.lidar import first_hits
from whill_mjx.world.scene import Boxes, Footprint, Scene, footprint
from whill_mjx.world.solids import Rounds, Solids

UNIT = 0.1  # m
HEIGHT = 0.3  # m, at which walls of a map are met, and lower ones at their edge
RANGE = 5.0  # m, largest free distance
RAYS = 48  # 3 m away they lie 0.39 m apart: at least one meets a box as wide as the corridor's
SIZE = 4 + RAYS
ANGLES = np.arange(RAYS) * 2 * np.pi / RAYS  # rad, from straight ahead to the left; mirrored, ray k is ray -k


@dataclass(frozen=True)
class Privileged(Sensor):
    """(52,) goal x, y, forward speed, yaw rate, free distances in 48 directions; in units of 0.1 m and 0.1 rad."""

    name: ClassVar[str] = "privileged"

    def reading(self, env: Any) -> Reading:
        return Reading((SIZE,))

    def measure(self, memory: Any, view: View, key: jax.Array) -> tuple[Any, jax.Array]:
        return memory, truth(view.env, view.state)

    def mirrored(self, value: jax.Array) -> jax.Array:  # type: ignore[override]
        return mirrored(value)


def truth(env: Any, state: Any, from_outline: bool = False) -> jax.Array:
    """(SIZE,) float32: goal x, y, forward speed, yaw rate, free distances; of one instance.

    Args:
        env: with the vehicle and the task.
        state: of one instance.
        from_outline: take off each free distance what the vehicle covers of it: at 0 the vehicle touches something.
    """
    x, y, yaw = reference_pose(env.model, state.vehicle.qpos)
    v, omega = body_twist(env.model, state.vehicle.qpos, state.vehicle.qvel)
    body = footprint(env.model.spec, x, y, yaw)
    dx, dy = env.task.goal(state.scene) - jnp.stack([body.x, body.y])
    ahead, aside = dx * jnp.cos(yaw) + dy * jnp.sin(yaw), dy * jnp.cos(yaw) - dx * jnp.sin(yaw)
    near = jnp.stack([ahead, aside, v, omega]) / UNIT
    free = free_distances(body, state.scene.boxes)
    if state.scene.walls is not None or rounds_of(state.scene) is not None:  # neither is a box
        height = HEIGHT if state.scene.walls is None else min(HEIGHT, state.scene.walls.height)
        there = first_hits(in_plane(state.scene, body, height), body.x, body.y, body.yaw + ANGLES, height)
        free = jnp.minimum(free, there)
    if from_outline:
        free = jnp.maximum(free - outline(body), 0.0)
    return jnp.concatenate([near, free / UNIT]).astype(jnp.float32)


def rounds_of(scene: Scene) -> Rounds | None:
    """Cylinders and capsules of a scene, people among them; None without any."""
    return None if scene.solids is None else scene.solids.rounds


def in_plane(scene: Scene, body: Footprint, height: float) -> Scene:
    """The scene, of whose rounds each lies in the plane at `height` [m] as the capsule that the vehicle can run into.

    A contact does not ask how high a post is, nor at which height a rod hangs, if the vehicle does not pass below it.
    """
    rounds = rounds_of(scene)
    if rounds is None:
        return scene
    seen = from_above(rounds)
    reach = (seen.end - seen.start) / 2
    half = jnp.sqrt(jnp.sum(reach**2, -1))
    axis = jnp.where(half[:, None] > 1e-6, reach / jnp.maximum(half, 1e-6)[:, None], jnp.array([1.0, 0.0]))
    lying = dataclasses.replace(
        rounds,
        centre=jnp.pad((seen.start + seen.end) / 2, ((0, 0), (0, 1)), constant_values=height),
        axis=jnp.pad(axis, ((0, 0), (0, 1))),
        half=half,
        capsule=jnp.ones_like(rounds.capsule),
        mask=seen.mask & (seen.low < body.height),
    )
    return dataclasses.replace(scene, solids=Solids(rounds=lying))


def free_distances(body: Footprint, boxes: Boxes) -> jax.Array:
    """(RAYS,) m from the footprint's centre to the first box in each direction of ANGLES, at most RANGE."""
    return distances(body.x, body.y, body.yaw + ANGLES, boxes, RANGE, (0.0, body.height))


def outline(body: Footprint) -> jax.Array:
    """(RAYS,) m from the footprint's middle to its edge in each direction of ANGLES."""
    ahead, aside = np.maximum(np.abs(np.cos(ANGLES)), 1e-9), np.maximum(np.abs(np.sin(ANGLES)), 1e-9)
    return jnp.minimum(body.half_length / ahead, body.half_width / aside)


def mirrored(values: jax.Array) -> jax.Array:
    """The vectors (..., SIZE) of the world mirrored left to right."""
    sign = jnp.array([1.0, -1.0, 1.0, -1.0])
    rays = values[..., 4:][..., (-np.arange(RAYS)) % RAYS]
    return jnp.concatenate([values[..., :4] * sign, rays], -1)

"""Privileged auxiliary targets of a world model, which only the simulator knows; never inputs of the policy.

The vector (D,) is in the body frame, centred on the footprint (x ahead, y to the left): goal, speeds, and the free
distance in `RAYS` directions. Lengths are in units of `UNIT`, so that the learner's symlog resolves the near ones.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from whill_mjx.env import Env, State
from whill_mjx.tasks.tasks import goal_position
from whill_mjx.vehicle.kinematics import body_twist, reference_pose
from whill_mjx.world.scene import Boxes, Footprint, footprint

UNIT = 0.1  # m
RANGE = 5.0  # m, largest free distance
RAYS = 48  # 3 m away they lie 0.39 m apart: at least one meets a box as wide as the corridor's
SIZE = 4 + RAYS
ANGLES = np.arange(RAYS) * 2 * np.pi / RAYS  # rad, from straight ahead to the left; mirrored, ray k is ray -k


def truth(env: Env, state: State) -> jax.Array:
    """(SIZE,) float32: goal x, y, forward speed, yaw rate, free distances; of one instance."""
    x, y, yaw = reference_pose(env.model, state.vehicle.qpos)
    v, omega = body_twist(env.model, state.vehicle.qpos, state.vehicle.qvel)
    body = footprint(env.model.spec, x, y, yaw)
    dx, dy = goal_position(state.scene) - jnp.stack([body.x, body.y])
    ahead, aside = dx * jnp.cos(yaw) + dy * jnp.sin(yaw), dy * jnp.cos(yaw) - dx * jnp.sin(yaw)
    near = jnp.stack([ahead, aside, v, omega]) / UNIT
    return jnp.concatenate([near, free_distances(body, state.scene.boxes) / UNIT]).astype(jnp.float32)


def scan(env: Env, state: State) -> jax.Array:
    """(RAYS,) m from the drive-axle centre to the first box in each direction of ANGLES, at most RANGE."""
    x, y, yaw = reference_pose(env.model, state.vehicle.qpos)
    body = footprint(env.model.spec, x, y, yaw)
    return free_distances(dataclasses.replace(body, x=x, y=y), state.scene.boxes)


def free_distances(body: Footprint, boxes: Boxes) -> jax.Array:
    """(RAYS,) m from the footprint's centre to the first box in each direction of ANGLES, at most RANGE."""
    turn = body.yaw + ANGLES[:, None] - boxes.yaw  # (RAYS, P): direction in each box's frame
    dx, dy = body.x - boxes.centre[:, 0], body.y - boxes.centre[:, 1]
    c, s = jnp.cos(boxes.yaw), jnp.sin(boxes.yaw)
    start = jnp.stack([dx * c + dy * s, dy * c - dx * s])[:, None]  # (2, 1, P)
    way = jnp.stack([jnp.cos(turn), jnp.sin(turn)])  # (2, RAYS, P)
    way = jnp.where(jnp.abs(way) < 1e-6, 1e-6, way)
    half = jnp.stack([boxes.half[:, 0], boxes.half[:, 1]])[:, None]
    ends = jnp.stack([(-half - start) / way, (half - start) / way])  # (2, 2, RAYS, P)
    enter, leave = ends.min(0).max(0), ends.max(0).min(0)
    met = (leave >= jnp.maximum(enter, 0.0)) & boxes.mask & (boxes.centre[:, 2] - boxes.half[:, 2] < body.height)
    return jnp.min(jnp.where(met, jnp.maximum(enter, 0.0), RANGE), -1, initial=RANGE)


def mirrored(values: jax.Array) -> jax.Array:
    """The vectors (..., SIZE) of the world mirrored left to right."""
    sign = jnp.array([1.0, -1.0, 1.0, -1.0])
    rays = values[..., 4:][..., (-np.arange(RAYS)) % RAYS]
    return jnp.concatenate([values[..., :4] * sign, rays], -1)

"""The ground under the wheels: height and normal at each contact.

The ground of a world is the plane z = 0 and what its surfaces put on it. A surface is anything with

    height(x, y) -> height [m], its slope along x, its slope along y

of places in the room, smooth and over lengths well beyond a wheel's radius: a wheel touches the ground at one point,
in the direction of the ground's normal there, so no kerb or step can be climbed.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.vehicle.types import VehicleParams, World


@struct.dataclass
class Footing:
    """The ground as the chassis sees it at the present pose; vectors in the chassis frame."""

    axes: jax.Array  # (3, 3) rows: forward, left and normal of the ground, or of its mean plane under the wheels
    contact_axes: jax.Array  # the same at each contact: (3, 3, 4); (3, 3) where it is the same for all
    contact_points: tuple  # x (4,), y (4,), z (4,) or () of the contact patches [m]
    height: jax.Array  # (4,) of the wheel centres above the ground, along its normal [m]


def footing(world: World, rotation: jax.Array, position: jax.Array, wheel_radius: float) -> Footing:
    """The ground under a chassis with this rotation (3, 3) to the world and origin (3,)."""
    x, y = world.geometry.contact_x, world.geometry.contact_y
    above = position[2] + rotation[2, 0] * x + rotation[2, 1] * y  # of the wheel centres, over z = 0
    if not world.ground:
        axes = axes_along(rotation[2])
        return Footing(axes, axes, (x, y, -wheel_radius), above)
    east = position[0] + rotation[0, 0] * x + rotation[0, 1] * y
    north = position[1] + rotation[1, 0] * x + rotation[1, 1] * y
    height, along_x, along_y = ground_height(world.ground, east, north)
    steepness = jnp.sqrt(1 + along_x**2 + along_y**2)
    normals = jnp.stack([-along_x, -along_y, jnp.ones(4)]) / steepness  # (3, 4) world
    mean = normals.sum(1) / 4
    mean = rotation.T @ (mean / jnp.sqrt((mean * mean).sum()))
    normals = rotation.T @ normals
    # On a plane the patches lie under the wheels, as on level ground; elsewhere they move round them with the normal.
    dx, dy, dz = wheel_radius * (normals - mean[:, None])
    points = x - dx, y - dy, -wheel_radius - dz
    return Footing(axes_along(mean), axes_along(normals), points, (above - height) / steepness)


def ground_height(ground: tuple, x: jax.Array, y: jax.Array) -> tuple[Any, Any, Any]:
    """Height [m] and its slopes along x and y at places of any shape: what all surfaces add up to."""
    parts = [surface.height(x, y) for surface in ground]
    return sum(part[0] for part in parts), sum(part[1] for part in parts), sum(part[2] for part in parts)


def axes_along(normal: jax.Array) -> jax.Array:
    """Axes (3, 3, ...), rows forward, left and normal, for normals (3, ...) in the chassis frame."""
    forward_x = jnp.array([1.0, 0.0, 0.0]).reshape(3, *[1] * (normal.ndim - 1))
    forward = forward_x - normal[0] * normal
    forward = forward / jnp.sqrt((forward * forward).sum(0))
    left = jnp.stack([
        normal[1] * forward[2] - normal[2] * forward[1],
        normal[2] * forward[0] - normal[0] * forward[2],
        normal[0] * forward[1] - normal[1] * forward[0],
    ])  # fmt: skip
    return jnp.stack([forward, left, normal])


def on_ground(params: VehicleParams, ground: tuple) -> VehicleParams:
    """Parameters of a vehicle in a room with these surfaces, behind the effects of its own."""
    return dataclasses.replace(params, effects=(*params.effects, *ground)) if ground else params


def plane_under(
    world: World, x: jax.Array, y: jax.Array, yaw: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Height [m] at a chassis origin (x, y), and slopes towards front and left, of the plane under its wheels."""
    ahead, aside = world.geometry.contact_x, world.geometry.contact_y
    cos, sin = jnp.cos(yaw), jnp.sin(yaw)
    height, _, _ = ground_height(world.ground, x + cos * ahead - sin * aside, y + sin * ahead + cos * aside)
    rear, front = (height[0] + height[1]) / 2, (height[2] + height[3]) / 2
    left, right = (height[0] + height[2]) / 2, (height[1] + height[3]) / 2
    rise_ahead = (front - rear) / (ahead[2] - ahead[0])
    rise_left = (left - right) / ((aside[0] + aside[2] - aside[1] - aside[3]) / 2)
    return rear - rise_ahead * ahead[0], rise_ahead, rise_left

"""Distance fields of maps: how far the nearest thing is from any point. Pure functions of one instance in JAX."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from whill_mjx.world.maps.grid import FREE, GridMap
from whill_mjx.world.scene import Footprint


@struct.dataclass
class DistanceField:
    """Distance from each cell's centre to the border of the free space."""

    distance: jax.Array  # (rows, columns) m, negative in cells that are not free
    origin: jax.Array  # (3,) x [m], y [m], yaw [rad] of the lower left corner
    resolution: jax.Array  # () m


def distance_field(grid: GridMap) -> DistanceField:
    """Distance of every cell's centre to the border of the free space, negative outside of it."""
    from scipy.ndimage import distance_transform_edt

    free = np.pad(grid.cells == FREE, 1)  # what lies beyond the grid is not free
    # From centre to centre; the border lies half a cell before the other centre.
    inside, outside = (distance_transform_edt(field) - 0.5 for field in (free, ~free))
    metres = np.where(free, inside, -outside)[1:-1, 1:-1] * grid.resolution
    origin, resolution = (jnp.asarray(value, jnp.float32) for value in (grid.origin, grid.resolution))
    return DistanceField(jnp.asarray(metres, jnp.float32), origin, resolution)


def distance_at(field: DistanceField, points: jax.Array) -> jax.Array:
    """(...,) m: distance from points (..., 2) to the nearest thing, bilinear between cells, 0 outside of the grid."""
    x, y, yaw = field.origin
    dx, dy = points[..., 0] - x, points[..., 1] - y
    along = (dx * jnp.cos(yaw) + dy * jnp.sin(yaw)) / field.resolution - 0.5
    across = (dy * jnp.cos(yaw) - dx * jnp.sin(yaw)) / field.resolution - 0.5
    near = jax.scipy.ndimage.map_coordinates
    return jnp.maximum(near(field.distance, [across, along], order=1, mode="constant", cval=0.0), 0.0)


def map_clearance(field: DistanceField, vehicle: Footprint, size: tuple[int, int] = (12, 8)) -> jax.Array:
    """() m: distance from the vehicle to the nearest thing, 0 when touching; right to half the distance of samples.

    The distance is sampled on a grid of `size` points over the rectangle, so that something thin that has got inside is
    seen as well.
    """
    u, v = jnp.meshgrid(jnp.linspace(-1.0, 1.0, size[0]), jnp.linspace(-1.0, 1.0, size[1]))
    a, b = u.ravel() * vehicle.half_length, v.ravel() * vehicle.half_width
    x = vehicle.x + a * jnp.cos(vehicle.yaw) - b * jnp.sin(vehicle.yaw)
    y = vehicle.y + a * jnp.sin(vehicle.yaw) + b * jnp.cos(vehicle.yaw)
    return jnp.min(distance_at(field, jnp.stack([x, y], -1)))

"""Walls of a map as boxes that can be seen and hit."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from whill_mjx.world.scene import Boxes


def nearest_walls(segments: jax.Array, x, y, count: int, height: float = 2.0, colour=(0.78, 0.76, 0.72)) -> Boxes:
    """The `count` segments (S, 2, 2) nearest to a point, as thin boxes that can be seen and hit.

    Each box lies behind its segment, outside of the free space. Fewer than `count` segments leave unused boxes.
    """
    thickness = 0.1
    start, end = segments[:, 0], segments[:, 1]
    way = end - start
    length = jnp.linalg.norm(way, axis=-1)
    share = jnp.clip(((x - start[:, 0]) * way[:, 0] + (y - start[:, 1]) * way[:, 1]) / length**2, 0.0, 1.0)
    foot = start + share[:, None] * way
    distance = jnp.hypot(foot[:, 0] - x, foot[:, 1] - y)
    used = min(count, segments.shape[0])
    _, index = jax.lax.top_k(-distance, used)
    index = jnp.concatenate([index, jnp.zeros(count - used, index.dtype)])
    direction = way[index] / length[index][:, None]
    right = jnp.stack([direction[:, 1], -direction[:, 0]], -1)
    middle = (start[index] + end[index]) / 2 + right * thickness / 2
    return Boxes(
        centre=jnp.concatenate([middle, jnp.full((count, 1), height / 2)], -1),
        half=jnp.stack([length[index] / 2, jnp.full(count, thickness / 2), jnp.full(count, height / 2)], -1),
        yaw=jnp.arctan2(direction[:, 1], direction[:, 0]),
        colour=jnp.broadcast_to(jnp.asarray(colour, jnp.float32), (count, 3)),
        mask=jnp.arange(count) < used,
    )

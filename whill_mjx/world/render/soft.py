"""A smooth image for calibration: differentiable with respect to camera pose, intrinsics, and places of boxes.

`render` has no useful gradient: a pixel shows one thing or the other. Here each thing covers a ray by a share that
falls smoothly across its edge, and nearer things hide farther ones smoothly, so that forward and reverse mode give the
derivative of what is computed. Kinks remain at the corners of an outline, where two faces of one box meet, and where a
face is seen edge-on. Flat colours; upright boxes, marker and blocks; no textures.
"""

from __future__ import annotations

from functools import partial
from itertools import combinations
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from whill_mjx.world.render.camera import Intrinsics, pixel_rays
from whill_mjx.world.render.tables import parts_of
from whill_mjx.world.render.visibility import into_frame
from whill_mjx.world.scene import Looks, Scene

SIGNS = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)], np.float32)
"""Of the eight corners of a box."""
EDGES = np.array([(a, b) for a, b in combinations(range(8), 2) if np.abs(SIGNS[a] - SIGNS[b]).sum() == 2])
SKY_DEPTH = 100.0
"""Depth at which the sky stands [m]."""


def render_soft(
    position: jax.Array,
    rotation: jax.Array,
    intrinsics: Intrinsics,
    scene: Scene,
    softness: float = 0.5,
    order: float = 60.0,
) -> tuple[jax.Array, jax.Array]:
    """Image (H, W, 3) float in [0, 1] and depth (H, W) [m], both smooth functions of the camera.

    Args:
        position, rotation, intrinsics, scene: as `render`.
        softness: scale over which an edge fades [pixels].
        order: how sharply a thing hides those behind it: by (depth ratio)^order.

    Raises:
        ValueError: the scene has cylinders or capsules.
    """
    parts, looks = parts_of(scene), scene.looks
    if parts.rounds is not None:
        raise ValueError("the smooth image knows no cylinders and capsules; use render_frame, or leave them out.")
    boxes = parts.boxes
    c, s, zero = jnp.cos(boxes.yaw), jnp.sin(boxes.yaw), jnp.zeros_like(boxes.yaw)
    frames = jnp.stack([c, -s, zero, s, c, zero, zero, zero, zero + 1.0], 1).reshape(-1, 3, 3)
    kinds = [Thing(boxes.centre, boxes.half, frames, boxes.colour, boxes.mask)]
    if parts.blocks is not None:
        blocks = parts.blocks
        kinds.append(Thing(blocks.centre, blocks.half, blocks.rotation, blocks.colour, blocks.mask))
    things = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *kinds)

    size = intrinsics.height, intrinsics.width
    row, column = (jax.lax.broadcasted_iota(jnp.float32, size, axis) for axis in (0, 1))
    u, v = pixel_rays(intrinsics, row, column)
    way = jnp.stack([u, v, jnp.ones_like(u)], -1) @ rotation.T  # (H, W, 3)

    blur = intrinsics.fy / softness
    one_thing = partial(_thing, way, position, looks, blur)
    cover, colour, depth = jax.vmap(one_thing)(things)  # (P, H, W), (P, H, W, 3), (P, H, W)
    back, ground = _behind(way, position, looks, blur)

    cover = jnp.concatenate([cover, jnp.ones_like(ground)[None]])
    place = order * jnp.log(jnp.concatenate([depth, jnp.full_like(ground, SKY_DEPTH)[None]]))

    def seen(own, at):
        """Share of one thing that no nearer thing hides."""
        hidden = cover * jax.nn.sigmoid(at - place)
        return own * jnp.prod(1.0 - hidden, 0) / (1.0 - 0.5 * own)  # without hiding itself

    share = jax.vmap(seen)(cover, place)
    share = share / jnp.sum(share, 0)
    image = jnp.sum(share[..., None] * jnp.concatenate([colour, back[None]]), 0)
    return jnp.clip(image, 0.0, 1.0), jnp.sum(share * jnp.concatenate([depth, ground[None]]), 0)


class Thing(NamedTuple):
    """A box of any rotation."""

    centre: jax.Array  # (3,) m
    half: jax.Array  # (3,) m
    frame: jax.Array  # (3, 3) world to box
    colour: jax.Array  # (3,)
    mask: jax.Array  # () bool, whether it is there


def _thing(way, position, looks: Looks, blur, thing: Thing) -> tuple[jax.Array, ...]:
    """Cover (H, W) of the rays by one box, its colour (H, W, 3) and depth (H, W) [m]."""
    centre, half, frame, colour, mask = thing
    ray = into_frame(frame, way)
    ray = jnp.where(jnp.abs(ray) < 1e-6, 1e-6, ray)
    middle = into_frame(frame, centre - position) / ray
    reach = jnp.abs(half / ray)
    near = jnp.max(middle - reach, -1)
    axis = jnp.argmax(middle - reach, -1)
    facing = -jnp.sign(jnp.take_along_axis(ray, axis[..., None], -1)[..., 0])
    sun = into_frame(frame, looks.sun)[axis] * facing
    light = looks.ambient + looks.diffuse * jnp.maximum(sun, 0.0)
    inside = _angle_inside(into_frame(frame, position - centre), half, ray) * blur
    cover = jnp.where(mask, jax.nn.sigmoid(jnp.clip(inside, -30.0, 30.0)), 0.0)
    return cover, light[..., None] * colour, jnp.maximum(near, 0.02)


def _behind(way, position, looks: Looks, blur) -> tuple[jax.Array, jax.Array]:
    """Colour (H, W, 3) of ground and sky behind all things, and the ground's depth (H, W) [m]."""
    ground = jnp.where(way[..., 2] < -1e-3, -position[2] / jnp.minimum(way[..., 2], -1e-3), SKY_DEPTH)
    lit = looks.ambient + looks.diffuse * jnp.maximum(looks.sun[2], 0.0)
    height_of = jnp.clip(way[..., 2] / jnp.linalg.norm(way, axis=-1), 0.0, 1.0)[..., None]
    sky = looks.sky_horizon + height_of * (looks.sky_zenith - looks.sky_horizon)
    below = jax.nn.sigmoid(-blur * way[..., 2])[..., None]
    return below * jnp.mean(looks.ground, 0) * lit + (1.0 - below) * sky, jnp.clip(ground, 0.02, SKY_DEPTH)


def _angle_inside(eye: jax.Array, half: jax.Array, ray: jax.Array) -> jax.Array:
    """Angle (H, W) by which rays pass inside the outline of a box, negative outside [rad, small angles].

    Everything is in the box's own axes: the eye (3,), half sizes (3,) and rays (H, W, 3). An edge is in the outline
    where one of its two faces is turned to the eye and the other is not; it spans a plane with the eye.
    """
    corners = SIGNS * half - eye  # (8, 3)
    front = SIGNS * eye > half  # (8, 3): is the face of this axis and side turned to the eye?
    one, other = EDGES.T
    # A face of an edge lies on one of the two axes on which its ends agree.
    axes = np.array([[axis for axis in range(3) if SIGNS[a][axis] == SIGNS[b][axis]] for a, b in EDGES])
    outline = front[one, axes[:, 0]] != front[one, axes[:, 1]]  # (12,)
    normal = jnp.cross(corners[one], corners[other])
    normal = normal * jax.lax.rsqrt(jnp.sum(normal * normal, 1, keepdims=True) + 1e-12)
    normal = normal * jnp.sign(-(normal @ eye))[:, None]  # towards the middle of the box
    angle = ray @ normal.T / jnp.linalg.norm(ray, axis=-1, keepdims=True)  # (H, W, 12)
    return jnp.min(jnp.where(outline, angle, jnp.pi / 2), -1)

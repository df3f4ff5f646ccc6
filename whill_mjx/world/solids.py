"""Things besides upright boxes: boxes of any rotation, which are only seen, and cylinders and capsules, which are hit.

All are of fixed number.
"""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct


@struct.dataclass
class Blocks:
    """K boxes of any rotation; one of hardly any thickness is a flat marker or a poster."""

    centre: jax.Array  # (K, 3) m
    half: jax.Array  # (K, 3) half sizes along the block's own axes [m]
    rotation: jax.Array  # (K, 3, 3) own axes to world
    colour: jax.Array  # (K, 3)
    mask: jax.Array  # (K,) bool: False is neither seen nor casts a shadow


@struct.dataclass
class Rounds:
    """K cylinders and capsules (people, posts); a capsule of half length 0 is a ball."""

    centre: jax.Array  # (K, 3) m
    axis: jax.Array  # (K, 3) unit vector
    half: jax.Array  # (K,) half length of the axis without a capsule's round ends [m]
    radius: jax.Array  # (K,) m
    capsule: jax.Array  # (K,) bool: round ends; False is a cylinder with flat ends
    colour: jax.Array  # (K, 3)
    mask: jax.Array  # (K,) bool


@struct.dataclass
class Solids:
    """Blocks and rounds of a scene; None where there are none."""

    blocks: Blocks | None = None
    rounds: Rounds | None = None


def block(centre, half, rotation, colour) -> Blocks:
    """One box of any rotation."""
    leaves = [jnp.asarray(value, jnp.float32)[None] for value in (centre, half, rotation, colour)]
    return Blocks(leaves[0], leaves[1], leaves[2], leaves[3], mask=jnp.ones(1, bool))


def rod(start, end, radius, colour, capsule: bool = True) -> Rounds:
    """One capsule (or cylinder) whose axis runs from `start` (3,) to `end` (3,); equal ends make a ball."""
    start, end = jnp.asarray(start, jnp.float32), jnp.asarray(end, jnp.float32)
    along = end - start
    length = jnp.linalg.norm(along)
    axis = jnp.where(length > 1e-6, along / jnp.maximum(length, 1e-6), jnp.array([0.0, 0.0, 1.0]))
    return Rounds(
        ((start + end) / 2)[None],
        axis[None],
        (length / 2)[None],
        jnp.asarray(radius, jnp.float32)[None],
        jnp.full(1, capsule),
        jnp.asarray(colour, jnp.float32)[None],
        jnp.ones(1, bool),
    )


def check_sizes(**sizes: Any) -> None:
    """Raise ValueError for sizes in plain numbers that are not above 0 and finite."""
    for name, size in sizes.items():
        if isinstance(size, int | float) and not 0.0 < size < math.inf:
            raise ValueError(f"{name} is {size:g} m; it must be above 0 and finite. Give a positive size.")


def post(x, y, height, radius, colour) -> Rounds:
    """One cylinder standing on the ground; ValueError for a size in plain numbers that is not above 0."""
    check_sizes(height=height, radius=radius)
    x, y, height = (jnp.asarray(value, jnp.float32) for value in (x, y, height))
    return rod(jnp.stack([x, y, 0.0 * height]), jnp.stack([x, y, height]), radius, colour, capsule=False)


CLOTHES, TROUSERS, SKIN = (0.25, 0.30, 0.45), (0.16, 0.17, 0.22), (0.80, 0.62, 0.50)


def person(x, y, height=1.7, clothes=CLOTHES, trousers=TROUSERS, skin=SKIN) -> Rounds:
    """Somebody standing at (x, y): legs, trunk and head as three capsules. A `Rounds` with K = 3."""
    x, y, height = (jnp.asarray(value, jnp.float32) for value in (x, y, height))

    def at(share):
        return jnp.stack([x, y, share * height])

    return stack_rounds([
        rod(at(0.06), at(0.44), 0.085 * height, trousers),
        rod(at(0.56), at(0.74), 0.125 * height, clothes),
        rod(at(0.91), at(0.935), 0.062 * height, skin),
    ])


def across(axis: jax.Array) -> jax.Array:
    """(K, 3) unit vectors square to the unit vectors `axis` (K, 3)."""
    x, y, z = axis[:, 0], axis[:, 1], axis[:, 2]
    flat = jnp.abs(x) < 0.9
    one = jnp.where(flat[:, None], jnp.stack([0.0 * x, z, -y], 1), jnp.stack([-z, 0.0 * y, x], 1))
    return one * jax.lax.rsqrt(jnp.sum(one * one, 1, keepdims=True))


def stack_rounds(rounds: list[Rounds]) -> Rounds:
    """The rounds of a list, one after the other."""
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *rounds)


def stack_blocks(blocks: list[Blocks]) -> Blocks:
    """The blocks of a list, one after the other."""
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *blocks)

"""Finish of a scene: textures, lamps and fog. A scene without one looks as `Looks` alone says.

Textures multiply a thing's own colour. They are named per label (see `whill_mjx.world.render`): 1 is the ground, 2
the goal marker, then the boxes, blocks and rounds in order.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

TEXTURES = ("plain", "cardboard", "tiles", "wood", "asphalt", "concrete", "brick")
"""Names of the procedural textures; their places are the numbers in `Finish.texture`."""
ATLAS = 16
"""Number of the first picture of the atlas."""


@struct.dataclass
class Finish:
    """Textures of L labels, M lamps and fog; one instance. Every leaf may differ between instances."""

    texture: jax.Array  # (L,) int32: place in TEXTURES, or ATLAS + picture
    scale: jax.Array  # (L,) edge of one repeat [m]; 0 fits one repeat to each face of a box or block
    lamp_position: jax.Array  # (M, 3) m
    lamp_colour: jax.Array  # (M, 3) light at 1 m distance; 0 switches a lamp off
    fog: jax.Array  # () 1/m; 0 is clear air
    fog_colour: jax.Array  # (3,)
    atlas: jax.Array | None = None  # (A, S, S) uint32 pictures from `make_atlas`; shared by all instances or not


def plain_finish(labels: int, lamps: int = 1) -> Finish:
    """Finish without textures, light of lamps, or fog. `labels` from `label_count`."""
    return Finish(
        texture=jnp.zeros(labels, jnp.int32),
        scale=jnp.ones(labels),
        lamp_position=jnp.tile(jnp.array([0.0, 0.0, 2.5]), (lamps, 1)),
        lamp_colour=jnp.zeros((lamps, 3)),
        fog=jnp.zeros(()),
        fog_colour=jnp.array([0.75, 0.78, 0.80]),
    )


def label_count(scene) -> int:
    """Number of labels of a scene: sky, ground, marker, boxes, blocks, rounds."""
    count = 3 + scene.boxes.yaw.shape[0] + (0 if scene.ghosts is None else scene.ghosts.yaw.shape[0])
    for part in (getattr(scene.solids, "blocks", None), getattr(scene.solids, "rounds", None)):
        count += 0 if part is None else part.mask.shape[0]
    return count


def texture_number(name: str) -> int:
    """Place of a texture in TEXTURES; ValueError names the known ones."""
    if name not in TEXTURES:
        raise ValueError(f"unknown texture {name!r} (known: {', '.join(TEXTURES)}; pictures are ATLAS + index).")
    return TEXTURES.index(name)


def make_atlas(pictures: Sequence[np.ndarray]) -> jax.Array:
    """(A, S, S) uint32 atlas of square pictures (S, S, 3) uint8, all of one size.

    Raises:
        ValueError: a picture of another shape or type.
    """
    for index, picture in enumerate(pictures):
        size = pictures[0].shape[0]
        if picture.shape != (size, size, 3) or picture.dtype != np.uint8:
            raise ValueError(
                f"picture {index} is {picture.shape} {picture.dtype}; an atlas needs ({size}, {size}, 3) uint8."
                " Resize or convert it."
            )
    stack = np.stack(pictures).astype(np.uint32)
    return jnp.asarray(stack[..., 0] | stack[..., 1] << 8 | stack[..., 2] << 16)

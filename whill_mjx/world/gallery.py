"""A furnished room that shows all that the camera can draw, and a walk through it."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from whill_mjx.world.materials import ATLAS, label_count, make_atlas, plain_finish, texture_number
from whill_mjx.world.render import camera_rotation, look_at
from whill_mjx.world.scene import BLUE, CARDBOARD, WALL, Marker, Scene, box, default_looks, stack_boxes
from whill_mjx.world.solids import Solids, block, person, post, rod, stack_blocks, stack_rounds

FLOOR_TILE = 0.6
"""Side of a floor tile, by its colour and by its grout [m]."""


def gallery() -> Scene:
    """Room with textured walls, boxes, people, posts, a poster, lamps and a little fog. Deterministic."""
    boxes = [
        ("cardboard", 0.0, box(3.6, 1.0, 0.6, 0.6, 0.6, jnp.array(CARDBOARD), 0.4)),
        ("cardboard", 0.0, box(5.4, -1.3, 0.5, 0.7, 0.9, jnp.array(CARDBOARD), -0.3)),
        ("concrete", 1.0, box(9.1, 0.0, 0.2, 5.2, 2.6, jnp.array(WALL))),
        ("brick", 1.2, box(3.5, -2.5, 11.0, 0.2, 2.6, jnp.array((0.62, 0.36, 0.28)))),
        ("wood", 1.0, box(3.5, 2.5, 11.0, 0.2, 2.6, jnp.array((0.66, 0.50, 0.34)))),
        ("concrete", 1.0, box(-2.1, 0.0, 0.2, 5.2, 2.6, jnp.array(WALL))),
    ]
    tilt = camera_rotation(0.6, 0.9, 0.3)
    blocks = [
        ("plain", 1.0, block((6.4, -0.4, 0.45), (0.3, 0.3, 0.3), tilt, (0.30, 0.55, 0.32))),
        (ATLAS, 0.0, block((4.6, -2.38, 1.5), (0.45, 0.01, 0.45), jnp.eye(3), (1.0, 1.0, 1.0))),
        (ATLAS, 0.0, block((2.2, 2.38, 1.5), (0.45, 0.01, 0.45), jnp.eye(3), (1.0, 1.0, 1.0))),
    ]
    rounds = stack_rounds([
        person(4.6, 0.1),
        person(6.8, 1.2, 1.8, (0.60, 0.20, 0.20)),
        person(7.4, -1.4, 1.6, (0.25, 0.45, 0.30)),
        post(2.6, -1.2, 1.0, 0.06, (0.90, 0.70, 0.10)),
        post(2.6, 1.9, 1.0, 0.06, (0.90, 0.70, 0.10)),
        rod((3.0, -0.5, 0.12), (3.5, -0.2, 0.12), 0.12, (0.20, 0.50, 0.80), capsule=False),
    ])
    marker = Marker(jnp.array([8.9, 0.3, 1.05]), jnp.array([0.02, 0.3, 0.3]), jnp.zeros(()), jnp.array(BLUE))
    solids = Solids(stack_blocks([part for *_, part in blocks]), rounds)
    looks = dataclasses.replace(default_looks(), tile=jnp.array(FLOOR_TILE))
    scene = Scene(stack_boxes([part for *_, part in boxes]), marker, looks, solids)
    named: list[tuple[Any, float]] = [("plain", 1.0), ("tiles", FLOOR_TILE), ("plain", 1.0)]
    named += [(name, scale) for name, scale, _ in boxes + blocks]
    labels = label_count(scene)
    named += [("plain", 1.0)] * (labels - len(named))
    numbers = [name if isinstance(name, int) else texture_number(name) for name, _ in named]
    finish = dataclasses.replace(
        plain_finish(labels, lamps=2),
        texture=jnp.array(numbers, jnp.int32),
        scale=jnp.array([scale for _, scale in named], jnp.float32),
        lamp_position=jnp.array([[3.0, 0.0, 2.4], [7.0, 0.0, 2.4]]),
        lamp_colour=jnp.array([[0.55, 0.50, 0.40], [0.40, 0.42, 0.50]]),
        fog=jnp.array(0.012),
        atlas=make_atlas([poster()]),
    )
    return dataclasses.replace(scene, finish=finish)


def poster(size: int = 64) -> np.ndarray:
    """(size, size, 3) uint8: a white arrow on green in a pale frame."""
    row, column = np.mgrid[:size, :size] / (size - 1.0)
    picture = np.full((size, size, 3), (235, 235, 225), np.uint8)
    inner = (np.abs(row - 0.5) < 0.42) & (np.abs(column - 0.5) < 0.42)
    picture[inner] = (20, 120, 60)
    shaft = (np.abs(row - 0.5) < 0.07) & (column > 0.2) & (column < 0.6)
    head = (column >= 0.55) & (column < 0.8) & (np.abs(row - 0.5) < 0.8 - column)
    picture[shaft | head] = (245, 245, 245)
    return picture


def walk(share: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Camera position (3,) and rotation (3, 3) at `share` in [0, 1] of the way through the gallery."""
    position = jnp.stack([-1.0 + 3.0 * share, -0.3 + 0.5 * jnp.sin(3.0 * share), 1.0 + 0.02 * jnp.sin(40.0 * share)])
    target = jnp.stack([jnp.array(7.0), 0.8 * jnp.sin(4.0 * share), jnp.array(0.8)])
    return position, look_at(position, target)

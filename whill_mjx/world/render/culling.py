"""Which primitives a part of the image can show: rectangles on the normalised image plane that hold each primitive.

The rectangles are conservative also for primitives that reach behind the camera, and they are taken before the lens
distorts, so that they hold for every lens.
"""

from __future__ import annotations

from functools import reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from whill_mjx.world.render.shading import View
from whill_mjx.world.scene import Boxes
from whill_mjx.world.solids import Blocks, Rounds, across

NEAREST = 1e-3
"""Depth at which primitives that reach behind the camera are cut off [m]."""
NOTHING = 1e9
"""Edge of an empty rectangle, and depth of what cannot be seen."""
LOWEST_SUN = 0.05
"""Shadows on the ground are as long as those of a sun this high at least (sine of its height)."""


@struct.dataclass
class Bounds:
    """Rectangles of P primitives, arrays (P,); one that cannot be seen is empty and at depth NOTHING."""

    low_u: jax.Array
    high_u: jax.Array
    low_v: jax.Array
    high_v: jax.Array
    near: jax.Array  # m: no point of it has less depth


Point = tuple[jax.Array, jax.Array, jax.Array]


class Body(NamedTuple):
    """P bodies by their centres and the ways from there to three faces: a corner is the centre and all three ways, each
    taken forwards or backwards."""

    centre: Point  # world x, y, z, each (P,)
    ways: tuple[Point, Point, Point]


class Eye(NamedTuple):
    """Where the camera is, and the sun where shadows are asked for."""

    position: Any  # (3,)
    rotation: Any  # (3, 3) camera to world
    sun: Any = None  # (3,) unit vector towards it


def upright_body(boxes: Boxes) -> Body:
    """Upright boxes."""
    c, s, zero = jnp.cos(boxes.yaw), jnp.sin(boxes.yaw), jnp.zeros_like(boxes.yaw)
    x, y, z = boxes.half.T
    return Body(tuple(boxes.centre.T), ((c * x, s * x, zero), (-s * y, c * y, zero), (zero, zero, z)))  # type: ignore


def block_body(blocks: Blocks) -> Body:
    """Blocks."""
    ways = [tuple((blocks.rotation[:, :, axis] * blocks.half[:, axis, None]).T) for axis in range(3)]
    return Body(tuple(blocks.centre.T), tuple(ways))  # type: ignore


def round_body(rounds: Rounds) -> Body:
    """The box around each round: square to its axis, as long as the round with its ends."""
    axis, one = rounds.axis, across(rounds.axis)
    long = rounds.half + jnp.where(rounds.capsule, rounds.radius, 0.0)
    sizes = (one, rounds.radius), (jnp.cross(axis, one), rounds.radius), (axis, long)
    return Body(tuple(rounds.centre.T), tuple(tuple((way * size[:, None]).T) for way, size in sizes))  # type: ignore


def upright_bounds(view: View, boxes: Boxes) -> Bounds:
    """Rectangles of upright boxes."""
    return bounds(Eye(view.position, view.rotation), upright_body(boxes), boxes.mask)


def bounds(eye: Eye, body: Body, mask: jax.Array) -> Bounds:
    """Rectangles of bodies; `mask` (P,). With a sun they hold the space in shadow too, down to the ground."""
    count = corner_count(eye)
    sides = corner_sides(eye, body, corner_signs(np.arange(count)[:, None], count))  # each (count, P)
    return shown_bounds(Sides(*(pick(one, 0) for pick, one in zip(ALL_OF, sides, strict=True))), mask)


def corner_count(eye: Eye) -> int:
    """Corners of a body, each also where the sun throws it on the ground."""
    return 8 if eye.sun is None else 16


def corner_signs(number, count: int) -> list:
    """Directions 1 or -1 of a corner along the three ways, by its number, and 1 or 0: thrown on the ground or not."""
    bits = [(number >> axis) & 1 for axis in range(4 if count > 8 else 3)]
    return [*(2.0 * bit - 1.0 for bit in bits[:3]), *(1.0 * bit for bit in bits[3:])]


class Sides(NamedTuple):
    """What corners and the edges that leave them add to a rectangle."""

    low_u: Any
    high_u: Any
    low_v: Any
    high_v: Any
    near: Any
    cut: Any  # float, 1 where an edge leads behind the camera


WIDER = (jnp.minimum, jnp.maximum, jnp.minimum, jnp.maximum, jnp.minimum, jnp.maximum)
"""Of two rectangles' Sides."""
ALL_OF = (jnp.min, jnp.max, jnp.min, jnp.max, jnp.min, jnp.max)
"""The same of many."""
NO_SIDES = Sides(NOTHING, -NOTHING, NOTHING, -NOTHING, NOTHING, 0.0)


def corner_sides(eye: Eye, body: Body, signs: list) -> Sides:
    """The corner of these signs, and where the edges from it to its neighbours pass the plane at NEAREST."""
    x, y, z = _corner(eye, body, signs)
    before = z >= NEAREST
    inverse = 1.0 / jnp.maximum(z, NEAREST)
    sides = [_sides(x * inverse, y * inverse, before)]
    cut = jnp.zeros_like(z)
    for axis, sign in enumerate(signs):
        other = [*signs[:axis], -sign if axis < 3 else 1.0 - sign, *signs[axis + 1 :]]
        x2, y2, z2 = _corner(eye, body, other)
        crosses = before & (z2 < NEAREST)  # an edge counts at its end before the camera
        share = (z - NEAREST) / jnp.maximum(z - z2, 1e-9)
        u, v = ((one + share * (end - one)) * (1.0 / NEAREST) for one, end in ((x, x2), (y, y2)))
        sides.append(_sides(u, v, crosses))
        cut = jnp.where(crosses, 1.0, cut)
    pairs = zip(WIDER[:4], zip(*sides, strict=True), strict=True)
    low_u, high_u, low_v, high_v = (reduce(pick, every) for pick, every in pairs)
    return Sides(low_u, high_u, low_v, high_v, jnp.where(before, z, NOTHING), cut)


def _corner(eye: Eye, body: Body, signs: list) -> tuple:
    """x, y, z of a corner in the camera's axes."""
    place = [
        body.centre[row] + signs[0] * body.ways[0][row] + signs[1] * body.ways[1][row] + signs[2] * body.ways[2][row]
        for row in range(3)
    ]
    if eye.sun is not None:
        fall = signs[3] * jnp.maximum(place[2], 0.0) / jnp.maximum(eye.sun[2], LOWEST_SUN)
        place = [place[row] - fall * eye.sun[row] for row in range(3)]
    way = [place[row] - eye.position[row] for row in range(3)]
    return tuple(
        way[0] * eye.rotation[0, axis] + way[1] * eye.rotation[1, axis] + way[2] * eye.rotation[2, axis]
        for axis in range(3)
    )


def _sides(u: jax.Array, v: jax.Array, used: jax.Array) -> tuple:
    """u and v as both ends of a rectangle, with some room for rounding; of nothing where not `used`."""
    sides = []
    for place in (u, v):
        slack = 1e-5 * (1.0 + jnp.abs(place))
        sides += [jnp.where(used, place - slack, NOTHING), jnp.where(used, place + slack, -NOTHING)]
    return tuple(sides)


def shown_bounds(sides: Sides, mask: jax.Array) -> Bounds:
    """The rectangles; empty where nothing is before the camera."""
    near = jnp.where(sides.cut > 0, 0.0, sides.near * (1.0 - 1e-5))
    shown = mask & (near < 0.5 * NOTHING)
    return Bounds(*(jnp.where(shown, one, nothing) for one, nothing in zip((*sides[:4], near), NO_SIDES, strict=False)))


class Members(NamedTuple):
    """Which of P primitives each upright strip of an image can show."""

    order: jax.Array  # (strips, P) int32: those first, then any
    used: jax.Array  # (strips,) int32: how many those are


def strip_members(view: View, body: Body, mask: jax.Array, strips: int) -> Members:
    """Bodies (P,) of each strip, in the order of their numbers. The last strip may reach beyond the image."""
    shown = _in_strips(bounds(Eye(view.position, view.rotation), body, mask), view, strips)
    shown |= mask & _around(view.position, body)
    number = jnp.broadcast_to(jnp.arange(shown.shape[1]), shown.shape)
    place = jnp.where(shown, jnp.cumsum(shown, 1) - 1, shown.shape[1])
    order = jnp.zeros(shown.shape, jnp.int32).at[jnp.arange(strips)[:, None], place].set(number, mode="drop")
    return Members(order, jnp.sum(shown, 1))


def _around(position: jax.Array, body: Body) -> jax.Array:
    """(P,) whether a place is within bodies, or so near that their rectangles, cut off at `NEAREST`, may miss them."""
    away = [position[axis] - body.centre[axis] for axis in range(3)]
    inside = jnp.ones(away[0].shape, bool)
    for way in body.ways:
        square = sum(part * part for part in way)
        along = sum(part * far for part, far in zip(way, away, strict=True))
        inside &= jnp.abs(along) <= square + 10.0 * NEAREST * jnp.sqrt(square)
    return inside


def _in_strips(boxes: Bounds, view: View, strips: int) -> jax.Array:
    """(strips, P) bool; with a distorting lens every strip can show all that the image can."""
    size = -(-view.intrinsics.width // strips)
    edges = jnp.arange(strips + 1) * float(size)
    intrinsics = view.intrinsics
    low, high = ((edge - intrinsics.cx) / intrinsics.fx for edge in (edges[:-1], edges[1:]))
    if intrinsics.distortion is not None:
        low, high = jnp.full_like(low, -NOTHING), jnp.full_like(high, NOTHING)
    return (boxes.low_u <= high[:, None]) & (boxes.high_u >= low[:, None]) & (boxes.near < NOTHING)


def strip_lists(boxes: Bounds, view: View, strips: int, keep: int) -> jax.Array:
    """(strips, keep) int32: the nearest boxes that each upright strip of the image can show; -1 is none.

    With a distorting lens the whole image is one strip.
    """
    near = jnp.where(_in_strips(boxes, view, strips), boxes.near, NOTHING)  # (strips, P)
    value, place = jax.lax.top_k(-near, keep)
    return jnp.where(value > -NOTHING, place, -1)

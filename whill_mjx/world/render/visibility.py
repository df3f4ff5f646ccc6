"""What a ray meets first: tests of upright boxes, blocks and rounds, shared by both renderers.

A pixel carries one integer through the loops over primitives: the bits of the nearest depth, with label and face in the
low bits, so that an integer minimum does the depth test. Depth is measured along the optical axis.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from whill_mjx.world.scene import Boxes
from whill_mjx.world.solids import Blocks, Rounds

SKY, GROUND, MARKER, FIRST_BOX = 0, 1, 2, 3
"""Labels of the segmentation; box i is FIRST_BOX + i, then come blocks and rounds."""
MAX_LABELS = 2048
FAR = 0x7F800000
"""Key of the sky: the bits of infinity."""
CURVED, FLAT_END = 0, 2
"""Faces of rounds."""


class Rays(NamedTuple):
    """Rays of some pixels; arrays of one shape. A ray's point at depth t is origin + t * direction."""

    u: jax.Array  # normalised image plane
    v: jax.Array
    x: jax.Array  # direction in the world
    y: jax.Array
    z: jax.Array
    inverse_z: jax.Array


def rays_of(rotation, u, v, invert: Callable | None = None) -> Rays:
    """Rays through points (u, v) of the image plane of a camera with `rotation` (3, 3) to the world."""
    x, y, z = (rotation[axis, 0] * u + rotation[axis, 1] * v + rotation[axis, 2] for axis in range(3))
    return Rays(u, v, x, y, z, (invert or reciprocal)(z + 1e-9))


def code_bits(labels: int) -> int:
    """Low bits of a key that hold 4 * label + face; at 10 they cost the depth a relative error of at most 1.3e-4.

    Raises:
        ValueError: more labels than MAX_LABELS, which would cost more than 1e-3.
    """
    if labels > MAX_LABELS:
        raise ValueError(
            f"scene has {labels - FIRST_BOX} boxes, blocks and rounds; labels allow {MAX_LABELS - FIRST_BOX}."
            " Merge or drop some, or keep those near the camera."
        )
    return max(10, (4 * labels - 1).bit_length())


def key_of(depth, code, bits: int = 10) -> jax.Array:
    """Depth and code in one int32 that sorts by depth: bits of positive floats sort like the numbers themselves."""
    return (jax.lax.bitcast_convert_type(depth, jnp.int32) & ~((1 << bits) - 1)) | code


def bits_to_float(bits: jax.Array) -> jax.Array:
    """The float32 of these bits."""
    return jax.lax.bitcast_convert_type(bits, jnp.float32)


def reciprocal(x: jax.Array) -> jax.Array:
    """1 / x to 2e-7 of normal numbers without a division, which XLA would not fuse on a CPU.

    A guess from the bits (within 7 %), a quadratic step (3e-5; minimax coefficients) and a Newton step.
    """
    guess = bits_to_float(np.int32(0x7EF00000) - jax.lax.bitcast_convert_type(x, jnp.int32))
    product = x * guess
    guess = guess * (3.0481951 + product * (-3.09533517 + product * 1.04711702))
    return guess + guess * (1.0 - x * guess)


def larger(x, y) -> jax.Array:
    """The larger of two numbers, y where one is NaN: an instruction of a processor, where `jnp.maximum` takes five."""
    return jnp.where(x > y, x, y)


def smaller(x, y) -> jax.Array:
    """The smaller of two numbers, y where one is NaN."""
    return jnp.where(x < y, x, y)


class Arithmetic(NamedTuple):
    """What processors and GPUs do fastest in different ways."""

    invert: Callable = reciprocal
    """x -> 1 / x."""
    larger: Callable = larger
    smaller: Callable = smaller


PROCESSOR = Arithmetic()


def face_normal(row, x, y, z) -> list:
    """Unit normal of a face at a point: that of a flat face, or the direction away from a round's axis."""
    dx, dy, dz = x - row[3], y - row[4], z - row[5]
    height = dx * row[0] + dy * row[1] + dz * row[2]
    height = jnp.minimum(jnp.maximum(height, -row[6]), row[6])
    curved = row[7] > 0
    away = ((dx - height * row[0]) * row[7], (dy - height * row[1]) * row[7], (dz - height * row[2]) * row[7])
    return [jnp.where(curved, bent, row[axis]) for axis, bent in enumerate(away)]


def into_frame(rotation: jax.Array, vector: jax.Array) -> jax.Array:
    """(..., 3) vectors of the world in frames with axes `rotation` (..., 3, 3): no matrix product, so that it fuses."""
    return sum(rotation[..., row, :] * vector[..., row, None] for row in range(3))  # type: ignore[return-value]


def _product(one: jax.Array, other: jax.Array) -> jax.Array:
    """(K, 3, 3) products of matrices (K, 3, 3) and (3, 3)."""
    return sum(one[:, :, row, None] * other[row] for row in range(3))  # type: ignore[return-value]


# Upright boxes: 12 numbers each.


def upright_table(position: jax.Array, rotation: jax.Array, boxes: Boxes) -> jax.Array:
    """(P, 12) numbers of each box: rows x and y of camera-to-box rotation, minus the camera centre, half sizes."""
    c, s = jnp.cos(boxes.yaw)[:, None], jnp.sin(boxes.yaw)[:, None]
    row_x = c * rotation[0] + s * rotation[1]
    row_y = c * rotation[1] - s * rotation[0]
    tiny = jnp.array([0.0, 0.0, 1e-7])  # no ray is exactly parallel to a face, so that 0 * inf cannot arise
    offset = boxes.centre - position
    middle_x = c[:, 0] * offset[:, 0] + s[:, 0] * offset[:, 1]
    middle_y = c[:, 0] * offset[:, 1] - s[:, 0] * offset[:, 0]
    middle = jnp.stack([middle_x, middle_y, offset[:, 2]], 1)
    half = jnp.where(boxes.mask[:, None], boxes.half, -1.0)  # a negative size is left before it is entered: no hit
    return jnp.concatenate([row_x + tiny, row_y + tiny, middle, half], 1)


def upright_key(rays: Rays, reach_z, numbers, code, bits: int = 10, how: Arithmetic = PROCESSOR) -> jax.Array:
    """Key of one upright box, FAR where the ray misses it: the slab test in the box's own frame.

    A box turned only about the vertical shows at most one of its two faces per axis: label and face are enough.
    `reach_z` is |inverse_z|, the same for all boxes.
    """
    ray_x, ray_y = _along(rays, numbers[:3]), _along(rays, numbers[3:6])
    both = how.invert(ray_x * ray_y)  # one reciprocal serves both axes
    inverse_x, inverse_y = both * ray_y, both * ray_x
    return _slabs((inverse_x, inverse_y, rays.inverse_z), reach_z, numbers[6:], (code, bits), how)


def _along(rays: Rays, axis) -> jax.Array:
    """Products of the rays with an axis in the camera's frame; what a row of pixels shares is summed first."""
    return axis[0] * rays.u + (axis[1] * rays.v + axis[2])


# Blocks: 15 numbers each.


def block_table(position: jax.Array, rotation: jax.Array, blocks: Blocks) -> jax.Array:
    """(K, 15) numbers of each block: rows of camera-to-block rotation, minus the camera centre, half sizes."""
    rows = _product(jnp.swapaxes(blocks.rotation, 1, 2), rotation)
    rows = rows + jnp.array([0.0, 0.0, 1e-7])
    middle = into_frame(blocks.rotation, blocks.centre - position)
    half = jnp.where(blocks.mask[:, None], blocks.half, -1.0)
    return jnp.concatenate([rows.reshape(-1, 9), middle, half], 1)


def block_key(rays: Rays, numbers, code, bits: int = 10, how: Arithmetic = PROCESSOR) -> jax.Array:
    """Key of one block of any rotation, FAR where the ray misses it."""
    x, y, z = (_along(rays, numbers[3 * i : 3 * i + 3]) for i in range(3))
    every = how.invert(x * y * z)
    inverse_z = every * x * y
    inverse = (every * y * z, every * x * z, inverse_z)
    return _slabs(inverse, jnp.abs(inverse_z), numbers[9:], (code, bits), how)


def _slabs(inverse, reach_z, numbers, name, how: Arithmetic):
    """Key from reciprocals of the ray in the box's frame; `numbers`: middle (3) and half sizes (3)."""
    code, bits = name
    inverse_x, inverse_y, inverse_z = inverse
    middle_x, middle_y, middle_z = numbers[0] * inverse_x, numbers[1] * inverse_y, numbers[2] * inverse_z
    reach_x, reach_y = numbers[3] * jnp.abs(inverse_x), numbers[4] * jnp.abs(inverse_y)
    reach_z = numbers[5] * reach_z
    near_x, near_y, near_z = middle_x - reach_x, middle_y - reach_y, middle_z - reach_z
    far = how.smaller(how.smaller(middle_x + reach_x, middle_y + reach_y), middle_z + reach_z)
    beside = how.larger(near_y, near_z)
    near = how.larger(how.larger(near_x, beside), 0.0)
    face = jnp.where(near_x > beside, 0, jnp.where(near_y > near_z, 1, 2))
    return jnp.where(near < far, key_of(near, code + face, bits), np.int32(FAR))


# Rounds: 12 numbers each.


def round_table(position: jax.Array, rotation: jax.Array, rounds: Rounds) -> jax.Array:
    """(K, 12) numbers of each round, in camera axes: axis, centre, and what the quadratic needs."""
    axis = into_frame(rotation, rounds.axis)
    centre = into_frame(rotation, rounds.centre - position)
    along, square = jnp.sum(axis * centre, 1), jnp.sum(centre * centre, 1)
    side = square - along * along
    beyond = jnp.maximum(jnp.abs(along) - rounds.half, 0.0)
    radius2 = rounds.radius**2
    inside = jnp.where(rounds.capsule, side + beyond**2 < radius2, (side < radius2) & (beyond == 0))
    inside = inside & rounds.mask
    radius2 = jnp.where(rounds.mask, radius2, -1e6)  # no ray meets it
    rest = jnp.stack([along, square, radius2, rounds.half, rounds.capsule, inside], 1)
    return jnp.concatenate([axis, centre, rest], 1)


def ray_square(rays: Rays) -> tuple[jax.Array, jax.Array]:
    """u^2 + v^2 + 1 of rays, and its inverse."""
    square = rays.u * rays.u + rays.v * rays.v + 1.0
    return square, reciprocal(square)


def round_key(rays: Rays, square, numbers, code, bits: int = 10, how: Arithmetic = PROCESSOR) -> jax.Array:
    """Key of one cylinder or capsule, FAR where the ray misses it. `square`: u^2 + v^2 + 1 and its inverse."""
    ray_axis, ray_centre = _along(rays, numbers[:3]), _along(rays, numbers[3:6])
    seen = RoundSeen(*(numbers[i] for i in range(6, 11)))
    length2, inverse = square
    distance, flat = round_distance(length2, inverse, ray_axis, ray_centre, seen, how)
    distance = jnp.where(numbers[11] > 0, 0.0, distance)
    hit = (distance < 1e9) & (distance >= 0)
    return jnp.where(hit, key_of(distance, code + jnp.where(flat, FLAT_END, CURVED), bits), np.int32(FAR))


class RoundSeen(NamedTuple):
    """A round as seen from the origin of rays."""

    along: jax.Array  # product of its centre with its axis [m]
    centre2: jax.Array  # square of its centre [m2]
    radius2: jax.Array  # squared radius [m2]
    half: jax.Array  # half length [m]
    capsule: jax.Array  # positive for round ends


def round_distance(square, inverse_square, ray_axis, ray_centre, seen: RoundSeen, how: Arithmetic = PROCESSOR):
    """Where rays enter a round, and whether through a flat end; 1e9 where they miss it, negative behind the origin.

    Args:
        square, inverse_square: product of the ray direction with itself, and its inverse.
        ray_axis, ray_centre: its products with the axis, and with the centre as seen from the ray's origin.
        seen: the round.
        how: arithmetic of the device.
    """
    along, centre2, radius2, half, capsule = seen
    a = how.larger(square - ray_axis * ray_axis, 1e-9)
    b = ray_centre - ray_axis * along
    c = centre2 - along * along - radius2
    root = b * b - a * c
    side = (b - jnp.sqrt(how.larger(root, 0.0))) * how.invert(a)
    height = side * ray_axis - along  # above the middle
    on_side = (root > 0) & (jnp.abs(height) <= half)
    end = jnp.where(height > 0, half, -half)  # a ray that enters beyond an end can only meet that end
    ball_b = ray_centre + end * ray_axis
    ball_c = centre2 + end * (2.0 * along + end) - radius2
    ball_root = ball_b * ball_b - square * ball_c
    ball = (ball_b - jnp.sqrt(how.larger(ball_root, 0.0))) * inverse_square
    disc = (along + end) * how.invert(jnp.where(jnp.abs(ray_axis) < 1e-7, 1e-7, ray_axis))
    off_axis = disc * (disc * square - 2.0 * ray_centre) + centre2 - end * end  # squared distance from the axis
    cap = jnp.where(capsule > 0, ball, disc)
    on_cap = (root > 0) & jnp.where(capsule > 0, ball_root > 0, off_axis <= radius2)
    return jnp.where(on_side, side, jnp.where(on_cap, cap, 1e9)), ~on_side & (capsule <= 0)


# Shadows: the same primitives met by rays towards the sun, from any point of the world.

SHADOW_GAP = 0.02
"""Casters nearer than this to a lit point are the surface itself [m]."""


def upright_shadow_table(sun: jax.Array, boxes: Boxes) -> jax.Array:
    """(P, 11) numbers of each box: cos, sin, minus the centre in its frame, inverse sun direction, half sizes."""
    c, s = jnp.cos(boxes.yaw), jnp.sin(boxes.yaw)
    x, y, z = boxes.centre.T
    direction = jnp.stack([c * sun[0] + s * sun[1], c * sun[1] - s * sun[0], jnp.broadcast_to(sun[2], c.shape)], 1)
    inverse = 1.0 / jnp.where(jnp.abs(direction) < 1e-6, 1e-6, direction)
    half = jnp.where(boxes.mask[:, None], boxes.half, -1.0)
    frame = jnp.stack([c, s, -(c * x + s * y), -(c * y - s * x), -z], 1)
    return jnp.concatenate([frame, inverse, half], 1)


def upright_shadow(x, y, z, numbers) -> jax.Array:
    """Bool: does one upright box stand between the point and the sun?"""
    own_x = numbers[0] * x + numbers[1] * y + numbers[2]
    own_y = numbers[0] * y - numbers[1] * x + numbers[3]
    return _slab_shadow((own_x, own_y, z + numbers[4]), numbers[5:8], numbers[8:11])


def block_shadow_table(sun: jax.Array, blocks: Blocks) -> jax.Array:
    """(K, 18) numbers of each block: world-to-block rows, minus the centre, inverse sun direction, half sizes."""
    into = jnp.swapaxes(blocks.rotation, 1, 2)
    offset = -into_frame(blocks.rotation, blocks.centre)
    direction = into_frame(blocks.rotation, sun)
    inverse = 1.0 / jnp.where(jnp.abs(direction) < 1e-6, 1e-6, direction)
    half = jnp.where(blocks.mask[:, None], blocks.half, -1.0)
    return jnp.concatenate([into.reshape(-1, 9), offset, inverse, half], 1)


def block_shadow(x, y, z, numbers) -> jax.Array:
    """Bool: does one block stand between the point and the sun?"""
    own = [numbers[3 * i] * x + numbers[3 * i + 1] * y + numbers[3 * i + 2] * z + numbers[9 + i] for i in range(3)]
    return _slab_shadow(own, numbers[12:15], numbers[15:18])


def _slab_shadow(own, inverse, half) -> jax.Array:
    middle = [-place * factor for place, factor in zip(own, inverse, strict=True)]
    reach = [size * abs(factor) for size, factor in zip(half, inverse, strict=True)]
    near = jnp.maximum(jnp.maximum(middle[0] - reach[0], middle[1] - reach[1]), middle[2] - reach[2])
    far = jnp.minimum(jnp.minimum(middle[0] + reach[0], middle[1] + reach[1]), middle[2] + reach[2])
    return jnp.maximum(near, SHADOW_GAP) < far


def round_shadow_table(sun: jax.Array, rounds: Rounds) -> jax.Array:
    """(K, 13) numbers of each round: centre, axis, squared radius, half length, kind, sun along axis, sun."""
    radius2 = jnp.where(rounds.mask, rounds.radius**2, -1e6)
    along = jnp.sum(rounds.axis * sun, 1)
    rest = jnp.stack([radius2, rounds.half, rounds.capsule, along], 1)
    return jnp.concatenate([rounds.centre, rounds.axis, rest, jnp.broadcast_to(sun, (along.shape[0], 3))], 1)


def round_shadow(x, y, z, numbers) -> jax.Array:
    """Bool: does one round stand between the point and the sun? `numbers` has 13 entries."""
    dx, dy, dz = numbers[0] - x, numbers[1] - y, numbers[2] - z
    along = dx * numbers[3] + dy * numbers[4] + dz * numbers[5]
    ray_centre = dx * numbers[10] + dy * numbers[11] + dz * numbers[12]
    centre2 = dx * dx + dy * dy + dz * dz
    seen = RoundSeen(along, centre2, numbers[6], numbers[7], numbers[8])
    distance, _ = round_distance(1.0, 1.0, numbers[9], ray_centre, seen)
    return (distance > SHADOW_GAP) & (distance < 1e8)

"""Camera image of one instance by ray casting: scene and camera pose -> (H, W, 3) uint8.

Camera axes: x right, y down, z forward. Depth is measured along the optical axis, not along the ray.

Written so that XLA fuses the loop over boxes into one kernel on CPUs and GPUs. A box turned only about the vertical
shows at most one of its two faces per axis, so label and face fit into ten bits. A pixel carries one integer through
the loop: the bits of the nearest depth with label and face in the low bits, so that an integer minimum does the depth
test. A face has one colour under a distant sun; it is looked up after the loop. There is no [P, H, W] array and no
division.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.scene import Boxes, Looks, Scene

SKY, GROUND, MARKER, FIRST_BOX = 0, 1, 2, 3
"""Labels of the segmentation; box i is FIRST_BOX + i."""
MAX_BOXES = 255 - FIRST_BOX
CODES = 1023
"""Low bits of a key that hold 4 * label + face; they cost the depth a relative error of at most 1.3e-4."""
FAR = 0x7F800000
"""Key of the sky: the bits of infinity."""
UNROLL = 8
"""Boxes tested in one loop round."""
SEAM = 0.35
"""Height over which boxes are darkened towards the ground, as by ambient occlusion [m]."""


@struct.dataclass
class Intrinsics:
    """Pinhole camera; pixel (row 0, column 0) has its centre at (0.5, 0.5)."""

    fx: jax.Array  # () focal lengths [pixels]
    fy: jax.Array
    cx: jax.Array  # () principal point [pixels]
    cy: jax.Array


@struct.dataclass
class Frame:
    """Image, depth and labels of one pass."""

    rgb: jax.Array  # (H, W, 3) uint8
    depth: jax.Array  # (H, W) m along the optical axis, inf for the sky
    label: jax.Array  # (H, W) uint8


def pinhole(fov_y: float, height: int = 64, width: int = 64) -> Intrinsics:
    """Intrinsics of a camera with square pixels and vertical field of view `fov_y` [rad]."""
    focal = 0.5 * height / jnp.tan(0.5 * fov_y)
    return Intrinsics(focal, focal, jnp.asarray(0.5 * width), jnp.asarray(0.5 * height))


def render(
    position: jax.Array, rotation: jax.Array, intrinsics: Intrinsics, scene: Scene, height: int = 64, width: int = 64
) -> jax.Array:
    """Image (H, W, 3) uint8 of one instance.

    Args:
        position: (3,) camera centre in the world [m].
        rotation: (3, 3) camera axes to world axes.
        intrinsics: focal lengths and principal point.
        scene: what is to be seen.
        height, width: static image size.

    Returns:
        The image. A camera inside a box sees that box at depth 0; a pose that is not finite gives a black image.
    """
    word, _ = _cast(position, rotation, intrinsics, scene, height, width)
    return _colours(word)


def render_frame(
    position: jax.Array, rotation: jax.Array, intrinsics: Intrinsics, scene: Scene, height: int = 64, width: int = 64
) -> Frame:
    """Image, depth and labels of one instance from the same pass; arguments as `render`.

    A pose that is not finite is labelled sky at depth inf.
    """
    word, depth = _cast(position, rotation, intrinsics, scene, height, width)
    return Frame(_colours(word), depth, (word >> 24).astype(jnp.uint8))


def _cast(position, rotation, intrinsics, scene: Scene, height: int, width: int) -> tuple[jax.Array, jax.Array]:
    """Word (H, W) uint32 with label, blue, green and red from the high byte to the low, and depth (H, W)."""
    finite = jnp.all(jnp.isfinite(position)) & jnp.all(jnp.isfinite(rotation))
    position = jnp.where(finite, position, jnp.array([0.0, 0.0, 1.0]))
    rotation = jnp.where(finite, rotation, jnp.eye(3))
    boxes = _with_marker(scene)
    # The barrier keeps XLA from computing the numbers of a box again in every pixel.
    table, faces = jax.lax.optimization_barrier(
        (_box_table(position, rotation, boxes), _face_words(position, boxes, scene.looks))
    )
    column = jax.lax.broadcasted_iota(jnp.float32, (height, width), 1)
    row = jax.lax.broadcasted_iota(jnp.float32, (height, width), 0)
    u = (column + (0.5 - intrinsics.cx)) * (1.0 / intrinsics.fx)
    v = (row + (0.5 - intrinsics.cy)) * (1.0 / intrinsics.fy)
    dx, dy, dz = (rotation[axis, 0] * u + rotation[axis, 1] * v + rotation[axis, 2] for axis in range(3))  # world
    inverse_z = _reciprocal(dz + 1e-9)
    ground = -position[2] * inverse_z
    key = _nearest_box(u, v, inverse_z, table)
    ground_key = jnp.where(ground > 0, _key(ground, 4 * GROUND), jnp.int32(FAR))
    box = key < ground_key
    code = key & CODES
    depth = jnp.where(box, _bits_to_float(key & ~CODES), jnp.where(ground > 0, ground, jnp.inf))
    word = jnp.where(box, faces.reshape(-1)[code], jnp.where(ground > 0, jnp.uint32(GROUND << 24), jnp.uint32(0)))
    word = _shade(word, depth, dx, dy, dz, position, scene.looks)
    return jnp.where(finite, word, jnp.uint32(0)), jnp.where(finite, depth, jnp.inf)


def _nearest_box(u, v, inverse_z, table) -> jax.Array:
    """Key (H, W) int32 of the nearest box face, FAR where there is none: a minimum over boxes in a few rounds."""
    rounds = max(2, -(-table.shape[0] // UNROLL))  # at least 2: a loop of one round is inlined, and no longer a kernel
    size = -(-table.shape[0] // rounds)
    padding = jnp.zeros((rounds * size - table.shape[0], table.shape[1])).at[:, 9:].set(-1.0)
    table = jnp.concatenate([table, padding])
    reach_z = jnp.abs(inverse_z)

    def one_round(index, key):
        first = index * size
        part = jax.lax.dynamic_slice(table, (first, 0), (size, table.shape[1]))
        for offset in range(size):
            key = jnp.minimum(key, _box_key(u, v, inverse_z, reach_z, part[offset], 4 * (first + offset + MARKER)))
        return key

    return jax.lax.fori_loop(0, rounds, one_round, jnp.full(u.shape, FAR, jnp.int32))


def _box_key(u, v, inverse_z, reach_z, numbers, code) -> jax.Array:
    """Key of one box, FAR where the ray misses it: the slab test in the box's own frame."""
    ray_x = numbers[0] * u + numbers[1] * v + numbers[2]
    ray_y = numbers[3] * u + numbers[4] * v + numbers[5]
    both = _reciprocal(ray_x * ray_y)  # one reciprocal serves both axes
    inverse_x, inverse_y = both * ray_y, both * ray_x
    middle_x, middle_y, middle_z = numbers[6] * inverse_x, numbers[7] * inverse_y, numbers[8] * inverse_z
    reach_x, reach_y = numbers[9] * jnp.abs(inverse_x), numbers[10] * jnp.abs(inverse_y)
    reach_z = numbers[11] * reach_z
    near_x, near_y, near_z = middle_x - reach_x, middle_y - reach_y, middle_z - reach_z
    far = jnp.minimum(jnp.minimum(middle_x + reach_x, middle_y + reach_y), middle_z + reach_z)
    near = jnp.maximum(jnp.maximum(near_x, near_y), jnp.maximum(near_z, 0.0))
    face = jnp.where(near_x > jnp.maximum(near_y, near_z), 0, jnp.where(near_y > near_z, 1, 2))
    return jnp.where(near < far, _key(near, code + face), jnp.int32(FAR))


def _key(depth, code) -> jax.Array:
    """Depth and code in one int32 that sorts by depth: bits of positive floats sort like the numbers themselves."""
    return (jax.lax.bitcast_convert_type(depth, jnp.int32) & ~CODES) | code


def _bits_to_float(bits: jax.Array) -> jax.Array:
    return jax.lax.bitcast_convert_type(bits, jnp.float32)


def _reciprocal(x: jax.Array) -> jax.Array:
    """1 / x to 2e-7 of normal numbers without a division, which XLA would not fuse on a CPU.

    A guess from the bits (within 7 %), a quadratic step (3e-5; minimax coefficients) and a Newton step.
    """
    guess = _bits_to_float(jnp.int32(0x7EF00000) - jax.lax.bitcast_convert_type(x, jnp.int32))
    product = x * guess
    guess = guess * (3.0481951 + product * (-3.09533517 + product * 1.04711702))
    return guess + guess * (1.0 - x * guess)


def _box_table(position: jax.Array, rotation: jax.Array, boxes: Boxes) -> jax.Array:
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


def _face_words(position: jax.Array, boxes: Boxes, looks: Looks) -> jax.Array:
    """(label, 4) uint32: label and colour of the x, y and z face that is turned to the camera."""
    c, s = jnp.cos(boxes.yaw), jnp.sin(boxes.yaw)
    offset = position - boxes.centre
    sun_x, sun_y = c * looks.sun[0] + s * looks.sun[1], c * looks.sun[1] - s * looks.sun[0]
    side_x, side_y = c * offset[:, 0] + s * offset[:, 1], c * offset[:, 1] - s * offset[:, 0]
    cosine = jnp.stack([
        jnp.where(side_x > 0, sun_x, -sun_x),
        jnp.where(side_y > 0, sun_y, -sun_y),
        jnp.where(offset[:, 2] > 0, looks.sun[2], -looks.sun[2]),
    ], 1)  # (P, 3)
    light = looks.ambient + looks.diffuse * jnp.maximum(cosine, 0.0)
    count = boxes.yaw.shape[0]
    label = jnp.arange(count, dtype=jnp.uint32)[:, None] + MARKER
    words = _pack(light[..., None] * boxes.colour[:, None, :], label)
    return jnp.zeros((count + MARKER, 4), jnp.uint32).at[MARKER:, :3].set(words)


def _shade(word, depth, dx, dy, dz, origin, looks: Looks):
    """Word of the visible surface: ground texture, grain and darker foot of the boxes, sky gradient."""
    label = word >> 24
    box, seen = label > GROUND, label > SKY
    depth = jnp.where(seen, depth, 0.0)
    x, y, z = origin[0] + depth * dx, origin[1] + depth * dy, origin[2] + depth * dz

    tile_x, tile_y = (x - looks.tile_offset[0]) / looks.tile, (y - looks.tile_offset[1]) / looks.tile
    odd = (jnp.floor(tile_x).astype(jnp.int32) + jnp.floor(tile_y).astype(jnp.int32)) & 1
    fine = 1.0 / (1.0 + 0.05 * depth * depth)  # texture finer than a pixel fades into its mean
    cell = jnp.where(box, 10.0, 10.0 / looks.tile)
    noise = _hash(x * cell + 0.37, y * cell + 0.59, jnp.where(box, z * 10.0 + 0.41, 0.0), looks.seed) - 0.5
    noise = 1.0 + 2.0 * jnp.where(box, looks.grain, looks.noise) * fine * noise
    foot = 0.72 + 0.28 * jnp.clip(z / SEAM, 0.0, 1.0)
    lit = looks.ambient + looks.diffuse * jnp.maximum(looks.sun[2], 0.0)
    mix = 0.5 + (odd.astype(jnp.float32) - 0.5) * (1.0 / (1.0 + 0.01 * depth * depth))
    height = jnp.clip(dz * jax.lax.rsqrt(dx * dx + dy * dy + dz * dz), 0.0, 1.0)

    channels = []
    for channel in range(3):
        paint = (word >> (8 * channel) & 255).astype(jnp.float32) * (foot / 255.0)
        tile = looks.ground[0, channel] + mix * (looks.ground[1, channel] - looks.ground[0, channel])
        sky = looks.sky_horizon[channel] + height * (looks.sky_zenith[channel] - looks.sky_horizon[channel])
        channels.append(jnp.where(box, paint * noise, jnp.where(seen, tile * (lit * noise), sky)))
    return _pack_channels(channels, label)


def _hash(x, y, z, seed) -> jax.Array:
    """Random number in [0, 1) of the unit cell around a point."""
    a, b, c = (jnp.floor(value).astype(jnp.int32).astype(jnp.uint32) for value in (x, y, z))
    mixed = (a * jnp.uint32(73856093)) ^ (b * jnp.uint32(19349663)) ^ (c * jnp.uint32(83492791)) ^ seed
    mixed = (mixed ^ (mixed >> 15)) * jnp.uint32(0x9E3779B1)
    mixed = (mixed ^ (mixed >> 13)) * jnp.uint32(0x85EBCA6B)
    return (mixed >> 8).astype(jnp.int32).astype(jnp.float32) * (1.0 / (1 << 24))


def _pack(colour: jax.Array, label: jax.Array) -> jax.Array:
    """Words (...) of colours (..., 3) in [0, 1]."""
    return _pack_channels([colour[..., channel] for channel in range(3)], label)


def _pack_channels(channels, label) -> jax.Array:
    word = label << 24
    for channel, value in enumerate(channels):
        level = (jnp.clip(value, 0.0, 1.0) * 255.0 + 0.5).astype(jnp.int32).astype(jnp.uint32)
        word = word | (level << (8 * channel))
    return word


def _colours(word: jax.Array) -> jax.Array:
    """(H, W, 3) uint8 of words (H, W). The barrier keeps the ray casting from being repeated for each channel."""
    word = jax.lax.optimization_barrier(word)
    return jax.lax.bitcast_convert_type(word, jnp.uint8)[..., :3]


def _with_marker(scene: Scene) -> Boxes:
    """Marker first, then the solid boxes, so that labels follow the order."""
    boxes, marker = scene.boxes, scene.marker
    if boxes.yaw.shape[0] > MAX_BOXES:
        raise ValueError(f"scene has {boxes.yaw.shape[0]} boxes; labels allow {MAX_BOXES}. Merge or drop some.")
    return Boxes(
        jnp.concatenate([marker.position[None], boxes.centre]),
        jnp.concatenate([marker.half[None], boxes.half]),
        jnp.concatenate([marker.yaw[None], boxes.yaw]),
        jnp.concatenate([marker.colour[None], boxes.colour]),
        jnp.concatenate([jnp.ones(1, bool), boxes.mask]),
    )

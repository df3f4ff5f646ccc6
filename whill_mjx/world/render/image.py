"""The camera in jnp, for any device: scene and camera pose of one instance -> image, depth, labels, normals.

Written so that XLA fuses the loop over boxes into one kernel on CPUs and GPUs. A flat face has one colour under a
distant sun; it is looked up after the loop. There is no [P, H, W] array and no division in the loop. On a processor
images are drawn in blocks (`blocks`), and the tables are complete before the first pixel.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from whill_mjx.devices import platform
from whill_mjx.world.render import visibility
from whill_mjx.world.render.blocks import IMAGES, in_blocks
from whill_mjx.world.render.camera import Intrinsics
from whill_mjx.world.render.culling import (
    Body,
    Members,
    block_body,
    round_body,
    strip_lists,
    strip_members,
    upright_body,
    upright_bounds,
)
from whill_mjx.world.render.rich import Everywhere, face_of_row
from whill_mjx.world.render.shading import Quality, View, cast, pack_channels, pixel_colours, pixel_view
from whill_mjx.world.render.tables import Parts, Tables, lit_words, make_tables, parts_of
from whill_mjx.world.render.visibility import FAR, GROUND, MARKER, SKY, Rays, face_normal, larger, smaller
from whill_mjx.world.scene import Scene

UNROLL = 8
"""Boxes tested in one loop round."""
MANY = 24
"""Primitives, with unused ones and the marker, from which a processor lists what each strip of an image can show."""
STRIPS, AT_ONCE = 16, 2
"""Upright strips at most, and how many primitives of a list are tested in one round of a loop."""
PLAIN = Quality()


@struct.dataclass
class Frame:
    """Image, depth and labels of one pass."""

    rgb: jax.Array  # (H, W, 3) uint8
    depth: jax.Array  # (H, W) m along the optical axis, inf for the sky
    label: jax.Array  # (H, W) uint8, or uint16 with more than 256 labels
    normal: jax.Array | None = None  # (H, W, 3) unit vector in the world, 0 for the sky; on request


def render(
    position: jax.Array,
    rotation: jax.Array,
    intrinsics: Intrinsics,
    scene: Scene,
    quality: Quality = PLAIN,
) -> jax.Array:
    """Image (H, W, 3) uint8 of one instance.

    Args:
        position: (3,) camera centre in the world [m].
        rotation: (3, 3) camera axes to world axes.
        intrinsics: focal lengths, principal point, distortion and image size.
        scene: what is to be seen.
        quality: static: anti-aliasing, shadows, culling.

    Returns:
        The image. A camera inside a box sees that box at depth 0; a pose that is not finite gives a black image.

    Raises:
        ValueError: more primitives than labels, or a finish of another scene.
    """
    view, finite = make_view(position, rotation, intrinsics, scene)
    return unpack_colours(_words(view, finite, _stage(view, scene, quality), quality))


def render_frame(
    position: jax.Array,
    rotation: jax.Array,
    intrinsics: Intrinsics,
    scene: Scene,
    quality: Quality = PLAIN,
    normals: bool = False,
) -> Frame:
    """Image, depth and labels of one instance from the same pass; arguments as `render`.

    Depth, labels and, with `normals`, normals are those at the pixel centres. A pose that is not finite is labelled sky
    at depth inf.
    """
    view, finite = make_view(position, rotation, intrinsics, scene)
    stage = _stage(view, scene, quality, normals)
    word = _words(view, finite, stage, quality)
    row, column = _grid(intrinsics)
    rays = pixel_view(view, stage, row, column)
    hit = cast(view, stage, rays)
    label = jnp.where(hit.solid, hit.code >> 2, jnp.where(hit.seen, GROUND, SKY))
    kind = jnp.uint8 if stage.labels <= 256 else jnp.uint16
    normal = None
    if normals:
        depth = jnp.where(hit.seen, hit.depth, 0.0)
        point = [view.position[i] + depth * way for i, way in enumerate((rays.x, rays.y, rays.z))]
        code = jnp.where(hit.solid, hit.code, jnp.where(hit.seen, 4 * GROUND, 0))
        normal = jnp.stack(face_normal(stage.row(code), *point), -1)
        normal = jnp.where(finite, normal, 0.0)
    return Frame(
        unpack_colours(word),
        jnp.where(finite, hit.depth, jnp.inf),
        jnp.where(finite, label, SKY).astype(kind),
        normal,
    )


def make_view(position, rotation, intrinsics: Intrinsics, scene: Scene) -> tuple[View, jax.Array]:
    """Numbers of one image, and whether its pose is finite; the pose of another is replaced."""
    finite = jnp.all(jnp.isfinite(position)) & jnp.all(jnp.isfinite(rotation))
    position = jnp.where(finite, position, jnp.array([0.0, 0.0, 1.0]))
    rotation = jnp.where(finite, rotation, jnp.eye(3))
    finish = scene.finish
    if finish is not None:
        finish = dataclasses.replace(finish, texture=None, scale=None, atlas=None)  # type: ignore[arg-type]
    lights = None if scene.rich is None else scene.rich.lights
    return View(position, rotation, intrinsics, scene.looks, finish, lights), finite


def unpack_colours(word: jax.Array) -> jax.Array:
    """(H, W, 3) uint8 of words (H, W). The barrier keeps the ray casting from being repeated for each channel."""
    word = jax.lax.optimization_barrier(word)
    return jax.lax.bitcast_convert_type(word, jnp.uint8)[..., :3]


def _words(view: View, finite: jax.Array, stage: Arrays, quality: Quality) -> jax.Array:
    """(H, W) uint32 colours of an image."""
    rows, columns = _grid(view.intrinsics)

    def drawn(stage: Arrays, row: jax.Array, column: jax.Array, view: View, finite: jax.Array) -> jax.Array:
        word = pack_channels(stage, pixel_colours(view, stage, quality, row, column))
        return jnp.where(finite, word, jnp.uint32(0))

    def some_rows(rows: jax.Array, column: jax.Array, view: View, finite: jax.Array, stage: Arrays) -> jax.Array:
        return drawn(stage, rows[:, None], column, view, finite)

    few, distorts = stage.parts.labels - MARKER < MANY, view.intrinsics.distortion is not None
    if platform() != "cpu" or few or distorts or stage.lists is not None:
        return in_blocks(some_rows)(rows[:, 0], columns, view, finite, stage)
    width = view.intrinsics.width
    size = -(-width // STRIPS)
    strips = -(-width // size)

    def some_strips(numbers: jax.Array, row: jax.Array, view: View, finite: jax.Array, stage: Arrays) -> jax.Array:
        members = jax.tree.map(lambda leaf: leaf[numbers], stage.members)
        column = numbers[:, None, None] * float(size) + jnp.arange(float(size))[:, None]
        return drawn(dataclasses.replace(stage, members=members), row, column, view, finite)

    stage = dataclasses.replace(stage, members=_members(view, stage.parts, strips))
    words = in_blocks(some_strips, 1)(jnp.arange(strips), rows[:, 0], view, finite, stage)
    return words.reshape(strips * size, -1)[:width].T


def _members(view: View, parts: Parts, strips: int) -> dict[str, Members]:
    """Of each kind of primitives, those that each strip can show."""
    found: dict[str, tuple[Body, jax.Array]] = {"upright": (upright_body(parts.boxes), parts.boxes.mask)}
    if parts.blocks is not None:
        found["block"] = block_body(parts.blocks), parts.blocks.mask
    if parts.rounds is not None:
        found["round"] = round_body(parts.rounds), parts.rounds.mask
    return {kind: strip_members(view, body, mask, strips) for kind, (body, mask) in found.items()}


def _grid(intrinsics: Intrinsics) -> tuple[jax.Array, jax.Array]:
    """Rows (H, 1) and columns (1, W): what a whole row or column shares is computed once."""
    return jnp.arange(float(intrinsics.height))[:, None], jnp.arange(float(intrinsics.width))[None, :]


def _stage(view: View, scene: Scene, quality: Quality, rows: bool = False) -> Arrays:
    """What every pixel meets."""
    parts = parts_of(scene)
    tables = make_tables(view, parts, scene, quality.shadows, rows)
    # The barrier keeps XLA from computing the numbers of a box again in every pixel.
    tables = jax.lax.optimization_barrier(tables)
    lists = None
    if quality.keep is not None and quality.keep < parts.boxes.yaw.shape[0]:
        seen = upright_bounds(view, parts.boxes)
        lists = jax.lax.optimization_barrier(strip_lists(seen, view, quality.strips, quality.keep))
    atlas = None if scene.finish is None else scene.finish.atlas
    return Arrays(parts, tables, lists, atlas, lit_words(scene))


@struct.dataclass
class Arrays(Everywhere):
    """The stage of the jnp renderer: tables are arrays, and every pixel meets every primitive of its strip."""

    parts: Parts
    tables: Tables
    lists: jax.Array | None  # (strips, keep) boxes of each strip, or None: all
    atlas: jax.Array | None
    lit_words: bool = struct.field(pytree_node=False)
    members: dict[str, Members] | None = None
    """What each strip can show: pixels are then (..., strips, columns, rows)."""

    @property
    def bits(self) -> int:
        return self.parts.bits

    @property
    def labels(self) -> int:
        return self.parts.labels

    @property
    def first_bent(self) -> int | None:
        return None if self.tables.bent is None else 4 * self.parts.first_round

    @property
    def picture(self) -> Any:
        return None if self.atlas is None else self._picture

    def nearest(self, rays: Rays) -> jax.Array:
        parts, tables, bits = self.parts, self.tables, self.bits
        first = {"upright": MARKER, "block": parts.first_block, "round": parts.first_round}
        square, reach_z = visibility.ray_square(rays), jnp.abs(rays.inverse_z)
        keys: dict[str, Callable] = {
            "upright": lambda numbers, code: visibility.upright_key(rays, reach_z, numbers, code, bits),
            "block": lambda numbers, code: visibility.block_key(rays, numbers, code, bits),
            "round": lambda numbers, code: visibility.round_key(rays, square, numbers, code, bits),
        }
        if self.members is not None:
            key = jnp.full(jnp.broadcast_shapes(*(one.shape for one in rays)), FAR, jnp.int32)
            for kind, members in self.members.items():
                key = _least_of_members(key, keys[kind], getattr(tables, kind), members, first[kind])
            return key
        if self.lists is None:
            key = _nearest_upright(rays, tables.upright, None, bits)
        else:
            key = _nearest_in_strips(rays, tables.upright, self.lists, bits)
        for kind in ("block", "round"):
            if (table := getattr(tables, kind)) is not None:
                key = _least(key, keys[kind], table, first[kind])
        return key

    def invert(self, x) -> jax.Array:
        return visibility.reciprocal(x)

    def ratio(self, x, y) -> jax.Array:
        return x / y

    def whole(self, x) -> jax.Array:
        """By the mantissa, within 2^22 of 0: XLA's conversion also minds NaN and overflow, which takes it longer."""
        floor = larger(smaller(jnp.floor(x), np.float32(2.0**22 - 1.0)), np.float32(-(2.0**22)))
        return jax.lax.bitcast_convert_type(floor + np.float32(1.5 * 2.0**23), jnp.int32) - np.int32(0x4B400000)

    def floor(self, x) -> jax.Array:
        return jnp.floor(x)

    def small(self, integer) -> jax.Array:
        return integer.astype(jnp.int32).astype(jnp.float32)

    def level(self, value) -> jax.Array:
        floor = jnp.floor(larger(smaller(value, 1.0), 0.0) * 255.0 + 0.5)
        return jax.lax.bitcast_convert_type(floor + np.float32(2.0**23), jnp.int32) & np.int32(255)

    def settle(self, values) -> Any:
        return jax.lax.optimization_barrier(values)

    def word(self, code) -> jax.Array:
        return self.tables.words.reshape(-1)[code]  # type: ignore[union-attr]

    def dark_word(self, code) -> jax.Array:
        return self.tables.dark.reshape(-1)[code]  # type: ignore[union-attr]

    def row(self, code) -> list:
        return list(jnp.moveaxis(self.tables.rows[code], -1, 0))  # type: ignore[index]

    def material(self, label) -> list:
        return list(jnp.moveaxis(self.tables.materials[label], -1, 0))  # type: ignore[index]

    def face(self, code, point: list, rays: Rays) -> tuple:
        return face_of_row(self.row(code), point, rays)

    def bent(self, place) -> list:
        return list(jnp.moveaxis(self.tables.bent[place], -1, 0))  # type: ignore[index]

    def shadow(self, x, y, z) -> jax.Array:
        tables = self.tables
        dark = _any_shadow(visibility.upright_shadow, tables.upright_shadow, x, y, z)
        if tables.block_shadow is not None:
            dark = dark | _any_shadow(visibility.block_shadow, tables.block_shadow, x, y, z)
        if tables.round_shadow is not None:
            dark = dark | _any_shadow(visibility.round_shadow, tables.round_shadow, x, y, z)
        return dark

    def _picture(self, number, s, t) -> list:
        count, size, _ = self.atlas.shape  # type: ignore[union-attr]
        row, column = ((jnp.clip(jnp.floor(c * size), 0, size - 1)).astype(jnp.int32) for c in (1.0 - t, s))
        index = jnp.clip(number.astype(jnp.int32), 0, count - 1)
        word = self.atlas.reshape(-1)[(index * size + row) * size + column]  # type: ignore[union-attr]
        return [(word >> (8 * channel) & 255).astype(jnp.float32) * (1.0 / 255.0) for channel in range(3)]


def _nearest_upright(rays: Rays, table, order, bits: int) -> jax.Array:
    """Key (H, W) int32 of the nearest upright box, FAR where there is none: a minimum over boxes in a few rounds.

    `order` (P,) int32 gives the box of each line of the table; None: its own place.
    """
    rounds = max(2, -(-table.shape[0] // UNROLL))  # at least 2: a loop of one round is inlined, and no longer a kernel
    size = -(-table.shape[0] // rounds)
    padding = jnp.zeros((rounds * size - table.shape[0], table.shape[1])).at[:, 9:].set(-1.0)
    table = jnp.concatenate([table, padding])
    if order is not None:
        order = jnp.concatenate([order, jnp.zeros(padding.shape[0], order.dtype)])

    def one_round(index, key):
        first, reach_z = index * size, jnp.abs(rays.inverse_z)
        part = jax.lax.dynamic_slice(table, (first, 0), (size, table.shape[1]))
        places = None if order is None else jax.lax.dynamic_slice(order, (first,), (size,))
        for offset in range(size):
            place = first + offset if places is None else places[offset]
            code = 4 * (place + MARKER)
            key = jnp.minimum(key, visibility.upright_key(rays, reach_z, part[offset], code, bits))
        return key

    return jax.lax.fori_loop(0, rounds, one_round, jnp.full(rays.x.shape, FAR, jnp.int32))


def _least(key: jax.Array, key_of_one: Callable, table: jax.Array, first: int) -> jax.Array:
    """Minimum of `key` and the keys of all lines of a table, labelled from `first` on. XLA does not unroll the loop."""

    def one(index, least):
        return jnp.minimum(least, key_of_one(table[index], 4 * (first + index)))

    return jax.lax.fori_loop(0, table.shape[0], one, key)


def _least_of_members(
    key: jax.Array, key_of_one: Callable, table: jax.Array, members: Members, first: int
) -> jax.Array:
    """Minimum of `key` (..., strips, columns, rows) and the keys of all that the strips can show, and perhaps of more.

    As many as the fullest strip of these images needs are compared; what is compared in vain misses the rays.
    """
    strips, count = members.order.shape
    order = jnp.pad(members.order, ((0, 0), (0, -count % AT_ONCE)))

    def one_round(number, key):
        places = jax.lax.dynamic_slice(order, (0, number * AT_ONCE), (strips, AT_ONCE))
        rows = table[places]
        for one in range(AT_ONCE):
            numbers = [rows[:, one, column, None, None] for column in range(table.shape[1])]
            key = jnp.minimum(key, key_of_one(numbers, 4 * (first + places[:, one, None, None])))
        return key

    fullest = jax.lax.pmax(jnp.max(members.used), IMAGES)
    return jax.lax.fori_loop(0, (fullest + AT_ONCE - 1) // AT_ONCE, one_round, key)


def _nearest_in_strips(rays: Rays, table, lists, bits: int) -> jax.Array:
    """The same, with the boxes of `lists` (strips, keep) alone in each upright strip; -1 is no box."""
    shape, width = rays.x.shape, rays.x.shape[-1]
    rays = Rays(*jnp.broadcast_arrays(*rays))
    strips = lists.shape[0]
    unused = jnp.zeros(table.shape[1]).at[9:].set(-1.0)
    tables = jnp.where((lists >= 0)[..., None], table[lists], unused)

    def cut(array):
        padded = jnp.pad(array.reshape(-1, width), ((0, 0), (0, -width % strips)), mode="edge")
        return jnp.moveaxis(padded.reshape(padded.shape[0], strips, -1), 1, 0)

    parts = jax.tree.map(cut, rays)
    keys = jax.vmap(lambda one, table, order: _nearest_upright(one, table, order, bits))(parts, tables, lists)
    return jnp.moveaxis(keys, 0, 1).reshape(keys.shape[1], -1)[:, :width].reshape(shape)


def _any_shadow(test, table, x, y, z) -> jax.Array:
    """Whether any primitive of a table (P, ...) hides the points from the sun."""
    none = jnp.zeros(x.shape, bool)
    return jax.lax.fori_loop(0, table.shape[0], lambda index, dark: dark | test(x, y, z, table[index]), none)

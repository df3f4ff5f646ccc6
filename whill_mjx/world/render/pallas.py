"""The camera as a Pallas kernel for NVIDIA GPUs (Triton): the same definition as `image.render`, with culling.

One program draws one tile. It compares the tile with the rectangles of 32 primitives at a time, one per lane, which
gives the bits of one integer; then it meets only the primitives whose bit is set. Of more than 32, those that lie
behind all that the tile already shows are left out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from whill_mjx.world.render import culling, visibility
from whill_mjx.world.render.camera import Intrinsics, pixel_rays
from whill_mjx.world.render.image import PLAIN, make_view, unpack_colours
from whill_mjx.world.render.rectangles import CHUNK, Kind, Listed, Numbers, listed
from whill_mjx.world.render.rich import BODY, CASTER, NUMBERS, caster_factor, caster_reach, face_of_body
from whill_mjx.world.render.shading import SAMPLES, Quality, View, pack_channels, pixel_colours
from whill_mjx.world.render.tables import bodies, lit_words, make_tables, parts_of, row_numbers
from whill_mjx.world.render.textures import whole
from whill_mjx.world.render.visibility import FAR, MARKER, Rays, key_of
from whill_mjx.world.scene import Scene

FOUR = 4
"""Numbers that a thread loads at once: 16 bytes."""


@dataclass(frozen=True)
class Tiling:
    """How the image is cut for the kernel, and how that is run. Static."""

    rows: int = 8
    """Rows of a tile; a power of two."""
    columns: int = 16
    """Columns of a tile; a power of two."""
    warps: int = 1
    """Warps of 32 threads that share a tile."""
    stages: int = 1
    """Software pipelining of the loads."""
    cull: bool = True
    """Compare tiles with rectangles; False meets every primitive."""
    fast: bool = True
    """Use the GPU's approximate reciprocal (1 unit in the last place), and sums instead of conversions to integers."""
    sort: bool = False
    """Bring more than 32 primitives of a kind into front-to-back order before. The images are the same; on an H200 the
    order costs more than it saves with 200 walls."""
    words: bool = False
    """Write four-byte words that XLA unpacks, instead of three bytes per pixel."""
    interpret: bool = False
    """Run the kernel on any device, slowly, to test."""

    def __post_init__(self) -> None:
        for name in ("rows", "columns", "warps"):
            value = getattr(self, name)
            if value < 1 or value & (value - 1):
                raise ValueError(f"tiling: {name} is {value}; Triton needs a power of two.")


@struct.dataclass
class Inputs:
    """Everything that the kernel reads."""

    floats: Any  # numbers of the view
    integers: Any  # (2,) seed, and whether the pose is finite
    words: Any  # (labels * 4,), or None
    dark: Any
    rows: Any  # lines of `row_numbers`, as `_flat` lays them
    bent: Any  # of 8
    atlas: Any  # (A * S * S,)
    kinds: dict[str, Listed]
    materials: Any = None  # of NUMBERS; None without rich looks
    bodies: Any = None  # of BODY, in place of rows


class Tile(NamedTuple):
    """A part of the image [pixels]."""

    top: jax.Array
    left: jax.Array
    shape: tuple[int, int]


def render_pallas(
    position: jax.Array,
    rotation: jax.Array,
    intrinsics: Intrinsics,
    scene: Scene,
    quality: Quality = PLAIN,
    tiling: Tiling | None = None,
) -> jax.Array:
    """Image (H, W, 3) uint8 of one instance, as `render` draws it; batch it by `vmap`.

    Args:
        position, rotation, intrinsics, scene, quality: as `render`; `quality.keep` has no meaning here,
            for nothing is left out.
        tiling: how the image is cut; None takes smaller tiles where a pixel needs more numbers.
    """
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton as plt

    tiling = tiling or _suitable_tiling(scene, quality)
    height, width = intrinsics.height, intrinsics.width
    inputs, rebuild = _inputs(position, rotation, intrinsics, scene, quality, tiling)
    leaves, tree = jax.tree.flatten(inputs)
    static = _static(scene, tiling)
    down, across = -(-height // tiling.rows), -(-width // tiling.columns)
    whole = height % tiling.rows == 0 and width % tiling.columns == 0

    def kernel(*refs):
        *read, out = refs
        tile = pl.program_id(0)
        top, left = tile // across * tiling.rows, tile % across * tiling.columns
        shape = (tiling.rows, tiling.columns)
        pixel = jax.lax.iota(jnp.int32, tiling.rows * tiling.columns)  # in a row: Triton moves no pixel between threads
        row, column = top + pixel // tiling.columns, left + pixel % tiling.columns
        data = jax.tree.unflatten(tree, read)
        view = rebuild(data)
        rows, columns = row.astype(jnp.float32), column.astype(jnp.float32)
        limits = _tile_limits(view, quality, rows, columns, Tile(top, left, shape))
        stage = Refs(data, limits, view, **static)
        colours = pixel_colours(view, stage, quality, rows, columns)
        word = jnp.where(data.integers[1] != 0, pack_channels(stage, colours), np.uint32(0))
        inside = None if whole else (row < height) & (column < width)
        _write(out, (row, column), word, inside, tiling.words)

    drawn = jax.ShapeDtypeStruct(
        (height, width) if tiling.words else (height, width, 3), jnp.uint32 if tiling.words else jnp.uint8
    )
    call = pl.pallas_call(
        kernel,
        out_shape=drawn,
        grid=(down * across,),
        compiler_params=plt.CompilerParams(num_warps=tiling.warps, num_stages=tiling.stages),
        interpret=tiling.interpret,
        name="camera",
    )
    image = call(*leaves)
    return unpack_colours(image) if tiling.words else image


def _suitable_tiling(scene: Scene, quality: Quality) -> Tiling:
    """Tiles whose numbers fit into the registers: the more a pixel needs, the fewer pixels share a thread."""
    if scene.rich is not None:
        return Tiling(8, 4)
    return Tiling(8, 8) if quality.antialias or quality.shadows else Tiling()


def _static(scene: Scene, tiling: Tiling) -> dict[str, Any]:
    """What the kernel knows when it is compiled."""
    return {
        "bits": parts_of(scene).bits,
        "lit_words": lit_words(scene),
        "atlas_shape": None if scene.finish is None or scene.finish.atlas is None else scene.finish.atlas.shape,
        "starts": _first_labels(scene),
        "fast": tiling.fast and not tiling.interpret,
        "interpret": tiling.interpret,
        "cull": tiling.cull,
        "row_numbers": row_numbers(scene),
    }


def _write(out: Any, here: tuple[Any, Any], word: jax.Array, inside: jax.Array | None, words: bool) -> None:
    """Write a tile's colours, as words or as three bytes a pixel; only those `inside` the image, if some are not."""
    from jax.experimental.pallas import triton as plt

    if words:
        plt.store(out.at[here], word, mask=inside)
        return
    for channel in range(3):
        level = (word >> np.uint32(8 * channel) & np.uint32(255)).astype(jnp.int32).astype(jnp.uint8)
        plt.store(out.at[(*here, channel)], level, mask=inside)


def _inputs(
    position, rotation, intrinsics, scene: Scene, quality: Quality, tiling: Tiling
) -> tuple[Inputs, Callable]:
    """Arrays for the kernel, and the function that makes the view of them there."""
    view, finite = make_view(position, rotation, intrinsics, scene)
    parts = parts_of(scene)
    tables = make_tables(view, parts, scene, quality.shadows)
    boxes, blocks, rounds = parts.boxes, parts.blocks, parts.rounds
    kinds = {"upright": Kind(tables.upright, boxes.mask, culling.upright_body(boxes), tables.upright_shadow)}
    if blocks is not None:
        kinds["block"] = Kind(tables.block, blocks.mask, culling.block_body(blocks), tables.block_shadow)
    if rounds is not None:
        kinds["round"] = Kind(tables.round, rounds.mask, culling.round_body(rounds), tables.round_shadow)
    eye = culling.Eye(view.position, view.rotation, scene.looks.sun)
    lists = {name: listed(eye, kind, tiling.sort, tiling.interpret) for name, kind in kinds.items()}

    seed = view.looks.seed.astype(jnp.uint32)
    integers = jnp.stack([jax.lax.bitcast_convert_type(seed, jnp.int32), finite.astype(jnp.int32)])
    leaves, tree = jax.tree.flatten(view)
    where_seed = next(i for i, leaf in enumerate(leaves) if leaf is view.looks.seed)
    shapes = [() if i == where_seed else jnp.shape(leaf) for i, leaf in enumerate(leaves)]
    leaves[where_seed] = jnp.zeros(())
    flat = [jnp.ravel(jnp.asarray(leaf, jnp.float32)) for leaf in leaves]

    def rebuild(data: Inputs) -> View:
        values, offset = [], 0
        for index, shape in enumerate(shapes):
            size = int(np.prod(shape))
            if index == where_seed:
                values.append(data.integers[0].astype(jnp.uint32))
            else:
                values.append(Numbers(data.floats, offset + np.arange(size).reshape(shape))[()])
            offset += size
        return jax.tree.unflatten(tree, values)

    atlas = None if scene.finish is None or scene.finish.atlas is None else scene.finish.atlas.reshape(-1)
    dark = None if tables.dark is None else tables.dark.reshape(-1)
    words = None if tables.words is None else tables.words.reshape(-1)
    rows = None if scene.rich is not None else _flat(tables.rows)
    own = None if scene.rich is None else _flat(bodies(parts))
    bent, materials, floats = _flat(tables.bent), _flat(tables.materials), jnp.concatenate(flat)
    return Inputs(floats, integers, words, dark, rows, bent, atlas, lists, materials, own), rebuild


def _first_labels(scene: Scene) -> dict[str, int]:
    parts = parts_of(scene)
    return {"upright": MARKER, "block": parts.first_block, "round": parts.first_round}


def _tile_limits(view: View, quality: Quality, row, column, tile: Tile) -> tuple:
    """Smallest and largest u and v of a tile: of its edges, or of its very rays where the lens distorts."""
    intrinsics = view.intrinsics
    if intrinsics.distortion is None:
        inverse_x, inverse_y = 1.0 / intrinsics.fx, 1.0 / intrinsics.fy
        u = [(tile.left + offset - intrinsics.cx) * inverse_x for offset in (0, tile.shape[1])]
        v = [(tile.top + offset - intrinsics.cy) * inverse_y for offset in (0, tile.shape[0])]
        return (*u, *v)
    limits = None
    for shift in SAMPLES if quality.antialias else ((0.5, 0.5),):
        ray_u, ray_v = pixel_rays(intrinsics, row, column, shift)
        new = (jnp.min(ray_u), jnp.max(ray_u), jnp.min(ray_v), jnp.max(ray_v))
        pairs = zip((jnp.minimum, jnp.maximum) * 2, limits or new, new, strict=True)
        limits = tuple(pick(old, other) for pick, old, other in pairs)
    return limits  # type: ignore[return-value]


def _each(hit: jax.Array, meet: Callable, carry: Any) -> Any:
    """`carry` after `meet(lane, carry)` for each of CHUNK lanes that `hit`."""
    lane = jax.lax.iota(jnp.int32, CHUNK)
    waiting = jnp.sum(jnp.where(hit, np.int32(1) << lane, np.int32(0)))

    def one(state):
        waiting, carry = state
        lowest = waiting & -waiting
        return waiting ^ lowest, meet(jax.lax.population_count(lowest - 1), carry)

    return jax.lax.while_loop(lambda state: state[0] != 0, one, (waiting, carry))[1]


def _steps(values: jax.Array, extreme: Callable) -> jax.Array:
    """A bound of lengths [m] from whole steps of 1/64 m, of which a warp finds the extreme in one instruction."""
    whole = extreme(jnp.floor(values * 64.0).astype(jnp.int32)) + (1 if extreme is jnp.max else 0)
    return whole.astype(jnp.float32) * (1.0 / 64.0)


def _flat(table: jax.Array | None) -> jax.Array | None:
    """The lines (K, n) of a table one after the other, each padded to whole FOURs."""
    return None if table is None else jnp.pad(table, ((0, 0), (0, -table.shape[1] % FOUR))).reshape(-1)


def _line(memory: Any, place: jax.Array, count: int) -> list:
    """The `count` numbers of line `place` (N,) in a `_flat` table, each (N,); FOUR are loaded at once."""
    wide, lane = count + -count % FOUR, jax.lax.iota(jnp.int32, FOUR)
    numbers = []
    for first in range(0, wide, FOUR):
        bits = jax.lax.bitcast_convert_type(memory[place[:, None] * wide + (first + lane)[None]], jnp.int32)
        for one in range(FOUR):  # a sum of integers: of one thread's four numbers it takes one, at no cost
            picked = jnp.sum(jnp.where(lane[None] == one, bits, 0), 1)
            numbers.append(jax.lax.bitcast_convert_type(picked, jnp.float32))
    return numbers[:count]


def _fast_reciprocal(x):
    """1 / x of the special-function unit; also right where the shared one overflows."""
    from jax.experimental.pallas import triton as plt

    [inverse] = plt.elementwise_inline_asm(
        "rcp.approx.ftz.f32 $0, $1;",
        args=[x],
        constraints="=f,f",
        pack=1,
        result_shape_dtypes=[jax.ShapeDtypeStruct(x.shape, x.dtype)],
    )
    return inverse


def fast_whole(x):
    """Largest integer not above x (|x| < 2^22), by the mantissa of x + 1.5 * 2^23.

    Conversions run at a quarter of the rate of a sum. Wrong for whole x, and only for compilers that keep the order of
    the sums, as Triton does.
    """
    return jax.lax.bitcast_convert_type(_shifted(x), jnp.int32) - np.int32(0x4B400000)


def fast_floor(x):
    """The same as float: for whole x it may be x - 1, as in `fast_whole`."""
    return _shifted(x) - np.float32(1.5 * 2.0**23)


def _shifted(x):
    return (x - 0.5) + np.float32(1.5 * 2.0**23)


def fast_small(integer):
    """An integer below 2^23 as float, by its place in the mantissa."""
    return visibility.bits_to_float(integer.astype(jnp.int32) | np.int32(0x4B000000)) - np.float32(2.0**23)


def fast_level(value):
    """The integer nearest to a value in [0, 255]."""
    return jax.lax.bitcast_convert_type(value + np.float32(2.0**23), jnp.int32) & np.int32(255)


@dataclass(frozen=True, eq=False)
class Refs:
    """The stage of the kernel: tables are references to global memory, and a tile meets only what it can show."""

    data: Inputs
    limits: tuple
    view: View
    bits: int
    lit_words: bool
    atlas_shape: tuple | None
    starts: dict[str, int]
    fast: bool
    interpret: bool
    cull: bool
    row_numbers: int

    @property
    def picture(self) -> Any:
        return None if self.atlas_shape is None else self._picture

    @property
    def first_bent(self) -> int | None:
        return None if self.data.bent is None else 4 * self.starts["round"]

    def nearest(self, rays: Rays) -> jax.Array:
        bits, how = self.bits, visibility.Arithmetic(self.invert, jnp.maximum, jnp.minimum)
        reach_z = jnp.abs(rays.inverse_z)
        square = visibility.ray_square(rays)
        tests = {
            "upright": partial(visibility.upright_key, rays, reach_z),
            "block": partial(visibility.block_key, rays),
            "round": partial(visibility.round_key, rays, square),
        }
        key = jnp.full(rays.u.shape, FAR, jnp.int32)
        for name, kind in self.data.kinds.items():

            def meet(place, least, name=name, kind=kind):
                numbers = [kind.table[place, j] for j in range(kind.table.shape[-1])]
                return jnp.minimum(least, tests[name](numbers, 4 * (self.starts[name] + place), bits, how))

            key = self._visit(kind.bounds, kind.order, meet, key, partial(self._farthest, rays))
        return key

    def _farthest(self, rays: Rays, key) -> jax.Array:
        """Key behind which the tile shows nothing more."""
        ground = -self.view.position[2] * rays.inverse_z
        ground_key = jnp.where(ground > 0, key_of(ground, 0, self.bits), np.int32(FAR))
        return jnp.max(jnp.minimum(key, ground_key))

    def _visit(self, bounds, order, meet, carry, farthest=None):
        """`carry` after `meet(place, carry)` for each primitive whose rectangle overlaps the tile."""
        from jax.experimental import pallas as pl

        chunks = bounds.shape[-1] // CHUNK
        low_u, high_u, low_v, high_v = self.limits

        def one_chunk(chunk, carry):
            lanes = pl.ds(chunk * CHUNK, CHUNK)
            hit = bounds[0, lanes] < 0.5 * culling.NOTHING
            if self.cull:
                hit = (bounds[0, lanes] <= high_u) & (bounds[1, lanes] >= low_u)
                hit = hit & (bounds[2, lanes] <= high_v) & (bounds[3, lanes] >= low_v)
            if self.cull and farthest is not None and chunks > 1:
                near = jax.lax.bitcast_convert_type(bounds[4, lanes], jnp.int32)
                hit = hit & (near <= farthest(carry))

            def one(number, carry):
                place = chunk * CHUNK + number
                return meet(place if order is None else order[place], carry)

            return _each(hit, one, carry)

        if chunks == 1:
            return one_chunk(0, carry)
        return jax.lax.fori_loop(0, chunks, one_chunk, carry)

    def word(self, code) -> jax.Array:
        return self.data.words[code]

    def dark_word(self, code) -> jax.Array:
        return self.data.dark[code]

    def row(self, code) -> list:
        return _line(self.data.rows, code, self.row_numbers)

    def material(self, label) -> list:
        return _line(self.data.materials, label, NUMBERS)

    def face(self, code, point: list, rays: Rays) -> tuple:
        return face_of_body(_line(self.data.bodies, code >> 2, BODY), code & 3, point, rays)

    def bent(self, place) -> list:
        return _line(self.data.bent, place, 8)

    def ratio(self, x, y) -> jax.Array:
        if jnp.ndim(y) == 0:
            return x * (1.0 / y)
        return x * self.invert(y)

    def invert(self, x) -> jax.Array:
        return _fast_reciprocal(x) if self.fast else visibility.reciprocal(x)

    def whole(self, x) -> jax.Array:
        return fast_whole(x) if self.fast else whole(x)

    def floor(self, x) -> jax.Array:
        return fast_floor(x) if self.fast else jnp.floor(x)

    def small(self, integer) -> jax.Array:
        return fast_small(integer) if self.fast else integer.astype(jnp.float32)

    def level(self, value) -> jax.Array:
        value = jnp.clip(value, 0.0, 1.0) * 255.0
        return fast_level(value) if self.fast else (value + 0.5).astype(jnp.int32)

    def settle(self, values) -> Any:
        return jax.lax.optimization_barrier(values) if self.interpret else values  # Triton needs none

    def shadow(self, x, y, z) -> jax.Array:
        tests = {name: getattr(visibility, f"{name}_shadow") for name in self.data.kinds}
        dark = jnp.zeros(x.shape, jnp.int32)
        for name, kind in self.data.kinds.items():

            def meet(place, dark, name=name, kind=kind):
                numbers = [kind.shadow[place, j] for j in range(kind.shadow.shape[-1])]
                return jnp.maximum(dark, tests[name](x, y, z, numbers).astype(jnp.int32))

            dark = self._visit(kind.shadow_bounds, None, meet, dark)
        return dark > 0

    def soft_shadow(self, casters: Numbers, x, y, z) -> jax.Array:
        lane, count = jax.lax.iota(jnp.int32, CHUNK), casters.shape[0]
        low, high = [_steps(one, jnp.min) for one in (x, y, z)], [_steps(one, jnp.max) for one in (x, y)]
        factor = jnp.ones_like(x)
        for first in range(0, count, CHUNK):
            here = jnp.minimum(first + lane, count - 1) * CASTER
            c = [casters.memory[int(casters.places[0, i]) + here] for i in range(CASTER)]
            hit = (first + lane < count) & (low[2] < c[6]) & (c[9] > 0.0)
            for axis, reach in enumerate(caster_reach(c)):
                hit = hit & (c[axis] - reach < high[axis]) & (c[axis] + reach > low[axis])

            def shade(place, factor, first=first):
                where = int(casters.places[0, 0]) + (first + place) * CASTER
                return factor * caster_factor([casters.memory[where + i] for i in range(CASTER)], x, y, z)

            factor = _each(hit, shade, factor)
        return factor

    def where_some(self, condition, compute: Callable, otherwise) -> Any:
        some = jnp.max(condition.astype(jnp.int32)) > 0
        return jax.lax.cond(some, lambda: jax.tree.map(jnp.asarray, compute()), lambda: otherwise)

    def _picture(self, number, s, t) -> list:
        count, size, _ = self.atlas_shape  # type: ignore[misc]
        row, column = ((jnp.clip(jnp.floor(c * size), 0, size - 1)).astype(jnp.int32) for c in (1.0 - t, s))
        index = jnp.clip(number.astype(jnp.int32), 0, count - 1)
        word = self.data.atlas[(index * size + row) * size + column]
        return [(word >> (8 * channel) & 255).astype(jnp.float32) * (1.0 / 255.0) for channel in range(3)]

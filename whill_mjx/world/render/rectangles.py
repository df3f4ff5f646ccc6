"""Rectangles of all primitives of an image, by a kernel for NVIDIA GPUs (Triton) with a primitive in each thread.

They are those of `culling.bounds`. XLA would compute all corners of a primitive anew for each of the five numbers of
its rectangle, or write them to memory.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from whill_mjx.world.render import culling

CHUNK = 32
"""Rectangles compared at once: the bits of an integer."""


@dataclass(frozen=True, eq=False)
class Numbers:
    """An array of numbers in memory; each is loaded where it is asked for, so that none waits in a register."""

    memory: Any
    places: np.ndarray

    @property
    def shape(self) -> tuple[int, ...]:
        return self.places.shape

    def __getitem__(self, index: Any) -> Any:
        places = self.places[index]
        return Numbers(self.memory, places) if np.ndim(places) else self.memory[int(places)]


class Kind(NamedTuple):
    """Solids of one kind: what the kernel reads of each, whether it is there, and of its shadow."""

    table: Any  # (N, numbers)
    mask: jax.Array
    body: culling.Body
    shadow: jax.Array | None


@struct.dataclass
class Listed:
    """Primitives of one kind: their numbers, and the rectangles that the tiles are compared with."""

    table: Any  # (P, n)
    bounds: Any  # (5, P padded to CHUNK): low u, high u, low v, high v, near
    order: Any  # (P padded,) int32 place in the table, front to back; None: as they are
    shadow: Any  # (P, m) numbers of the shadow test, or None
    shadow_bounds: Any  # (5, P padded) or None


def listed(eye: culling.Eye, kind: Kind, sort: bool, interpret: bool) -> Listed:
    """Rectangles of one kind, padded to whole chunks; with `sort` in front-to-back order where there are several."""
    count = kind.table.shape[0]
    sides, order = _rectangles(eye._replace(sun=None), kind, interpret), None
    if sort and count > CHUNK:
        order = jnp.argsort(sides[4]).astype(jnp.int32)  # the padding is at depth NOTHING
        sides = sides[:, order]
        order = jnp.minimum(order, count - 1)
    shadows = None if kind.shadow is None else _rectangles(eye, kind, interpret)
    return Listed(kind.table, sides, order, kind.shadow, shadows)


def _rectangles(eye: culling.Eye, kind: Kind, interpret: bool) -> jax.Array:
    """(5, P padded) `culling.bounds` of one kind."""
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton as plt

    body, extra = kind.body, -kind.mask.shape[0] % CHUNK
    lines = [*body.centre, *body.ways[0], *body.ways[1], *body.ways[2], kind.mask.astype(jnp.float32)]
    table = jnp.pad(jnp.stack(lines), ((0, 0), (0, extra)))
    given = [eye.position, eye.rotation.reshape(-1), *([] if eye.sun is None else [eye.sun])]
    count = culling.corner_count(eye)

    def kernel(table, pose, out):
        lanes = pl.ds(pl.program_id(0) * CHUNK, CHUNK)
        line = [table[i, lanes] for i in range(len(lines))]
        numbers = Numbers(pose, np.arange(12 if count == 8 else 15))
        sun = None if count == 8 else numbers[12:]
        own = culling.Eye(numbers[:3], Numbers(pose, np.arange(3, 12).reshape(3, 3)), sun)
        bodies = culling.Body(tuple(line[:3]), (tuple(line[3:6]), tuple(line[6:9]), tuple(line[9:12])))  # type: ignore

        def one(number, widest):
            signs = [sign.astype(jnp.float32) for sign in culling.corner_signs(number, count)]
            new = culling.corner_sides(own, bodies, signs)
            pairs = zip(culling.WIDER, widest, new, strict=True)
            return culling.Sides(*(pick(old, other) for pick, old, other in pairs))

        nothing = culling.Sides(*(jnp.full((CHUNK,), one, jnp.float32) for one in culling.NO_SIDES))
        sides = jax.lax.fori_loop(0, count, one, nothing)
        for i, leaf in enumerate(jax.tree.leaves(culling.shown_bounds(sides, line[12] > 0.0))):
            out[i, lanes] = leaf

    return pl.pallas_call(
        kernel,
        out_shape=jax.ShapeDtypeStruct((5, table.shape[1]), jnp.float32),
        grid=(table.shape[1] // CHUNK,),
        compiler_params=plt.CompilerParams(num_warps=1, num_stages=1),
        interpret=interpret,
        name="rectangles",
    )(table, jnp.concatenate(given))

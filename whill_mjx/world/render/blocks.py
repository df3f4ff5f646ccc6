"""Images on a processor: drawn block by block, so that what lies between two loops is computed once, and cached."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from whill_mjx.devices import platform

BLOCK = 16
"""Images of a block: of 64x64 pixels, a quarter of a megabyte for each number of a pixel."""
IMAGES = "images"
"""Name of the axis of the images of a block, for collective operations."""


def in_blocks(function: Callable[..., jax.Array], images: int = BLOCK) -> Callable[..., jax.Array]:
    """`function` (rows (H,), ...) -> (H, ...) of one image, on a processor in a loop over blocks.

    XLA joins all that is computed between two loops, and computes it anew wherever it is used: the tables of an image
    in each pixel, a pixel for each of its bytes. What enters a loop or leaves it is computed once. A block is a half of
    a single image, or several whole `images` under `vmap`. The result has no derivative.
    `function` gets every array as an argument: one that it closes over is lost under `vmap` of a loop.
    """
    if platform() != "cpu":
        return function

    @jax.custom_batching.custom_vmap
    def in_halves(rows: jax.Array, *args):  # type: ignore[no-untyped-def]
        size = -(-rows.shape[0] // 2)
        alone = jax.vmap(function, None, axis_name=IMAGES, axis_size=1)  # so that the axis has its name here too
        return _assembled(lambda first: alone(_part(rows, first, size), *args)[0], rows.shape[0], size)

    @in_halves.def_vmap
    def by_images(count: int, batched: list, *args):  # type: ignore[no-untyped-def]
        chosen = tuple(batched)
        every = jax.vmap(function, jax.tree.map(lambda one: 0 if one else None, chosen), axis_name=IMAGES)
        size = -(-count // max(2, -(-count // images)))  # a loop of one round is none to XLA

        def block(first: jax.Array) -> jax.Array:
            return every(*jax.tree.map(lambda leaf, one: _part(leaf, first, size) if one else leaf, args, chosen))

        return _assembled(block, count, size), True

    return lambda *args: in_halves(*jax.lax.stop_gradient(args))


def _part(leaf: jax.Array, first: jax.Array, size: int) -> jax.Array:
    return jax.lax.dynamic_slice_in_dim(leaf, first, size)


def _assembled(block: Callable[[jax.Array], jax.Array], count: int, size: int) -> jax.Array:
    """(count, ...) of which `block(first)` computes `size` from the place `first` on.

    A block is written in the round after its own: XLA would compute it within the write, which a single core does.
    """

    def first(number: jax.Array | int) -> jax.Array:
        return jnp.clip(number * size, 0, count - size)

    def write(whole: jax.Array, part: jax.Array, number: jax.Array | int) -> jax.Array:
        return jax.lax.dynamic_update_slice_in_dim(whole, part, first(number), 0)

    def one_round(number: jax.Array, carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        return write(carry[0], carry[1], number - 1), block(first(number))

    block = jax.jit(block, inline=True)  # traced for its shape, and not again in the loop
    like = jax.eval_shape(lambda: block(first(0)))
    empty = (jnp.zeros((count, *like.shape[1:]), like.dtype), jnp.zeros(like.shape, like.dtype))
    rounds = -(-count // size)
    whole, last = jax.lax.fori_loop(0, rounds, one_round, empty)
    return write(whole, last, rounds - 1)

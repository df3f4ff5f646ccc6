"""Convolution and max-pool, with gradients and an order of work that suit a CPU.

There, XLA turns the gradients of a convolution into convolutions that none of its libraries takes: with a reversed
window for the input, with a window as large as the image for the weight. Its plain loops then run at 0.3 GFLOP/s. The
forms here are a forward convolution and matrix products. Frames go through the layers a chunk at a time, and the
backward pass computes a chunk's layers again: that is cheaper than gigabytes of fresh memory in every update.
On other devices the frames go together and JAX's own gradients stay.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

CHUNK = 64
"""Most frames that go through the layers together on a CPU."""


def by_chunks(function: Callable[..., jax.Array], *arrays: jax.Array) -> jax.Array:
    """function(*arrays) for a function that treats the rows of its arguments (M, ...) alike and apart."""
    rows = arrays[0].shape[0]
    size = max(n for n in range(1, CHUNK + 1) if rows % n == 0)
    if jax.default_backend() != "cpu" or rows <= CHUNK or size < CHUNK // 4:
        return function(*arrays)
    chunks = [x.reshape(rows // size, size, *x.shape[1:]) for x in arrays]
    result = jax.lax.map(jax.checkpoint(lambda chunk: function(*chunk)), chunks)
    return result.reshape(rows, *result.shape[2:])


def conv(x: jax.Array, weight: jax.Array) -> jax.Array:
    """Stride-1 convolution with zero padding: (M, H, W, I) and (3, 3, I, O) of one type -> (M, H, W, O)."""
    return conv_on_cpu(x, weight) if jax.default_backend() == "cpu" else convolve(x, weight)


def block_max(x: jax.Array) -> jax.Array:
    """Largest of each block's four values: (M, H, W, 4, O) -> (M, H, W, O)."""
    return block_max_on_cpu(x) if jax.default_backend() == "cpu" else x.max(-2)


def convolve(x: jax.Array, weight: jax.Array) -> jax.Array:
    """`conv` with JAX's own gradients."""
    return jax.lax.conv_general_dilated(x, weight, (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC"))


@jax.custom_vjp
def conv_on_cpu(x: jax.Array, weight: jax.Array) -> jax.Array:
    """`conv` with gradients for a CPU."""
    return convolve(x, weight)


def _conv_forward(x: jax.Array, weight: jax.Array) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
    return convolve(x, weight), (x, weight)


def _conv_backward(residuals: tuple[jax.Array, jax.Array], cotangent: jax.Array) -> tuple[jax.Array, jax.Array]:
    x, weight = residuals
    turned = jnp.flip(weight, (0, 1)).swapaxes(2, 3)
    return convolve(cotangent, turned), _weight_gradient(x, cotangent).astype(weight.dtype)


conv_on_cpu.defvjp(_conv_forward, _conv_backward)


def _weight_gradient(x: jax.Array, cotangent: jax.Array) -> jax.Array:
    """(3, 3, I, O) from x (M, H, W, I) and cotangent (M, H, W, O).

    A block of 2x2 outputs sees 4x4 inputs, which are 2x2 blocks of the padded input: four products of all inputs with
    all outputs, of which the ones nine taps apart are wanted.
    """
    inputs, outputs = x.shape[-1], cotangent.shape[-1]
    odd = [n % 2 for n in x.shape[1:3]]
    x = jnp.pad(x, ((0, 0), (1, 1 + odd[0]), (1, 1 + odd[1]), (0, 0)))
    cotangent = blocks(jnp.pad(cotangent, ((0, 0), (0, odd[0]), (0, odd[1]), (0, 0))))
    height, width = cotangent.shape[1:3]
    x, flat = blocks(x), cotangent.reshape(-1, 4 * outputs)
    rows = [
        jnp.stack([
            jnp.matmul(x[:, a : a + height, b : b + width].reshape(-1, 4 * inputs).T, flat,
                       preferred_element_type=jnp.float32)
            for b in range(2)
        ])
        for a in range(2)
    ]
    table = jnp.stack(rows).reshape(2, 2, 2, 2, inputs, 2, 2, outputs)  # (a, b, da, db, I, p, q, O)
    table = jnp.swapaxes(table, 1, 2).reshape(4, 4, inputs, 2, 2, outputs)
    return sum((table[p : p + 3, q : q + 3, :, p, q] for p in range(2) for q in range(2)), jnp.zeros(()))


def blocks(x: jax.Array) -> jax.Array:
    """(M, H, W, C) -> (M, H / 2, W / 2, 4 C), ordered row, column, channel."""
    rows, height, width, channels = x.shape
    x = x.reshape(rows, height // 2, 2, width // 2, 2, channels)
    return jnp.swapaxes(x, 2, 3).reshape(rows, height // 2, width // 2, 4 * channels)


@jax.custom_vjp
def block_max_on_cpu(x: jax.Array) -> jax.Array:
    """`block_max` with a gradient for a CPU: one pass that compares again instead of several that count and divide."""
    return x.max(-2)


def _max_forward(x: jax.Array) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
    y = x.max(-2)
    return y, (x, y)


def _max_backward(residuals: tuple[jax.Array, jax.Array], cotangent: jax.Array) -> tuple[jax.Array]:
    x, y = residuals
    best = x == y[..., None, :]
    share = cotangent / jnp.sum(best, -2).astype(cotangent.dtype)
    return (jnp.where(best, share[..., None, :], 0),)


block_max_on_cpu.defvjp(_max_forward, _max_backward)

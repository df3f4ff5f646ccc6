"""Layers as pure functions on dicts of float32 arrays; products run in the type of their input."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from dreamer.layers.convolution import block_max, conv
from dreamer.layers.recurrence import keep
from dreamer.types import Params

NORM_EPS = 1e-4
TRUNCATION_GAIN = 1.1368
"""1 / standard deviation of a unit normal cut at +-2, so that the cut weights have the intended deviation."""


def init_weight(key: jax.Array, shape: tuple[int, ...], fan_in: int, outscale: float = 1.0) -> jax.Array:
    """Normal weights cut at two standard deviations, with standard deviation outscale / sqrt(fan_in)."""
    if outscale == 0.0:
        return jnp.zeros(shape, jnp.float32)
    gain = TRUNCATION_GAIN * outscale / fan_in**0.5
    return gain * jax.random.truncated_normal(key, -2.0, 2.0, shape, jnp.float32)


def init_linear(key: jax.Array, inputs: int, outputs: int, outscale: float = 1.0) -> Params:
    """Weight (inputs, outputs) and bias (outputs,)."""
    return {"w": init_weight(key, (inputs, outputs), inputs, outscale), "b": jnp.zeros((outputs,), jnp.float32)}


def init_block_linear(key: jax.Array, blocks: int, inputs: int, outputs: int) -> Params:
    """Weight (G, inputs / G, outputs / G) and bias (G, outputs / G). The fan-in is the full width, as in the source."""
    shape = (blocks, inputs // blocks, outputs // blocks)
    return {"w": init_weight(key, shape, inputs), "b": jnp.zeros((blocks, outputs // blocks), jnp.float32)}


def init_layer(key: jax.Array, inputs: int, outputs: int) -> Params:
    """Linear map followed by a norm."""
    return {**init_linear(key, inputs, outputs), "scale": jnp.ones((outputs,), jnp.float32)}


def init_conv(key: jax.Array, kernel: int, inputs: int, outputs: int, norm: bool = True) -> Params:
    """Kernel (K, K, inputs, outputs), bias and, if asked, norm scale."""
    weight = init_weight(key, (kernel, kernel, inputs, outputs), kernel * kernel * inputs)
    params = {"w": weight, "b": jnp.zeros((outputs,), jnp.float32)}
    return {**params, "scale": jnp.ones((outputs,), jnp.float32)} if norm else params


def init_mlp(key: jax.Array, inputs: int, units: int, layers: int) -> Params:
    """Layers named layer0, layer1, ..."""
    keys = jax.random.split(key, layers)
    return {f"layer{i}": init_layer(keys[i], inputs if i == 0 else units, units) for i in range(layers)}


def linear(params: Params, x: jax.Array) -> jax.Array:
    """x (..., inputs) @ w + b in the type of x."""
    return x @ params["w"].astype(x.dtype) + params["b"].astype(x.dtype)


def block_linear(params: Params, x: jax.Array) -> jax.Array:
    """(..., G, inputs / G) -> (..., G, outputs / G), each block with its own weight."""
    return block_product(x, params["w"].astype(x.dtype)) + params["b"].astype(x.dtype)


def block_product(x: jax.Array, weight: jax.Array) -> jax.Array:
    """(..., G, I) and (G, I, O) -> (..., G, O).

    On a CPU the blocks lead in the product, and its result is put in order before anything else reads it: left to
    itself, XLA reads it column by column in all that follows.
    """
    if jax.default_backend() != "cpu":
        return jnp.einsum("...gi,gio->...go", x, weight)
    rows = jnp.swapaxes(x.reshape(-1, *x.shape[-2:]), 0, 1)
    product = jnp.swapaxes(jnp.matmul(rows, weight), 0, 1)
    return jax.lax.optimization_barrier(product).reshape(*x.shape[:-1], weight.shape[-1])


def norm_act(x: jax.Array, scale: jax.Array) -> jax.Array:
    """SiLU(RMSNorm(x)) over the last axis; computed in float32, returned in the type of x."""
    wide = x.astype(jnp.float32)
    root = keep(jax.lax.rsqrt(jnp.mean(jnp.square(wide), -1, keepdims=True) + NORM_EPS))
    return jax.nn.silu(wide * root * scale.astype(jnp.float32)).astype(x.dtype)


def layer(params: Params, x: jax.Array) -> jax.Array:
    """Linear, RMSNorm, SiLU."""
    return norm_act(linear(params, x), params["scale"])


def mlp(params: Params, x: jax.Array) -> jax.Array:
    """All layers of `init_mlp` in turn."""
    for i in range(sum(name.startswith("layer") for name in params)):
        x = layer(params[f"layer{i}"], x)
    return x


def space_to_depth(x: jax.Array) -> jax.Array:
    """(..., H, W, C) -> (..., H / 2, W / 2, 4 C): each 2x2 block becomes channels, ordered row, column, channel."""
    *batch, height, width, channels = x.shape
    x = x.reshape(*batch, height // 2, 2, width // 2, 2, channels)
    return jnp.swapaxes(x, -4, -3).reshape(*batch, height // 2, width // 2, 4 * channels)


def depth_to_space(x: jax.Array) -> jax.Array:
    """The inverse of `space_to_depth`."""
    *batch, height, width, channels = x.shape
    x = x.reshape(*batch, height, width, 2, 2, channels // 4)
    return jnp.swapaxes(x, -4, -3).reshape(*batch, 2 * height, 2 * width, channels // 4)


def block_conv_weight(weight: jax.Array) -> jax.Array:
    """3x3 kernel on 2x2 blocks that equals a 5x5 kernel on pixels.

    The four outputs of a block see 6x6 pixels, which are exactly the 3x3 blocks around it.

    Args:
        weight: (5, 5, I, O).

    Returns:
        (3, 3, 4 I, 4 O), channels as `space_to_depth` orders them.
    """
    inputs, outputs = weight.shape[2:]
    shifted = [[jnp.pad(weight, ((p, 1 - p), (q, 1 - q), (0, 0), (0, 0))) for q in (0, 1)] for p in (0, 1)]
    wide = jnp.stack([jnp.stack(row) for row in shifted])  # (p, q, 6, 6, I, O)
    wide = wide.reshape(2, 2, 3, 2, 3, 2, inputs, outputs)  # (p, q, a, di, b, dj, I, O)
    return wide.transpose(2, 4, 3, 5, 6, 0, 1, 7).reshape(3, 3, 4 * inputs, 4 * outputs)


def upsample_conv_weight(weight: jax.Array) -> jax.Array:
    """3x3 kernel that equals nearest-neighbour doubling followed by a 5x5 kernel, at a third of the arithmetic.

    A doubled image repeats each pixel, so the five taps of an output fall on three input pixels: the taps that share
    an input pixel are summed. Even outputs take (0+1, 2+3, 4), odd ones (0, 1+2, 3+4).

    Args:
        weight: (5, 5, I, O).

    Returns:
        (3, 3, I, 4 O), the four outputs of a block ordered as `space_to_depth` orders them.
    """
    fold = jnp.array(
        [
            [[1, 1, 0, 0, 0], [0, 0, 1, 1, 0], [0, 0, 0, 0, 1]],
            [[1, 0, 0, 0, 0], [0, 1, 1, 0, 0], [0, 0, 0, 1, 1]],
        ],
        weight.dtype,
    )  # (phase, input pixel, tap)
    folded = jnp.einsum("pak,qbl,klio->abipqo", fold, fold, weight, precision="highest")
    return folded.reshape(3, 3, weight.shape[2], 4 * weight.shape[3])


def conv_pool(params: Params, blocks: jax.Array) -> jax.Array:
    """5x5 convolution, 2x2 max-pool, norm, SiLU of an image in block form: (M, H, W, 4 I) -> (M, H, W, O)."""
    outputs = params["w"].shape[-1]
    x = conv(blocks, block_conv_weight(params["w"]).astype(blocks.dtype))
    x = block_max(x.reshape(*x.shape[:-1], 4, outputs))
    return norm_act(x + params["b"].astype(x.dtype), params["scale"])


def conv_pool_pixels(params: Params, x: jax.Array) -> jax.Array:
    """`conv_pool` of an image in pixels: (M, H, W, I) -> (M, H / 2, W / 2, O)."""
    y = jax.lax.conv_general_dilated(x, params["w"].astype(x.dtype), (1, 1), "SAME",
                                     dimension_numbers=("NHWC", "HWIO", "NHWC"))
    y = jax.lax.reduce_window(y, -jnp.inf, jax.lax.max, (1, 2, 2, 1), (1, 2, 2, 1), "VALID")
    return norm_act(y + params["b"].astype(y.dtype), params["scale"])


def upsample_conv(params: Params, x: jax.Array) -> jax.Array:
    """Nearest-neighbour doubling and 5x5 convolution: (M, H, W, I) -> (M, H, W, 4, O), the result in block form."""
    outputs = params["w"].shape[-1]
    y = conv(x, upsample_conv_weight(params["w"]).astype(x.dtype))
    return y.reshape(*y.shape[:-1], 4, outputs) + params["b"].astype(y.dtype)

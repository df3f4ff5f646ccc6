"""Image encoder and decoder: convolutions, or linear layers on patches for machines without an accelerator."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp

from dreamer.config import DreamerConfig
from dreamer.layers import nets
from dreamer.layers.convolution import by_chunks
from dreamer.types import Params

Shape = tuple[int, int, int]


def check_shape(config: DreamerConfig, obs_shape: Shape) -> None:
    """Raise where the image does not fit the layers.

    Raises:
        ValueError: height or width not divisible by the total stride.
    """
    stride = 2 ** len(config.mults) if config.encoder == "conv" else config.patch
    if len(obs_shape) != 3 or obs_shape[0] % stride or obs_shape[1] % stride:
        raise ValueError(
            f"obs_shape = {obs_shape}: the {config.encoder} encoder needs (H, W, C) with H and W divisible by "
            f"{stride}. Resize the image or change mults or patch in DreamerConfig."
        )


def grid(config: DreamerConfig, obs_shape: Shape) -> tuple[int, int]:
    """Height and width of the coarsest feature map."""
    stride = 2 ** len(config.mults) if config.encoder == "conv" else config.patch
    return obs_shape[0] // stride, obs_shape[1] // stride


def token_size(config: DreamerConfig, obs_shape: Shape) -> int:
    """Width of the encoder's output."""
    height, width = grid(config, obs_shape)
    return height * width * config.depth * config.mults[-1] if config.encoder == "conv" else config.units


def init_encoder(config: DreamerConfig, obs_shape: Shape, key: jax.Array) -> Params:
    """Parameters of `encode`."""
    check_shape(config, obs_shape)
    keys = jax.random.split(key, len(config.mults) + 2)
    if config.encoder == "conv":
        depths = [obs_shape[2], *(config.depth * m for m in config.mults)]
        return {
            f"conv{i}": nets.init_conv(keys[i], config.kernel, depths[i], depths[i + 1])
            for i in range(len(config.mults))
        }
    height, width = grid(config, obs_shape)
    return {
        "patch": nets.init_layer(keys[0], config.patch**2 * obs_shape[2], config.patch_units),
        "mix": nets.init_layer(keys[1], height * width * config.patch_units, config.units),
    }


def encode(config: DreamerConfig, params: Params, image: jax.Array) -> jax.Array:
    """Tokens (..., E) of images (..., H, W, C) uint8."""
    batch = image.shape[:-3]
    frames = image.reshape(-1, *image.shape[-3:])
    if config.encoder == "patch":
        x = to_blocks(config, frames).astype(config.dtype)
        x = nets.layer(centred(params["patch"]), x)
        return nets.layer(params["mix"], x.reshape(x.shape[0], -1)).reshape(*batch, -1)
    return by_chunks(partial(_encode_conv, config, params), frames).reshape(*batch, -1)


def _encode_conv(config: DreamerConfig, params: Params, frames: jax.Array) -> jax.Array:
    """Feature maps (M, h, w, C') of frames (M, H, W, C) uint8."""
    if frames.shape[0] == 1:  # one frame, as on a vehicle: a third less arithmetic; blocks pay off in batches
        x = frames.astype(config.dtype) / 255 - 0.5
        for i in range(len(config.mults)):
            x = nets.conv_pool_pixels(params[f"conv{i}"], x)
        return x
    x = to_blocks(config, frames).astype(config.dtype)
    x = nets.conv_pool(params["conv0"], x / 255 - 0.5)
    for i in range(1, len(config.mults)):
        x = nets.conv_pool(params[f"conv{i}"], nets.space_to_depth(x))
    return x


def centred(params: Params) -> Params:
    """The layer that makes of bytes x what `params` makes of x / 255 - 0.5; it spares a pass over all pixels."""
    bias = params["b"] - 0.5 * jnp.sum(params["w"], 0)
    return {**params, "w": params["w"] / 255, "b": bias}


def init_decoder(config: DreamerConfig, obs_shape: Shape, key: jax.Array) -> Params:
    """Parameters of `decode`."""
    keys = jax.random.split(key, len(config.mults) + 5)
    height, width = grid(config, obs_shape)
    coarse = config.depth * config.mults[-1] if config.encoder == "conv" else config.patch_units
    params: Params = {
        "deter": nets.init_block_linear(keys[0], config.blocks, config.deter, height * width * coarse),
        "stoch0": nets.init_layer(keys[1], config.stoch_size, 2 * config.units),
        "stoch1": nets.init_linear(keys[2], 2 * config.units, height * width * coarse),
        "scale": jnp.ones((coarse,), jnp.float32),
    }
    if config.encoder == "patch":
        return {**params, "patch": nets.init_linear(keys[3], coarse, config.patch**2 * obs_shape[2])}
    depths = [config.depth * m for m in config.mults]
    for i in reversed(range(len(depths) - 1)):
        params[f"conv{i}"] = nets.init_conv(keys[4 + i], config.kernel, depths[i + 1], depths[i])
    params["out"] = nets.init_conv(keys[3], config.kernel, depths[0], obs_shape[2], norm=False)
    return params


def decode_blocks(
    config: DreamerConfig, params: Params, deter: jax.Array, stoch: jax.Array, obs_shape: Shape
) -> jax.Array:
    """Predicted images in the form of `to_blocks`, float32, about 0 to 1.

    The convolutions end in a sigmoid as in the source; patches do not, since it costs as much as their products.

    Args:
        config: sizes.
        params: from `init_decoder`.
        deter: (M, D).
        stoch: (M, S * C).
        obs_shape: (H, W, C).
    """
    height, width = grid(config, obs_shape)
    cells, side, rows = height * width, params["scale"].shape[0], deter.shape[0]
    blocks = deter.reshape(rows, config.blocks, -1)
    spread = nets.block_linear(params["deter"], blocks)  # (M, G, h * w * c / G)
    spread = spread.reshape(rows, config.blocks, cells, side // config.blocks)
    spread = jnp.swapaxes(spread, 1, 2).reshape(rows, cells, side)
    flat = nets.linear(params["stoch1"], nets.layer(params["stoch0"], stoch)).reshape(rows, cells, side)
    x = nets.norm_act(spread + flat, params["scale"])
    if config.encoder == "patch":
        return nets.linear(params["patch"], x).astype(jnp.float32) + 0.5  # mid-grey at the start
    x = x.reshape(rows, height, width, side)
    for i in reversed(range(len(config.mults) - 1)):
        y = nets.norm_act(nets.upsample_conv(params[f"conv{i}"], x), params[f"conv{i}"]["scale"])
        x = nets.depth_to_space(y.reshape(*y.shape[:-2], -1))
    y = nets.upsample_conv(params["out"], x)
    return jax.nn.sigmoid(y.reshape(*y.shape[:-2], -1).astype(jnp.float32))


def reconstruction_loss(
    config: DreamerConfig, params: Params, deter: jax.Array, stoch: jax.Array, image: jax.Array
) -> jax.Array:
    """Squared error (M,) summed over pixels, image (M, H, W, C) uint8 scaled to [0, 1].

    The target is brought into the decoder's block form, which is cheaper than unfolding the decoder's output.
    """
    obs_shape = (image.shape[1], image.shape[2], image.shape[3])

    def squared_error(deter: jax.Array, stoch: jax.Array, image: jax.Array) -> jax.Array:
        target = to_blocks(config, image).astype(jnp.float32) / 255
        error = decode_blocks(config, params, deter, stoch, obs_shape) - target
        return jnp.sum(jnp.square(error), range(1, error.ndim))

    if config.encoder == "patch":
        return squared_error(deter, stoch, image)
    return by_chunks(squared_error, deter, stoch, image)


def decode(config: DreamerConfig, params: Params, deter: jax.Array, stoch: jax.Array, obs_shape: Shape) -> jax.Array:
    """Predicted images (M, H, W, C) in [0, 1], for videos."""
    blocks = jnp.clip(decode_blocks(config, params, deter, stoch, obs_shape), 0.0, 1.0)
    if config.encoder == "conv":
        return nets.depth_to_space(blocks)
    return from_patches(blocks, config.patch, obs_shape)


def to_blocks(config: DreamerConfig, image: jax.Array) -> jax.Array:
    """Images (M, H, W, C) as patches (M, cells, p * p * C), for convolutions as 2x2 blocks (M, H / 2, W / 2, 4 C)."""
    return to_patches(image, config.patch) if config.encoder == "patch" else nets.space_to_depth(image)


def to_patches(image: jax.Array, patch: int) -> jax.Array:
    """(M, H, W, C) -> (M, H / p * W / p, p * p * C)."""
    rows, height, width, channels = image.shape
    x = image.reshape(rows, height // patch, patch, width // patch, patch * channels)
    return jnp.swapaxes(x, 2, 3).reshape(rows, -1, patch * patch * channels)


def from_patches(patches: jax.Array, patch: int, obs_shape: Shape) -> jax.Array:
    """The inverse of `to_patches`."""
    height, width, channels = obs_shape
    x = patches.reshape(-1, height // patch, width // patch, patch, patch * channels)
    return jnp.swapaxes(x, 2, 3).reshape(-1, height, width, channels)

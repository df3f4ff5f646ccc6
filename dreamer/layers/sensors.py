"""Encoder and decoder of a whole observation: its images through `image`, its vectors through small MLPs.

Parameters of the image layers lie flat, those of the vectors under the name `vector`; either may be absent.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp

from dreamer.config import DreamerConfig
from dreamer.layers import distributions as dist
from dreamer.layers import image, nets
from dreamer.model.rssm import Latent
from dreamer.spaces import ObsShape, image_of, image_shape, vector_of, vector_size
from dreamer.training import parallel
from dreamer.types import Params


def check(config: DreamerConfig, obs_shape: ObsShape) -> None:
    """Raise ValueError where the observation does not fit the layers."""
    for part in (obs_shape, visible(config, obs_shape)):
        pixels = image_shape(part)
        if pixels:
            image.check_shape(config, pixels)
    unknown = [name for name in config.decode_only if not isinstance(obs_shape, Mapping) or name not in obs_shape]
    if unknown:
        raise ValueError(
            f"DreamerConfig.decode_only = {config.decode_only}: the environment shows no {', '.join(unknown)} "
            f"(obs_shape = {obs_shape}). Correct the names."
        )


def visible(config: DreamerConfig, obs: Any) -> Any:
    """What of an observation, or of its shapes, the encoder sees."""
    if not isinstance(obs, Mapping):
        return obs
    return {name: value for name, value in obs.items() if name not in config.decode_only}


def token_size(config: DreamerConfig, obs_shape: ObsShape) -> int:
    """Width E of the encoder's output."""
    seen = visible(config, obs_shape)
    pixels = image_shape(seen)
    return (image.token_size(config, pixels) if pixels else 0) + (config.units if vector_size(seen) else 0)


def init_encoder(config: DreamerConfig, obs_shape: ObsShape, key: jax.Array) -> Params:
    """Parameters of `encode`."""
    seen = visible(config, obs_shape)
    pixels, width = image_shape(seen), vector_size(seen)
    params = image.init_encoder(config, pixels, key) if pixels else {}
    if width:
        params["vector"] = nets.init_mlp(jax.random.fold_in(key, 1), width, config.units, config.vector_layers)
    return params


def encode(config: DreamerConfig, params: Params, obs: Any) -> jax.Array:
    """Tokens (..., E) of an observation with any leading axes. Vectors are squeezed by symlog first."""
    seen = visible(config, obs)
    pixels, vector = image_of(seen), vector_of(seen)
    tokens = [] if pixels is None else [image.encode(config, params, pixels)]
    if vector is not None:
        tokens.append(nets.mlp(params["vector"], dist.symlog(vector).astype(config.dtype)))
    return tokens[0] if len(tokens) == 1 else jnp.concatenate(tokens, -1)


def init_decoder(config: DreamerConfig, obs_shape: ObsShape, key: jax.Array) -> Params:
    """Parameters of `representation_losses`."""
    if config.representation == "barlow":
        features = config.deter + config.stoch_size
        return {"project": nets.init_linear(key, features, token_size(config, obs_shape))}
    pixels, width = image_shape(obs_shape), vector_size(obs_shape)
    params = image.init_decoder(config, pixels, key) if pixels else {}
    if width:
        mlp_key, out_key = jax.random.split(jax.random.fold_in(key, 1))
        params["vector"] = {
            **nets.init_mlp(mlp_key, config.deter + config.stoch_size, config.units, config.vector_layers),
            "out": nets.init_linear(out_key, config.units, width),
        }
    return params


def decode_vector(params: Params, features: jax.Array) -> jax.Array:
    """Predicted symlog of the vectors (..., D) float32 from features (..., F)."""
    return nets.linear(params["vector"]["out"], nets.mlp(params["vector"], features)).astype(jnp.float32)


def representation_losses(
    config: DreamerConfig, params: Params, latent: Latent, obs: Any, tokens: jax.Array
) -> dict[str, jax.Array]:
    """Weighted losses by name that make the latents hold what is observed.

    Args:
        config: sizes and weights.
        params: from `init_decoder`.
        latent: states (..., D).
        obs: observation with the same leading axes.
        tokens: (..., E) that the encoder made of it.
    """
    if config.representation == "barlow":
        projected = nets.linear(params["project"], latent.features())
        return {"barlow": config.barlow_scale * barlow_loss(projected, tokens, config.barlow_redundancy)}
    losses = reconstruction_losses(config, params, latent, obs)
    weights = {"recon": config.recon_scale, "recon_vector": config.recon_scale * config.vector_scale}
    return {name: weights[name] * error for name, error in losses.items()}


def barlow_loss(projected: jax.Array, tokens: jax.Array, redundancy: float) -> jax.Array:
    """Distance () of the correlation matrix of (..., E) and (..., E) from the identity; the tokens get no gradient."""

    def standard(x: jax.Array) -> jax.Array:
        x = x.astype(jnp.float32).reshape(-1, x.shape[-1])
        x = x - parallel.mean(jnp.mean(x, 0))
        return x / (jnp.sqrt(parallel.mean(jnp.mean(jnp.square(x), 0))) + 1e-4)

    first, second = standard(projected), standard(jax.lax.stop_gradient(tokens))
    correlation = parallel.mean(first.T @ second / first.shape[0])
    agreement = jnp.diagonal(correlation)
    others = jnp.sum(jnp.square(correlation)) - jnp.sum(jnp.square(agreement))
    return jnp.sum(jnp.square(agreement - 1.0)) + redundancy * others


def reconstruction_losses(config: DreamerConfig, params: Params, latent: Latent, obs: Any) -> dict[str, jax.Array]:
    """Squared errors (...) by name: `recon` summed over the pixels, `recon_vector` over the symlogs of all vectors.

    Args:
        config: sizes.
        params: from `init_decoder`.
        latent: states (..., D).
        obs: observation with the same leading axes.
    """
    pixels, vector, batch = image_of(obs), vector_of(obs), latent.deter.shape[:-1]
    losses = {}
    if pixels is not None:
        flat = Latent(latent.deter.reshape(-1, config.deter), latent.stoch.reshape(-1, config.stoch_size))
        frames = pixels.reshape(-1, *pixels.shape[-3:])
        losses["recon"] = image.reconstruction_loss(config, params, flat.deter, flat.stoch, frames).reshape(batch)
    if vector is not None:
        error = decode_vector(params, latent.features()) - dist.symlog(vector)
        losses["recon_vector"] = jnp.sum(jnp.square(error), -1)
    return losses

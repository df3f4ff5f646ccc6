"""Random vehicle parameters around given ones, and random looks of a scene."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from whill_mjx.vehicle.types import VehicleParams
from whill_mjx.world.scene import Scene


def randomize_params(key: jax.Array, params: VehicleParams, spread: float) -> VehicleParams:
    """Parameters drawn around `params`: each floating-point leaf times exp(spread * z), z normal and cut at +-2.

    Signs are kept, and a value of zero stays zero, so an effect that is switched off stays off.

    Args:
        key: random key.
        params: parameters of one instance.
        spread: relative standard deviation, about; 0 gives `params` back.
    """
    leaves, tree = jax.tree.flatten(params)
    keys = jax.random.split(key, len(leaves))
    drawn = [_scale(k, jnp.asarray(leaf), spread) for k, leaf in zip(keys, leaves, strict=True)]
    return jax.tree.unflatten(tree, drawn)


def _scale(key: jax.Array, leaf: jax.Array, spread: float) -> jax.Array:
    if not jnp.issubdtype(leaf.dtype, jnp.floating):
        return leaf
    normal = jax.random.truncated_normal(key, -2.0, 2.0, leaf.shape, leaf.dtype)
    return leaf * jnp.exp(spread * normal)


def randomize_looks(key: jax.Array, scene: Scene) -> Scene:
    """The scene with other colours, tiles, sun and sky. Shapes and places stay; the goal marker stays blue."""
    keys = iter(jax.random.split(key, 20))
    boxes, marker, looks = scene.boxes, scene.marker, scene.looks
    paint = jax.random.uniform(next(keys), boxes.colour.shape, minval=0.08, maxval=0.92)
    # No other thing may be taken for the marker: a box's blue never exceeds its red and green.
    paint = paint.at[:, 2].set(jnp.minimum(paint[:, 2], jnp.maximum(paint[:, 0], paint[:, 1])))
    shade = jax.random.uniform(next(keys), minval=0.6, maxval=1.05)
    blue = jnp.clip(marker.colour * shade + jax.random.uniform(next(keys), (3,), minval=0.0, maxval=0.08), 0.0, 1.0)

    azimuth = jax.random.uniform(next(keys), minval=-jnp.pi, maxval=jnp.pi)
    elevation = jax.random.uniform(next(keys), minval=0.5, maxval=1.4)
    sun = jnp.stack([
        jnp.cos(elevation) * jnp.cos(azimuth), jnp.cos(elevation) * jnp.sin(azimuth), jnp.sin(elevation)
    ])
    base = jax.random.uniform(next(keys), minval=0.25, maxval=0.7)
    tint = jax.random.uniform(next(keys), (3,), minval=0.9, maxval=1.1)
    step = jax.random.uniform(next(keys), minval=0.0, maxval=0.15)
    ground = jnp.clip(jnp.stack([base * tint, (base - step) * tint]), 0.0, 1.0)
    tile = jax.random.uniform(next(keys), minval=0.3, maxval=0.9)
    horizon = jax.random.uniform(next(keys), minval=0.6, maxval=0.95) * jnp.array([0.97, 1.0, 1.03])
    zenith = horizon * jax.random.uniform(next(keys), (3,), minval=0.5, maxval=0.95)
    looks = dataclasses.replace(
        looks,
        sun=sun,
        ambient=jax.random.uniform(next(keys), minval=0.4, maxval=0.7),
        diffuse=jax.random.uniform(next(keys), minval=0.3, maxval=0.6),
        sky_horizon=jnp.clip(horizon, 0.0, 1.0),
        sky_zenith=jnp.clip(zenith, 0.0, 1.0),
        ground=ground,
        tile=tile,
        tile_offset=jax.random.uniform(next(keys), (2,), maxval=1.0) * tile,
        noise=jax.random.uniform(next(keys), maxval=0.12),
        grain=jax.random.uniform(next(keys), maxval=0.10),
        seed=jax.random.bits(next(keys), dtype=jnp.uint32),
    )
    solid, goal = dataclasses.replace(boxes, colour=paint), dataclasses.replace(marker, colour=blue)
    return dataclasses.replace(scene, boxes=solid, marker=goal, looks=looks)

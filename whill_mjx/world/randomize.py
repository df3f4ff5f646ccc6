"""Random vehicle parameters, around given ones or in given ranges, and random looks of a scene."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from whill_mjx.effects import EFFECTS, make_effect
from whill_mjx.io.fields import Field, check, parameter_field
from whill_mjx.vehicle.types import Body, VehicleParams, parameters_of
from whill_mjx.world.scene import Scene


def randomize_params(key: jax.Array, params: VehicleParams, spread: float) -> VehicleParams:
    """Parameters drawn around `params`: each floating-point leaf times exp(spread * z), z normal and cut at +-2.

    Signs are kept, and a value of zero stays zero, so an effect that is switched off stays off.

    Args:
        key: random key.
        params: parameters of one instance.
        spread: relative standard deviation, about; 0 gives `params` back.
    """
    leaves, tree = jax.tree.flatten(jax.tree.map(jnp.asarray, params))
    most = max((leaf.size for leaf in leaves), default=0)
    keys = jax.random.split(key, len(leaves))
    factors = jnp.exp(spread * jax.vmap(lambda key: jax.random.truncated_normal(key, -2.0, 2.0, (most,)))(keys))
    drawn = [
        leaf * factor[: leaf.size].reshape(leaf.shape) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf
        for leaf, factor in zip(leaves, factors, strict=True)
    ]
    return jax.tree.unflatten(tree, drawn)


def with_parameter(params: VehicleParams, name: str, value: jax.Array, relative: bool) -> VehicleParams:
    """The parameters of one vehicle with one value changed; an effect that it does not have is added.

    Args:
        params: of one instance.
        name: `EFFECT.PARAMETER` or `body.PARAMETER`.
        value: () new value, or factor on the old one.
        relative: whether it is a factor.
    """
    holder, _, field = name.partition(".")

    def changed(owner: Any) -> Any:
        new = getattr(owner, field) * value if relative else value
        return dataclasses.replace(owner, **{field: jnp.asarray(new, jnp.result_type(float))})

    if holder == "body":
        return dataclasses.replace(params, body=changed(params.body))
    effects = params.effects
    if not any(effect.name == holder for effect in effects):
        effects = (*effects, make_effect(holder))
    return dataclasses.replace(params, effects=tuple(
        changed(effect) if effect.name == holder else effect for effect in effects
    ))


def check_parameter(where: str, name: str, values: Iterable[float], relative: bool) -> None:
    """Raise ValueError unless `name` is EFFECT.PARAMETER or body.PARAMETER that may take these values, or factors."""
    holder, _, field = name.partition(".")
    if holder != "body" and holder not in EFFECTS:
        raise ValueError(f"{where}: no effect {holder!r} (known: body, {', '.join(sorted(EFFECTS))}).")
    known = parameters_of(Body if holder == "body" else EFFECTS[holder])
    if field not in known:
        raise ValueError(f"{where}: {holder} has no parameter {field!r} (known: {', '.join(known)}).")
    about = known[field]
    allowed = (Field("factor", "-", 1e-3 if holder == "body" else 0.0, 1e3, remedy="1x changes nothing.") if relative
               else parameter_field(name, about.unit, about.low, about.high, about.neutral))
    for value in values:
        check(where, allowed, value)


def check_factor(where: str, params: VehicleParams, name: str) -> None:
    """Raise ValueError where a factor on a parameter of a vehicle, or of the effect that it lacks, changes nothing."""
    holder, _, field = name.partition(".")
    mine = next((effect for effect in params.effects if effect.name == holder), None)
    owner = params.body if holder == "body" else mine or make_effect(holder)
    if not np.any(np.asarray(getattr(owner, field))):
        why = f"lacks {holder}" if holder != "body" and mine is None else f"has {name} = 0"
        raise ValueError(f"{where}: the vehicle {why}, so a factor changes nothing. Give values without an x.")


@dataclass(frozen=True)
class Variation:
    """One parameter of the vehicle that is drawn uniformly for each episode."""

    name: str
    """EFFECT.PARAMETER or body.PARAMETER; an effect that the vehicle lacks is added."""
    low: float
    high: float
    relative: bool = False
    """The bounds are factors on the vehicle's own value."""


def read_variation(text: str) -> Variation:
    """Variation from NAME=LOW:HIGH, where bounds with an x are factors; ValueError says what is wrong."""
    name, equals, values = text.partition("=")
    low, colon, high = values.partition(":")
    relative = low.endswith("x")
    try:
        if not (equals and colon) or high.endswith("x") != relative:
            raise ValueError
        bounds = float(low.removesuffix("x")), float(high.removesuffix("x"))
        if not (math.isfinite(bounds[0]) and math.isfinite(bounds[1]) and bounds[0] <= bounds[1]):
            raise ValueError
    except ValueError:
        raise ValueError(f"{text!r} is no variation: write EFFECT.PARAMETER=LOW:HIGH or body.PARAMETER=0.9x:1.1x, the "
                         "lower bound first.") from None
    check_parameter(f"variation {text!r}", name, bounds, relative)
    return Variation(name, *bounds, relative)


def vary_params(key: jax.Array, params: VehicleParams, variations: tuple[Variation, ...]) -> VehicleParams:
    """Parameters of one instance with each variation drawn from its range."""
    numbers = jax.vmap(lambda place: jax.random.uniform(jax.random.fold_in(key, place)))(jnp.arange(len(variations)))
    for one, number in zip(variations, numbers, strict=True):
        params = with_parameter(params, one.name, one.low + (one.high - one.low) * number, one.relative)
    return params


def randomize_looks(key: jax.Array, scene: Scene) -> Scene:
    """The scene with other colours, tiles, sun and sky. Shapes and places stay; the goal marker stays blue."""
    keys = jax.random.split(key, 20)
    numbers = jax.vmap(lambda key: jax.random.uniform(key, (3,)))(keys)  # one by one, they take long to compile
    rows = iter(range(1, len(keys)))

    def draw(low: float, high: float, size: int | None = None) -> jax.Array:
        row = numbers[next(rows)]
        return low + (high - low) * (row[0] if size is None else row[:size])

    boxes, marker, looks = scene.boxes, scene.marker, scene.looks
    paint = jax.random.uniform(keys[0], boxes.colour.shape, minval=0.08, maxval=0.92)
    # No other thing may be taken for the marker: a box's blue never exceeds its red and green.
    paint = paint.at[:, 2].set(jnp.minimum(paint[:, 2], jnp.maximum(paint[:, 0], paint[:, 1])))
    shade = draw(0.6, 1.05)
    blue = jnp.clip(marker.colour * shade + draw(0.0, 0.08, 3), 0.0, 1.0)

    azimuth, elevation = draw(-jnp.pi, jnp.pi), draw(0.5, 1.4)
    sun = jnp.stack([
        jnp.cos(elevation) * jnp.cos(azimuth), jnp.cos(elevation) * jnp.sin(azimuth), jnp.sin(elevation)
    ])
    base, tint, step = draw(0.25, 0.7), draw(0.9, 1.1, 3), draw(0.0, 0.15)
    ground = jnp.clip(jnp.stack([base * tint, (base - step) * tint]), 0.0, 1.0)
    tile = draw(0.3, 0.9)
    horizon = draw(0.6, 0.95) * jnp.array([0.97, 1.0, 1.03])
    zenith = horizon * draw(0.5, 0.95, 3)
    looks = dataclasses.replace(
        looks,
        sun=sun,
        ambient=draw(0.4, 0.7),
        diffuse=draw(0.3, 0.6),
        sky_horizon=jnp.clip(horizon, 0.0, 1.0),
        sky_zenith=jnp.clip(zenith, 0.0, 1.0),
        ground=ground,
        tile=tile,
        tile_offset=draw(0.0, 1.0, 2) * tile,
        noise=draw(0.0, 0.12),
        grain=draw(0.0, 0.10),
        seed=jax.random.bits(keys[next(rows)], dtype=jnp.uint32),
    )
    solid, goal = dataclasses.replace(boxes, colour=paint), dataclasses.replace(marker, colour=blue)
    return dataclasses.replace(scene, boxes=solid, marker=goal, looks=looks)

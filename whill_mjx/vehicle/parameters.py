"""Names for the leaves of `VehicleParams`: "body.mass", "pid_drive.kp", ..."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from whill_mjx.vehicle.types import Parameter, VehicleParams, parameters_of


def holders(params: VehicleParams) -> dict[str, Any]:
    """The body and every effect by name; ValueError if two effects share one."""
    found: dict[str, Any] = {"body": params.body}
    for effect in params.effects:
        if effect.name in found:
            raise ValueError(f"vehicle has two effects named {effect.name!r}; keep one of them.")
        found[effect.name] = effect
    return found


def describe(params: VehicleParams) -> dict[str, Parameter]:
    """Every parameter by its dotted name, with unit, range and neutral value."""
    return {
        f"{name}.{field}": about
        for name, holder in holders(params).items()
        for field, about in parameters_of(holder).items()
    }


def get_values(params: VehicleParams, names: Sequence[str]) -> jax.Array:
    """Values (P,) of the named parameters of one instance, in their SI units; KeyError names the known ones."""
    found = holders(params)
    return jnp.stack([jnp.asarray(getattr(found[holder], field)) for holder, field in _split(found, names)])


def set_values(params: VehicleParams, names: Sequence[str], values: jax.Array) -> VehicleParams:
    """The same vehicle with the named parameters at `values` (P,), in their SI units.

    Raises:
        KeyError: no such parameter; names the known ones.
        ValueError: not one value for each name.
    """
    if len(values) != len(names):
        raise ValueError(f"{len(names)} names of parameters and {len(values)} values: give one value for each name.")
    found = holders(params)
    for index, (holder, field) in enumerate(_split(found, names)):
        found[holder] = dataclasses.replace(found[holder], **{field: values[index]})
    return VehicleParams(found.pop("body"), tuple(found.values()))


def _split(found: dict[str, Any], names: Sequence[str]) -> list[tuple[str, str]]:
    pairs = []
    for name in names:
        holder, _, field = name.partition(".")
        if holder not in found or field not in parameters_of(found[holder]):
            known = [f"{key}.{leaf}" for key, value in found.items() for leaf in parameters_of(value)]
            raise KeyError(f"unknown parameter {name!r} (known: {', '.join(known)}).")
        pairs.append((holder, field))
    return pairs

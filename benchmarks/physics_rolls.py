"""Vehicles at random parameters, and a compiled drive of many of them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import numpy as np
from jax.sharding import PartitionSpec

from whill_mjx.effects import EFFECTS, make_effect
from whill_mjx.vehicle.config import VehicleConfig
from whill_mjx.vehicle.dynamics import drive, place
from whill_mjx.vehicle.model import VehicleModel, build_model
from whill_mjx.vehicle.presets import preset
from whill_mjx.vehicle.specs import VehicleSpec
from whill_mjx.vehicle.types import VehicleParams, VehicleState, parameters_of

BASE = "whill_cr_physical"
LOADED = ("acceleration_limit", "actuator_lag", "dry_friction", "slope", "odometry_scale")

SPREAD = 0.1  # relative spread of every parameter between instances


def vehicle_of(name: str) -> tuple[VehicleSpec, VehicleParams]:
    """A preset, "loaded", or "+EFFECT": the physical base model with that one effect."""
    more = LOADED if name == "loaded" else (name[1:],) if name.startswith("+") else ()
    spec, params = preset(BASE if more else name)
    return spec, replace(params, effects=(*params.effects, *map(usual, more)))


def random_instances(
    vehicle: str, count: int, dynamics: str = "fused", kernel: bool | None = VehicleConfig.kernel
) -> tuple[VehicleModel, VehicleParams, VehicleState]:
    """`count` vehicles at rest with every parameter spread by SPREAD."""
    spec, params = vehicle_of(vehicle)
    model = build_model(spec, VehicleConfig(dynamics=dynamics, kernel=kernel))
    key = jax.random.key(0)

    def scatter(leaf: jax.Array, leaf_key: jax.Array) -> jax.Array:
        return leaf * (1 + SPREAD * jax.random.uniform(leaf_key, (count,), minval=-1.0))

    leaves, tree = jax.tree.flatten(params)
    keys = jax.random.split(key, len(leaves))
    spread = [scatter(leaf, leaf_key) for leaf, leaf_key in zip(leaves, keys, strict=True)]
    scattered = jax.tree.unflatten(tree, spread)
    states = jax.jit(jax.vmap(lambda params: place(model, params, 0.0, 0.0, 0.0)))(scattered)
    return model, scattered, states


def compiled_roll(
    vehicle: str, count: int, periods: int, dynamics: str = "fused", kernel: bool | None = VehicleConfig.kernel
) -> tuple[VehicleModel, Any, tuple]:
    """The model, a compiled drive of `count` instances over `periods` control periods, and its arguments.

    Several devices of a processor (`whill_mjx.processor.device_per_core`) take a share of the instances each.
    """
    model, params, states = random_instances(vehicle, count, dynamics, kernel)
    commands = jax.random.uniform(jax.random.key(1), (periods, count, 2), minval=-1.0)

    def roll(params: VehicleParams, states: VehicleState, commands: jax.Array) -> VehicleState:
        def period(states: VehicleState, command: jax.Array) -> tuple[VehicleState, None]:
            return jax.vmap(lambda p, s, c: drive(model, p, s, c))(params, states, command), None

        return jax.lax.scan(period, states, commands)[0]

    arguments = params, states, commands
    cores = jax.devices() if jax.default_backend() == "cpu" else []
    if len(cores) > 1 and count % len(cores) == 0:
        rows, columns = PartitionSpec("instance"), PartitionSpec(None, "instance")
        mesh = jax.sharding.Mesh(cores, ("instance",))
        roll = jax.shard_map(roll, mesh=mesh, in_specs=(rows, rows, columns), out_specs=rows, check_vma=False)
        arguments = tuple(
            jax.device_put(one, jax.sharding.NamedSharding(mesh, where))
            for one, where in zip(arguments, (rows, rows, columns), strict=True)
        )
    roll = jax.jit(roll)
    return model, roll.lower(*arguments).compile(), arguments


def usual(name: str) -> Any:
    """An effect three quarters up its usual values: not neutral."""
    values = {field: about.high for field, about in parameters_of(EFFECTS[name]).items() if about.neutral == np.inf}
    values |= {field: low + 0.75 * (high - low) for field, (low, high) in EFFECTS[name].typical.items()}
    return make_effect(name, **values)

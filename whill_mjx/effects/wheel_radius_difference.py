"""Wheel radii that differ from the nominal one."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.vehicle.types import World, parameter


@struct.dataclass
class WheelRadiusDifference(Effect):
    """r_left = r (1 + c + e/2), r_right = r (1 + c - e/2); controller and odometry keep r.

    One wheel 2 % too small on the right is e = 0.02, c = -0.01. The radii change the rolling alone, not the chassis
    height.
    """

    name = "wheel_radius_difference"
    typical = {"difference": (-0.01, 0.01), "common": (-0.02, 0.02)}
    source = "estimate: tyre pressure and wear; published radii of the chair differ by 1.9 %"
    difference: jax.Array = parameter("-", -0.1, 0.1, 0.0, "left radius less the right one, of the nominal radius, e")
    common: jax.Array = parameter("-", -0.1, 0.1, 0.0, "error of both radii, of the nominal radius, c")

    def world(self, memory: tuple[()], world: World) -> tuple[tuple[()], World]:
        """World with the true radii (2,)."""
        factor = 1 + self.common + self.difference / 2 * jnp.array([1.0, -1.0])
        geometry = replace(world.geometry, wheel_radius=world.geometry.wheel_radius * factor)
        return memory, replace(world, geometry=geometry)

"""Wheel radii that differ from the nominal one."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.effects.card import LAW_OF_SPEED, SAME_ALL_DRIVE, SAME_BACKWARD, Axis, Card, Variant
from whill_mjx.vehicle.types import World, parameter


@struct.dataclass
class WheelRadiusDifference(Effect):
    """r_left = r (1 + c + e/2), r_right = r (1 + c - e/2); controller and odometry keep r.

    A right wheel that is 2 % too small is e = 0.02, c = -0.01. The radii change the rolling only, not the height of the
    chassis.
    """

    name = "wheel_radius_difference"
    typical = {"difference": (-0.01, 0.01), "common": (-0.02, 0.02)}
    source = "estimate: tyre pressure and wear; published radii of the chair differ by 1.9 %"
    card = Card(
        order=110,
        variants=(Variant((Axis("difference", 0.005, signed=True), Axis("common", 0.005, signed=True))),),
        forbids=(LAW_OF_SPEED, SAME_BACKWARD, SAME_ALL_DRIVE),
        sensor="an outside pose",
        shown_by_pose=True,
        mirrored=("difference",),
    )
    difference: jax.Array = parameter("-", -0.1, 0.1, 0.0, "left radius minus the right one, over the nominal one, e")
    common: jax.Array = parameter("-", -0.1, 0.1, 0.0, "error of both radii, over the nominal radius, c")

    def world(self, memory: tuple[()], world: World) -> tuple[tuple[()], World]:
        """World with the true radii (2,)."""
        factor = 1 + self.common + self.difference / 2 * jnp.array([1.0, -1.0])
        geometry = replace(world.geometry, wheel_radius=world.geometry.wheel_radius * factor)
        return memory, replace(world, geometry=geometry)

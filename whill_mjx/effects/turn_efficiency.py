"""Skid steering: the share of the wheels' speed difference that turns the body."""

from __future__ import annotations

from dataclasses import replace

import jax
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.vehicle.types import World, parameter


@struct.dataclass
class TurnEfficiency(Effect):
    """omega = chi (v_right - v_left) / b: the driven contacts act at y / chi, outside their wheels.

    The centres about which the sides of a skid-steered vehicle rotate lie outside its track. On the command it would
    show in the odometry too, and a yaw torque would be worked off by the speed control; as true geometry it holds for
    both drives, and the odometry keeps counting the whole difference. `track_width` moves the free wheels as well and
    is the same on a skid drive, with 1 + e = 1 / chi: free one of them.
    """

    name = "turn_efficiency"
    typical = {"efficiency": (0.6, 0.9)}
    source = "estimate for skid steering on hard floors"
    efficiency: jax.Array = parameter("-", 0.5, 1.3, 1.0, "share of the wheels' speed difference that turns the body")

    def world(self, memory: tuple[()], world: World) -> tuple[tuple[()], World]:
        """World with the driven contacts where they act."""
        geometry = world.geometry
        factor = 1 + geometry.driven * (1 / self.efficiency - 1)
        return memory, replace(world, geometry=replace(geometry, contact_y=geometry.contact_y * factor))

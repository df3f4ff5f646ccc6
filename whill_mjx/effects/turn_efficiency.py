"""Skid steering: the share of the wheels' speed difference that turns the body."""

from __future__ import annotations

from dataclasses import replace

import jax
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.effects.card import LAW_OF_YAW_RATE, SAME_ALL_DRIVE, SAME_LEFT_AND_RIGHT, Axis, Card, Variant
from whill_mjx.vehicle.types import World, parameter


@struct.dataclass
class TurnEfficiency(Effect):
    """omega = chi (v_right - v_left) / b: the driven contacts act at y / chi, outside their wheels.

    The centres about which the sides of a skid-steered vehicle rotate lie outside its track. A scale on the command
    would show in the odometry too, and the speed control would work against a yaw torque. As true geometry the law
    holds for both drives, and the odometry counts the whole difference. `track_width` moves the free wheels as well. On
    a skid drive it is the same, with 1 + e = 1 / chi: free only one of them.
    """

    name = "turn_efficiency"
    typical = {"efficiency": (0.6, 0.9)}
    source = "estimate for skid steering on hard floors"
    card = Card(
        order=270,
        variants=lambda scale: (
            (Variant((Axis("efficiency", 0.02, signed=True),)),) if scale.spec.drive == "skid" else ()
        ),
        forbids=(LAW_OF_YAW_RATE, SAME_LEFT_AND_RIGHT, SAME_ALL_DRIVE),
        shown_by_pose=True,
    )
    efficiency: jax.Array = parameter("-", 0.5, 1.3, 1.0, "share of the wheels' speed difference that turns the body")

    def world(self, memory: tuple[()], world: World) -> tuple[tuple[()], World]:
        """World with the driven contacts where they act."""
        geometry = world.geometry
        factor = 1 + geometry.driven * (1 / self.efficiency - 1)
        return memory, replace(world, geometry=replace(geometry, contact_y=geometry.contact_y * factor))

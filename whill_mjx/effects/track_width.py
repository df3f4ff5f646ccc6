"""Effective track that differs from the nominal one."""

from __future__ import annotations

from dataclasses import replace

import jax
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.effects.card import LAW_OF_YAW_RATE, SAME_ALL_DRIVE, SAME_LEFT_AND_RIGHT, Alike, Axis, Card, Variant
from whill_mjx.vehicle.types import World, parameter


@struct.dataclass
class TrackWidth(Effect):
    """b -> b (1 + e): omega = (v_right - v_left) / (b (1 + e)); controller and odometry keep b.

    All contacts move. Wide contact patches that carry their load off centre have this effect.
    """

    name = "track_width"
    typical = {"error": (-0.05, 0.05)}
    source = "estimate; published tracks of the chair are 0.490 and 0.496 m"
    card = Card(
        order=120,
        variants=(Variant((Axis("error", 0.01, signed=True),)),),
        forbids=(LAW_OF_YAW_RATE, SAME_LEFT_AND_RIGHT, SAME_ALL_DRIVE),
        sensor="an outside pose",
        shown_by_pose=True,
        alike=(Alike(("turn_efficiency",), "the same on a skid drive", "nothing"),),
    )
    error: jax.Array = parameter("-", -0.3, 0.5, 0.0, "true track minus the nominal one, over the nominal one, e")

    def world(self, memory: tuple[()], world: World) -> tuple[tuple[()], World]:
        """World with the true track."""
        geometry = replace(world.geometry, contact_y=world.geometry.contact_y * (1 + self.error))
        return memory, replace(world, geometry=geometry)

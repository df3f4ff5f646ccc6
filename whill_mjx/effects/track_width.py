"""Effective track that differs from the nominal one."""

from __future__ import annotations

from dataclasses import replace

import jax
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.vehicle.types import World, parameter


@struct.dataclass
class TrackWidth(Effect):
    """b -> b (1 + e): omega = (v_right - v_left) / (b (1 + e)); controller and odometry keep b.

    All contacts move; wide contact patches carry the load off their middle.
    """

    name = "track_width"
    typical = {"error": (-0.05, 0.05)}
    source = "estimate; published tracks of the chair are 0.490 and 0.496 m"
    error: jax.Array = parameter("-", -0.3, 0.5, 0.0, "true track less the nominal one, of the nominal track")

    def world(self, memory: tuple[()], world: World) -> tuple[tuple[()], World]:
        """World with the true track."""
        geometry = replace(world.geometry, contact_y=world.geometry.contact_y * (1 + self.error))
        return memory, replace(world, geometry=geometry)

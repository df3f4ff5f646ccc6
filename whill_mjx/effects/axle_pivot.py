"""Passive axle that pivots about the vehicle's long axis."""

from __future__ import annotations

from dataclasses import replace

import jax
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.vehicle.types import World, parameter


@struct.dataclass
class AxlePivot(Effect):
    """y -> y (1 - f) at the passive contacts: they carry load, but less of the roll; with f = 1 none of it.

    In a turn the load then shifts between the driven wheels alone, and so does the force with which they can brake. The
    outer wheel turns a chair back that brakes hard out of a turn. A skid drive has no passive wheels: no effect there.
    """

    name = "axle_pivot"
    typical = {"freedom": (0.5, 1.0)}
    source = "estimate: front beams of powered chairs pivot, or yield, to keep all wheels on the floor"
    freedom: jax.Array = parameter("-", 0.0, 1.0, 0.0, "0 for a rigid axle, 1 for one that pivots freely, f")

    def world(self, memory: tuple[()], world: World) -> tuple[tuple[()], World]:
        """World in which the passive wheels stand closer to the middle."""
        geometry = world.geometry
        kept = 1 - self.freedom * (1 - geometry.driven)
        return memory, replace(world, geometry=replace(geometry, contact_y=geometry.contact_y * kept))

"""Constant push to the side."""

from __future__ import annotations

from dataclasses import replace

import jax
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.vehicle.types import Motion, Wrench, parameter


@struct.dataclass
class SideForce(Effect):
    """F_y = F_s in the vehicle's own frame, at the chassis origin: it turns with the vehicle, unlike slope and wind.

    It acts even at rest; what holds it is the sideways grip of the wheels.
    """

    name = "side_force"
    typical = {"sideways": (-20.0, 20.0)}
    source = "estimate: a pull on one side, a dragging caster"
    sideways: jax.Array = parameter("N", -300.0, 300.0, 0.0, "force to the left, F_s")

    def force(self, memory: tuple[()], motion: Motion) -> tuple[tuple[()], Wrench]:
        """Wrench along the chassis y axis."""
        return memory, replace(Wrench.zero(), fy=self.sideways)

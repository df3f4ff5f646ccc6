"""How far suspension and tyres give way."""

from __future__ import annotations

from dataclasses import replace

import jax
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.vehicle.types import World, parameter


@struct.dataclass
class Suspension(Effect):
    """Each contact is a spring that a quarter of the weight compresses by s, with zeta times the critical damping.

    When drive or brakes pull, a soft chair nods at sqrt(g / s) before its loads have shifted, and its wheels turn with
    the nodding. In the wheel speeds this looks like a late command and a high gain. On a stiff chair the loads shift at
    once. Loads are those at the end of a physics step (`vehicle.dynamics`), so any sag is stable.
    """

    name = "suspension"
    typical = {"sag": (0.002, 0.01), "damping": (0.2, 1.0)}
    source = "estimate: below 1 mm for hard wheels, 2 mm for solid tyres, 5 mm for soft ones, 20 mm for a sprung chair"
    sag: jax.Array = parameter("m", 0.00002, 0.02, 0.005, "compression under a quarter of the weight, s")
    damping: jax.Array = parameter("-", 0.1, 1.0, 0.5, "damping over the critical, zeta")

    def world(self, memory: tuple[()], world: World) -> tuple[tuple[()], World]:
        """World for a vehicle on other springs."""
        return memory, replace(world, sag=self.sag, damping=self.damping, sprung=True)

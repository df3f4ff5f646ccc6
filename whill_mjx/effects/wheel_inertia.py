"""Spin inertia of the driven wheels."""

from __future__ import annotations

from dataclasses import replace

import jax
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.vehicle.types import World, parameter


@struct.dataclass
class WheelInertia(Effect):
    """J = ratio * J_nominal of each driven wheel, its tyre, its motor and its gears together, about its axle.

    A rotor behind a gear counts with the square of its ratio, which can make J several times that of the wheel alone.
    While the wheels roll J hardly shows, because the chair's mass is much larger. Only J holds back a skidding wheel.

    The angular momentum of a wheel that slows down tips the chassis forward, and the loads shift. With a direct drive
    or a hub motor all of J does so (`reaction` 1). A rotor behind a gear has little angular momentum for its part of J.
    """

    name = "wheel_inertia"
    typical = {"ratio": (1.0, 4.0), "reaction": (0.2, 1.0)}
    source = "estimate: 1 for a direct drive, 2 to 4 with the rotor of a hub motor"
    ratio: jax.Array = parameter("-", 0.2, 20.0, 1.0, "spin inertia of a driven wheel with its motor over the nominal")
    reaction: jax.Array = parameter("-", 0.0, 1.0, 0.0, "share of it whose momentum the chassis takes up")

    def world(self, memory: tuple[()], world: World) -> tuple[tuple[()], World]:
        """World for a vehicle with other wheels."""
        return memory, replace(world, wheel_inertia=self.ratio, wheel_reaction=self.reaction)

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

    A rotor behind a gear counts with the square of its ratio, which can make J several times a wheel's own. While
    the wheels roll J hardly shows: the chair's mass is much more. A wheel that skids is thrown by J alone.

    A wheel that is slowed down turns the chassis forward by its angular momentum, and the loads shift. What turns with
    the wheel itself does so: all of J with a direct drive or a hub motor, `reaction` 1. A rotor behind a gear turns
    faster but weighs in J with the gear's square, so that little of its J does.
    """

    name = "wheel_inertia"
    typical = {"ratio": (1.0, 4.0), "reaction": (0.2, 1.0)}
    source = "estimate: 1 for a direct drive, 2 to 4 with the rotor of a hub motor"
    ratio: jax.Array = parameter("-", 0.2, 20.0, 1.0, "spin inertia of a driven wheel with its motor over the nominal")
    reaction: jax.Array = parameter("-", 0.0, 1.0, 0.0, "share of it whose momentum the chassis takes up")

    def world(self, memory: tuple[()], world: World) -> tuple[tuple[()], World]:
        """World for a vehicle with other wheels."""
        return memory, replace(world, wheel_inertia=self.ratio, wheel_reaction=self.reaction)

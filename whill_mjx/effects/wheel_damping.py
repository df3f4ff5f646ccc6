"""Viscous friction of the driven wheels' bearings and motors."""

from __future__ import annotations

from dataclasses import replace

import jax
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.vehicle.types import Motion, Wrench, parameter


@struct.dataclass
class WheelDamping(Effect):
    """T = -d spin on each driven wheel about its axle: bearings, gears and motor resist with speed.

    For rolling wheels it is a rolling resistance that grows with speed. A skidding wheel is slowed by nothing else.
    """

    name = "wheel_damping"
    typical = {"damping": (0.02, 0.3)}
    source = "estimate: hub motors of 100 to 300 W"
    damping: jax.Array = parameter("N m s/rad", 0.0, 2.0, 0.0, "viscous friction of a driven wheel, d")

    def force(self, memory: tuple[()], motion: Motion) -> tuple[tuple[()], Wrench]:
        """Wrench with torques on the driven wheels only."""
        return memory, replace(Wrench.zero(), spin_torque=-self.damping * motion.spin)

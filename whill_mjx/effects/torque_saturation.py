"""Largest force of the drive."""

from __future__ import annotations

import jax
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.effects.card import SAME_ALL_DRIVE, SAME_BACKWARD, SAME_LEFT_AND_RIGHT, Alike, Axis, Card, Variant
from whill_mjx.effects.smooth import limit_drive
from whill_mjx.vehicle.types import Drive, Motion, parameter


@struct.dataclass
class TorqueSaturation(Effect):
    """F -> F / (1 + (F / F_max)^4)^(1/4) on each side; a motor torque is limited at F_max r.

    The knee is that of `soft_limit`: 16 % below the corner of a hard limit.
    """

    name = "torque_saturation"
    typical = {"limit": (60.0, 200.0)}
    source = "estimate, per wheel"
    card = Card(
        order=70,
        variants=lambda scale: (
            (Variant((Axis("torque_drive.limit", -0.1, form="factor"),), kind="parameter_shift"),)
            if "torque_drive.limit" in scale.parameters
            else (Variant((Axis("limit", 0.2 * scale.weight, form="inverse"),)),)
        ),
        forbids=(SAME_BACKWARD, SAME_LEFT_AND_RIGHT, SAME_ALL_DRIVE),
        sensor="motor currents",
        alike=(Alike(("traction_limit",), "a cap on each side's force", "another floor"),),
    )
    limit: jax.Array = parameter("N", 5.0, 3000.0, float("inf"), "largest traction of one side")

    def actuation(self, memory: tuple[()], drive: Drive, motion: Motion) -> tuple[tuple[()], Drive]:
        """Drive with limited force (2,) and torque (2,)."""
        return memory, limit_drive(drive, self.limit, self.limit * motion.wheel_radius)

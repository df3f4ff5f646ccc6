"""Unequal drives."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.effects.card import SAME_ALL_DRIVE, SAME_BACKWARD, Axis, Card, Variant
from whill_mjx.effects.smooth import scale_drive
from whill_mjx.vehicle.types import Drive, Motion, parameter


@struct.dataclass
class DriveGainDifference(Effect):
    """F_left -> (1 + d/2) F_left, F_right -> (1 - d/2) F_right."""

    name = "drive_gain_difference"
    typical = {"difference": (-0.1, 0.1)}
    source = "estimate"
    card = Card(
        order=90,
        variants=(Variant((Axis("difference", 0.05, signed=True),)),),
        forbids=(SAME_BACKWARD, SAME_ALL_DRIVE),
        sensor="motor currents of both sides",
        mirrored=("difference",),
    )
    difference: jax.Array = parameter("-", -0.8, 0.8, 0.0, "left gain minus the right one, over their mean, d")

    def actuation(self, memory: tuple[()], drive: Drive, motion: Motion) -> tuple[tuple[()], Drive]:
        """Drive with unequal sides."""
        return memory, scale_drive(drive, 1 + self.difference / 2 * jnp.array([1.0, -1.0]))

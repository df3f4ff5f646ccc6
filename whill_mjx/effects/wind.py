"""Steady wind."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.effects.card import FIXED_IN_ROOM, SAME_BACKWARD, Axis, Card, Variant
from whill_mjx.vehicle.types import Motion, Wrench, parameter


@struct.dataclass
class Wind(Effect):
    """A force (F_x, F_y) fixed in the room, at the chassis origin; no area or air speed is needed.

    A slope gives the same motion, except for the shift of load between the wheels.
    """

    name = "wind"
    room_fixed = True
    typical = {"along_x": (-10.0, 10.0), "along_y": (-10.0, 10.0)}
    source = "estimate: 5 N is about 3 m/s on 0.8 m^2"
    card = Card(
        order=220,
        variants=lambda scale: (
            Variant((Axis("along_x", scale.force / 2, signed=True), Axis("along_y", scale.force / 2, signed=True))),
        ),
        forbids=(*FIXED_IN_ROOM, SAME_BACKWARD),
        sensor="an anemometer, or the same drive out of the wind",
        shown_by_pose=True,
        mirrored=("along_y",),
    )
    along_x: jax.Array = parameter("N", -200.0, 200.0, 0.0, "force towards +x of the room")
    along_y: jax.Array = parameter("N", -200.0, 200.0, 0.0, "force towards +y of the room")

    def force(self, memory: tuple[()], motion: Motion) -> tuple[tuple[()], Wrench]:
        """Wrench of the force in the chassis frame."""
        fx, fy, fz = motion.rotation.T @ jnp.stack([self.along_x, self.along_y, jnp.zeros_like(self.along_x)])
        return memory, replace(Wrench.zero(), fx=fx, fy=fy, fz=fz)

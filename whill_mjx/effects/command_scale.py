"""Scale of commands."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.effects.card import LAW_OF_SPEED, SAME_ALL_DRIVE, SAME_BACKWARD, Axis, Card, Variant
from whill_mjx.vehicle.types import Motion, parameter


@struct.dataclass
class CommandScale(Effect):
    """v -> s_v v, omega -> s_omega omega: the vehicle's unit of speed differs from the sender's."""

    name = "command_scale"
    typical = {"linear": (0.95, 1.05), "angular": (0.9, 1.1)}
    source = "estimate; published wheel radii of the chair differ by 1.9 % (0.1325 and 0.135 m)"
    card = Card(
        order=50,
        variants=(Variant((Axis("linear", 0.02, signed=True), Axis("angular", 0.03, signed=True))),),
        forbids=(LAW_OF_SPEED, SAME_BACKWARD, SAME_ALL_DRIVE),
        sensor="a log of the commands as the vehicle receives them",
        shown_by_pose=True,
    )
    linear: jax.Array = parameter("-", 0.5, 1.5, 1.0, "scale of v")
    angular: jax.Array = parameter("-", 0.3, 1.5, 1.0, "scale of omega")

    def command(self, memory: tuple[()], command: jax.Array, motion: Motion) -> tuple[tuple[()], jax.Array]:
        """Scaled command (2,)."""
        return memory, command * jnp.stack([self.linear, self.angular])

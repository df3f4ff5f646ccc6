"""Dead zone of commands."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.types import Motion, parameter

EDGE = 0.2  # half width of the smooth edge, as a share of the dead zone
TINY = 1e-12  # keeps the edge defined at a dead zone of 0


@struct.dataclass
class CommandDeadZone(Effect):
    """u -> 0 where |u| < d, and u beyond, each of v and omega for itself.

    The edge is a smooth step from 0.8 d to 1.2 d. Larger commands pass unchanged, so only slow motion tells d.
    """

    name = "command_dead_zone"
    typical = {"linear": (0.01, 0.05), "angular": (0.02, 0.1)}
    source = "estimate"
    linear: jax.Array = parameter("m/s", 0.0, 0.2, 0.0, "commands of v below this are lost")
    angular: jax.Array = parameter("rad/s", 0.0, 0.4, 0.0, "commands of omega below this are lost")

    def command(self, memory: tuple[()], command: jax.Array, motion: Motion) -> tuple[tuple[()], jax.Array]:
        """Command (2,) without its small components."""
        edge = jnp.stack([self.linear, self.angular])
        depth = (jnp.abs(command) - (1 - EDGE) * edge) / jnp.maximum(2 * EDGE * edge, TINY)
        depth = jnp.clip(depth, 0.0, 1.0)
        return memory, command * (depth * depth * (3 - 2 * depth))

"""Dead zone of commands."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.vehicle.types import Motion, parameter

EDGE = 0.2  # half width of the smooth edge, as a share of the dead zone
TINY = 1e-12  # keeps the edge defined at a dead zone of 0


@struct.dataclass
class CommandDeadZone(Effect):
    """u -> 0 where |u| < d, and u beyond, of v and omega each for itself, and then of each wheel's speed.

    The edge is a smooth step from 0.8 d to 1.2 d. Larger commands pass unchanged, so only slow motion shows d. Once
    awake, a command passes down to `release` d (a switch with hysteresis), and asleep again it needs d.
    """

    name = "command_dead_zone"
    typical = {"linear": (0.01, 0.05), "angular": (0.02, 0.1)}
    source = "estimate"
    linear: jax.Array = parameter("m/s", 0.0, 0.4, 0.0, "commands of v below this are lost")
    angular: jax.Array = parameter("rad/s", 0.0, 0.8, 0.0, "commands of omega below this are lost")
    wheel: jax.Array = parameter("m/s", 0.0, 0.4, 0.0, "commands of one wheel's speed below this are lost")
    release: jax.Array = parameter("-", 0.1, 1.0, 1.0, "where a command falls asleep again, over where it wakes")

    def init(self) -> jax.Array:
        return jnp.zeros(4)  # how far v, omega, left and right wheel are awake, 0 to 1

    def command(self, memory: jax.Array, command: jax.Array, motion: Motion) -> tuple[jax.Array, jax.Array]:
        """Command (2,) without its small components."""
        half = motion.track / 2
        edge = jnp.stack([self.linear, self.angular])
        awake, passed = self._passed(memory[:2], command, edge)
        kept = command * passed
        wheels = jnp.stack([kept[0] - half * kept[1], kept[0] + half * kept[1]])
        turning, share = self._passed(memory[2:], wheels, self.wheel * jnp.ones(2))
        lost = wheels * (share - 1)  # exactly 0 without a dead zone
        both = kept + jnp.stack([lost[0] + lost[1], (lost[1] - lost[0]) / half]) / 2
        return jnp.concatenate([awake, turning]), both

    def _passed(self, awake: jax.Array, command: jax.Array, edge: jax.Array) -> tuple[jax.Array, jax.Array]:
        """How far components (2,) are awake one step on, and the share of each that passes."""
        size, level = jnp.abs(command), edge * (1 + awake * (self.release - 1))
        depth = jnp.clip((size - (1 - EDGE) * level) / jnp.maximum(2 * EDGE * level, TINY), 0.0, 1.0)
        share = jnp.where(edge > 0, _smooth(depth), 1.0)
        return _smooth(jnp.clip(2 * depth - 1, 0.0, 1.0)), share


def _smooth(depth: jax.Array) -> jax.Array:
    return depth * depth * (3 - 2 * depth)

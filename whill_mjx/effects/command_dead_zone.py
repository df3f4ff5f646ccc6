"""Dead zone of commands."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import TINY, Effect
from whill_mjx.effects.card import (
    SAME_ALL_DRIVE,
    SAME_BACKWARD,
    SAME_IN_TURNS,
    SAME_LEFT_AND_RIGHT,
    Axis,
    Card,
    Variant,
)
from whill_mjx.vehicle.kinematics import twist_from_wheels, wheel_speeds
from whill_mjx.vehicle.types import Motion, parameter

EDGE = 0.2  # half width of the smooth edge, as a share of the dead zone
RELEASE = Axis("release", -0.1, dependent=True, limit=8.0)


@struct.dataclass
class CommandDeadZone(Effect):
    """u -> 0 where |u| < d, else u: first for v and omega separately, then for the speed of each wheel.

    The edge is a smooth step from 0.8 d to 1.2 d. Larger commands pass unchanged, so only slow motion shows d. The
    switch has hysteresis: a command that passes does so until it falls below `release` d, and then needs d again.
    """

    name = "command_dead_zone"
    typical = {"linear": (0.01, 0.05), "angular": (0.02, 0.1)}
    source = "estimate"
    card = Card(
        order=20,
        variants=lambda scale: (
            Variant((Axis("linear", 0.02 * scale.speed, limit=16.0), Axis("angular", 0.04, limit=16.0), RELEASE)),
            Variant((Axis("wheel", 0.02 * scale.speed, limit=16.0), RELEASE), "wheel"),
        ),
        forbids=(SAME_BACKWARD, SAME_LEFT_AND_RIGHT, SAME_IN_TURNS, SAME_ALL_DRIVE),
        sensor="a log of the commands as the vehicle receives them",
    )
    linear: jax.Array = parameter("m/s", 0.0, 0.4, 0.0, "commands of v below this are lost")
    angular: jax.Array = parameter("rad/s", 0.0, 0.8, 0.0, "commands of omega below this are lost")
    wheel: jax.Array = parameter("m/s", 0.0, 0.4, 0.0, "commands of one wheel's speed below this are lost")
    release: jax.Array = parameter("-", 0.1, 1.0, 1.0, "threshold at which a command is lost again, over d")

    def init(self) -> jax.Array:
        return jnp.zeros(4)  # how far v, omega, left and right wheel are passing, 0 to 1

    def command(self, memory: jax.Array, command: jax.Array, motion: Motion) -> tuple[jax.Array, jax.Array]:
        """Command (2,) without its small components."""
        edge = jnp.stack([self.linear, self.angular])
        awake, passed = self._passed(memory[:2], command, edge)
        kept = command * passed
        wheels = wheel_speeds(kept, motion.track)
        turning, share = self._passed(memory[2:], wheels, self.wheel * jnp.ones(2))
        lost = wheels * (share - 1)  # exactly 0 without a dead zone
        return jnp.concatenate([awake, turning]), kept + twist_from_wheels(lost, motion.track)

    def _passed(self, awake: jax.Array, command: jax.Array, edge: jax.Array) -> tuple[jax.Array, jax.Array]:
        """How far components (2,) pass one step on, and the share of each that passes now."""
        size, level = jnp.abs(command), edge * (1 + awake * (self.release - 1))
        depth = jnp.clip((size - (1 - EDGE) * level) / jnp.maximum(2 * EDGE * level, TINY), 0.0, 1.0)
        share = jnp.where(edge > 0, _smooth(depth), 1.0)
        return _smooth(jnp.clip(2 * depth - 1, 0.0, 1.0)), share


def _smooth(depth: jax.Array) -> jax.Array:
    return depth * depth * (3 - 2 * depth)

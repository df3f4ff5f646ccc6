"""Lag of turning."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.effects.card import (
    GONE_WHEN_SETTLED,
    SAME_ALL_DRIVE,
    SAME_FOR_ANY_STEP,
    SAME_LEFT_AND_RIGHT,
    SHOWS_AT_BOTH_ENDS,
    Alike,
    Axis,
    Card,
    Variant,
)
from whill_mjx.vehicle.types import Motion, parameter


@struct.dataclass
class TurnLag(Effect):
    """T d omega / dt = omega_wanted - omega: the yaw rate follows its command with a lag that v does not have.

    Skid-steered wheels slide sideways to turn the vehicle, and their drives take up that load slowly. On published logs
    of such robots the wheels' difference reaches its value in 1.0 to 1.5 s, their mean in 0.4 to 0.5 s.
    """

    name = "turn_lag"
    typical = {"time_constant": (0.2, 1.2)}
    source = "fits to the published DRIVE logs of a Warthog: 0.5 to 1 s more in yaw than ahead"
    card = Card(
        order=290,
        variants=lambda scale: (
            (Variant((Axis("time_constant", 0.1, limit=20.0),)),) if scale.spec.drive == "skid" else ()
        ),
        forbids=(SAME_FOR_ANY_STEP, SHOWS_AT_BOTH_ENDS, SAME_LEFT_AND_RIGHT, SAME_ALL_DRIVE, GONE_WHEN_SETTLED),
        alike=(Alike(("actuator_lag",), "a slower response", "steps of v alone"),),
        limits="The lag is that of one pole and does not depend on the load.",
    )
    time_constant: jax.Array = parameter("s", 0.0, 3.0, 0.0, "time constant of the yaw rate, T")

    def init(self) -> jax.Array:
        return jnp.zeros(())  # yaw rate so far [rad/s]

    def command(self, memory: jax.Array, command: jax.Array, motion: Motion) -> tuple[jax.Array, jax.Array]:
        """Command (2,) with a lagging yaw rate."""
        kept = self.time_constant / (self.time_constant + motion.dt)
        omega = command[1] + (memory - command[1]) * kept
        return omega, jnp.stack([command[0], omega])

"""Steps and limits of the serial command word."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import TINY, Effect
from whill_mjx.effects.card import Card
from whill_mjx.vehicle.types import Motion, parameter

MAKER = {"linear": 0.004 / 3.6, "angular": 0.004 / 3.6 / 0.496, "v_min": -0.556, "v_max": 1.667, "omega_max": 1.68}
"""The chair's values: words of 0.004 km/h, -500 to 1500 forward and +-750 turning (wheel difference over the track)."""


@struct.dataclass
class CommandQuantisation(Effect):
    """u -> q trunc(u / q), clamped: truncation toward zero, as the drivers do it.

    Not smooth in u. In q it is differentiable, except at the jumps from one multiple to the next.
    """

    name = "command_quantisation"
    typical = {
        "linear": (0.001, 0.0012), "angular": (0.0022, 0.0023),
        "v_min": (-0.556, -0.556), "v_max": (1.667, 1.667), "omega_max": (1.68, 1.68),
    }  # fmt: skip
    source = "maker's protocol specification, Rev 10, SetVelocity: 1.111 mm/s and 2.240 mrad/s"
    card = Card(stepped=True)
    linear: jax.Array = parameter("m/s", 0.0, 0.02, 0.0, "step of v")
    angular: jax.Array = parameter("rad/s", 0.0, 0.04, 0.0, "step of omega")
    v_min: jax.Array = parameter("m/s", -5.0, 0.0, float("-inf"), "smallest v")
    v_max: jax.Array = parameter("m/s", 0.1, 5.0, float("inf"), "largest v")
    omega_max: jax.Array = parameter("rad/s", 0.1, 5.0, float("inf"), "largest omega")

    def command(self, memory: tuple[()], command: jax.Array, motion: Motion) -> tuple[tuple[()], jax.Array]:
        """Command (2,) as the vehicle reads it."""
        low = jnp.stack([self.v_min, -self.omega_max])
        high = jnp.stack([self.v_max, self.omega_max])
        clamped = jnp.minimum(jnp.maximum(command, low), high)
        step = jnp.stack([self.linear, self.angular])
        words = jnp.trunc(clamped / jnp.maximum(step, TINY))
        return memory, jnp.where(step > 0, step * words, clamped)

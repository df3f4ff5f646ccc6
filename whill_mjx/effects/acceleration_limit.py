"""Ramp on velocity commands."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.effects.card import GONE_WHEN_SETTLED, SAME_ALL_DRIVE, Axis, Card, Falsifier, Variant
from whill_mjx.vehicle.kinematics import twist_from_wheels, wheel_speeds
from whill_mjx.vehicle.types import Motion, parameter

LINEAR, ANGULAR = Axis("linear", 1.5, form="inverse"), Axis("angular", 3.0, form="inverse")
BRAKES = tuple(Axis(way, 0.25, form="factor", signed=True, dependent=True, limit=6.0)
               for way in ("slowing", "reversing", "turn_slowing"))
"""How braking differs from speeding up; the first two also apply to wheels."""


@struct.dataclass
class AccelerationLimit(Effect):
    """The command followed at a limited rate: |dv/dt| <= linear, |domega/dt| <= angular, |dv_wheel/dt| <= wheel.

    When the command slows the vehicle down, the limit is `slowing` times as large (`turn_slowing` times for omega).
    When it asks for at least as much in the other direction, the limit is `reversing` times as large until the vehicle
    stands.

    Source: the maker's protocol specification, 3.2.8: velocity commands are ramped with about 1.7 m/s^2. It does not
    say whether the ramp acts on (v, omega) or on each wheel. Either can be given, or both, one after the other.
    """

    name = "acceleration_limit"
    typical = {"linear": (0.5, 2.0), "angular": (1.0, 8.0), "wheel": (0.6, 2.5), "slowing": (1.0, 2.0),
               "turn_slowing": (1.0, 2.0), "reversing": (1.0, 2.0)}
    source = "maker's protocol specification, 3.2.8: about 1.7 m/s^2 on velocity commands"
    card = Card(
        order=30,
        variants=(
            Variant((LINEAR,), "linear"),
            Variant((ANGULAR,), "angular"),
            Variant((LINEAR, ANGULAR, *BRAKES), "ramp"),
            Variant((Axis("wheel", 1.5, form="inverse"), *BRAKES[:2]), "wheel"),
        ),
        forbids=(Falsifier("lasts in proportion to the command's step", "size of the step"), GONE_WHEN_SETTLED,
                 SAME_ALL_DRIVE),
        sensor="a log of the wheel-speed targets inside the vehicle",
    )
    linear: jax.Array = parameter("m/s^2", 0.1, 5.0, float("inf"), "largest change of v")
    angular: jax.Array = parameter("rad/s^2", 0.2, 15.0, float("inf"), "largest change of omega")
    wheel: jax.Array = parameter("m/s^2", 0.1, 5.0, float("inf"), "largest change of a wheel's speed")
    slowing: jax.Array = parameter("-", 0.2, 5.0, 1.0, "limit when slowing down over that when speeding up")
    turn_slowing: jax.Array = parameter("-", 0.2, 5.0, 1.0, "the same for omega")
    reversing: jax.Array = parameter("-", 0.2, 5.0, 1.0, "limit on the way to a stop before driving the other way")

    def init(self) -> tuple[jax.Array, jax.Array]:
        return jnp.zeros(2), jnp.zeros(2)  # ramped (v, omega) and wheel speeds so far

    def command(
        self, memory: tuple[jax.Array, jax.Array], command: jax.Array, motion: Motion
    ) -> tuple[tuple[jax.Array, jax.Array], jax.Array]:
        """Ramped command (2,)."""
        ramped = self._follow(memory[0], command, jnp.stack([self.linear, self.angular]) * motion.dt,
                              jnp.stack([self.slowing, self.turn_slowing]))
        wanted = wheel_speeds(ramped, motion.track)
        wheels = self._follow(memory[1], wanted, self.wheel * motion.dt * jnp.ones(2), self.slowing)
        behind = wheels - wanted  # exactly 0 at an infinite limit
        return (ramped, wheels), ramped + twist_from_wheels(behind, motion.track)

    def _follow(self, now: jax.Array, wanted: jax.Array, step: jax.Array, slowing: jax.Array) -> jax.Array:
        """`now` (2,) after one step towards `wanted`; the step differs where it slows down."""
        limited = jnp.isfinite(step)
        step = jnp.where(limited, step, 1.0)
        back = (now * wanted < 0) & (jnp.abs(wanted) >= jnp.abs(now))
        brake = jnp.where(back, self.reversing, slowing) * step
        up, down = jnp.where(now < 0, brake, step), jnp.where(now > 0, brake, step)
        return jnp.where(limited, jnp.minimum(jnp.maximum(wanted, now - down), now + up), wanted)

"""Lag of the drive."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.effects.card import GONE_WHEN_SETTLED, SAME_FOR_ANY_STEP, SHOWS_AT_BOTH_ENDS, Axis, Card, Variant
from whill_mjx.effects.smooth import yielding_by
from whill_mjx.vehicle.types import Drive, Motion, parameter


@struct.dataclass
class ActuatorLag(Effect):
    """(1 + (1 - c) T d/dt) (1 + c T d/dt) F = F_wanted, on the force or the torque of each side (backward Euler).

    With c = 0 it is one lag. With c > 0 it is two lags in a row, such as a filter and a winding; their time constants
    add up to T.
    """

    name = "actuator_lag"
    typical = {"time_constant": (0.02, 0.15), "cascade": (0.0, 0.5)}
    source = "estimate"
    card = Card(
        order=60,
        variants=(Variant((Axis("time_constant", 0.03, limit=10.0), Axis("cascade", 0.1, dependent=True, limit=5.0))),),
        forbids=(SAME_FOR_ANY_STEP, SHOWS_AT_BOTH_ENDS, GONE_WHEN_SETTLED),
        sensor="motor currents",
        shown_by_pose=True,
    )
    time_constant: jax.Array = parameter("s", 0.0, 0.5, 0.0, "time constant of the drive, the sum of both lags")
    cascade: jax.Array = parameter("-", 0.0, 0.5, 0.0, "share of it in the second lag, c")

    def init(self) -> tuple[jax.Array, jax.Array]:
        return jnp.zeros((2, 2)), jnp.zeros((2, 2))  # force and torque of each side so far, after each lag

    def actuation(
        self, memory: tuple[jax.Array, jax.Array], drive: Drive, motion: Motion
    ) -> tuple[tuple[jax.Array, jax.Array], Drive]:
        """Drive with lagging force (2,) and torque (2,)."""
        first = self._lagged(jnp.stack([drive.force, drive.torque]), memory[0], 1 - self.cascade, motion)
        second = self._lagged(first, memory[1], self.cascade, motion)
        at_once = (1 - self._kept(1 - self.cascade, motion)) * (1 - self._kept(self.cascade, motion))
        return (first, second), replace(drive, force=second[0], torque=second[1], yielding=yielding_by(drive, at_once))

    def _lagged(self, wanted: jax.Array, before: jax.Array, share: jax.Array, motion: Motion) -> jax.Array:
        return wanted + (before - wanted) * self._kept(share, motion)

    def _kept(self, share: jax.Array, motion: Motion) -> jax.Array:
        """Share of its old output that a lag keeps in one step."""
        lag = self.time_constant * share
        return lag / (lag + motion.dt)

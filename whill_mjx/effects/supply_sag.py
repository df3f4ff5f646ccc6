"""Loss of drive gain as the supply gives way."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.effects.card import SAME_BACKWARD, SAME_LEFT_AND_RIGHT, Alike, Axis, Card, Variant
from whill_mjx.effects.smooth import scale_drive
from whill_mjx.vehicle.types import Drive, Motion, parameter

ROUND = 200.0  # [s] of a session that one round of manoeuvres takes, with its pauses; logs do not record it


@struct.dataclass
class SupplySag(Effect):
    """F -> F / (1 + a t + b P + d (s + t)): the drive weakens with the time t in a drive, with the power P it draws,
    and over a session that has lasted s when the drive begins.

    P is the power of the wanted forces at the present wheel speeds; power fed back does not count. a is for losses that
    recover between drives (warm motors), d for those that do not (charge).
    """

    name = "supply_sag"
    typical = {"per_second": (0.002, 0.01), "per_watt": (0.0005, 0.002), "drain": (0.00005, 0.0005)}
    source = "estimate: 5 to 15 % late in a session or under full load"
    card = Card(
        order=80,
        variants=lambda scale: (
            Variant((Axis("per_second", 0.004),), "time"),
            Variant((Axis("drain", 0.0002),), "session", constants=(("session", 1.5 * ROUND),)),
            Variant((Axis("per_watt", 0.0006 / scale.power),), "power"),
            Variant((Axis("torque_drive.kp", -0.1, form="factor", signed=True),), "gain", kind="parameter_shift"),
        ),
        forbids=(SAME_BACKWARD, SAME_LEFT_AND_RIGHT),
        sensor="supply voltage and motor currents",
        alike=(Alike(("payload_shift",), "a slower response", "weighing"),),
    )
    per_second: jax.Array = parameter("1/s", 0.0, 0.1, 0.0, "loss of gain per second of the drive, a")
    per_watt: jax.Array = parameter("1/W", 0.0, 0.02, 0.0, "loss of gain per watt drawn, b")
    drain: jax.Array = parameter("1/s", 0.0, 0.02, 0.0, "loss of gain per second of the session, d")
    session: jax.Array = parameter("s", 0.0, 7200.0, 0.0, "time of the session when the drive begins, s")

    def init(self) -> jax.Array:
        return jnp.zeros(())  # time of the drive [s]

    def actuation(self, memory: jax.Array, drive: Drive, motion: Motion) -> tuple[jax.Array, Drive]:
        """Weakened drive."""
        power = ((drive.force * motion.wheel_radius + drive.torque) * motion.spin).sum()
        spent = self.per_second * memory + self.drain * (self.session + memory)
        gain = 1 / (1 + spent + self.per_watt * jnp.maximum(power, 0.0))
        return memory + motion.dt, scale_drive(drive, gain)

"""Loss of drive gain as the supply gives way."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.effects.smooth import scale_drive
from whill_mjx.vehicle.types import Drive, Motion, parameter


@struct.dataclass
class SupplySag(Effect):
    """F -> F / (1 + a t + b P + d (s + t)): the drive weakens within the time t of a drive, with the power P it draws,
    and over a session that has lasted s when the drive begins.

    P is the power of the wanted forces at the present wheel speeds; power fed back does not count. What recovers
    between drives (warm motors) is a, what does not (charge) is d.
    """

    name = "supply_sag"
    typical = {"per_second": (0.002, 0.01), "per_watt": (0.0005, 0.002), "drain": (0.00005, 0.0005)}
    source = "estimate: 5 to 15 % late in a session or under full load"
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

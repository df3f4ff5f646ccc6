"""Play between motor and wheel."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.effects.smooth import scale_drive
from whill_mjx.types import Drive, Motion, parameter


@struct.dataclass
class Gap:
    """Motor angle against the wheel, and its rate, of the left and the right side."""

    angle: jax.Array  # (2,) rad, within +-play
    rate: jax.Array  # (2,) rad/s


@struct.dataclass
class Backlash(Effect):
    """No drive while the motor crosses the gap: I d2(phi)/dt2 = T, |phi| <= beta; T reaches the wheel at phi = +-beta.

    I is the spin inertia of one side, so a reversal to torque T is lost for sqrt(4 beta I / T). Within the physics step
    in which the gap closes, the share of the torque after closing is passed on.
    """

    name = "backlash"
    typical = {"play": (0.0035, 0.0175)}
    source = "estimate: 0.2 to 1 degree at the wheel; hub motors have none"
    play: jax.Array = parameter("rad", 0.0, 0.2, 0.0, "half of the free angle at the wheel, beta")

    def init(self) -> Gap:
        return Gap(jnp.zeros(2), jnp.zeros(2))

    def actuation(self, memory: Gap, drive: Drive, motion: Motion) -> tuple[Gap, Drive]:
        """Drive without what is lost in the gap."""
        torque = drive.torque + drive.force * motion.wheel_radius
        rate = memory.rate + torque / motion.wheel_inertia * motion.dt
        move = rate * motion.dt
        angle = memory.angle + move
        past = jnp.sign(torque) * angle - self.play  # how far the motor would be beyond the end of the gap
        moved = jnp.abs(move)
        some = jnp.clip(past / jnp.where(moved > 0, moved, 1.0), 0.0, 1.0)
        share = jnp.where(past >= moved, 1.0, some)
        stopped = jnp.abs(angle) >= self.play
        kept = jnp.minimum(jnp.maximum(angle, -self.play), self.play)
        return Gap(kept, jnp.where(stopped, 0.0, rate)), scale_drive(drive, share)

"""Play between motor and wheel."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.effects.card import GONE_WHEN_SETTLED, SAME_ALL_DRIVE, SAME_BACKWARD, Axis, Card, Variant
from whill_mjx.effects.smooth import scale_drive
from whill_mjx.vehicle.types import Drive, Motion, parameter


@struct.dataclass
class Gap:
    """Motor angle against the wheel, and its rate, of the left and the right side."""

    angle: jax.Array  # (2,) rad, within +-play
    rate: jax.Array  # (2,) rad/s
    due: jax.Array  # (2,) N m, rest of a blow that came late in the previous step


@struct.dataclass
class Backlash(Effect):
    """The motor crosses the gap by itself: I d2(phi)/dt2 = T, |phi| <= beta; at +-beta it strikes the wheel and stays.

    I is the motor's share of the spin inertia of one side. After a reversal to torque T nothing reaches the wheel for
    sqrt(4 beta I / T). Then all momentum gathered meanwhile arrives in one blow, which lasts one physics step from the
    instant at which the gap closes. A controller that sees the wheel's speed may hunt.
    """

    name = "backlash"
    typical = {"play": (0.0035, 0.0175), "rotor": (0.3, 1.0)}
    source = "estimate: 0.2 to 1 degree at the wheel; hub motors have none. Two masses with a gap: Nordin 2002"
    card = Card(
        order=230,
        variants=(Variant((Axis("play", 0.007, limit=10.0),)),),
        forbids=(GONE_WHEN_SETTLED, SAME_BACKWARD, SAME_ALL_DRIVE),
        sensor="encoders on the motors beside those on the wheels",
    )
    play: jax.Array = parameter("rad", 0.0, 0.2, 0.0, "half of the free angle at the wheel, beta")
    rotor: jax.Array = parameter("-", 0.1, 1.0, 1.0, "share of a side's spin inertia that is the motor's")

    def init(self) -> Gap:
        return Gap(jnp.zeros(2), jnp.zeros(2), jnp.zeros(2))

    def actuation(self, memory: Gap, drive: Drive, motion: Motion) -> tuple[Gap, Drive]:
        """Drive as it reaches the wheel."""
        torque = drive.torque + drive.force * motion.wheel_radius
        inertia = self.rotor * motion.wheel_inertia
        gained = torque / inertia * motion.dt
        move = (memory.rate + gained) * motion.dt
        angle = memory.angle + move
        past = jnp.sign(move) * angle - self.play  # how far the motor would be beyond the end of the gap
        moved = jnp.abs(move)
        some = jnp.clip(past / jnp.where(moved > 0, moved, 1.0), 0.0, 1.0)
        share = jnp.where(past >= moved, 1.0, some)  # of the step, after the gap has closed
        closed = jnp.abs(angle) >= self.play
        blow = jnp.where(closed, (memory.rate + (1 - share) * gained) * inertia / motion.dt, 0.0)  # [N m] over a step
        struck = share * blow + memory.due
        on_chassis = jnp.abs(drive.force) > 0  # the paper's drive
        passed = scale_drive(drive, share)
        passed = replace(passed, force=passed.force + jnp.where(on_chassis, struck / motion.wheel_radius, 0.0),
                         torque=passed.torque + jnp.where(on_chassis, 0.0, struck))
        kept = jnp.minimum(jnp.maximum(angle, -self.play), self.play)
        return Gap(kept, jnp.where(closed, 0.0, memory.rate + gained), (1 - share) * blow), passed

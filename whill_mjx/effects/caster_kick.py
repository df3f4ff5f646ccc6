"""Swivelling casters that have to turn round."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect, contact_wrench, yaw_rate
from whill_mjx.effects.card import GONE_WHEN_STRAIGHT, SAME_ALL_DRIVE, SAME_LEFT_AND_RIGHT, Axis, Card, Variant
from whill_mjx.vehicle.types import Motion, Wrench, parameter

FADE_SPEED = 0.05  # [m/s], fades the kick at rest
TIE_BREAK = 0.03  # [rad], lets an exactly straight reversal start the swivel, counter-clockwise


@struct.dataclass
class CasterKick(Effect):
    """d(delta)/dt = (|v| / L) sin(phi - delta) - omega; F = F_k (1 + k) s / (1 + k |s|), s = sin(phi - delta), across
    each free wheel.

    delta is the direction in which a caster's wheel rolls, phi the direction of motion at its pivot. A trailing caster
    gives no force. After a reversal, or from a parked angle, it pushes until it has swivelled, over a path of a few
    trails L. The force fades below 0.05 m/s. A tyre that slips sideways reaches its maximum force at an angle of some
    degrees, about 1 / k. A skid drive has no free wheels: no effect there.
    """

    name = "caster_kick"
    typical = {"force_limit": (5.0, 30.0), "trail": (0.1, 0.3), "start_angle": (-1.57, 1.57), "sharpness": (0.0, 10.0)}
    source = "estimate; the largest error at a start angle of 90 degrees: reverse directional stability, 2003"
    card = Card(
        order=160,
        variants=lambda scale: (
            Variant((Axis("force_limit", scale.force),
                     Axis("trail", 0.3, form="factor", signed=True, dependent=True, limit=5.0,
                          start=0.15 * scale.length),
                     Axis("sharpness", 2.0, dependent=True))),
        ),
        forbids=(SAME_LEFT_AND_RIGHT, GONE_WHEN_STRAIGHT, SAME_ALL_DRIVE),
        mirrored=("start_angle",),
    )
    force_limit: jax.Array = parameter("N", 0.0, 200.0, 0.0, "largest force of one caster across its wheel, F_k")
    trail: jax.Array = parameter("m", 0.03, 0.5, 0.15, "path over which a caster swivels, L")
    start_angle: jax.Array = parameter("rad", -3.2, 3.2, 0.0, "swivel angle at the start of the drive")
    sharpness: jax.Array = parameter("-", 0.0, 50.0, 0.0, "how early the force approaches its maximum, k")

    def init(self) -> jax.Array:
        return jnp.broadcast_to(jnp.asarray(self.start_angle), (4,)) + jnp.zeros(4)  # delta at each contact

    def force(self, memory: jax.Array, motion: Motion) -> tuple[jax.Array, Wrench]:
        """Wrench of the casters, and their swivel angles (4,) one step on."""
        cos, sin = jnp.cos(memory), jnp.sin(memory)
        speed = jnp.sqrt(motion.contact_vx**2 + motion.contact_vy**2 + FADE_SPEED**2)
        along = motion.contact_vx * cos + motion.contact_vy * sin
        moving = along**2 / (along**2 + FADE_SPEED**2)
        backward = moving * (jnp.sqrt(along**2 + FADE_SPEED**2) - along) / 2  # almost 0 for one that trails or stands
        across = motion.contact_vy * cos - motion.contact_vx * sin
        turning = (across + TIE_BREAK * backward) / self.trail
        swivelled = memory + (turning - yaw_rate(motion)) * motion.dt  # the chassis turns under it
        slide = across / speed
        share = slide * (1 + self.sharpness) / (1 + self.sharpness * jnp.abs(slide))
        push = -self.force_limit * (1 - motion.world.geometry.driven) * share
        return swivelled, contact_wrench(motion, -push * sin, push * cos)

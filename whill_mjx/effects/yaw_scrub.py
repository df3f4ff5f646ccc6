"""Scrub of wide contact patches."""

from __future__ import annotations

from dataclasses import replace

import jax
from flax import struct

from whill_mjx.effects.base import Effect, resting_mass, yaw_rate
from whill_mjx.effects.card import GONE_WHEN_STRAIGHT, SAME_ALL_DRIVE, SAME_LEFT_AND_RIGHT, Alike, Axis, Card, Variant
from whill_mjx.effects.smooth import REST_RATE, soft_sign
from whill_mjx.vehicle.specs import GRAVITY
from whill_mjx.vehicle.types import Motion, Wrench, parameter


@struct.dataclass
class YawScrub(Effect):
    """Torque against turning: T_z = -T_s L tanh(omega / omega_0), L the load of the driven wheels over that at rest.

    T_s is for the vehicle without a load on board. Braking shifts load forward, so the vehicle then turns more easily.
    """

    name = "yaw_scrub"
    typical = {"torque": (2.0, 15.0)}
    source = "estimate; grows with the load of the drive wheels: Lin 2015"
    card = Card(
        order=140,
        variants=lambda scale: (
            Variant((
                Axis("torque", 0.008 * scale.weight * scale.spec.track),
                Axis("track_width.error", 0.005, form="along", dependent=True, limit=4.0),
            ), kind="parameter_shift"),
        ),
        forbids=(SAME_LEFT_AND_RIGHT, GONE_WHEN_STRAIGHT, SAME_ALL_DRIVE),
        alike=(Alike(("omni_roller_friction",), "dry resistance to turning",
                     "an outside pose, and turns about other centres"),),
    )
    torque: jax.Array = parameter("N m", 0.0, 200.0, 0.0, "scrub torque")

    def force(self, memory: tuple[()], motion: Motion) -> tuple[tuple[()], Wrench]:
        """Wrench with a yaw torque only."""
        driven = motion.world.geometry.driven
        rest = (driven * resting_mass(motion)).sum() * motion.mass / motion.total_mass
        share = (driven * motion.normal_force).sum() / (GRAVITY * rest)
        return memory, replace(Wrench.zero(), tz=-self.torque * share * soft_sign(yaw_rate(motion), REST_RATE))

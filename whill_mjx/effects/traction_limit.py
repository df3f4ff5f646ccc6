"""Grip of the driven wheels."""

from __future__ import annotations

import jax
from flax import struct

from whill_mjx.effects.base import Effect, driven_mean
from whill_mjx.effects.card import GONE_WHEN_SETTLED, SAME_ALL_DRIVE, SAME_LEFT_AND_RIGHT, Axis, Card, Variant
from whill_mjx.effects.smooth import limit_drive
from whill_mjx.vehicle.types import Drive, Motion, parameter

TINY = 1e-3  # [N], keeps the limit defined where a wheel has lifted


@struct.dataclass
class TractionLimit(Effect):
    """F -> F / (1 + (F / mu N)^4)^(1/4) on each side, N the load of its driven wheels; a torque is limited at mu N r.

    Like traction control: the drive never asks for more than the ground can give along the wheels, so wheels and
    odometry stay with the body. `slip_traction` of the physical base model has wheels that break away, and grip that
    cornering uses up. The knee is that of `soft_limit`.
    """

    name = "traction_limit"
    typical = {"mu": (0.2, 0.9)}
    source = "estimate: 0.6 to 0.9 dry, 0.2 to 0.4 wet"
    card = Card(
        order=170,
        variants=(Variant((Axis("slip_traction.mu", -0.15, form="factor"),), kind="parameter_shift"),),
        forbids=(SAME_LEFT_AND_RIGHT, GONE_WHEN_SETTLED, SAME_ALL_DRIVE),
        sensor="wheel encoders beside an outside pose",
        limits="The cap ignores cornering, and wheels never break away; `slip_traction` models both.",
    )
    mu: jax.Array = parameter("-", 0.02, 2.0, float("inf"), "traction coefficient of the driven wheels")

    def actuation(self, memory: tuple[()], drive: Drive, motion: Motion) -> tuple[tuple[()], Drive]:
        """Drive with limited force (2,) and torque (2,)."""
        wheels = motion.world.geometry.driven.sum() / 2  # of one side
        grip = self.mu * (wheels * driven_mean(motion, motion.normal_force) + TINY)
        return memory, limit_drive(drive, grip, grip * motion.wheel_radius)

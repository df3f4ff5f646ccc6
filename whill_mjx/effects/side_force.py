"""Constant push to the side."""

from __future__ import annotations

from dataclasses import replace

import jax
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.effects.card import FIXED_ON_VEHICLE, SAME_ALL_DRIVE, Axis, Card, Variant
from whill_mjx.vehicle.specs import VehicleSpec
from whill_mjx.vehicle.types import Motion, Wrench, parameter


def pushed_anywhere(spec: VehicleSpec) -> tuple[float, float]:
    """Smallest and largest sideways force, relative to one at the chassis origin, that turns the vehicle as much.

    Driven wheels hardly yield to the side, so only the torque about their axle shows. We let the force act anywhere on
    the middle half of the wheelbase. If the origin lies on the axle, or wheels of both axles are driven, the force
    itself shows.
    """
    arm = abs(spec.reference_x)
    if spec.drive == "skid" or arm < 1e-3:
        return 1.0, 1.0
    return min(arm / (0.75 * spec.wheelbase), 1.0), max(arm / (0.25 * spec.wheelbase), 1.0)


@struct.dataclass
class SideForce(Effect):
    """F_y = F_s in the vehicle's own frame, at the chassis origin: it turns with the vehicle, unlike slope and wind.

    It acts even at rest, where the sideways grip of the wheels holds it.
    """

    name = "side_force"
    typical = {"sideways": (-20.0, 20.0)}
    source = "estimate: a pull on one side, a dragging caster"
    card = Card(
        order=200,
        variants=lambda scale: (
            Variant((Axis("sideways", scale.force, signed=True, open=pushed_anywhere(scale.spec)),)),
        ),
        forbids=(*FIXED_ON_VEHICLE, SAME_ALL_DRIVE),
        mirrored=("sideways",),
    )
    sideways: jax.Array = parameter("N", -300.0, 300.0, 0.0, "force to the left, F_s")

    def force(self, memory: tuple[()], motion: Motion) -> tuple[tuple[()], Wrench]:
        """Wrench along the chassis y axis."""
        return memory, replace(Wrench.zero(), fy=self.sideways)

"""Distance per turn of the wheels, less while turning."""

from __future__ import annotations

from dataclasses import replace

import jax
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.effects.card import (
    LAW_OF_YAW_RATE,
    SAME_ALL_DRIVE,
    SAME_BACKWARD,
    SAME_LEFT_AND_RIGHT,
    Axis,
    Card,
    Variant,
)
from whill_mjx.effects.smooth import smooth_size
from whill_mjx.vehicle.types import World, parameter


@struct.dataclass
class TurningSlip(Effect):
    """r -> r / (1 + k |omega|): a turn of the wheels moves the vehicle less far the faster it turns.

    Wheels that are dragged sideways creep more along as well. The odometry counts the whole distance.
    """

    name = "turning_slip"
    typical = {"per_yaw_rate": (0.0, 0.15)}
    source = "fits to the published DRIVE logs of a Warthog"
    card = Card(
        order=320,
        variants=lambda scale: (
            (Variant((Axis("per_yaw_rate", 0.02, signed=True),)),) if scale.spec.drive == "skid" else ()
        ),
        forbids=(LAW_OF_YAW_RATE, SAME_BACKWARD, SAME_LEFT_AND_RIGHT, SAME_ALL_DRIVE),
        shown_by_pose=True,
        limits="The same on both sides, and whatever the speed.",
    )
    per_yaw_rate: jax.Array = parameter("s/rad", -0.3, 0.5, 0.0, "loss of distance per rad/s, k")

    def world(self, memory: tuple[()], world: World) -> tuple[tuple[()], World]:
        """World with smaller wheels while the vehicle turns."""
        geometry = world.geometry
        shrunk = 1 / (1 + self.per_yaw_rate * smooth_size(world.yaw_rate)).clip(1 / 3, 3.0)
        return memory, replace(world, geometry=replace(geometry, wheel_radius=geometry.wheel_radius * shrunk))

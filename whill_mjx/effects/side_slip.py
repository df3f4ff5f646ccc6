"""Sideways slip in bends."""

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
    Alike,
    Axis,
    Card,
    Variant,
)
from whill_mjx.vehicle.types import World, parameter


@struct.dataclass
class SideSlip(Effect):
    """v_y = -k v omega: in a bend the vehicle travels at an angle to its heading, outwards.

    Its wheels roll along a line that is turned by the tangent -k omega. k = m / c for tyres that hold with c v_y
    against the centrifugal force m v omega, which for `slip_traction` is about s0_y / (mu g): this effect is what the
    vehicle slides beyond that.
    """

    name = "side_slip"
    typical = {"per_yaw_rate": (0.0, 0.15)}
    source = "fits to the published DRIVE logs of a Warthog: 0.05 to 0.15 s/rad in all, the tyres' own creep included"
    card = Card(
        order=330,
        variants=lambda scale: (
            (Variant((Axis("per_yaw_rate", 0.02, signed=True),)),) if scale.spec.drive == "skid" else ()
        ),
        forbids=(LAW_OF_YAW_RATE, SAME_BACKWARD, SAME_LEFT_AND_RIGHT, SAME_ALL_DRIVE),
        shown_by_pose=True,
        alike=(Alike(("pose_delay",), "a path that turns late", "a gyro"),),
        limits="All wheels are turned by one angle, which follows the yaw rate without a lag.",
    )
    per_yaw_rate: jax.Array = parameter("s/rad", -0.3, 0.5, 0.0, "sideways over forward speed, per rad/s, k")

    def world(self, memory: tuple[()], world: World) -> tuple[tuple[()], World]:
        """World with the direction in which the wheels roll."""
        return memory, replace(world, drift=world.drift - self.per_yaw_rate * world.yaw_rate)

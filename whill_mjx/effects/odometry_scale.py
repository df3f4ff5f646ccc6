"""Scale of the reported odometry."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.effects.card import LAW_OF_SPEED, SAME_ALL_DRIVE, SAME_BACKWARD, Alike, Axis, Card, Variant
from whill_mjx.vehicle.types import Motion, Odometry, parameter


@struct.dataclass
class ScaleMemory:
    """The latest pose, and by how much the reported position differs from it."""

    pose: jax.Array  # (3,) x, y, yaw
    shift: jax.Array  # (2,) m


@struct.dataclass
class OdometryScale(Effect):
    """v -> s_v v, omega -> s_omega omega, and the pose they integrate to: the odometry's radius or track is wrong."""

    name = "odometry_scale"
    typical = {"linear": (0.98, 1.02), "angular": (0.95, 1.05)}
    source = "published wheel radii of the chair, 0.1325 and 0.135 m; tracks 0.490 and 0.496 m"
    card = Card(
        order=240,
        variants=(Variant((Axis("linear", 0.005, signed=True), Axis("angular", 0.01, signed=True))),),
        forbids=(LAW_OF_SPEED, SAME_BACKWARD, SAME_ALL_DRIVE),
        sensor="an outside pose",
        alike=(Alike(("command_scale", "wheel_radius_difference"), "scales of distance", "an outside pose"),),
    )
    linear: jax.Array = parameter("-", 0.7, 1.3, 1.0, "scale of distance and speed")
    angular: jax.Array = parameter("-", 0.5, 2.0, 1.0, "scale of heading and yaw rate")

    def init(self) -> ScaleMemory:
        return ScaleMemory(jnp.zeros(3), jnp.zeros(2))

    def sensing(self, memory: ScaleMemory, reading: Odometry, motion: Motion) -> tuple[ScaleMemory, Odometry]:
        """Scaled reading."""
        pose = jnp.stack([reading.x, reading.y, reading.yaw])
        dx, dy = pose[0] - memory.pose[0], pose[1] - memory.pose[1]
        turn = (self.angular - 1) * (pose[2] + memory.pose[2]) / 2  # the reported heading runs ahead by this
        cos, sin = self.linear * jnp.cos(turn), self.linear * jnp.sin(turn)
        # The shift grows by the scaled and turned step less the step itself: exactly 0 at scales of 1.
        shift = memory.shift + jnp.stack([cos * dx - sin * dy - dx, sin * dx + cos * dy - dy])
        scaled = replace(
            reading,
            x=pose[0] + shift[0],
            y=pose[1] + shift[1],
            yaw=self.angular * pose[2],
            v=self.linear * reading.v,
            omega=self.angular * reading.omega,
        )
        return ScaleMemory(pose, shift), scaled

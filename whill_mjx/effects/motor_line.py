"""The line of torque over speed of the motors."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.effects.card import SAME_ALL_DRIVE, SAME_BACKWARD, SAME_LEFT_AND_RIGHT, Alike, Axis, Card, Variant
from whill_mjx.vehicle.types import Drive, Motion, parameter


@struct.dataclass
class MotorLine(Effect):
    """-(S + w) / d <= F <= (S - w) / d on each side, with its wheel speed w: F <= F_stall (1 - w / S), F_stall = S / d.

    A DC motor at a limited voltage has less torque the faster it turns, so the speed that a side reaches falls with its
    load by the droop d. On published logs of a skid-steered robot it is 4.0 m/s on a straight and 0.4 to 1.6 m/s less
    in turns. With d = 0 it is a limit of the wheel's speed. A steeper line than a physics step allows, on which a wheel
    that slips would swing, is flattened to that.

    On a differential drive turning loads the motors little, and their controller ends far below S: the loop looks for
    the effect on skid drives alone.
    """

    name = "motor_line"
    typical = {"no_load_speed": (1.0, 6.0), "droop": (0.0005, 0.05)}
    source = "torque over speed of a DC motor; 4 m/s and some 0.003 s/kg fit the published DRIVE logs of a Warthog"
    card = Card(
        order=300,
        variants=lambda scale: (
            (Variant((Axis("no_load_speed", 2 * scale.spec.v_max, form="inverse"),
                      Axis("droop", scale.spec.v_max / (2 * scale.weight), dependent=True))),)
            if scale.spec.drive == "skid" else ()
        ),
        forbids=(SAME_BACKWARD, SAME_LEFT_AND_RIGHT, SAME_ALL_DRIVE),
        alike=(Alike(("torque_saturation", "supply_sag"), "a cap on the force", "one load at several speeds"),),
        limits="The voltage does not fall with the battery or with what the other side draws.",
    )
    no_load_speed: jax.Array = parameter("m/s", 0.2, 20.0, float("inf"), "wheel speed without load, S")
    droop: jax.Array = parameter("s/kg", 0.0, 0.2, 0.0, "speed lost per newton that a side pushes, d")

    def actuation(self, memory: tuple[()], drive: Drive, motion: Motion) -> tuple[tuple[()], Drive]:
        """Drive with force (2,) and torque (2,) on or below the line."""
        radius, speed = motion.wheel_radius, motion.spin * motion.wheel_radius
        limited = jnp.isfinite(self.no_load_speed)
        fastest = jnp.where(limited, self.no_load_speed, 1.0)
        droop = self.droop + motion.dt * radius**2 / (2 * motion.wheel_inertia)
        low, high = -(fastest + speed) / droop, (fastest - speed) / droop
        torque = jnp.clip(drive.torque, radius * low, radius * high)
        cut, about = drive.torque - torque, drive.yielding
        within = replace(about, slack=about.slack + cut, low=jnp.maximum(about.low + cut, radius * low - torque),
                         high=jnp.minimum(about.high + cut, radius * high - torque))
        line = replace(drive, force=jnp.clip(drive.force, low, high), torque=torque, yielding=within)
        return memory, jax.tree.map(lambda on, off: jnp.where(limited, on, off), line, drive)

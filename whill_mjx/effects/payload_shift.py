"""Extra mass on board."""

from __future__ import annotations

from dataclasses import replace

import jax
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.effects.card import SAME_ALL_DRIVE, SAME_BACKWARD, SHOWS_AT_BOTH_ENDS, Axis, Card, Variant
from whill_mjx.vehicle.types import Payload, World, parameter


@struct.dataclass
class PayloadShift(Effect):
    """A point mass m_p fixed at (x, y, z): more weight and inertia, another centre of mass.

    The diagonal of the inertia becomes that of I + mu (d^2 1 - d d^T), with mu = m m_p / (m + m_p) and d the arm
    between both centres (parallel axes; no products of inertia). Springs and gains of the drive stay as without the
    load.
    """

    name = "payload_shift"
    typical = {"mass": (5.0, 40.0), "x": (-0.2, 0.2), "y": (-0.2, 0.2), "z": (0.1, 0.5)}
    source = "estimate: bags of 5 to 40 kg; riders of 40 to 120 kg belong into the vehicle's mass"
    card = Card(
        order=130,
        variants=lambda scale: (
            Variant((
                Axis("mass", 0.08 * scale.spec.mass),
                Axis("x", 0.01 * scale.spec.mass * scale.spec.wheelbase, form="moment", signed=True, dependent=True,
                     reach=0.6 * scale.length),
                Axis("y", 0.01 * scale.spec.mass * scale.spec.track, form="moment", signed=True, dependent=True,
                     reach=0.6 * scale.width),
            ), constants=(("z", 0.3 * scale.height),)),
        ),
        forbids=(SHOWS_AT_BOTH_ENDS, SAME_BACKWARD, SAME_ALL_DRIVE),
        sensor="scales under the wheels",
        limits="No products of inertia: a load both ahead of and above the centre of mass would couple roll and yaw.",
        mirrored=("y",),
    )
    mass: jax.Array = parameter("kg", 0.0, 150.0, 0.0, "extra mass, m_p")
    x: jax.Array = parameter("m", -0.6, 0.6, 0.0, "position ahead of the chassis origin")
    y: jax.Array = parameter("m", -0.4, 0.4, 0.0, "position to the left of the chassis origin")
    z: jax.Array = parameter("m", -0.2, 1.0, 0.0, "position above the chassis origin")

    def world(self, memory: tuple[()], world: World) -> tuple[tuple[()], World]:
        """World with a payload on the vehicle."""
        return memory, replace(world, payload=Payload(self.mass, self.x, self.y, self.z))

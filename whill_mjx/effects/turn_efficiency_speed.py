"""How well a speed difference of the wheels turns the vehicle, by its speed."""

from __future__ import annotations

from dataclasses import replace

import jax
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.effects.card import LAW_OF_SPEED, SAME_ALL_DRIVE, SAME_BACKWARD, SAME_LEFT_AND_RIGHT, Axis, Card, Variant
from whill_mjx.effects.smooth import smooth_size
from whill_mjx.vehicle.types import World, parameter


@struct.dataclass
class TurnEfficiencySpeed(Effect):
    """chi = chi_0 (1 + s |v|): the share of the wheels' speed difference that turns the body changes with the speed.

    chi_0 is `turn_efficiency`, and the law is its law: the driven contacts act at y / (1 + s |v|). The centres about
    which the sides of a skid-steered vehicle rotate move with its speed, as its load shifts and its tyres creep.
    """

    name = "turn_efficiency_speed"
    typical = {"per_speed": (-0.08, 0.08)}
    source = "fits to the published DRIVE logs of a Warthog: some percent per m/s"
    card = Card(
        order=310,
        variants=lambda scale: (
            (Variant((Axis("per_speed", 0.02 / scale.speed, signed=True),)),) if scale.spec.drive == "skid" else ()
        ),
        forbids=(LAW_OF_SPEED, SAME_BACKWARD, SAME_LEFT_AND_RIGHT, SAME_ALL_DRIVE),
        shown_by_pose=True,
        limits="Linear in the speed, between a third and three times of the efficiency at rest.",
    )
    per_speed: jax.Array = parameter("s/m", -0.3, 0.3, 0.0, "change of the turn efficiency per m/s, s")

    def world(self, memory: tuple[()], world: World) -> tuple[tuple[()], World]:
        """World with the driven contacts where they act at this speed."""
        geometry = world.geometry
        chi = (1 + self.per_speed * smooth_size(world.speed)).clip(1 / 3, 3.0)
        factor = 1 + geometry.driven * (1 / chi - 1)
        return memory, replace(world, geometry=replace(geometry, contact_y=geometry.contact_y * factor))

"""From the road up a ramp to the pavement, where the kerb is cut."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp

from whill_mjx.effects.ramp import Ramp
from whill_mjx.io.fields import Field
from whill_mjx.tasks.base import COMMON_SWEEPS, Task, World
from whill_mjx.tasks.parts import lane, make_marker
from whill_mjx.world.scene import Boxes, Scene, box, default_looks, stack_boxes
from whill_mjx.world.solids import Blocks, Solids, block, stack_blocks

KERB, EDGE, PAVEMENT, SLAB = (0.62, 0.62, 0.60), (0.74, 0.70, 0.58), (0.55, 0.50, 0.46), (0.70, 0.66, 0.60)
"""Colours of the kerb, of the ramp's sides, of the pavement and of the ramp."""
THICK = 0.1
"""Width of a kerb stone [m]."""
SLABS = 6
"""Flat pieces that show the ramp."""
HALF = 2.0
"""Half the distance of the walls [m]."""
BEHIND = 2.0
"""From the marker to the wall behind it [m]."""


@dataclass(frozen=True)
class KerbRamp(Task):
    """Find the cut in a kerb across the way, drive up its ramp and on to a marker on the pavement.

    The kerb and the sides of the ramp stop the vehicle. The ramp is a surface of the vehicle's physics: it tilts, slows
    down and looks upwards.
    """

    name: ClassVar[str] = "kerb_ramp"
    ranges: ClassVar[tuple[Field, ...]] = (
        Field("kerb_x", "m", 0.5, 1e3), Field("cut", "m", 0.01, 100.0, kind="numbers", count=2),
        Field("rise", "m", 0.001, 2.0, kind="numbers", count=2), Field("run", "-", 0.5, 1e3, kind="numbers", count=2),
    )  # fmt: skip
    walls: ClassVar[int] = 3
    sweeps: ClassVar[tuple[str, ...]] = COMMON_SWEEPS

    v_min: float = -0.2
    v_max: float = 0.8
    omega_max: float = 0.8
    max_steps: int = 250
    smoothness_gain: float = 0.1
    kerb_x: float = 2.2
    """Distance of the kerb, where the ramp begins [m]."""
    goal_x: float = 5.5
    """Distance of the marker [m]."""
    cut: tuple[float, float] = (0.95, 1.3)
    """Least and largest width of the cut [m]; the built-in chair is 0.55 m wide."""
    rise: tuple[float, float] = (0.06, 0.14)
    """Least and largest height of the kerb [m]."""
    run: tuple[float, float] = (8.0, 12.0)
    """Least and largest length of the ramp for its height."""

    def __post_init__(self) -> None:
        super().__post_init__()
        longest, end_x = max(self.rise) * max(self.run), self.goal_x + BEHIND
        if self.kerb_x + longest >= end_x:
            raise ValueError(f"task: kerb_x {self.kerb_x:g}, rise {max(self.rise):g}, run {max(self.run):g}: the ramp "
                             f"ends at {self.kerb_x + longest:g} m, and the room at {end_x:g} m. Take a lower rise, a "
                             "shorter run or a nearer kerb_x, or a farther goal_x.")  # fmt: skip

    def sample_world(self, key: jax.Array) -> World:
        """Place, width, height and steepness of the cut, the goal behind it, place and heading of the start."""
        draw = self.draws(key)
        cut_y, start_y = draw(-0.9, 0.9, fixed=0.4), draw(-0.5, 0.5, fixed=0.0)
        width, rise, run = (draw(*limits, fixed=sum(limits) / 2) for limits in (self.cut, self.rise, self.run))
        goal_y = jnp.clip(cut_y + draw(-0.5, 0.5, fixed=0.0), -1.2, 1.2)
        start = jnp.stack([
            jnp.zeros(()), start_y, jnp.arctan2(cut_y - start_y, self.kerb_x) + draw(-0.3, 0.3, fixed=0.0)
        ])
        ramp = Ramp(rise=rise, length=rise * run, distance=jnp.asarray(self.kerb_x), direction=jnp.zeros(()))
        end_x = self.goal_x + BEHIND
        boxes = stack_boxes([*lane(jnp.asarray(HALF), end_x), *_stones(ramp, cut_y, width)])
        marker = make_marker(self.goal_x, goal_y, size=0.6, height=0.8 + rise)
        scene = Scene(
            boxes, marker, default_looks(), solids=Solids(blocks=_slabs(ramp, cut_y, width)),
            ghosts=_pavement(ramp, cut_y, width, end_x), ground=(ramp,),
        )  # fmt: skip
        return World(scene, start)


def _sides(cut_y: jax.Array, width: jax.Array) -> list[tuple[jax.Array, jax.Array]]:
    """Middle across the way, and length, of the kerb to the left and to the right of the cut."""
    return [(side * (HALF + side * cut_y + width / 2) / 2, HALF - side * cut_y - width / 2)
            for side in (1.0, -1.0)]  # fmt: skip


def _stones(ramp: Ramp, cut_y: jax.Array, width: jax.Array) -> list[Boxes]:
    """The kerb beside the cut, and the stones along both sides of the ramp."""
    stones = [box(ramp.distance + THICK / 2, middle, THICK, length, ramp.rise, jnp.array(KERB))
              for middle, length in _sides(cut_y, width)]  # fmt: skip
    for side in (1.0, -1.0):
        y = cut_y + side * (width + THICK) / 2
        stones.append(box(ramp.distance + ramp.length / 2, y, ramp.length, THICK, ramp.rise, jnp.array(EDGE)))
    return stones


def _pavement(ramp: Ramp, cut_y: jax.Array, width: jax.Array, end_x: float) -> Boxes:
    """The pavement behind the ramp and beside it; it is seen, and the ramp's surface carries the vehicle."""
    top, colour = ramp.distance + ramp.length, jnp.array(PAVEMENT)
    beside = [box(ramp.distance + (THICK + ramp.length) / 2, middle, ramp.length - THICK, length, ramp.rise, colour)
              for middle, length in _sides(cut_y, width)]  # fmt: skip
    return stack_boxes([box((top + end_x) / 2, 0.0, end_x - top, 2 * HALF, ramp.rise, colour), *beside])


def _slabs(ramp: Ramp, cut_y: jax.Array, width: jax.Array) -> Blocks:
    """The ramp as flat pieces between points of its surface."""
    x = ramp.distance + ramp.length * jnp.linspace(0.0, 1.0, SLABS + 1)
    z = ramp.height(x, jnp.zeros(()))[0]
    length, slope = jnp.hypot(x[1:] - x[:-1], z[1:] - z[:-1]), jnp.arctan2(z[1:] - z[:-1], x[1:] - x[:-1])
    slabs, half_thick = [], 0.01
    for index in range(SLABS):
        c, s = jnp.cos(slope[index]), jnp.sin(slope[index])
        zero, one = 0.0 * c, 1.0 + 0.0 * c
        rotation = jnp.stack([jnp.stack([c, zero, -s]), jnp.stack([zero, one, zero]), jnp.stack([s, zero, c])])
        middle = jnp.stack([(x[index] + x[index + 1]) / 2, cut_y, (z[index] + z[index + 1]) / 2])
        half = jnp.stack([length[index] / 2, width / 2, half_thick * one])
        slabs.append(block(middle - half_thick * rotation[:, 2], half, rotation, jnp.array(SLAB)))
    return stack_blocks(slabs)


"""The paper's laboratory corridor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp

from whill_mjx.tasks.base import COMMON_SWEEPS, Budget, Task, World
from whill_mjx.tasks.parts import CARDBOARD, lane, make_marker
from whill_mjx.world.scene import Scene, box, default_looks, stack_boxes


@dataclass(frozen=True)
class Corridor(Task):
    """Drive around a cardboard box to a blue square 4.5 m ahead, in a corridor.

    The paper does not give the corridor's width; it is chosen here and stays, so that figures compare.
    """

    name: ClassVar[str] = "corridor"
    looks: ClassVar[str] = "paper"
    lane: ClassVar[bool] = True
    walls: ClassVar[int] = 3
    sweeps: ClassVar[tuple[str, ...]] = ("obstacle_x=2,3 obstacle_y=-0.4:0.4:5", *COMMON_SWEEPS)
    budgets: ClassVar[dict[str, Budget]] = {
        "paper": Budget(
            200_000, eval_every=20_000, second_tries=0.5, learner=dict(train_ratio=160.0, vector_scale=5.0, mirror=3)
        ),
        "transfer": Budget(  # no picture is learned twice, and most of what a picture shows is of no use elsewhere
            200_000, eval_every=20_000, second_tries=0.5,
            learner=dict(train_ratio=160.0, recon_scale=0.1, vector_scale=50.0, mirror=1, redraw=True),
        ),
        "wallclock": Budget(8_000_000, eval_every=500_000, exploring_starts=0.5, stop_success=0.99),
        "cpu": Budget(8_000, eval_every=1000),
    }

    v_min: float = 0.0
    v_max: float = 0.3
    omega_max: float = 0.6
    max_steps: int = 300
    smoothness_gain: float = 0.0
    goal_x: float = 4.5
    """Distance of the goal marker [m]."""
    box_x: float = 2.5
    """Distance of the cardboard box before its randomisation; 2 and 3 in the paper's evaluation [m]."""
    width: float = 2.4
    """Distance between the walls [m]."""

    def sample_world(self, key: jax.Array) -> World:
        """Randomised as in the paper: start +-0.3 m and +-15 degrees, box +-1.0 m along and +-0.5 m across."""
        draw = self.draws(key)
        box_x, box_y = self.box_x + draw(-1.0, 1.0, fixed=0.0), draw(-0.5, 0.5, fixed=0.0)
        x, y = draw(-0.3, 0.3, fixed=0.0), draw(-0.3, 0.3, fixed=0.0)
        start = jnp.stack([x, y, jnp.deg2rad(draw(-15.0, 15.0, fixed=0.0))])
        cardboard = box(box_x, box_y, 0.40, 0.40, 0.45, jnp.array(CARDBOARD))
        boxes = stack_boxes([*lane(jnp.asarray(self.width / 2), self.goal_x + 2.0), cardboard])
        marker = make_marker(self.goal_x, jnp.zeros(()), size=0.5, height=0.55)
        return World(Scene(boxes, marker, default_looks()), start)

"""The paper's obstacle course."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp

from whill_mjx.tasks.base import COMMON_SWEEPS, Budget, Task, World
from whill_mjx.tasks.parts import OBSTACLES, lane, make_marker
from whill_mjx.world.scene import Scene, box, default_looks, stack_boxes

_EASY = {"v_min": 0.0, "gates": 1}


@dataclass(frozen=True)
class ObstacleCourse(Task):
    """Drive through two gates to a goal 5.3 m ahead, between walls. Driving straight on hits the first gate.

    A gate is a pair of low boxes, one to each side of a gap, that leave no second way through. The boxes are lower than
    the camera, so the goal marker above them is in sight from the start, and so is the second gap above the first gate.
    The paper does not give the layout; it is chosen here and stays, so that figures compare.
    """

    name: ClassVar[str] = "obstacle_course"
    lane: ClassVar[bool] = True
    walls: ClassVar[int] = 3
    sweeps: ClassVar[tuple[str, ...]] = ("obstacle_shift_y=-0.3:0.3:7", *COMMON_SWEEPS)
    budgets: ClassVar[dict[str, Budget]] = {
        "paper": Budget(
            22_000, eval_every=1000, exploring_starts=0.5,
            learner=dict(train_ratio=384.0, horizon=50.0, return_lambda=0.98, imag_horizon=25, mirror=1, batch_size=32,
                         batch_length=32),
        ),
        "wallclock": Budget(8_000_000, eval_every=500_000, exploring_starts=0.5, stop_success=0.99),
        "cpu": Budget(8_000, eval_every=1000, fields=_EASY),
        "smoke": Budget(400, eval_every=200, fields=_EASY),
    }  # fmt: skip

    gates: int = 2
    """1 leaves out the second gate: an easier course for short trainings on a CPU."""
    goal_x: float = 5.3
    """Distance of the goal centre [m]: 4.3 m to go until arrival."""
    gate_x: tuple[float, float] = (2.30, 3.90)
    """Places of the gates [m]."""

    def sample_world(self, key: jax.Array) -> World:
        """Gaps of the gates, their sizes, walls, goal and heading at the start; all lengths in m."""
        draw = self.draws(key)
        heading = draw(-0.20, 0.20, fixed=0.0)
        ahead = self.gate_x[0] * jnp.tan(heading)  # where driving straight on would cross the first gate
        side = draw.sign()
        gap_1 = side * draw(0.42, 0.66, fixed=0.50)
        gap_1 = jnp.where(jnp.abs(gap_1 - ahead) < 0.40, ahead - side * 0.40, gap_1)  # straight on must not pass
        gap_2 = jnp.clip(gap_1 + side * draw(-0.70, 0.30, fixed=-0.65), -0.66, 0.66)
        wall = draw(1.60, 1.90, fixed=1.75)
        goal_y = jnp.clip(gap_2 + draw(-0.50, 0.50, fixed=-0.10), -0.60, 0.60)
        boxes = [*lane(wall, self.goal_x + 2.5)]
        for gate, gap in enumerate([gap_1, gap_2][: self.gates]):
            x = self.gate_x[gate] + draw(-0.10, 0.10, fixed=0.0)
            gap_width = draw(0.96, 1.10, fixed=1.04)
            for part, direction in enumerate((1.0, -1.0)):
                inner = direction * gap + gap_width / 2  # signed distance of the box's near end from the centre line
                outer = wall - draw(0.0, 0.35, fixed=0.1)
                length, height = draw(0.25, 0.50, fixed=0.35), draw(0.35, 0.62, fixed=0.5)
                colour = jnp.array(OBSTACLES[2 * gate + part])
                boxes.append(box(x, direction * (inner + outer) / 2, length, outer - inner, height, colour))
        marker = make_marker(self.goal_x, goal_y, size=0.6, height=1.05)
        start = jnp.stack([jnp.zeros(()), jnp.zeros(()), heading])
        return World(Scene(stack_boxes(boxes), marker, default_looks()), start)

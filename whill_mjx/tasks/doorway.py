"""A door in a wall, between the vehicle and its goal."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp

from whill_mjx.io.fields import Field
from whill_mjx.tasks.base import COMMON_SWEEPS, Task, World
from whill_mjx.tasks.parts import WALL, lane, make_marker
from whill_mjx.world.scene import Scene, box, default_looks, stack_boxes


@dataclass(frozen=True)
class Doorway(Task):
    """Drive through a door of 0.85 to 1.0 m, anywhere in a wall across a room, to a marker that is seen through it."""

    name: ClassVar[str] = "doorway"
    ranges: ClassVar[tuple[Field, ...]] = (
        Field("wall_x", "m", 0.5, 1e3), Field("door", "m", 0.01, 100.0, kind="numbers", count=2),
    )  # fmt: skip
    looks: ClassVar[str] = "paper"
    lane: ClassVar[bool] = True
    walls: ClassVar[int] = 3
    sweeps: ClassVar[tuple[str, ...]] = ("obstacle_shift_y=-0.3:0.3:7", *COMMON_SWEEPS)

    v_min: float = -0.2
    v_max: float = 0.5
    omega_max: float = 0.8
    max_steps: int = 250
    smoothness_gain: float = 0.1
    wall_x: float = 2.5
    """Distance of the wall with the door [m]."""
    goal_x: float = 5.0
    """Distance of the marker [m]."""
    door: tuple[float, float] = (0.85, 1.0)
    """Least and largest width of the door [m]; the built-in chair is 0.55 m wide."""

    def sample_world(self, key: jax.Array) -> World:
        """Place and width of the door, goal behind it, place and heading of the start."""
        draw = self.draws(key)
        half, thickness = 2.0, 0.15
        door_y = draw(-1.0, 1.0, fixed=0.4)
        width = draw(self.door[0], self.door[1], fixed=(self.door[0] + self.door[1]) / 2)
        goal_y = jnp.clip(door_y + draw(-0.4, 0.4, fixed=0.0), -1.2, 1.2)
        start_y = draw(-0.5, 0.5, fixed=0.0)
        towards = jnp.arctan2(door_y - start_y, self.wall_x)
        start = jnp.stack([jnp.zeros(()), start_y, towards + draw(-0.3, 0.3, fixed=0.0)])
        left, right = half - (door_y + width / 2), half + (door_y - width / 2)  # lengths of the wall's two parts
        colour = 0.92 * jnp.array(WALL)
        boxes = stack_boxes([
            *lane(jnp.asarray(half), self.goal_x + 2.0),
            box(self.wall_x, half - left / 2, thickness, left, 2.0, colour),
            box(self.wall_x, -half + right / 2, thickness, right, 2.0, colour),
        ])
        return World(Scene(boxes, make_marker(self.goal_x, goal_y, size=0.6, height=0.8), default_looks()), start)

"""A goal in an open square with obstacles, reached by state instead of pictures."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from whill_mjx.io.fields import Field
from whill_mjx.sensors.commands import Commands
from whill_mjx.sensors.goal import Goal
from whill_mjx.sensors.lidar import Lidar
from whill_mjx.tasks.base import COMMON_SWEEPS, Budget, Task, World
from whill_mjx.tasks.parts import OBSTACLES, make_marker, room
from whill_mjx.world.scene import Scene, box, default_looks, stack_boxes

HALF = 4.0
"""Half the edge of the square, if no goal needs a larger one [m]."""
AROUND_START, AROUND_GOAL = 1.4, 1.1
"""Boxes whose middle is nearer than this to the start or to the goal are left out [m]."""


@dataclass(frozen=True)
class PointGoal(Task):
    """Drive to a point 2 to 3.5 m away in any direction, between up to five boxes, in a square of 8 m.

    Goals that are farther away make the square larger.

    The vehicle knows where the goal is, scans what is around it, and knows its last command; it needs no camera.
    """

    name: ClassVar[str] = "point_goal"
    rising: ClassVar[tuple[str, ...]] = ("nearest", "farthest")
    ranges: ClassVar[tuple[Field, ...]] = (
        Field("nearest", "m", 0.0, 1e4), Field("farthest", "m", 0.01, 1e4),
        Field("boxes", kind="whole", low=0, high=200),
    )  # fmt: skip
    sweeps: ClassVar[tuple[str, ...]] = COMMON_SWEEPS[:1] + COMMON_SWEEPS[3:]
    budgets: ClassVar[dict[str, Budget]] = {
        "cpu": Budget(
            400_000, eval_every=100_000, instances=64, fields={"action_repeat": 2}, ppo=dict(rollout=64, minibatches=8)
        ),
    }

    v_min: float = 0.0
    v_max: float = 0.8
    omega_max: float = 1.2
    max_steps: int = 200
    goal_radius: float = 0.5
    smoothness_gain: float = 0.1
    boxes: int = 5
    """Most boxes in the square."""
    nearest: float = 2.0
    """Smallest distance of the goal from the start [m]."""
    farthest: float = 3.5
    """Largest distance [m]."""

    def sample_world(self, key: jax.Array) -> World:
        """Heading at the start, goal and boxes."""
        draw = self.draws(key)
        heading = draw(-math.pi, math.pi, fixed=0.0)
        distance, bearing = draw(self.nearest, self.farthest, fixed=2.7), draw(-math.pi, math.pi, fixed=0.5)
        goal = distance * jnp.stack([jnp.cos(bearing), jnp.sin(bearing)])
        boxes = [room(max(HALF, self.farthest + self.goal_radius))]
        for number in range(self.boxes):
            angle = 2 * math.pi * number / self.boxes + draw(-0.6, 0.6, fixed=0.0)
            away, edge, turned = draw(1.2, 3.2, fixed=2.0), draw(0.3, 0.6, fixed=0.4), draw(0.0, 1.5, fixed=0.0)
            place = away * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
            there = (away > AROUND_START) & (jnp.linalg.norm(place - goal) > AROUND_GOAL)
            colour = jnp.array(OBSTACLES[number % len(OBSTACLES)])
            boxes.append(box(place[0], place[1], edge, edge, 0.6, colour, turned, there))
        marker = make_marker(goal[0], goal[1], size=0.5, height=0.9, yaw=bearing)
        start = jnp.stack([jnp.zeros(()), jnp.zeros(()), heading])
        return World(Scene(stack_boxes(boxes), marker, default_looks()), start)

    def observations(self) -> Mapping[str, Any]:
        return {"goal": Goal(), "lidar": Lidar(rays=36, reach=4.0, z=0.3), "commands": Commands(1)}

"""Ground plans of the foreign worlds: where the chair starts, what stands in its way, and where the goal is."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

BEGIN = -2.0
"""Where each room begins [m]; the chair starts near the origin and drives along x."""
WAY = 1.05
"""Width that things along the walls leave on the wider side of a carton [m]."""


class Block(NamedTuple):
    """A box on the floor: the place of its middle, its half sizes [m], and its turn [rad]."""

    x: float
    y: float
    half_x: float
    half_y: float
    half_z: float
    yaw: float

    def reach(self) -> tuple[float, float]:
        """Half sizes along and across the room [m]."""
        sin, cos = abs(math.sin(self.yaw)), abs(math.cos(self.yaw))
        return self.half_x * cos + self.half_y * sin, self.half_x * sin + self.half_y * cos


@dataclass(frozen=True)
class Plan:
    """What all variants of a world share."""

    start: tuple[float, float, float]
    """x, y [m] and heading [rad] of the drive axle."""
    obstacles: tuple[Block, ...]
    goal: tuple[float, float]
    marker: tuple[float, float]
    """Half size of the blue square, and height of its middle [m]."""
    half_width: float
    end: float
    lone: bool
    """Whether the one obstacle is a carton on the floor, which may have any size and turn."""

    def takes(self, thing: Block, obstacles: tuple[Block, ...]) -> bool:
        """Whether something may stand along a wall, with these obstacles in the room."""
        if not self.lone:
            return all(abs(thing.x - one.x) > one.half_x + thing.half_x + 0.05 for one in obstacles)
        carton = obstacles[0]
        beside = abs(thing.x - carton.x) < max(carton.half_x, carton.half_y) + thing.half_x + 1.0
        wider = -1 if carton.y > 0 else 1
        free = self.half_width + abs(carton.y) - carton.reach()[1] - 2 * thing.half_y
        return not (beside and thing.y * wider > 0 and free < WAY)


def corridor(seed: int) -> Plan:
    """The paper's corridor: a lane 2.4 m wide, a carton at 2 or 3 m, a blue square of 0.5 m at 4.5 m."""
    random = np.random.default_rng([seed, 11])
    start = (random.uniform(-0.3, 0.3), random.uniform(-0.3, 0.3), math.radians(random.uniform(-15, 15)))
    carton = Block(2.0 + seed % 2, random.uniform(-0.5, 0.5), 0.2, 0.2, 0.225, 0.0)
    return Plan(start, (carton,), (4.5, 0.0), (0.25, 0.55), 1.2, 6.5, True)


def obstacle_course(seed: int) -> Plan:
    """The obstacle course: two gates of low boxes, and a blue square of 0.6 m above and behind them.

    Straight on is the first gate, never its gap. The gaps are 0.96 to 1.10 m wide.
    """
    random = np.random.default_rng([seed, 15])
    heading, side = random.uniform(-0.2, 0.2), random.choice([-1.0, 1.0])
    straight = 2.3 * math.tan(heading)
    first = side * random.uniform(0.42, 0.66)
    if abs(first - straight) < 0.4:
        first = straight - side * 0.4
    second = float(np.clip(first + side * random.uniform(-0.7, 0.3), -0.66, 0.66))
    half_width = random.uniform(1.6, 1.9)
    blocks = []
    for x, gap in ((2.3, first), (3.9, second)):
        x, wide = x + random.uniform(-0.1, 0.1), random.uniform(0.96, 1.1)
        for way in (-1.0, 1.0):
            inner, outer = way * gap + wide / 2, half_width - random.uniform(0.0, 0.35)
            long, tall = random.uniform(0.25, 0.5), random.uniform(0.35, 0.62)
            blocks.append(Block(x, way * (inner + outer) / 2, long / 2, (outer - inner) / 2, tall / 2, 0.0))
    goal = (5.3, float(np.clip(second + random.uniform(-0.5, 0.5), -0.6, 0.6)))
    return Plan((0.0, 0.0, heading), tuple(blocks), goal, (0.3, 1.05), half_width, 7.8, False)


PLANS: dict[str, Callable[[int], Plan]] = {"corridor": corridor, "obstacle_course": obstacle_course}
"""By the names of the tasks that policies learn."""

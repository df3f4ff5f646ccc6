"""A task of one's own: come to rest in a bay beside a pillar. This program drives it by a rule."""

from dataclasses import dataclass
from typing import ClassVar

import jax.numpy as jnp
import numpy as np

from whill_mjx import Budget, Task, World
from whill_mjx.sensors.goal import Goal
from whill_mjx.sensors.lidar import Lidar
from whill_mjx.tasks import parts, terms
from whill_mjx.world.scene import Scene, box, default_looks, stack_boxes


@dataclass(frozen=True)
class Parking(Task):
    """The bay lies beside a pillar, somewhere across the room."""

    budgets: ClassVar = {"cpu": Budget(steps=100_000, instances=32)}
    v_min: float = -0.4
    v_max: float = 0.8
    bay_x: float = 3.0

    def sample_world(self, key):
        bay_y = self.draws(key)(-1.0, 1.0, fixed=0.5)
        pillar = box(self.bay_x, bay_y + 1.2, 0.4, 0.4, 1.0, jnp.array(parts.CARDBOARD))
        bay = parts.make_marker(self.bay_x, bay_y, size=0.4, height=0.8)
        return World(Scene(stack_boxes([parts.room(6.0), pillar]), bay, default_looks()), start=jnp.zeros(3))

    def parked(self, moment):
        return (moment.goal_distance < 0.3) & (jnp.abs(moment.twist[0]) < 0.1)

    def rewards(self, moment):
        return {
            "progress": 10.0 * terms.progress(moment),
            "rest": 50.0 * self.parked(moment),
            "time": jnp.asarray(-0.05),
        }

    def endings(self, moment):
        return {"collision": moment.collided, "success": self.parked(moment)}

    def observations(self):
        return {"goal": Goal(noise=0.02), "lidar": Lidar(rays=24, reach=5.0)}


def rule(goal: np.ndarray) -> np.ndarray:
    """Action towards the goal (2,) m ahead and to the left; slow near it, and standing at it."""
    ahead, left = goal
    speed = min(0.5, 0.8 * max(ahead, 0.0)) if ahead > 0.15 else 0.0
    v = 2 * (speed + 0.4) / 1.2 - 1  # the task drives from -0.4 to 0.8 m/s
    return np.clip([v, 1.5 * np.arctan2(left, max(ahead, 0.3))], -1, 1)


def main() -> None:
    from whill_mjx.gym import WhillEnv

    env = WhillEnv(Parking())
    for seed in range(3):
        obs, info = env.reset(seed=seed)
        done = False
        while not done:
            obs, _, terminated, truncated, info = env.step(rule(obs["goal"]))
            done = terminated or truncated
        print(
            f"world {seed}: {'parked' if info['success'] else 'not parked'}, {info['goal_distance']:.2f} m from the bay"
        )


if __name__ == "__main__":
    main()

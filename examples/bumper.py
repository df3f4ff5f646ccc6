"""A sensor of one's own: a bumper that feels what is near. This program drives into a box and prints what it feels."""

from dataclasses import dataclass

import jax.numpy as jnp

from whill_mjx.sensors.base import Reading, Sensor
from whill_mjx.sensors.lidar import Lidar
from whill_mjx.tasks import terms


@dataclass(frozen=True)
class Bumper(Sensor):
    """(1,) 1 where something is nearer than `reach`."""

    reach: float = 0.05
    """[m]"""

    def reading(self, env):
        return Reading(shape=(1,), low=0.0, high=1.0)

    def measure(self, memory, view, key):
        near = terms.shortfall(view.moment, self.reach) > 0
        return memory, near.astype(jnp.float32)[None]


def main() -> None:
    from whill_mjx.gym import WhillEnv

    env = WhillEnv("corridor", observations={"bumper": Bumper(latency_s=0.1), "lidar": Lidar(rays=36)})
    obs, info = env.reset(seed=0)
    done = False
    while not done:
        obs, _, terminated, truncated, info = env.step([1.0, 0.0])
        done = terminated or truncated
    felt, nearest = obs["bumper"][0], obs["lidar"].min()
    print(f"bumper {felt:.0f}, nearest ray {nearest:.2f}, clearance {info['clearance']:.2f} m")


if __name__ == "__main__":
    main()

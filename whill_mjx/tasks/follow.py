"""Follow a person who walks ahead through a room."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from whill_mjx.io.fields import Field
from whill_mjx.sensors.commands import Commands
from whill_mjx.sensors.goal import Goal
from whill_mjx.sensors.lidar import Lidar
from whill_mjx.tasks.base import COMMON_SWEEPS, Budget, Task, World
from whill_mjx.tasks.parts import OBSTACLES, make_marker, room
from whill_mjx.tasks.terms import Moment, wrap
from whill_mjx.world.maps.walls import distances_to
from whill_mjx.world.people.contact import scene_with_people
from whill_mjx.world.people.crowd import Crowd, people_on
from whill_mjx.world.people.law import ARRIVED
from whill_mjx.world.scene import Scene, box, default_looks, stack_boxes

ROOM, INSIDE = 6.0, 4.5
"""Half the edge of the room, and of the square that the person stays in [m]."""
POINTS, LEG = 12, 1.5
"""Points of the person's way, and their distance [m]."""
SHARPEST = 1.2
"""Largest turn of the way at one of its points, where it would leave the square [rad]."""
AHEAD, BESIDE = 1.5, 1.2
"""Where the person begins ahead of the vehicle, and how near to the way no pillar stands [m]."""


@dataclass(frozen=True)
class Follow(Task):
    """Stay behind a person until they stop, 0.8 to 2 m away at best, in a square of 12 m with up to five pillars.

    The vehicle knows where the person is, scans what is around it, and knows its last command.
    """

    name: ClassVar[str] = "follow"
    rising: ClassVar[tuple[str, ...]] = ("slowest", "fastest")
    ranges: ClassVar[tuple[Field, ...]] = (
        Field("keep", "m", 0.01, 100.0), Field("near_reward", "-", -1e9, 1e9), Field("lost_at", "m", 0.01, 1e3),
        Field("slowest", "m/s", 0.0, 10.0), Field("fastest", "m/s", 0.0, 10.0),
        Field("pillars", kind="whole", low=0, high=200),
    )  # fmt: skip
    sweeps: ClassVar[tuple[str, ...]] = COMMON_SWEEPS[:1] + COMMON_SWEEPS[3:]
    budgets: ClassVar[dict[str, Budget]] = {
        "cpu": Budget(
            600_000, eval_every=150_000, instances=64, fields={"action_repeat": 2}, ppo=dict(rollout=64, minibatches=8)
        ),
    }
    per_period: ClassVar[tuple[str, ...]] = ("time", "distance")

    v_min: float = -0.2
    v_max: float = 1.2
    omega_max: float = 1.2
    max_steps: int = 400
    goal_radius: float = 2.0
    """Greatest distance from the person that counts as near [m]."""
    smoothness_gain: float = 0.1
    step_reward: float = 0.0
    keep: float = 1.3
    """Best distance of the driven-axle centre from the person [m]."""
    near_reward: float = 0.3
    """Reward of a control period at the best distance."""
    lost_at: float = 4.0
    """Distance at which the person is lost [m]."""
    slowest: float = 0.4
    fastest: float = 0.9
    """Speed of the person [m/s]."""
    pillars: int = 5

    def sample_world(self, key: jax.Array) -> World:
        """The person's way and speed, and pillars beside it."""
        draw = self.draws(key)
        place, heading = jnp.array([AHEAD, 0.0]), draw(-0.4, 0.4, fixed=0.2)
        way = [place]
        for number in range(POINTS - 1):
            inwards = jnp.arctan2(-place[1], -place[0])
            turn = draw(-0.7, 0.7, fixed=0.3 * math.sin(number))
            back = jnp.clip(wrap(inwards - heading), -SHARPEST, SHARPEST)
            heading = heading + jnp.where(jnp.max(jnp.abs(place)) > INSIDE - LEG, back, turn)
            place = jnp.clip(place + LEG * jnp.stack([jnp.cos(heading), jnp.sin(heading)]), -INSIDE, INSIDE)
            way.append(place)
        route = jnp.stack(way)
        legs = jnp.stack([route[:-1], route[1:]], 1)
        boxes = [room(ROOM)]
        for number in range(self.pillars):
            x, y = draw(-5.0, 5.0, fixed=-4.0 + 2.0 * number), draw(-5.0, 5.0, fixed=4.5)
            turned, edge = draw(0.0, 1.5, fixed=0.0), draw(0.3, 0.6, fixed=0.4)
            clear = jnp.minimum(distances_to(legs, x, y).min(), jnp.hypot(x, y)) > BESIDE + edge
            boxes.append(box(x, y, edge, edge, 1.6, jnp.array(OBSTACLES[number % len(OBSTACLES)]), turned, clear))
        pace = draw(self.slowest, self.fastest, fixed=0.7)
        person_key, dress_key = jax.random.split(key if self.randomised else jax.random.key(0))
        person = people_on(
            person_key, Crowd(count=1, yielding=0.0), route[None], jnp.zeros(1, jnp.int32), jnp.ones(1, bool)
        )
        person = replace(
            person,
            speed=pace[None],
            velocity=pace * person.velocity / person.speed[:, None],
            returns=jnp.zeros(1, bool),
        )
        end = route[-1]
        marker = make_marker(end[0], end[1], size=0.02, height=0.02)  # a scene has one; nobody looks for this one
        scene = Scene(stack_boxes(boxes), marker, default_looks())
        return World(scene_with_people(scene, person, dress_key), jnp.zeros(3))

    def goal(self, scene: Scene) -> jax.Array:
        """The person, who comes first among all people."""
        assert scene.people is not None
        return scene.people.position[0]

    def rewards(self, moment: Moment) -> dict[str, jax.Array]:
        off = (moment.goal_distance - self.keep) / 0.5
        change = jnp.abs(moment.command[1] - moment.previous_command[1])
        return {
            "distance": self.near_reward * jnp.exp(-(off**2)),
            "goal": self.goal_reward * self._arrived(moment),
            "collision": self.collision_reward * moment.collided,
            "lost": self.collision_reward * self._lost(moment),
            "smoothness": -self.smoothness_gain * change,
            "time": jnp.asarray(self.step_reward),
        }

    def endings(self, moment: Moment) -> dict[str, jax.Array]:
        return {"collision": moment.collided, "success": self._arrived(moment), "lost": self._lost(moment)}

    def observations(self) -> Mapping[str, Any]:
        return {"goal": Goal(noise=0.05), "lidar": Lidar(rays=72, reach=5.0, z=0.3), "commands": Commands(1)}

    def _arrived(self, moment: Moment) -> jax.Array:
        """The person stands at the end of the way, and the vehicle is near."""
        person = moment.scene.people
        assert person is not None
        far = jnp.linalg.norm(person.route[0, -1] - person.position[0])
        return (far < ARRIVED) & moment.reached

    def _lost(self, moment: Moment) -> jax.Array:
        return (moment.goal_distance > self.lost_at) & ~moment.collided

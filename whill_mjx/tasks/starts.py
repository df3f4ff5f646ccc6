"""Episodes that begin anywhere on the way: the exploring starts of Sutton and Barto, for training only.

From the nominal start alone, a learner that is held up half-way never sees what lies behind: neither its model nor its
critic learns that going on pays. A simulator can put the vehicle there.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from whill_mjx.tasks.base import Task, World
from whill_mjx.vehicle.specs import VehicleSpec
from whill_mjx.world.collision import free_distance
from whill_mjx.world.lidar import first_hits
from whill_mjx.world.scene import Scene, footprint

TRIES = 64
"""Poses drawn at one distance from the goal, of which the first free one is taken."""
ASIDE = 1.0
"""Largest distance from the straight line to the goal [m]."""
TURNED = 0.6
"""Largest angle off the direction of the goal [rad]."""
CLEAR = 0.10
"""Smallest distance from a box or a wall [m]."""
HEIGHT = 0.3
"""At which the sight is free [m]."""
SHORT = 0.3
"""Least way to go beyond the radius of arrival [m]."""


def anywhere(task: Task, spec: VehicleSpec, world: World, key: jax.Array) -> jax.Array:
    """Start (3,) of x [m], y [m] and yaw [rad] at a random free place between the world's own start and the goal.

    A place is free where nothing is near and no wall lies between it and the own start, or between it and the goal:
    inside a wall of a map, or outside of the building, nothing is near either. The own start, where none of the places
    drawn is free.

    Args:
        task: radius of arrival.
        spec: the vehicle's size.
        world: of the episode.
        key: consumed.
    """
    goal = task.goal(world.scene)
    way = goal - world.start[:2]
    length = jnp.linalg.norm(way)
    along = way / length
    far_key, key = jax.random.split(key)
    far = jax.random.uniform(far_key, maxval=jnp.maximum(length - task.goal_radius - SHORT, 0.0))

    def draw(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        aside, turned = jax.random.uniform(key, (2,), minval=-1.0)
        place = world.start[:2] + far * along + aside * ASIDE * jnp.stack([-along[1], along[0]])
        ahead = goal - place
        yaw = jnp.arctan2(ahead[1], ahead[0]) + turned * TURNED
        free = free_distance(footprint(spec, place[0], place[1], yaw), world.scene) >= CLEAR
        free &= jnp.linalg.norm(ahead) >= task.goal_radius + SHORT
        return jnp.append(place, yaw), free

    starts, free = jax.vmap(draw)(jax.random.split(key, TRIES))
    rooms = _walls_alone(task, world.scene)
    free &= _in_sight(rooms, world.start[:2], starts[:, :2]) | _in_sight(rooms, goal, starts[:, :2])
    return jnp.where(jnp.any(free), starts[jnp.argmax(free)], world.start)


def _walls_alone(task: Task, scene: Scene) -> Scene:
    """The scene with only its walls: those of a map, and the boxes that the task calls walls."""
    count = scene.boxes.mask.shape[0]
    drawn = 0 if scene.walls is None else scene.walls.keep  # the last boxes are pictures of a map's walls
    is_wall = (jnp.arange(count) < task.walls) | (jnp.arange(count) >= count - drawn)
    boxes = dataclasses.replace(scene.boxes, mask=scene.boxes.mask & is_wall)
    return dataclasses.replace(scene, boxes=boxes, solids=None)


def _in_sight(scene: Scene, eye: jax.Array, places: jax.Array) -> jax.Array:
    """Which places (N, 2) [m] are seen from a point (2,)."""
    way = places - eye
    return first_hits(scene, eye[0], eye[1], jnp.arctan2(way[:, 1], way[:, 0]), HEIGHT) > jnp.hypot(*way.T)


def draw_start(share: float, task: Task, spec: VehicleSpec, world: World, key: jax.Array) -> jax.Array:
    """Start (3,) of an episode: `anywhere` in this share of episodes, else the world's own."""
    choice, place = jax.random.split(key)
    return jnp.where(jax.random.uniform(choice) < share, anywhere(task, spec, world, place), world.start)

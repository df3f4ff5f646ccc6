"""The world of one instance from above: what people look at, in pictures and films."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from whill_mjx.env.records import Env, State
from whill_mjx.vehicle.kinematics import reference_pose
from whill_mjx.world.maps.walls import nearest_walls
from whill_mjx.world.render import Intrinsics, render
from whill_mjx.world.scene import box, footprint, stack_boxes

VIEW, INSIDE = np.array([2.6, 0.0], np.float32), np.array([4.0, 2.0], np.float32)
"""Middle of the view from above, and how far from it the view lets a vehicle go [m]."""


def top_view(env: Env, state: State, path: jax.Array | None = None) -> jax.Array:
    """World of one instance from 12 m above, as wide as its camera image and twice as high; +x is up.

    The vehicle is drawn as a dark box, and each point of `path` (T, 2) as a small yellow one. The view follows a
    vehicle that would leave it, and in a map every one. Colours are plain ones, without ceiling and lamps.
    """
    x, y, yaw = reference_pose(env.model, state.vehicle.qpos)
    spec, outline = env.model.spec, footprint(env.model.spec, x, y, yaw)
    dark, yellow = jnp.array([0.1, 0.1, 0.12]), jnp.array([0.95, 0.85, 0.1])
    extra = [box(outline.x, outline.y, spec.body_length, spec.body_width, 0.9, dark, yaw)]
    if path is not None:
        extra += [box(point[0], point[1], 0.08, 0.08, 0.95, yellow) for point in path]
    scene, walls, marker = state.scene, state.scene.walls, state.scene.marker
    edge = 2 * marker.half[1]
    extra.append(box(marker.position[0], marker.position[1], 0.15, edge, 1.4, marker.colour, marker.yaw))
    boxes, off = scene.boxes, jnp.stack([x, y]) - VIEW
    place: jax.Array = jnp.asarray(VIEW) + (off - jnp.clip(off, -INSIDE, INSIDE))
    if scene.hidden is not None:
        boxes = dataclasses.replace(boxes, mask=boxes.mask & ~scene.hidden)
    if walls is not None:  # the last boxes are those that the camera sees; from above, the nearest are seen
        boxes = jax.tree.map(lambda leaf: leaf[: leaf.shape[0] - walls.keep], boxes)
        extra.append(nearest_walls(jnp.asarray(walls.segments), x, y, walls.keep, walls.height))
        place = jnp.stack([x, y])
    ghosts = scene.ghosts if scene.rich is None else None
    scene = dataclasses.replace(
        scene, boxes=stack_boxes([boxes, *extra]), walls=None, hidden=None, ghosts=ghosts, finish=None, rich=None
    )
    height, width = 2 * env.height, env.width
    down = jnp.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])  # right is -y, down is -x, forward is -z
    focal = jnp.asarray(height * 12.0 / 9.0)  # 9 m of ground over the height
    intrinsics = Intrinsics(focal, focal, jnp.asarray(width / 2), jnp.asarray(height / 2), height=height, width=width)
    return render(jnp.append(place, 12.0), down, intrinsics, scene)

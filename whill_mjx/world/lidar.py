"""Rays of a 2-D laser scanner in the same scene that the camera sees, exact against every shape, on the device.

`whill_mjx.sensors.lidar` makes a sensor of them.

A ray is a half line in the plane of the scanner. It meets upright boxes, walls of a map, cylinders and capsules
(people); a distance field is followed along the ray (sphere tracing, Hart 1996).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from whill_mjx.world.maps.field import DistanceField, distance_at
from whill_mjx.world.maps.walls import to_first_wall
from whill_mjx.world.scene import Boxes, Scene
from whill_mjx.world.solids import Rounds

TRACES = 64
"""Steps of the sphere tracing."""
FARTHEST = 100.0
"""Longest ray that is traced [m]."""
AT_A_TIME = 8
"""Cylinders and capsules that are met in one round of a loop."""
CLOSE = 1e-3
"""Distance at which a traced ray has arrived [m]."""


def sent_from(
    place: jax.Array, pose: jax.Array, twist: jax.Array, rays: int, period: float
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """x, y [m] and turn [rad], each (rays,), of a scanner when each ray of a scan was sent; the first is oldest.

    The vehicle's reference point goes along an arc, and the scanner, which is fixed to the vehicle, turns around it.
    `turn` is the vehicle's yaw less its yaw when the scan ends.

    Args:
        place: (2,) x, y of the scanner when the scan ends [m].
        pose: (3,) x [m], y [m], yaw [rad] of the reference point then.
        twist: (2,) speed ahead of the reference point [m/s], and yaw rate [rad/s].
        rays: number of rays.
        period: duration of the scan [s]; 0 is a scan at one moment.
    """
    if period == 0.0:
        still = jnp.zeros(rays)
        return place[0] + still, place[1] + still, still
    age = period * (1.0 - (jnp.arange(rays) + 1.0) / rays)
    turn = -twist[1] * age
    chord = age * twist[0] * jnp.sinc(turn / (2 * jnp.pi))
    middle = pose[2] + turn / 2  # a chord has the direction of its arc's middle
    c, s = jnp.cos(turn), jnp.sin(turn)
    arm = place - pose[:2]
    x = place[0] - chord * jnp.cos(middle) + (c - 1.0) * arm[0] - s * arm[1]
    y = place[1] - chord * jnp.sin(middle) + s * arm[0] + (c - 1.0) * arm[1]
    return x, y, turn


def disturbed(
    distance: jax.Array, key: jax.Array, noise: float, dropouts: float, nearest: float, reach: float
) -> jax.Array:
    """Distances (R,) [m] as a scanner reports them, at most `reach`, which also stands for no return.

    Args:
        distance: (R,) true ones.
        key: of noise and dropouts.
        noise: standard deviation [m].
        dropouts: share of rays without a return.
        nearest: shorter distances give no return [m].
        reach: largest distance [m].
    """
    noise_key, drop_key = jax.random.split(key)
    measured = distance + noise * jax.random.normal(noise_key, distance.shape)
    lost = (jax.random.uniform(drop_key, distance.shape) < dropouts) | (distance < nearest) | (distance > reach)
    return jnp.where(lost, reach, jnp.clip(measured, 0.0, reach))


def first_hits(
    scene: Scene, x, y, angle: jax.Array, height: float, field: DistanceField | None = None
) -> jax.Array:
    """(R,) m: how far the first thing is along each ray, inf without one.

    Args:
        scene: upright boxes, rounds and the walls of a map count; the goal's marker does not.
        x, y: (R,) or () where each ray begins [m].
        angle: (R,) direction in the world [rad].
        height: of the plane [m].
        field: followed as well.
    """
    x, y = jnp.broadcast_to(x, angle.shape), jnp.broadcast_to(y, angle.shape)
    boxes, walls = scene.boxes, scene.walls
    nearest = jnp.full(angle.shape, jnp.inf)
    if walls is not None:
        boxes = jax.tree.map(lambda leaf: leaf[: leaf.shape[0] - walls.keep], boxes)  # the rest are pictures of walls
        if height <= walls.height:
            nearest = to_first_wall(jnp.asarray(walls.segments), x, y, angle)
    if boxes.mask.shape[0]:
        nearest = jnp.minimum(nearest, _to_boxes(boxes, x, y, angle, height))
    if scene.solids is not None and scene.solids.rounds is not None:
        origin = jnp.stack([x, y, jnp.full(x.shape, height)], -1)
        way = jnp.stack([jnp.cos(angle), jnp.sin(angle), jnp.zeros(angle.shape)], -1)
        nearest = jnp.minimum(nearest, _to_rounds(scene.solids.rounds, origin, way))
    if field is not None:
        nearest = jnp.minimum(nearest, trace(field, x, y, angle))
    return nearest


def _to_boxes(boxes: Boxes, x, y, angle, height) -> jax.Array:
    """(R,) m to the first upright box that the plane cuts, by the slab test in each box's frame."""
    dx, dy = x[:, None] - boxes.centre[:, 0], y[:, None] - boxes.centre[:, 1]  # (R, P)
    c, s = jnp.cos(boxes.yaw), jnp.sin(boxes.yaw)
    turn = angle[:, None] - boxes.yaw
    start = (dx * c + dy * s, dy * c - dx * s)
    enter, leave = jnp.zeros(turn.shape), jnp.full(turn.shape, jnp.inf)
    ways, halves = (jnp.cos(turn), jnp.sin(turn)), (boxes.half[:, 0], boxes.half[:, 1])
    for place, way, half in zip(start, ways, halves, strict=True):
        way = jnp.where(jnp.abs(way) < 1e-9, 1e-9, way)
        one, other = (-half - place) / way, (half - place) / way
        enter = jnp.maximum(enter, jnp.minimum(one, other))
        leave = jnp.minimum(leave, jnp.maximum(one, other))
    cut = boxes.mask & (jnp.abs(height - boxes.centre[:, 2]) <= boxes.half[:, 2])
    return jnp.min(jnp.where((enter <= leave) & cut, enter, jnp.inf), -1, initial=jnp.inf)


def _to_rounds(rounds: Rounds, origin: jax.Array, way: jax.Array) -> jax.Array:
    """(R,) m to the first cylinder or capsule, some of them at a time."""
    count = rounds.mask.shape[0]
    size = min(count, AT_A_TIME)  # the last of them may be met twice

    def some(number: jax.Array, nearest: jax.Array) -> jax.Array:
        first = jnp.minimum(number * size, count - size)
        part = jax.tree.map(lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, first, size), rounds)
        return jnp.minimum(nearest, round_hits(part, origin, way).min(-1))

    nearest = jnp.full(way.shape[:1], jnp.inf)
    return jax.lax.fori_loop(0, -(-count // size), some, nearest) if count else nearest


def round_hits(rounds: Rounds, origin: jax.Array, way: jax.Array) -> jax.Array:
    """(R, K) m from places (R, 3) along unit vectors (R, 3) to each cylinder or capsule, inf where a ray misses it.

    By the quadratic of the mantle, and the ends.
    """
    out, way = origin[:, None] - rounds.centre, way[:, None]  # (R, K, 3), (R, 1, 3)
    along = jnp.sum(out * rounds.axis, -1)
    slope = jnp.sum(way * rounds.axis, -1)
    square, half = rounds.radius**2, rounds.half

    def quadratic(a, b, c):
        """Smaller root of a t2 + 2 b t + c where there is one and it is not behind, else inf; 0 from the inside."""
        root = b * b - a * c
        t = (-b - jnp.sqrt(jnp.maximum(root, 0.0))) / jnp.where(a < 1e-9, 1e-9, a)
        return jnp.where((root >= 0.0) & (a >= 1e-9), t, jnp.inf)

    side = quadratic(1.0 - slope**2, jnp.sum(out * way, -1) - along * slope, jnp.sum(out**2, -1) - along**2 - square)
    hits = [jnp.where(jnp.abs(along + side * slope) <= half, side, jnp.inf)]
    for end in (-1.0, 1.0):
        apart = out - end * half[:, None] * rounds.axis
        ball = quadratic(jnp.ones(slope.shape), jnp.sum(apart * way, -1), jnp.sum(apart**2, -1) - square)
        safe = jnp.where(jnp.abs(slope) < 1e-9, 1e-9, slope)
        disc = (end * half - along) / safe
        at = apart + disc[..., None] * way
        disc = jnp.where((jnp.sum(at**2, -1) <= square) & (jnp.abs(slope) >= 1e-9), disc, jnp.inf)
        hits.append(jnp.where(rounds.capsule, ball, disc))
    hits = [jnp.where(hit >= 0.0, hit, jnp.inf) for hit in hits]
    beyond = jnp.maximum(jnp.abs(along) - half, 0.0)
    aside = jnp.sum(out**2, -1) - along**2
    inside = jnp.where(rounds.capsule, aside + beyond**2 <= square, (aside <= square) & (beyond == 0.0))
    nearest = jnp.where(inside, 0.0, jnp.minimum(jnp.minimum(hits[0], hits[1]), hits[2]))
    return jnp.where(rounds.mask, nearest, jnp.inf)


def trace(field: DistanceField, x, y, angle) -> jax.Array:
    """(R,) m along each ray until the field's distance is nothing, inf beyond FARTHEST."""
    c, s = jnp.cos(angle), jnp.sin(angle)

    def one_step(_, gone):
        free = distance_at(field, jnp.stack([x + gone * c, y + gone * s], -1))
        return jnp.where(free > CLOSE, jnp.minimum(gone + free, FARTHEST + 1.0), gone)

    gone = jax.lax.fori_loop(0, TRACES, one_step, jnp.zeros(angle.shape))
    return jnp.where(gone <= FARTHEST, gone, jnp.inf)

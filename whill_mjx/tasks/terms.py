"""What rewards, endings and observations look at, and small functions of it to build them from.

A term is a function of one `Moment`. It is traced once; write it in `jax.numpy`.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.world.collision import free_distance
from whill_mjx.world.people.crowd import TRUNK
from whill_mjx.world.people.law import Mover, nearest_on
from whill_mjx.world.scene import Footprint, Scene


@struct.dataclass
class Moment:
    """One instance at the end of one control period."""

    scene: Scene
    pose: jax.Array  # (3,) x [m], y [m], yaw [rad] of the driven-axle centre
    twist: jax.Array  # (2,) forward speed [m/s], yaw rate [rad/s]
    body: Footprint
    command: jax.Array  # (2,) v [m/s], omega [rad/s] of this period
    previous_command: jax.Array  # (2,)
    goal_distance: jax.Array  # () m
    previous_goal_distance: jax.Array  # () m
    collided: jax.Array  # () bool: the vehicle touches a box
    reached: jax.Array  # () bool: within the goal's radius, and not collided
    diverged: jax.Array  # () bool: the physics failed; nothing else of the moment is to be trusted
    time_s: jax.Array  # () since the start of the episode


def progress(moment: Moment) -> jax.Array:
    """() m by which the goal came nearer; 0 where the physics diverged."""
    return jnp.where(moment.diverged, 0.0, moment.previous_goal_distance - moment.goal_distance)


def yaw_rate_change(moment: Moment) -> jax.Array:
    """() rad/s, absolute change of the commanded yaw rate."""
    return jnp.abs(moment.command[1] - moment.previous_command[1])


def speed_change(moment: Moment) -> jax.Array:
    """() m/s, absolute change of the commanded speed."""
    return jnp.abs(moment.command[0] - moment.previous_command[0])


def fastest_corner(moment: Moment) -> jax.Array:
    """() m/s, speed of that corner of the vehicle which moves fastest: it drives ahead and turns."""
    body, (v, omega) = moment.body, moment.twist
    to_centre = to_body(moment.pose, jnp.stack([body.x, body.y]))[0]  # of the body, ahead of the driven axle
    reach = jnp.abs(to_centre) + body.half_length
    return jnp.hypot(jnp.abs(v) + jnp.abs(omega) * body.half_width, omega * reach)


def shortfall(moment: Moment, margin: float) -> jax.Array:
    """() m by which the distance to the nearest thing falls short of a margin."""
    return jnp.maximum(margin - free_distance(moment.body, moment.scene), 0.0)


def haste(moment: Moment, seconds: float) -> jax.Array:
    """() m/s by which the vehicle nears a person faster than is safe; 0 without people.

    It is safe to near a person so fast that both would touch in no less than `seconds` if the person walked on as now.
    Only the vehicle's own part counts: who stands beside a person who comes is in no haste.
    """
    people, body = moment.scene.people, moment.body
    if people is None:
        return jnp.zeros(())
    centre = jnp.stack([body.x, body.y])
    heading = jnp.stack([jnp.cos(body.yaw), jnp.sin(body.yaw)])
    half = jnp.stack([body.half_length, body.half_width])
    border = nearest_on(Mover(centre, heading, half, moment.twist[0] * heading, moment.twist[1]), people.position)
    away = people.position - border
    distance = jnp.sqrt(jnp.sum(away**2, -1) + 1e-12)
    towards, arm = away / distance[:, None], border - moment.pose[:2]
    moves = moment.twist[0] * heading + moment.twist[1] * jnp.stack([-arm[:, 1], arm[:, 0]], -1)
    nears = jnp.sum(moves * towards, -1)
    comes = jnp.maximum(-jnp.sum(people.velocity * towards, -1), 0.0)
    safe = jnp.maximum((distance - TRUNK * people.height) / seconds - comes, 0.0)
    most = jnp.max(jnp.where(people.there, nears - safe, 0.0), initial=0.0)
    return jnp.where(moment.diverged, 0.0, most)


def goal_vector(moment: Moment, goal: jax.Array) -> jax.Array:
    """(2,) m: a place (2,) in the frame of the driven-axle centre, x ahead and y to the left."""
    return to_body(moment.pose, goal)


def heading_error(moment: Moment, yaw: jax.Array) -> jax.Array:
    """() rad, signed angle from the vehicle's heading to a direction in the room, within +-pi."""
    return wrap(yaw - moment.pose[2])


def to_body(pose: jax.Array, place: jax.Array) -> jax.Array:
    """(2,) m: a place (2,) of the room in the frame of a pose (3,)."""
    dx, dy = place[0] - pose[0], place[1] - pose[1]
    c, s = jnp.cos(pose[2]), jnp.sin(pose[2])
    return jnp.stack([dx * c + dy * s, dy * c - dx * s])


def wrap(angle: jax.Array) -> jax.Array:
    """The same angle within +-pi [rad]."""
    return jnp.arctan2(jnp.sin(angle), jnp.cos(angle))

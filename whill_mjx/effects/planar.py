"""The chassis as a rigid body in the plane of the ground: its motion after the next physics step.

A wheel that grips is stiff: its force follows the speeds that wheel and chassis have after the step, not before it.
Effects that react so (`Effect.reacts`) act last, when the sum of all other forces on the chassis is known.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import driven_mean, per_axle, yaw_rate
from whill_mjx.vehicle.types import Motion


@struct.dataclass
class Ahead:
    """Planar motion after one step under all forces except those of the gripping wheels; chassis frame."""

    forward: jax.Array  # (2,) speed of the driven contacts of the left and the right side [m/s]
    left: jax.Array  # (A,) speed of the contacts of each axle, from rear to front, to the left [m/s]
    arm_y: jax.Array  # (2,) of the driven contacts of each side, from the centre of mass to the left [m]
    arm_x: jax.Array  # (A,) of the axles, from the centre of mass forward [m]


def look_ahead(motion: Motion) -> Ahead:
    """Speeds of the contacts after one physics step under `motion.others` and gravity.

    m (v' + omega x v) = F and I omega' = T about the centre of mass, in the chassis frame. Pitch and roll rates stay.
    """
    mass, com = motion.total_mass, motion.com
    others, rate = motion.others, yaw_rate(motion)
    gravity = motion.rotation.T @ motion.world.gravity
    vx, vy = motion.velocity[0] - rate * com[1], motion.velocity[1] + rate * com[0]
    ax = others.fx / mass + gravity[0] + rate * vy
    ay = others.fy / mass + gravity[1] - rate * vx
    turn = (others.tz - com[0] * others.fy + com[1] * others.fx) / motion.yaw_inertia
    arm_y = driven_mean(motion, motion.world.geometry.contact_y) - com[1]
    arm_x = at_wheels(motion, motion.world.geometry.contact_x)[1::2] - com[0]
    return Ahead(
        driven_mean(motion, motion.contact_vx) + motion.dt * (ax - turn * arm_y),
        per_axle(at_wheels(motion, motion.contact_vy)) / 2 + motion.dt * (ay + turn * arm_x),
        arm_y,
        arm_x,
    )


def at_wheels(motion: Motion, values: jax.Array) -> jax.Array:
    """Values (4,) at the contacts, at each wheel: (6,) with those midway between them on a vehicle of three axles.

    It holds for places and speeds of one body, which change evenly from contact to contact.
    """
    if motion.world.middle is None:
        return values
    return jnp.concatenate([values[:2], (values[:2] + values[2:]) / 2, values[2:]])


def loads_of_wheels(motion: Motion) -> jax.Array:
    """Loads (4,) or (6,) [N] of the wheels: those in the middle take their share of both others of their side, at most
    until one of these is lifted."""
    loads, driven = motion.normal_force, motion.world.geometry.driven
    if motion.world.middle is None:
        return loads
    most = 2 * jnp.minimum(loads[:2], loads[2:])
    middle = driven.min() * jnp.minimum(motion.world.middle * (loads[:2] + loads[2:]), most)  # none where two are free
    return jnp.concatenate([loads[:2] - middle / 2, middle, loads[2:] - middle / 2])


def at_contacts(forces: jax.Array) -> jax.Array:
    """Forces (4,) at the contacts with the sum and the moments of those (4,) or (6,) of the wheels."""
    if len(forces) == 4:
        return forces
    middle = forces[2:4] / 2
    return jnp.concatenate([forces[:2] + middle, forces[4:] + middle])


def spin_response(motion: Motion) -> jax.Array:
    """Spin acceleration per motor torque (2,) [1/(kg m^2)]: with both sides in the same and in opposite directions.

    The wheels roll without slip and turn the chassis about the driven axle, whose tyres hold it sideways.
    """
    driven = motion.world.geometry.driven
    axle = (motion.world.geometry.contact_x * driven).sum() / driven.sum()
    turning = motion.yaw_inertia + motion.total_mass * (motion.com[0] - axle) ** 2
    carried = jnp.stack([motion.total_mass / 2, 2 * turning / motion.track**2])  # by one side's force [kg]
    return 1 / (motion.wheel_inertia + motion.wheel_radius**2 * carried)


def by_mode(values: jax.Array, factors: jax.Array) -> jax.Array:
    """Values (2,) of the left and right side with their mean times factors[0] and their difference times factors[1]."""
    together = (values[0] + values[1]) / 2 * factors[0]
    against = (values[1] - values[0]) / 2 * factors[1]
    return jnp.stack([together - against, together + against])


def held(
    motion: Motion, ahead: Ahead, grip: jax.Array, wanted: jax.Array, hold: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Speeds forward (2,) and left (A,) of `ahead` with the wheels' forces added, both taken after the step.

    The wheels push with grip (wanted - forward) at each side and with -hold left at each axle: an implicit step, so
    any stiffness is stable. Three equations, of which two are eliminated:

        m dvx = dt sum F_side,  m dvy = dt sum F_axle,  I domega = dt (sum x F_axle - sum y F_side).

    Args:
        motion, ahead: the present motion, and `look_ahead` of it.
        grip: (2,) of the left and right side [N s/m].
        wanted: (2,) forward speed at which the wheels do not push [m/s].
        hold: (A,) of the axles, from rear to front [N s/m].
    """
    pull, push = grip * (wanted - ahead.forward), -hold * ahead.left
    inertia = motion.total_mass / motion.dt
    along, across = inertia + grip.sum(), inertia + hold.sum()
    along_turn, across_turn = -(grip * ahead.arm_y).sum(), (hold * ahead.arm_x).sum()
    turn = motion.yaw_inertia / motion.dt + (grip * ahead.arm_y**2).sum() + (hold * ahead.arm_x**2).sum()
    torque = (push * ahead.arm_x).sum() - (pull * ahead.arm_y).sum()
    rate = (torque - along_turn / along * pull.sum() - across_turn / across * push.sum()) / (
        turn - along_turn**2 / along - across_turn**2 / across
    )
    forward = (pull.sum() - along_turn * rate) / along
    left = (push.sum() - across_turn * rate) / across
    return ahead.forward + forward - rate * ahead.arm_y, ahead.left + left + rate * ahead.arm_x

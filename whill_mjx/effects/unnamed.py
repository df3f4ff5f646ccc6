"""A wrench without a name: found by a fit, and explained by no effect of the catalogue."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect, driven_mean, yaw_rate
from whill_mjx.effects.smooth import REST_RATE, REST_SPIN, soft_sign
from whill_mjx.vehicle.types import Motion, Wrench, parameter

KNOTS = 12
ACROSS = 4
"""Knots along x of a map of the room, which has KNOTS / ACROSS rows of them along y."""
QUANTITIES = {
    "time in the drive": "s", "speed": "m/s", "yaw rate": "rad/s", "left wheel's angle": "rad",
    "right wheel's angle": "rad", "heading in the room": "rad", "time since rest": "s", "distance since rest": "m",
    "x in the room": "m", "y in the room": "m", "place in the room": "m",
}  # fmt: skip
"""What the wrench may depend on, by number from 1, and its unit. Angles repeat after a full turn."""
MAP = "place in the room"
PERIODIC = ("left wheel's angle", "right wheel's angle", "heading in the room")
TURN = 2 * jnp.pi


@struct.dataclass
class UnnamedMemory:
    """Quantities that add up over a drive."""

    time: jax.Array  # () s
    angle: jax.Array  # (2,) rad, of the left and the right driven wheel
    moving: jax.Array  # () s since the vehicle rested
    distance: jax.Array  # () m that the driven wheels rolled since then, their mean


def quantities(memory: UnnamedMemory, motion: Motion) -> jax.Array:
    """Values (11,) of `QUANTITIES`; for the place its x."""
    speed = motion.spin.mean() * motion.wheel_radius
    rate = yaw_rate(motion)
    x, y = motion.position
    return jnp.stack([memory.time, speed, rate, memory.angle[0], memory.angle[1], motion.heading, memory.moving,
                      memory.distance, x, y, x])


def hats(position: jax.Array, periodic: jax.Array) -> jax.Array:
    """Weights (KNOTS,) of linear interpolation at a position () counted in knots; constant beyond the ends."""
    knot = jnp.arange(KNOTS, dtype=position.dtype)
    turned = position - KNOTS * jnp.floor(position / KNOTS)
    away = jnp.abs(turned - knot)
    around = jnp.minimum(away, KNOTS - away)
    return jnp.where(periodic, jnp.maximum(1 - around, 0.0), between(position, KNOTS))


def between(position: jax.Array, count: int) -> jax.Array:
    """Weights (count,) of linear interpolation at a position () counted in knots; constant beyond the ends."""
    knot = jnp.arange(count, dtype=position.dtype)
    return jnp.maximum(1 - jnp.abs(jnp.clip(position, 0.0, count - 1.0) - knot), 0.0)


@struct.dataclass
class Unnamed(Effect):
    """F_x = f(z) and T_z = g(z): tables over one quantity z of the motion, interpolated linearly.

    `quantity` chooses z: 1 time in the drive, 2 speed, 3 yaw rate, 4 and 5 angle of the left and the right wheel, 6
    heading in the room, 7 time and 8 distance since rest, 9 x and 10 y of the chassis origin in the room. The knots are
    evenly spaced from `low` to `high`; beyond them the value of the last knot holds. Angles repeat, with a knot every
    30 degrees from 0 on. 11 is a map of the room: four knots along x from `low` to `high` by three along y from `low_y`
    to `high_y`, the row of the smallest y first, interpolated along both.

    A wheel starts a drive at `start_angle`, which is unknown and differs between drives. With `with_motion` = 1 the
    force changes sign with the rolling direction of each side and the torque with that of the turn, as friction does
    (negative values brake). With 0 they do not depend on the motion. `sysid.close_loop` writes this effect where
    something is missing that no effect of the catalogue explains; it names nothing.
    """

    name = "unnamed"
    room_fixed = True
    typical = {"quantity": (2.0, 2.0), "low": (-1.0, -1.0), "high": (1.0, 1.0), "with_motion": (0.0, 1.0),
               "low_y": (-1.0, -1.0), "high_y": (1.0, 1.0),
               **{f"force_{k}": (-10.0, 10.0) for k in range(1, KNOTS + 1)},
               **{f"torque_{k}": (-5.0, 5.0) for k in range(1, KNOTS + 1)}}
    source = "fitted by `sysid.close_loop`; sizes are estimates"
    quantity: jax.Array = parameter("-", 1.0, 11.0, 1.0, "number of the quantity z, 1 to 11")
    low: jax.Array = parameter("SI", -1000.0, 1000.0, 0.0, "z at the first knot")
    high: jax.Array = parameter("SI", -1000.0, 1000.0, 1.0, "z at the last knot")
    with_motion: jax.Array = parameter("-", 0.0, 1.0, 0.0, "1 where the wrench changes sign with the motion")
    start_angle: jax.Array = parameter("rad", -6.3, 6.3, 0.0, "angle of the wheels at the start of the drive")
    low_y: jax.Array = parameter("m", -1000.0, 1000.0, 0.0, "y of a map's first row")
    high_y: jax.Array = parameter("m", -1000.0, 1000.0, 1.0, "y of its last row")
    force_1: jax.Array = parameter("N", -300.0, 300.0, 0.0, "force forward at knot 1")
    force_2: jax.Array = parameter("N", -300.0, 300.0, 0.0, "force forward at knot 2")
    force_3: jax.Array = parameter("N", -300.0, 300.0, 0.0, "force forward at knot 3")
    force_4: jax.Array = parameter("N", -300.0, 300.0, 0.0, "force forward at knot 4")
    force_5: jax.Array = parameter("N", -300.0, 300.0, 0.0, "force forward at knot 5")
    force_6: jax.Array = parameter("N", -300.0, 300.0, 0.0, "force forward at knot 6")
    force_7: jax.Array = parameter("N", -300.0, 300.0, 0.0, "force forward at knot 7")
    force_8: jax.Array = parameter("N", -300.0, 300.0, 0.0, "force forward at knot 8")
    force_9: jax.Array = parameter("N", -300.0, 300.0, 0.0, "force forward at knot 9")
    force_10: jax.Array = parameter("N", -300.0, 300.0, 0.0, "force forward at knot 10")
    force_11: jax.Array = parameter("N", -300.0, 300.0, 0.0, "force forward at knot 11")
    force_12: jax.Array = parameter("N", -300.0, 300.0, 0.0, "force forward at knot 12")
    torque_1: jax.Array = parameter("N m", -200.0, 200.0, 0.0, "torque to the left at knot 1")
    torque_2: jax.Array = parameter("N m", -200.0, 200.0, 0.0, "torque to the left at knot 2")
    torque_3: jax.Array = parameter("N m", -200.0, 200.0, 0.0, "torque to the left at knot 3")
    torque_4: jax.Array = parameter("N m", -200.0, 200.0, 0.0, "torque to the left at knot 4")
    torque_5: jax.Array = parameter("N m", -200.0, 200.0, 0.0, "torque to the left at knot 5")
    torque_6: jax.Array = parameter("N m", -200.0, 200.0, 0.0, "torque to the left at knot 6")
    torque_7: jax.Array = parameter("N m", -200.0, 200.0, 0.0, "torque to the left at knot 7")
    torque_8: jax.Array = parameter("N m", -200.0, 200.0, 0.0, "torque to the left at knot 8")
    torque_9: jax.Array = parameter("N m", -200.0, 200.0, 0.0, "torque to the left at knot 9")
    torque_10: jax.Array = parameter("N m", -200.0, 200.0, 0.0, "torque to the left at knot 10")
    torque_11: jax.Array = parameter("N m", -200.0, 200.0, 0.0, "torque to the left at knot 11")
    torque_12: jax.Array = parameter("N m", -200.0, 200.0, 0.0, "torque to the left at knot 12")

    def init(self) -> UnnamedMemory:
        return UnnamedMemory(jnp.zeros(()), self.start_angle + jnp.zeros(2), jnp.zeros(()), jnp.zeros(()))

    def force(self, memory: UnnamedMemory, motion: Motion) -> tuple[UnnamedMemory, Wrench]:
        """Wrench along and about the chassis, and the quantities one step on."""
        seen = quantities(memory, motion)
        number = jnp.round(self.quantity) - 1
        periodic = (number >= 3) & (number <= 5)
        value = jnp.where(jnp.arange(len(QUANTITIES)) == number, seen, 0.0).sum()
        share = (value - self.low) / span_of(self.low, self.high)
        over_one = hats(jnp.where(periodic, value * (KNOTS / TURN), share * (KNOTS - 1)), periodic)
        rows = KNOTS // ACROSS
        row = (motion.position[1] - self.low_y) / span_of(self.low_y, self.high_y)
        over_map = (between(row * (rows - 1), rows)[:, None] * between(share * (ACROSS - 1), ACROSS)).reshape(-1)
        weights = jnp.where(number == list(QUANTITIES).index(MAP), over_map, over_one)
        forces = jnp.stack([getattr(self, f"force_{k}") for k in range(1, KNOTS + 1)])
        torques = jnp.stack([getattr(self, f"torque_{k}") for k in range(1, KNOTS + 1)])
        force, torque = (weights * forces).sum(), (weights * torques).sum()
        ahead = soft_sign(driven_mean(motion, motion.contact_vx), REST_SPIN * motion.wheel_radius)
        sides = 1 + self.with_motion * (ahead - 1)
        turning = 1 + self.with_motion * (soft_sign(seen[2], REST_RATE) - 1)
        wrench = replace(Wrench.zero(), fx=force * sides.mean(),
                         tz=torque * turning + force * (sides[1] - sides[0]) * motion.track / 4)
        return _advanced(memory, motion), wrench


def span_of(low: jax.Array, high: jax.Array) -> jax.Array:
    """high - low (), or 1 where that is 0."""
    return jnp.where(high == low, 1.0, high - low)


def _advanced(memory: UnnamedMemory, motion: Motion) -> UnnamedMemory:
    """Memory one physics step on."""
    rolling = jnp.abs(motion.spin).mean() * motion.wheel_radius
    moves = jnp.where(rolling < REST_SPIN * motion.wheel_radius, 0.0, 1.0)
    return UnnamedMemory(memory.time + motion.dt, memory.angle + motion.spin * motion.dt,
                         moves * (memory.moving + motion.dt), moves * (memory.distance + rolling * motion.dt))

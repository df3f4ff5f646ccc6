"""Pytrees that travel through the simulator. All arrays are of ONE instance; batch.py adds the instance axis."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct


@struct.dataclass
class Geometry:
    """True geometry of one instance, in the chassis frame [m]. Nominal values, used by its controller, are in the spec."""

    contact_x: jax.Array  # (4,) rear left, rear right, front left, front right
    contact_y: jax.Array  # (4,)
    wheel_radius: jax.Array  # (2,) driven left, right


@struct.dataclass
class Motion:
    """What an effect may look at: the present motion of one instance in the chassis frame."""

    geometry: Geometry
    mass: jax.Array  # () kg
    rotation: jax.Array  # (3, 3) chassis to world
    position: jax.Array  # (3,) chassis origin in the world [m]
    velocity: jax.Array  # (3,) of the chassis origin, chassis frame [m/s]
    angular_velocity: jax.Array  # (3,) chassis frame [rad/s]
    contact_vx: jax.Array  # (4,) forward speed of the chassis at the contact patches [m/s]
    contact_vy: jax.Array  # (4,) leftward speed at the contact patches [m/s]
    normal_force: jax.Array  # (4,) suspension force at the contact patches [N]
    spin: jax.Array  # (2,) speed of the driven wheels, left and right [rad/s]
    wheel_speed: jax.Array  # (4,) forward speed of the wheel at each contact, spin * radius where driven [m/s]
    ground_contact: jax.Array  # (4,) 1 where the wheel is driven, 0 where it rolls freely
    gravity: jax.Array  # (3,) world frame [m/s^2]
    wind: jax.Array  # (3,) world frame [m/s]
    dt: float = struct.field(pytree_node=False)  # physics step [s]


@struct.dataclass
class Wrench:
    """Force and torque on the chassis about its origin, in the chassis frame, and torque on the driven wheels."""

    fx: jax.Array
    fy: jax.Array
    fz: jax.Array
    tx: jax.Array
    ty: jax.Array
    tz: jax.Array
    spin_torque: jax.Array  # (2,) on the left and right driven wheel about its axle [N m]

    @staticmethod
    def zero() -> Wrench:
        zero = jnp.zeros(())
        return Wrench(zero, zero, zero, zero, zero, zero, jnp.zeros(2))

    def __add__(self, other: Wrench) -> Wrench:
        return jax.tree.map(jnp.add, self, other)


@struct.dataclass
class Drive:
    """Signal of the actuation chain: targets come in, the drive effects fill force and torque."""

    target: jax.Array  # (2,) commanded wheel speeds, left and right [m/s]
    force: jax.Array  # (2,) traction of each side put straight on the chassis [N] (the paper's drive)
    torque: jax.Array  # (2,) motor torque on the wheel [N m] (the physical drive)


@struct.dataclass
class Odometry:
    """What the vehicle's own odometry reports; it starts at the origin with heading 0."""

    x: jax.Array  # () m
    y: jax.Array  # () m
    yaw: jax.Array  # () rad, unwrapped
    v: jax.Array  # () m/s
    omega: jax.Array  # () rad/s


@struct.dataclass
class VehicleState:
    """Mechanical state, memory of every effect, and the odometry, which need not agree with the body's motion."""

    qpos: jax.Array  # (9,) position, quaternion, wheel angles left and right
    qvel: jax.Array  # (8,) velocity (world), angular velocity (chassis), wheel speeds
    memory: tuple  # one entry per effect
    odometry: Odometry
    diverged: jax.Array  # () bool: the state became non-finite at some time


@struct.dataclass
class Body:
    """Mass and geometry of one instance; scale factors are relative to the spec's nominal values."""

    mass: jax.Array  # () kg
    yaw_inertia: jax.Array  # () about the centre of mass [kg m^2]
    com: jax.Array  # (3,) centre of mass from the chassis origin [m]


@struct.dataclass
class VehicleParams:
    """The whole physical parameter tree of one instance: what is randomised, fitted and saved."""

    body: Body
    effects: tuple


@struct.dataclass
class TimeStep:
    """What one environment step returns."""

    obs: jax.Array  # (H, W, 3) uint8
    reward: jax.Array  # ()
    terminated: jax.Array  # () bool: goal, collision or divergence; ends the return
    truncated: jax.Array  # () bool: time ran out; the return would have gone on
    first: jax.Array  # () bool: first frame of an episode; reward is 0 and the action before it meaningless
    metrics: dict[str, jax.Array]  # () floats that people watch

"""Pytrees that travel through the simulator. All arrays are of ONE instance; batch.py adds the instance axis."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct


@dataclass(frozen=True)
class Parameter:
    """What is known of a parameter before any data: unit, the range a fit may search, and where it has no effect."""

    unit: str
    low: float
    high: float
    neutral: float
    description: str = ""


def parameter(unit: str, low: float, high: float, neutral: float, description: str = "") -> Any:
    """Field of a pytree of parameters: a scalar leaf, neutral by default, with its `Parameter` beside it."""
    return struct.field(default=neutral, metadata={"parameter": Parameter(unit, low, high, neutral, description)})


def as_number(value: float) -> jax.Array:
    """A number as an array of the default float type. NumPy converts it: JAX would compile a program for that."""
    return jax.device_put(np.asarray(value, jnp.result_type(float)))


def parameters_of(holder: Any) -> dict[str, Parameter]:
    """The parameters of an effect or a `Body` by field name."""
    return {field.name: field.metadata["parameter"] for field in fields(holder) if "parameter" in field.metadata}


@struct.dataclass
class Geometry:
    """True geometry of one instance in the chassis frame [m]. Its controller uses the spec's nominal one."""

    contact_x: jax.Array  # (4,) rear left, rear right, front left, front right
    contact_y: jax.Array  # (4,)
    wheel_radius: jax.Array  # (2,) driven left, right
    driven: jax.Array  # (4,) 1 where the contact's wheel is driven, 0 where it rolls freely


@struct.dataclass
class Payload:
    """Point mass on board, at a place in the chassis frame."""

    mass: jax.Array  # () kg
    x: jax.Array  # () m
    y: jax.Array  # () m
    z: jax.Array  # () m


@struct.dataclass
class World:
    """Surroundings as the effects of place `world` leave them."""

    geometry: Geometry
    gravity: jax.Array  # (3,) world frame [m/s^2]
    wind: jax.Array  # (3,) world frame [m/s]
    payload: Payload | None = None
    ground: tuple = ()  # surfaces on the plane z = 0, see ground.py; none costs nothing
    sag: jax.Array | float = 0.005  # () m, compression of each contact under a quarter of the weight
    damping: jax.Array | float = 0.5  # () of the contacts, over the critical
    wheel_inertia: jax.Array | float = 1.0  # () spin inertia of the driven wheels over the nominal
    wheel_reaction: jax.Array | float = 0.0  # () share of it whose momentum the chassis takes up
    speed: jax.Array | float = 0.0  # () m/s, of the chassis ahead at the start of the step
    yaw_rate: jax.Array | float = 0.0  # () rad/s, there
    drift: jax.Array | float = 0.0  # () tangent by which the wheels' line is turned to the left of the heading
    middle: jax.Array | None = None  # () share of the load on wheels midway between the axles; None without them
    sprung: bool = struct.field(pytree_node=False, default=False)
    """Whether loads are those at the end of a physics step, which any springs allow, or those at its start."""


@struct.dataclass
class Yielding:
    """How a motor torque changes within the step where its wheel does not turn as the drive foresaw: by

        factor clip(slack - slope (spin - foreseen), low, high)    with the spin after the step.

    A wheel that slips has its own small inertia only: at a torque that is held for the step a speed controller would
    throw it from one limit to the other.
    """

    foreseen: jax.Array  # (2,) spin after the step [rad/s] at which the torque would be what the controller wants
    slope: jax.Array  # (2,) by how much it falls with a faster wheel [N m s/rad]
    slack: jax.Array  # (2,) wanted torque beyond the limit [N m]
    low: jax.Array  # (2,) N m
    high: jax.Array  # (2,) N m
    factor: jax.Array  # (2,) what of it reaches the wheel [-]

    @staticmethod
    def none() -> Yielding:
        """A torque that does not change."""
        zero = jnp.zeros(2)
        return Yielding(zero, zero, zero, zero, zero, jnp.ones(2))

    def change(self, line: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Change (2,) of the wanted torque [N m] where no limit would give the spin `line` (2,) after the step, and
        which wheels are within the limits: the torque falls with the spin, so that no other side of a limit fits."""
        wanted = self.slack - self.slope * (line - self.foreseen)
        change = jnp.clip(wanted, self.low, self.high)
        return change, change == wanted


@struct.dataclass
class Motion:
    """What an effect may look at: the present motion of one instance in the chassis frame."""

    world: World
    mass: jax.Array  # () kg, without payload
    heading: jax.Array  # () rad
    ground_axes: jax.Array  # (3, 3) rows: forward along the ground, left along the ground, ground normal; chassis frame
    contact_axes: jax.Array  # the same at each contact, (3, 3, 4); (3, 3) where the ground has no surfaces
    contact_points: tuple  # x (4,), y (4,), z (4,) or () of the contact patches, chassis frame [m]
    rotation: jax.Array  # (3, 3) chassis to world
    position: jax.Array  # (2,) x and y of the chassis origin in the room [m]
    velocity: jax.Array  # (3,) of the chassis origin, chassis frame [m/s]
    angular_velocity: jax.Array  # (3,) chassis frame [rad/s]
    contact_vx: jax.Array  # (4,) forward speed of the chassis at the contact patches [m/s]
    contact_vy: jax.Array  # (4,) leftward speed at the contact patches [m/s]
    normal_force: jax.Array  # (4,) suspension force at the contact patches [N]
    spring_force: jax.Array  # (4,) the same, where a spring would pull as well [N]
    normal_speed: jax.Array  # (4,) of the chassis at the contact patches, away from the ground [m/s]
    spin: jax.Array  # (2,) speed of the driven wheels, left and right [rad/s]
    drive_torque: jax.Array  # (2,) motor torque on the driven wheels [N m]; zero for the paper's drive
    yielding: Yielding  # of that torque
    wheel_inertia: jax.Array  # () spin inertia of the driven wheels of one side [kg m^2]
    total_mass: jax.Array  # () kg, with payload
    com: jax.Array  # (3,) centre of mass with payload, chassis frame [m]
    yaw_inertia: jax.Array  # () about that centre of mass [kg m^2]
    others: Wrench  # all other forces on the chassis, for effects that react to them (effects/planar.py)
    wheel_radius: float = struct.field(pytree_node=False)  # nominal [m]
    track: float = struct.field(pytree_node=False)  # nominal [m]
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
    yielding: Yielding = struct.field(default_factory=Yielding.none)  # of that torque


@struct.dataclass
class Odometry:
    """What the vehicle's own odometry and gyro report; the odometry starts at the origin with heading 0."""

    x: jax.Array  # () m
    y: jax.Array  # () m
    yaw: jax.Array  # () rad, unwrapped
    v: jax.Array  # () m/s
    omega: jax.Array  # () rad/s
    gyro: jax.Array | float = 0.0  # () rad/s, rate of the chassis about its own z axis


@struct.dataclass
class VehicleState:
    """Mechanical state, memory of every effect, and the odometry, which need not agree with the body's motion."""

    qpos: jax.Array  # (9,) position, quaternion, wheel angles left and right
    qvel: jax.Array  # (8,) velocity (world), angular velocity (chassis), wheel speeds
    memory: tuple  # one entry per effect
    encoder: Odometry  # integrated from the wheel speeds with nominal radius and track
    odometry: Odometry  # the same after the sensing effects: what the vehicle reports
    diverged: jax.Array  # () bool: the state became non-finite at some time


@struct.dataclass
class Body:
    """Mass distribution of one instance, wheels included."""

    mass: jax.Array = parameter("kg", 1.0, 1000.0, 0.0, "total mass, rider and load included")
    yaw_inertia: jax.Array = parameter("kg m^2", 0.001, 1000.0, 0.0, "about the centre of mass")
    com_x: jax.Array = parameter("m", -0.3, 0.3, 0.0, "centre of mass ahead of the chassis origin")
    com_y: jax.Array = parameter("m", -0.1, 0.1, 0.0, "centre of mass to the left of the chassis origin")
    com_z: jax.Array = parameter("m", -0.2, 0.6, 0.0, "centre of mass above the chassis origin")


@struct.dataclass
class VehicleParams:
    """The whole physical parameter tree of one instance: what is randomised, fitted and saved."""

    body: Body
    """Mass distribution."""
    effects: tuple
    """Physical effects, each with its own parameters, in the order in which they act."""


@struct.dataclass
class TimeStep:
    """What one environment step returns."""

    obs: jax.Array  # (H, W, 3) uint8
    reward: jax.Array  # ()
    terminated: jax.Array  # () bool: goal, collision or divergence; ends the return
    truncated: jax.Array  # () bool: time ran out; the return would have gone on
    first: jax.Array  # () bool: first frame of an episode; reward is 0 and the action before it meaningless
    metrics: dict[str, jax.Array]  # () floats that people watch

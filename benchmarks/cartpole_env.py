"""Cart and pole as in the DeepMind Control Suite, written anew as pure functions: a task that is not ours.

Constants, rewards and starts are those of dm_control's `cartpole` (balance and swingup, smooth reward): cart 1 kg, pole
0.1 kg and 1 m, force 10 N, 10 s episodes that end by time-out. Integration is MuJoCo's Runge-Kutta of fourth order, and
the rail's soft ends are MuJoCo's constraint in closed form. The picture has the size and the field of view of the
suite's first camera, but plain colours, no perspective, no shadows.
"""

from __future__ import annotations

from typing import Literal

import jax
import jax.numpy as jnp
from flax import struct

from dreamer.spaces import ObsShape
from dreamer.types import FunctionalEnv, Transition

CART_MASS, POLE_MASS = 1.0, 0.1  # [kg]
RADIUS, LENGTH = 0.045, 1.0  # of the pole's capsule [m]
GEAR, GRAVITY = 10.0, 9.81
CART_DAMPING, HINGE_DAMPING = 5e-4, 2e-6
DT = 0.01
EPISODE_STEPS = 1000  # of DT
RAIL = 1.8  # the cart's centre may go so far [m]
LIMIT_TIME = 0.08  # time constant of the rail's ends [s]
IMPEDANCE_LOW, IMPEDANCE_HIGH, IMPEDANCE_WIDTH = 0.9, 0.95, 1e-3
HALF_VIEW = 4.0 * 0.41421356  # half the width seen by a camera of 45 degrees at 4 m [m]

Task = Literal["balance", "swingup"]


def capsule_inertia() -> float:
    """Moment [kg m^2] of the pole about an axis across its middle: a cylinder and two half spheres, even density."""
    cylinder, sphere = RADIUS**2 * LENGTH, 4 / 3 * RADIUS**3
    a, b = (POLE_MASS * part / (cylinder + sphere) for part in (cylinder, sphere))
    across = a * (3 * RADIUS**2 + LENGTH**2) / 12
    return across + b * (2 / 5 * RADIUS**2 + LENGTH**2 / 4 + 3 / 8 * LENGTH * RADIUS)


ARM = LENGTH / 2
INERTIA = capsule_inertia() + POLE_MASS * ARM**2  # about the hinge
REST_INVERSE_MASS = INERTIA / ((CART_MASS + POLE_MASS) * INERTIA - (POLE_MASS * ARM) ** 2)


def acceleration(position: jax.Array, velocity: jax.Array, action: jax.Array) -> jax.Array:
    """Accelerations (2,) of cart and pole.

    Args:
        position: (2,) cart [m], angle from upright [rad], positive towards +x.
        velocity: (2,).
        action: () in [-1, 1].
    """
    cos, sin = jnp.cos(position[1]), jnp.sin(position[1])
    coupling = POLE_MASS * ARM * cos
    determinant = (CART_MASS + POLE_MASS) * INERTIA - coupling**2
    force = GEAR * action - CART_DAMPING * velocity[0] + POLE_MASS * ARM * sin * velocity[1] ** 2
    torque = POLE_MASS * GRAVITY * ARM * sin - HINGE_DAMPING * velocity[1]

    def solve(force: jax.Array) -> jax.Array:
        cart = INERTIA * force - coupling * torque
        pole = (CART_MASS + POLE_MASS) * torque - coupling * force
        return jnp.stack([cart, pole]) / determinant

    return solve(force + rail_force(position[0], velocity[0], solve(force)[0], INERTIA / determinant))


def rail_force(x: jax.Array, v: jax.Array, free: jax.Array, inverse_mass: jax.Array) -> jax.Array:
    """Force () [N] of the rail's end on the cart, as MuJoCo's soft constraint of one row gives it.

    Args:
        x: cart [m].
        v: its velocity.
        free: its acceleration without the constraint.
        inverse_mass: its acceleration per force [1/kg].
    """
    side = jnp.sign(x)  # the end that is nearer
    depth = side * x - RAIL
    ramp = jnp.clip(depth / IMPEDANCE_WIDTH, 0.0, 1.0)
    ramp = jnp.where(ramp < 0.5, 2 * ramp**2, 1 - 2 * (1 - ramp) ** 2)
    impedance = IMPEDANCE_LOW + (IMPEDANCE_HIGH - IMPEDANCE_LOW) * ramp
    stiffness = 1 / (IMPEDANCE_HIGH * LIMIT_TIME) ** 2
    damping = 2 / (IMPEDANCE_HIGH * LIMIT_TIME)
    wanted = damping * side * v + stiffness * impedance * depth  # deceleration into the end
    softness = (1 - impedance) / impedance * REST_INVERSE_MASS
    push = (wanted + side * free) / (inverse_mass + softness)
    return jnp.where(depth > 0, -side * jnp.maximum(push, 0.0), 0.0)


def advance(position: jax.Array, velocity: jax.Array, action: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Position (2,) and velocity (2,) after DT, by the classical Runge-Kutta method."""
    state = jnp.concatenate([position, velocity])

    def slope(state: jax.Array) -> jax.Array:
        return jnp.concatenate([state[2:], acceleration(state[:2], state[2:], action)])

    a = slope(state)
    b = slope(state + DT / 2 * a)
    c = slope(state + DT / 2 * b)
    d = slope(state + DT * c)
    state = state + DT / 6 * (a + 2 * b + 2 * c + d)
    return state[:2], state[2:]


def smooth_reward(position: jax.Array, velocity: jax.Array, action: jax.Array) -> jax.Array:
    """Reward () in [0, 1] of a state and the action that led to it: upright, centred, little control, slow."""

    def gaussian(x: jax.Array, margin: float) -> jax.Array:
        return jnp.power(0.1, jnp.square(x / margin))  # 1 at 0, 0.1 at the margin

    upright = (jnp.cos(position[1]) + 1) / 2
    centred = (1 + gaussian(position[0], 2.0)) / 2
    small_control = (4 + jnp.maximum(0.0, 1 - action**2)) / 5
    small_velocity = (1 + gaussian(velocity[1], 5.0)) / 2
    return upright * centred * small_control * small_velocity


def start(task: Task, key: jax.Array) -> tuple[jax.Array, jax.Array]:
    """First position (2,) and velocity (2,)."""
    place_key, speed_key = jax.random.split(key)
    if task == "swingup":
        position = jnp.array([0.0, jnp.pi]) + 0.01 * jax.random.normal(place_key, (2,))
    else:
        position = jnp.array([0.1, 0.034]) * jax.random.uniform(place_key, (2,), minval=-1.0, maxval=1.0)
    return position, 0.01 * jax.random.normal(speed_key, (2,))


def picture(position: jax.Array, side: int = 64) -> jax.Array:
    """Image (side, side, 3) uint8 of rail, cart and pole, each covering the pixels by its signed distance."""
    pixel = 2 * HALF_VIEW / side
    centre = (jnp.arange(side) + 0.5) * pixel - HALF_VIEW
    x, z = jnp.meshgrid(centre, -centre)  # the rail lies in the middle

    def paint(canvas: jax.Array, distance: jax.Array, colour: tuple[float, float, float]) -> jax.Array:
        cover = jnp.clip(0.5 - distance / pixel, 0.0, 1.0)[..., None]
        return canvas + cover * (jnp.array(colour) - canvas)

    def box(x: jax.Array, z: jax.Array, half_width: float, half_height: float) -> jax.Array:
        return jnp.maximum(jnp.abs(x) - half_width, jnp.abs(z) - half_height)

    dx = x - position[0]
    sin, cos = jnp.sin(position[1]), jnp.cos(position[1])
    along = jnp.clip(dx * sin + z * cos, 0.0, LENGTH)
    pole = jnp.hypot(dx - along * sin, z - along * cos) - RADIUS
    canvas = jnp.broadcast_to(jnp.array([0.16, 0.24, 0.32]), (side, side, 3))
    canvas = paint(canvas, box(x, z + 1.0 + HALF_VIEW, 10.0, HALF_VIEW), (0.10, 0.15, 0.20))  # the floor
    canvas = paint(canvas, box(x, z, 2.0, 0.02), (0.3, 0.5, 0.7))
    canvas = paint(canvas, box(dx, z, 0.2, 0.1), (0.7, 0.5, 0.3))
    canvas = paint(canvas, pole, (0.9, 0.75, 0.5))
    return jnp.round(255 * canvas).astype(jnp.uint8)


def joint_state(position: jax.Array, velocity: jax.Array) -> dict[str, jax.Array]:
    """The suite's observation: cart, cosine and sine of the angle (3,), and velocities (2,)."""
    x, angle = position[0], position[1]
    return {"position": jnp.stack([x, jnp.cos(angle), jnp.sin(angle)]), "velocity": velocity}


@struct.dataclass
class CartPole:
    """State of one instance."""

    position: jax.Array
    velocity: jax.Array
    count: jax.Array
    """() int32 decisions taken."""
    over: jax.Array
    """() bool, the next step begins an episode."""
    key: jax.Array


def make(
    task: Task, instances: int, sight: Literal["image", "joints", "both"] = "image", repeat: int = 2
) -> FunctionalEnv:
    """`instances` carts, begun together; actions (N, 1).

    Args:
        task: balance starts upright, swingup hanging.
        instances: N.
        sight: what is observed: the picture, positions and velocities, or a dict of both.
        repeat: physics steps of DT for one decision; their rewards are added, so that the best return is 1000.
    """
    last = EPISODE_STEPS // repeat

    def observe(state: CartPole) -> dict[str, jax.Array] | jax.Array:
        joints = joint_state(state.position, state.velocity) if sight != "image" else {}
        return picture(state.position) if sight == "image" else (
            {"image": picture(state.position), **joints} if sight == "both" else joints)  # fmt: skip

    def emit(state: CartPole, reward: jax.Array, first: jax.Array) -> tuple[CartPole, Transition]:
        ends = (state.count >= last) & ~first
        state = CartPole(state.position, state.velocity, state.count, ends, state.key)
        return state, Transition(observe(state), reward, first, ends, jnp.zeros((), bool), {})

    def begin(key: jax.Array) -> CartPole:
        key, start_key = jax.random.split(key)
        return CartPole(*start(task, start_key), jnp.zeros((), jnp.int32), jnp.zeros((), bool), key)

    def reset_one(key: jax.Array) -> tuple[CartPole, Transition]:
        return emit(begin(key), jnp.zeros(()), jnp.ones((), bool))

    def step_one(state: CartPole, action: jax.Array) -> tuple[CartPole, Transition]:
        position, velocity, reward = state.position, state.velocity, jnp.zeros(())
        for _ in range(repeat):
            position, velocity = advance(position, velocity, action[0])
            reward += smooth_reward(position, velocity, action[0])
        moved = CartPole(position, velocity, state.count + 1, state.over, state.key)
        state = jax.tree.map(lambda new, old: jnp.where(state.over, new, old), begin(state.key), moved)
        first = moved.over
        return emit(state, jnp.where(first, 0.0, reward), first)

    joints: dict[str, tuple[int, ...]] = {"position": (3,), "velocity": (2,)}
    shapes: dict[str, ObsShape] = {
        "image": (64, 64, 3), "joints": joints, "both": {"image": (64, 64, 3), **joints},
    }  # fmt: skip
    return FunctionalEnv(
        num_envs=instances, obs_shape=shapes[sight], action_dim=1,
        reset=lambda key: jax.vmap(reset_one)(jax.random.split(key, instances)), step=jax.vmap(step_one),
    )  # fmt: skip

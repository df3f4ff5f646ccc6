"""One vehicle through time: command -> drive -> forces -> rigid bodies (`mjx.step`) -> odometry."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp

from whill_mjx.devices import runs_triton
from whill_mjx.effects.base import (
    apply_chain,
    contact_wrench,
    side_forces,
    sum_forces,
)
from whill_mjx.effects.planar import by_mode, spin_response
from whill_mjx.vehicle import rigid
from whill_mjx.vehicle.ground import footing, plane_under
from whill_mjx.vehicle.kernel import Roll, held_in_registers
from whill_mjx.vehicle.kinematics import (
    body_twist,
    heading,
    quaternion_from_angles,
    rotation_from_quaternion,
    wheel_speeds,
)
from whill_mjx.vehicle.model import VehicleModel, box_inertia, import_mjx
from whill_mjx.vehicle.scalars import apart, scan_apart
from whill_mjx.vehicle.specs import GRAVITY
from whill_mjx.vehicle.types import (
    Drive,
    Geometry,
    Motion,
    Odometry,
    Payload,
    VehicleParams,
    VehicleState,
    World,
    Wrench,
    Yielding,
)

STATIC_SAG = 0.005  # [m] suspension and tyre compression under the static load
DAMPING_RATIO = 0.5  # [-] of the suspension
LEAST_SAG = 8.0  # [m/s^2] times the squared physics step: with 3 instead, loads ring and wheels lose the floor
LOAD_ROUNDS = 2  # in which loads and what wheels pull by them find together
LOG1P = (0.999999966, -0.49999445, 0.333181217, -0.24835399, 0.190768807, -0.136022476, 0.0775160866, -0.0290740646,
         0.00512610212)  # coefficients of log(1 + x) / x from 0 to 1, at Chebyshev's points
SMOOTH_LOAD = 0.04  # share of the static load over which a contact loses it smoothly when it lifts


def substep(model: VehicleModel, params: VehicleParams, state: VehicleState, command: jax.Array) -> VehicleState:
    """Advance one instance by one physics step.

    Args:
        model: static model.
        params: physical parameters of this instance.
        state: from `place` or the previous step.
        command: (2,) v [m/s] and omega [rad/s] in force during this step; limited to what the spec allows.

    Returns:
        The next state. A non-finite result is replaced by the previous state and flagged `diverged`.
    """
    if model.config.dynamics == "fused":
        return apart(partial(one_step, model))(params, state, command)
    return one_step(model, params, state, command)


def one_step(model: VehicleModel, params: VehicleParams, state: VehicleState, command: jax.Array) -> VehicleState:
    memory, force, motion = forces(model, params, state, command)
    qpos, qvel = integrate(model, params, motion.world, state, force)
    healthy = jnp.isfinite(qpos).all() & jnp.isfinite(qvel).all()
    qpos, qvel = jnp.where(healthy, qpos, state.qpos), jnp.where(healthy, qvel, state.qvel)
    encoder = dataclasses.replace(advance_odometry(state.encoder, qvel[6:8], model), gyro=qvel[5])
    memory, reading = apply_chain(params.effects, memory, "sensing", encoder, motion)
    return VehicleState(qpos, qvel, memory, encoder, reading, state.diverged | ~healthy)


def substeps(model: VehicleModel, params: VehicleParams, state: VehicleState, commands: jax.Array) -> VehicleState:
    """Advance one instance by K physics steps, each with its own command of commands (K, 2)."""

    def body(state: VehicleState, command: jax.Array) -> tuple[VehicleState, None]:
        return one_step(model, params, state, command), None

    scan = scan_apart if model.config.dynamics == "fused" else jax.lax.scan
    return scan(body, state, commands)[0]


def record(
    model: VehicleModel, params: VehicleParams, state: VehicleState, commands: jax.Array,
    observe: Callable[[VehicleState], jax.Array],
) -> jax.Array:
    """What is observed (R, C) of one instance after each K of R K physics steps.

    A fused vehicle stays in single numbers from record to record: an accelerator launches a quarter of the kernels,
    and takes longer to compile them.

    Args:
        commands: (R, K, 2), one for each step.
        observe: state -> (C,).
    """

    def body(state: VehicleState, commands: jax.Array) -> tuple[VehicleState, jax.Array]:
        for command in commands:
            state = one_step(model, params, state, command)
        return state, observe(state)

    scan = scan_apart if model.config.dynamics == "fused" else jax.lax.scan
    return scan(body, state, commands)[1]


def drive(model: VehicleModel, params: VehicleParams, state: VehicleState, command: jax.Array) -> VehicleState:
    """Advance one instance by one control period with one command (2,) held."""
    config = model.config

    def plain(params: VehicleParams, state: VehicleState, command: jax.Array) -> VehicleState:
        return substeps(model, params, state, jnp.broadcast_to(command, (config.substeps, 2)))

    wanted = runs_triton() if config.kernel is None else config.kernel
    if config.dynamics != "fused" or not wanted:
        return plain(params, state, command)
    roll = Roll(partial(one_step, model), config.substeps, plain)
    return held_in_registers(roll, (params, state, command), forced=config.kernel is True)


def forces(
    model: VehicleModel, params: VehicleParams, state: VehicleState, command: jax.Array
) -> tuple[tuple, jax.Array, Motion]:
    """All forces on one instance at its present state.

    Returns:
        New memory of the effects; the generalised force (8,) as MuJoCo's qfrc_applied; the motion it was computed from.
    """
    effects = params.effects
    memory, world = apply_chain(effects, state.memory, "world", moving_world(model, state))
    motion = measure(model, params, world, state)
    command = limited(model, command) if model.config.limited else command
    memory, command = apply_chain(effects, memory, "command", command, motion)
    target = wheel_speeds(command, model.spec.track)
    memory, signal = apply_chain(effects, memory, "actuation", _no_drive(target), motion)
    motion = dataclasses.replace(motion, drive_torque=signal.torque, yielding=signal.yielding)
    if world.sprung:
        return sprung_forces(model, params, memory, motion, signal.force)
    memory, wrench = sum_forces(effects, memory, motion, reacts=False)
    wrench = wrench + contact_wrench(motion, side_forces(motion, signal.force), jnp.zeros(4), motion.normal_force)
    memory, reaction = sum_forces(effects, memory, dataclasses.replace(motion, others=wrench), reacts=True)
    wrench = wrench + reaction
    return memory, generalised_force(motion, wrench), motion


def limited(model: VehicleModel, command: jax.Array) -> jax.Array:
    """Command (2,) within the vehicle's limits; one that is within them is unchanged, and so is its derivative."""
    spec = model.spec
    low = jnp.asarray([spec.v_min, -spec.omega_max], command.dtype)
    high = jnp.asarray([spec.v_max, spec.omega_max], command.dtype)
    command = jnp.where(command > high, high, command)
    return jnp.where(command < low, low, command)


def sprung_forces(
    model: VehicleModel, params: VehicleParams, memory: tuple, motion: Motion, drive_force: jax.Array
) -> tuple[tuple, jax.Array, Motion]:
    """As `forces`, from the motion with its drive on, where loads are those at the end of the step.

    Loads decide what the wheels can pull, and the pull shifts the loads. First the wheels are taken to roll, then the
    pull is that of the loads and the loads those of the pull, LOAD_ROUNDS times.

    Args:
        drive_force: (2,) force of the drive on each side [N]; 0 for a drive that turns the wheels.
    """
    effects, loads, none = params.effects, load_law(model, params, motion), jnp.zeros(4)
    spun = motion.wheel_inertia * by_mode(motion.drive_torque, spin_response(motion))  # [N m] that turns the wheels
    pull = drive_force + (motion.drive_torque - spun) / motion.wheel_radius
    rolling = contact_wrench(motion, side_forces(motion, pull), none)
    rolling = dataclasses.replace(rolling, spin_torque=spun - motion.drive_torque)
    motion = dataclasses.replace(motion, normal_force=loads(rolling))
    memory, wrench = sum_forces(effects, memory, motion, reacts=False)
    wrench = wrench + contact_wrench(motion, side_forces(motion, drive_force), none)
    after, reaction = memory, Wrench.zero()
    for _ in range(LOAD_ROUNDS):
        others = wrench + contact_wrench(motion, none, none, motion.normal_force)
        after, reaction = sum_forces(effects, memory, dataclasses.replace(motion, others=others), reacts=True)
        motion = dataclasses.replace(motion, normal_force=loads(wrench + reaction))
    wrench = wrench + reaction + contact_wrench(motion, none, none, motion.normal_force)
    return after, generalised_force(motion, wrench), motion


def load_law(model: VehicleModel, params: VehicleParams, motion: Motion) -> Callable[[Wrench], jax.Array]:
    """Loads (4,) [N] at the end of the step, as a function of all other forces on the chassis and its wheels.

    Springs and dampers at the speeds after the step (Euler's implicit rule), with the chassis' heave, roll and pitch as
    the three unknowns: any stiffness is stable, and what a stiff suspension carries shifts at once. Turning about other
    axes does not change them, and the normals of the ground are taken to be the chassis' own.
    """
    world, dt = motion.world, motion.dt
    stiffness, damping = suspension(params.body.mass, world.sag, world.damping)
    mass, inertia, com = mass_distribution(model, params, world)
    wheels = model.wheels
    total = mass + 2 * wheels.mass
    x, y, _ = motion.contact_points
    rows = jnp.stack([jnp.ones(4), y - com[1], com[0] - x])  # (3, 4) what heave, roll and pitch move each contact by
    hold = (damping + stiffness * dt) * dt  # [N s^2/m]
    matrix = jnp.diag(jnp.stack([total, inertia[0], inertia[1]])) + hold * (rows[:, None] * rows[None]).sum(-1)
    start = motion.spring_force - stiffness * dt * motion.normal_speed  # if the speeds did not change
    weight = total * (motion.rotation.T @ world.gravity)[2]
    spun = wheels.armature * world.wheel_inertia
    turned = (wheels.inertia + world.wheel_reaction * spun) / (wheels.inertia + spun)  # share that turns the chassis

    def loads(others: Wrench) -> jax.Array:
        back = turned * (motion.drive_torque + others.spin_torque).sum()
        push = jnp.stack([others.fz + weight, others.tx - com[1] * others.fz + com[2] * others.fy,
                          others.ty - com[2] * others.fx + com[0] * others.fz - back])
        acceleration = rigid.solve_symmetric(matrix, push + (rows * start).sum(-1))
        return smooth_load(params.body.mass, start - hold * (acceleration[:, None] * rows).sum(0))

    return loads


def smooth_load(mass: jax.Array, load: jax.Array) -> jax.Array:
    """Loads (4,) [N] that contacts lose smoothly where springs would pull."""
    smooth = SMOOTH_LOAD * mass * GRAVITY / 4
    return smooth * softplus(load / smooth)


def integrate(
    model: VehicleModel, params: VehicleParams, world: World, state: VehicleState, force: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """qpos (9,) and qvel (8,) one physics step on, under the generalised force (8,)."""
    if model.config.dynamics == "fused":
        chassis = mass_distribution(model, params, world)
        return rigid.step(model, chassis, world, state.qpos, state.qvel, force)
    mjx = import_mjx()
    data = model.data.replace(qpos=state.qpos, qvel=state.qvel, qfrc_applied=force)
    data = mjx.step(instance_model(model, params, world), data)
    return rigid.moved(state.qpos, (state.qvel + data.qvel) / 2, model.config.physics_dt), data.qvel


def mass_distribution(model: VehicleModel, params: VehicleParams, world: World) -> rigid.Chassis:
    """Mass, inertia and centre of mass of this instance's chassis body."""
    body = params.body
    roll, pitch, _ = box_inertia(model.spec)
    scale = body.mass / model.spec.mass
    inertia = jnp.stack([roll * scale, pitch * scale, body.yaw_inertia])
    com = jnp.stack([body.com_x, body.com_y, body.com_z])
    if world.payload is None:
        return rigid.Chassis(body.mass, inertia, com)
    return rigid.Chassis(*add_payload(body.mass, inertia, com, world.payload))


def instance_model(model: VehicleModel, params: VehicleParams, world: World):
    """The mjx.Model with this instance's mass distribution, wheels and gravity."""
    mass, inertia, com = mass_distribution(model, params, world)
    nominal = model.mjx
    return nominal.replace(
        body_mass=jnp.concatenate([nominal.body_mass[:1], mass[None], nominal.body_mass[2:]]),
        body_inertia=jnp.concatenate([nominal.body_inertia[:1], inertia[None], nominal.body_inertia[2:]]),
        body_ipos=jnp.concatenate([nominal.body_ipos[:1], com[None], nominal.body_ipos[2:]]),
        dof_armature=jnp.concatenate([nominal.dof_armature[:6], nominal.dof_armature[6:] * world.wheel_inertia]),
        opt=nominal.opt.replace(gravity=world.gravity),
    )


def add_payload(
    mass: jax.Array, inertia: jax.Array, com: jax.Array, payload: Payload
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Mass (), inertia (3,) about the centre of mass and centre of mass (3,) with a point mass on board.

    Parallel axes; products of inertia are left out. A payload of 0 kg changes no bit.
    """
    share = payload.mass / (mass + payload.mass)
    arm = jnp.stack([payload.x, payload.y, payload.z]) - com
    square = arm * arm
    return mass + payload.mass, inertia + mass * share * (square.sum() - square), com + share * arm


def nominal_world(model: VehicleModel) -> World:
    """Level ground, no wind, and the spec's geometry."""
    spec = model.spec
    rear, front, half_track = spec.rear_x, spec.front_x, spec.track / 2
    if spec.drive == "skid":
        driven = (1.0, 1.0, 1.0, 1.0)
    else:
        driven = (1.0, 1.0, 0.0, 0.0) if spec.driven_axle == "rear" else (0.0, 0.0, 1.0, 1.0)
    geometry = Geometry(
        contact_x=jnp.array([rear, rear, front, front]),
        contact_y=jnp.array([half_track, -half_track, half_track, -half_track]),
        wheel_radius=jnp.full(2, spec.wheel_radius),
        driven=jnp.array(driven),
    )
    sag = jnp.asarray(STATIC_SAG, jnp.result_type(float))
    return World(geometry, gravity=jnp.array([0.0, 0.0, -GRAVITY]), wind=jnp.zeros(3), sag=sag,
                 damping=jnp.asarray(DAMPING_RATIO, sag.dtype), wheel_inertia=jnp.ones((), sag.dtype),
                 wheel_reaction=jnp.zeros((), sag.dtype))


def moving_world(model: VehicleModel, state: VehicleState) -> World:
    """The nominal world, and how the chassis moves in it."""
    v, omega = body_twist(model, state.qpos, state.qvel)
    return dataclasses.replace(nominal_world(model), speed=v, yaw_rate=omega, drift=jnp.zeros_like(omega))


def measure(model: VehicleModel, params: VehicleParams, world: World, state: VehicleState) -> Motion:
    """The present motion in the chassis frame, with the suspension's forces on the ground of `world`."""
    spec = model.spec
    rotation = rotation_from_quaternion(state.qpos[3:7])
    velocity = rotation.T @ state.qvel[:3]
    rate = state.qvel[3:6]
    under = footing(world, rotation, state.qpos[:3], spec.wheel_radius)
    x, y, z = under.contact_points
    point_velocity = (
        velocity[0] + rate[1] * z - rate[2] * y,
        velocity[1] + rate[2] * x - rate[0] * z,
        velocity[2] + rate[0] * y - rate[1] * x,
    )  # each (4,), chassis frame

    def along(axis: jax.Array) -> jax.Array:
        return axis[0] * point_velocity[0] + axis[1] * point_velocity[1] + axis[2] * point_velocity[2]

    forward, left, normal = contact_axes = rolling_axes(under.contact_axes, world.drift)
    mass, inertia, com = mass_distribution(model, params, world)
    stiffness, damping = suspension(params.body.mass, carried_sag(model, world), world.damping)
    normal_speed = along(normal)
    load = stiffness * (spec.wheel_radius - under.height) - damping * normal_speed
    return Motion(
        world=world,
        mass=params.body.mass,
        heading=heading(rotation),
        ground_axes=under.axes,
        contact_axes=contact_axes,
        contact_points=under.contact_points,
        rotation=rotation,
        position=state.qpos[:2],
        velocity=velocity,
        angular_velocity=rate,
        contact_vx=along(forward),
        contact_vy=along(left),
        normal_force=smooth_load(params.body.mass, load),
        spring_force=load,
        normal_speed=normal_speed,
        spin=state.qvel[6:8],
        drive_torque=jnp.zeros(2),
        yielding=Yielding.none(),
        wheel_inertia=jnp.asarray(spec.wheel_inertia) * world.wheel_inertia,
        total_mass=mass,
        com=com,
        yaw_inertia=inertia[2],
        others=Wrench.zero(),
        wheel_radius=spec.wheel_radius,
        track=spec.track,
        dt=model.config.physics_dt,
    )


def rolling_axes(axes: jax.Array, drift: jax.Array | float) -> jax.Array:
    """Axes (3, 3, ...) at the contacts with forward and left turned by an angle of tangent `drift`."""
    cos = 1 / jnp.sqrt(1 + jnp.square(drift))
    sin = cos * drift
    return jnp.stack([cos * axes[0] + sin * axes[1], cos * axes[1] - sin * axes[0], axes[2]])


def softplus(value: jax.Array) -> jax.Array:
    """log(1 + exp(value)), as `jax.nn.softplus` but of plain operations, which scalars.py can take apart.

    log(1 + small) / small is a polynomial, right to 4e-8: a processor takes six times as many operations for a
    logarithm of any number, a fifth of a whole step.
    """
    small = jnp.exp(-jnp.abs(value))
    ratio = LOG1P[-2] + LOG1P[-1] * small
    for coefficient in reversed(LOG1P[:-2]):
        ratio = ratio * small + coefficient
    return jnp.maximum(value, 0.0) + small * ratio


def suspension(
    mass: jax.Array, sag: jax.Array | float = STATIC_SAG, ratio: jax.Array | float = DAMPING_RATIO
) -> tuple[jax.Array, jax.Array]:
    """Stiffness [N/m] and damping [N s/m] of each of the four contacts: `sag` under a quarter of the weight."""
    stiffness = mass * GRAVITY / (4 * sag)
    return stiffness, 2 * ratio * jnp.sqrt(stiffness * mass / 4)


def carried_sag(model: VehicleModel, world: World) -> jax.Array:
    """The sag [m]; where loads are those at the start of the step, at least the one that physics steps of this length
    carry: 0.2 mm at 5 ms, 3.2 mm at 20 ms."""
    least = 0.0 if world.sprung else LEAST_SAG * model.config.physics_dt**2
    return jnp.maximum(world.sag, least)


def generalised_force(motion: Motion, wrench: Wrench) -> jax.Array:
    """qfrc_applied (8,): force in the world frame, torque about the origin in the chassis frame, wheel torques."""
    force = motion.rotation @ jnp.stack([wrench.fx, wrench.fy, wrench.fz])
    spinning = motion.drive_torque + wrench.spin_torque
    torque = jnp.stack([wrench.tx, wrench.ty - motion.world.wheel_reaction * spinning.sum(), wrench.tz])
    return jnp.concatenate([force, torque, spinning])


def advance_odometry(odometry: Odometry, spin: jax.Array, model: VehicleModel) -> Odometry:
    """Wheel odometry one physics step on, from wheel speeds (2,) [rad/s], with nominal radius and track."""
    radius, track, dt = model.spec.wheel_radius, model.spec.track, model.config.physics_dt
    v = radius * (spin[0] + spin[1]) / 2
    omega = radius * (spin[1] - spin[0]) / track
    mean_v, turn = (odometry.v + v) / 2, (odometry.omega + omega) / 2 * dt
    middle = odometry.yaw + turn / 2
    return Odometry(
        x=odometry.x + mean_v * jnp.cos(middle) * dt,
        y=odometry.y + mean_v * jnp.sin(middle) * dt,
        yaw=odometry.yaw + turn,
        v=v,
        omega=omega,
    )


def place(
    model: VehicleModel,
    params: VehicleParams,
    x: jax.Array | float,
    y: jax.Array | float,
    yaw: jax.Array | float,
    twist: tuple[jax.Array | float, jax.Array | float] = (0.0, 0.0),
) -> VehicleState:
    """State with the reference point at (x, y) [m], heading yaw [rad] and `twist` v [m/s], omega [rad/s].

    The chassis rests on its suspension: it tilts towards its centre of mass (small angles), and the wheels roll. On a
    ground with surfaces it stands on the plane through its contacts, and v is horizontal.
    """
    spec, body = model.spec, params.body
    middle = (spec.rear_x + spec.front_x) / 2  # of the four contacts
    memory = tuple(effect.init() for effect in params.effects)
    _, world = apply_chain(params.effects, memory, "world", nominal_world(model))
    sag = carried_sag(model, world)
    pitch = 4 * sag * (body.com_x - middle) / spec.wheelbase**2
    roll = -4 * sag * body.com_y / spec.track**2
    height = spec.wheel_radius - sag + pitch * middle
    x, y, yaw, v, omega = (jnp.asarray(value, dtype=body.mass.dtype) for value in (x, y, yaw, *twist))
    forward = jnp.stack([jnp.cos(yaw), jnp.sin(yaw)])
    # The origin lies reference_x behind (or ahead of) the reference point, which moves with v along the heading.
    origin = jnp.stack([x, y]) - forward * spec.reference_x
    sideways = -omega * spec.reference_x  # speed of the origin to the left
    velocity = v * forward + sideways * jnp.stack([-forward[1], forward[0]])
    zero = jnp.zeros_like(v)
    climb = zero
    if world.ground:
        level, ahead, aside = plane_under(world, origin[0], origin[1], yaw)
        height = level + height * jnp.sqrt(1 + ahead**2 + aside**2)
        pitch, roll = pitch - jnp.arctan(ahead), roll + jnp.arctan(aside / jnp.sqrt(1 + ahead**2))
        climb = v * ahead + sideways * aside
    qpos = jnp.concatenate([origin, height * jnp.ones(1), quaternion_from_angles(roll, pitch, yaw), jnp.zeros(2)])
    spin = wheel_speeds(jnp.stack([v, omega]), spec.track) / spec.wheel_radius
    qvel = jnp.concatenate([velocity, jnp.stack([climb, zero, zero, omega]), spin])
    odometry = Odometry(zero, zero, zero, v, omega, omega)
    return VehicleState(qpos, qvel, memory, odometry, odometry, jnp.zeros((), bool))


def _no_drive(target: jax.Array) -> Drive:
    """Signal at the head of the actuation chain."""
    return Drive(target=target, force=jnp.zeros(2), torque=jnp.zeros(2))

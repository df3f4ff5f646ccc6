"""The environment of one instance: `reset` and `step`, pure functions without a batch axis."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.io.fields import ENV, check_fields
from whill_mjx.tasks.starts import draw_start
from whill_mjx.tasks.tasks import BLUE, Task, goal_position, make_task, reward_terms, sample_world, scale_action
from whill_mjx.vehicle.dynamics import drive, place
from whill_mjx.vehicle.kinematics import body_twist, camera_pose, reference_pose
from whill_mjx.vehicle.model import VehicleModel, build_model
from whill_mjx.vehicle.types import TimeStep, VehicleParams, VehicleState
from whill_mjx.vehicle.vehicle_file import load_vehicle
from whill_mjx.world.collision import first_contact, free_distance, obstacles_of, poses_between
from whill_mjx.world.maps.walls import shown
from whill_mjx.world.photometric import Photometry, augment, draw_photometry, neutral
from whill_mjx.world.randomize import randomize_looks
from whill_mjx.world.render import pinhole, render
from whill_mjx.world.scene import Scene, footprint

END_METRICS = ("success", "collision", "timeout", "diverged", "time_s", "episode_return")
"""Metrics that are 0 except on the last frame of an episode."""

DEFAULT_VEHICLE = "whill_cr_ramp"
"""The paper's identified WHILL with its ramp."""


@dataclass(frozen=True, eq=False)
class Env:
    """Static part of an environment; closed over by compiled functions."""

    model: VehicleModel
    task: Task
    height: int = 64
    """Rows of the image."""
    width: int = 64
    """Columns of the image."""
    random_looks: bool = False
    """Draw colours, light and textures anew for each episode."""
    photometric: bool = False
    """Apply the paper's photometric randomisation to the images."""
    exploring_starts: float = 0.0
    """Share of episodes that begin at a random free place on the way to the goal; for training
    (`whill_mjx.tasks.starts`)."""

    def __post_init__(self) -> None:
        check_fields("environment", ENV, self)


@struct.dataclass
class State:
    """One instance between two steps."""

    vehicle: VehicleState
    scene: Scene
    photometry: Photometry
    command: jax.Array  # (2,) last command: v [m/s], omega [rad/s]
    goal_distance: jax.Array  # () m
    step_count: jax.Array  # () int32 control periods since the start
    episode_return: jax.Array  # () sum of the rewards since the start
    done: jax.Array  # () bool: the episode has ended; the next step of a batch starts a new one
    key: jax.Array  # random key of the episode


@struct.dataclass
class Outcome:
    """What one step gives besides the image."""

    reward: jax.Array  # ()
    terminated: jax.Array  # () bool
    truncated: jax.Array  # () bool
    metrics: dict[str, jax.Array]


def make_env(
    task: str | Task = "obstacle_course",
    vehicle: str | Path | None = None,
    layout: str | None = None,
    random_looks: bool | None = None,
    photometric: bool | None = None,
    height: int = 64,
    width: int = 64,
    exploring_starts: float = 0.0,
) -> tuple[Env, VehicleParams]:
    """Environment, and the nominal parameters of its vehicle.

    Args:
        task: name of a task, or a task with its fields set.
        vehicle: path of a vehicle file, or the name of a preset; None takes the built-in WHILL Model CR.
        layout: "randomised" or "fixed"; None keeps the task's own.
        random_looks, photometric: see `Env`; None means off, except in a randomised corridor, as in the paper.
        height, width: image size [pixels].
        exploring_starts: see `Env`.

    Raises:
        ValueError: unknown task, layout or vehicle; a share that is none.
    """
    task = make_task(task) if isinstance(task, str) else task
    if layout is not None:
        task = dataclasses.replace(task, layout=layout)
    spec, params, _ = load_vehicle(DEFAULT_VEHICLE if vehicle is None else vehicle)
    default = task.randomised and getattr(task, "name", "") == "corridor"
    env = Env(
        build_model(spec),
        task,
        height,
        width,
        default if random_looks is None else random_looks,
        default if photometric is None else photometric,
        exploring_starts,
    )
    return env, params


def reset(env: Env, params: VehicleParams, key: jax.Array) -> tuple[State, TimeStep]:
    """Start an episode.

    Args:
        env: static model and task.
        params: physical parameters of this instance.
        key: random key; the same key gives the same world.

    Returns:
        State, and the first time step: reward 0, `first` True.
    """
    state = reset_state(env, params, key)
    return state, time_step(observe(env, state), first_outcome(env, state), first=jnp.array(True))


def step(env: Env, params: VehicleParams, state: State, action: jax.Array) -> tuple[State, TimeStep]:
    """Advance one instance by one environment step: `action_repeat` control periods, fewer when the episode ends.

    Args:
        env: static model and task.
        params: physical parameters of this instance.
        state: from `reset` or the previous `step`. After the end of an episode nothing moves any more.
        action: (2,) normalised speed and yaw rate, each in [-1, 1]. One that is no number is standstill, and ends the
            episode as `diverged`.

    Returns:
        Next state, and its time step with obs (H, W, 3) uint8 and reward ().
    """
    state, outcome = step_state(env, params, state, action)
    return state, time_step(observe(env, state), outcome, first=jnp.array(False))


def time_step(obs: jax.Array, outcome: Outcome, first: jax.Array) -> TimeStep:
    """Image and outcome as one time step."""
    return TimeStep(obs, outcome.reward, outcome.terminated, outcome.truncated, first, outcome.metrics)


def reset_state(env: Env, params: VehicleParams, key: jax.Array) -> State:
    """State at the start of an episode, without its image."""
    key, world_key, looks_key, photometry_key = jax.random.split(key, 4)
    world = sample_world(env.task, world_key)
    scene = randomize_looks(looks_key, world.scene) if env.random_looks else world.scene
    photometry = draw_photometry(photometry_key) if env.photometric else neutral()
    start = world.start
    if env.exploring_starts:
        start = draw_start(env.exploring_starts, env.task, env.model.spec, world, jax.random.fold_in(world_key, 0))
    vehicle = place(env.model, params, start[0], start[1], start[2])
    return State(
        vehicle=vehicle,
        scene=scene,
        photometry=photometry,
        command=jnp.zeros(2),
        goal_distance=jnp.linalg.norm(goal_position(scene) - start[:2]),
        step_count=jnp.zeros((), jnp.int32),
        episode_return=jnp.zeros(()),
        done=jnp.zeros((), bool),
        key=key,
    )


def repainted(env: Env, state: State, key: jax.Array) -> State:
    """The state with other colours, light and textures, and another photometric change, where `env` draws them at
    random; shapes, places and motion stay."""
    looks_key, photometry_key, key = jax.random.split(key, 3)
    scene, photometry = state.scene, state.photometry
    if env.random_looks:
        marker = dataclasses.replace(scene.marker, colour=jnp.array(BLUE))  # as before its own shade was drawn
        scene = randomize_looks(looks_key, dataclasses.replace(scene, marker=marker))
    if env.photometric:
        photometry = draw_photometry(photometry_key)
    return dataclasses.replace(state, scene=scene, photometry=photometry, key=key)


def step_state(env: Env, params: VehicleParams, state: State, action: jax.Array) -> tuple[State, Outcome]:
    """State and outcome after one environment step, without the image."""
    command, unreadable = scale_action(env.task, action), jnp.isnan(action).any()
    if env.task.action_repeat == 1:
        return _control_period(env, params, state, command, unreadable)

    def repeat(carry, _):
        before, so_far = carry
        after, outcome = _control_period(env, params, before, command, unreadable)
        outcome = dataclasses.replace(outcome, reward=so_far.reward + outcome.reward)
        return jax.tree.map(lambda old, new: jnp.where(before.done, old, new), carry, (after, outcome)), None

    carry = (state, first_outcome(env, state))
    return jax.lax.scan(repeat, carry, None, length=env.task.action_repeat)[0]


def _control_period(
    env: Env, params: VehicleParams, state: State, command: jax.Array, unreadable: jax.Array
) -> tuple[State, Outcome]:
    """One control period, its reward and whether it ended the episode; an `unreadable` action () ends it."""
    task = env.task
    vehicle = drive(env.model, params, state.vehicle, command)
    vehicle = dataclasses.replace(vehicle, diverged=vehicle.diverged | unreadable)
    vehicle, collided = _stopped(env, state, vehicle)
    x, y, yaw = reference_pose(env.model, vehicle.qpos)
    distance = jnp.linalg.norm(goal_position(state.scene) - jnp.stack([x, y]))
    reached = (distance <= task.goal_radius) & ~collided & ~vehicle.diverged
    progress = jnp.where(vehicle.diverged, 0.0, state.goal_distance - distance)
    terms = reward_terms(task, progress, command[1] - state.command[1], reached, collided)
    reward = jnp.asarray(sum(terms.values()))

    terminated = reached | collided | vehicle.diverged
    step_count = state.step_count + 1
    truncated = (step_count >= task.max_steps) & ~terminated
    after = dataclasses.replace(
        state,
        vehicle=vehicle,
        command=command,
        goal_distance=distance,
        step_count=step_count,
        episode_return=state.episode_return + reward,
        done=terminated | truncated,
    )
    ends = {"success": reached, "collision": collided, "timeout": truncated, "diverged": vehicle.diverged}
    ends = {name: flag.astype(reward.dtype) for name, flag in ends.items()}
    ends["time_s"] = jnp.where(after.done, step_count * jnp.array(env.model.config.control_dt, float), 0.0)
    ends["episode_return"] = jnp.where(after.done, after.episode_return, 0.0)
    outcome = Outcome(reward, terminated, truncated, ends | _pose_metrics(env, after))
    still = (state, first_outcome(env, state))  # after the end nothing moves, and the end is reported once
    return jax.tree.map(lambda old, new: jnp.where(state.done, old, new), still, (after, outcome))


def _stopped(env: Env, state: State, vehicle: VehicleState) -> tuple[VehicleState, jax.Array]:
    """The vehicle after a control period, where it first touched something if it did, and whether it did."""
    task, spec = env.task, env.model.spec
    before, after = (footprint(spec, *reference_pose(env.model, qpos)) for qpos in (state.vehicle.qpos, vehicle.qpos))
    fastest = max(abs(task.v_min), abs(task.v_max))
    duration = env.model.config.control_dt
    poses = poses_between(fastest, task.omega_max, duration, spec.body_length / 2, spec.body_width / 2)
    obstacles = obstacles_of(state.scene, after.x, after.y)
    collided, share = first_contact(before, after, obstacles, poses)
    collided = collided & ~vehicle.diverged
    there = state.vehicle.qpos + share * (vehicle.qpos - state.vehicle.qpos)
    return dataclasses.replace(vehicle, qpos=jnp.where(collided, there, vehicle.qpos)), collided


def first_outcome(env: Env, state: State) -> Outcome:
    """Outcome that goes with the first frame of an episode."""
    false, zero = jnp.zeros((), bool), jnp.zeros(())
    return Outcome(zero, false, false, dict.fromkeys(END_METRICS, zero) | _pose_metrics(env, state))


def _pose_metrics(env: Env, state: State) -> dict[str, jax.Array]:
    x, y, yaw = reference_pose(env.model, state.vehicle.qpos)
    v, omega = body_twist(env.model, state.vehicle.qpos, state.vehicle.qvel)
    return {
        "x": x,
        "y": y,
        "yaw": yaw,
        "v": v,
        "omega": omega,
        "goal_distance": state.goal_distance,
        "clearance": free_distance(footprint(env.model.spec, x, y, yaw), state.scene),
    }


def observe(env: Env, state: State) -> jax.Array:
    """Camera image (H, W, 3) uint8 of one instance."""
    position, rotation = camera_pose(env.model, state.vehicle.qpos)
    intrinsics = pinhole(env.model.spec.camera.fov_y, env.height, env.width)
    scene = shown(state.scene, position, rotation, intrinsics, env.width)
    image = render(position, rotation, intrinsics, scene, env.height, env.width)
    if not env.photometric:
        return image
    return augment(image, state.photometry, jax.random.fold_in(state.key, state.step_count))

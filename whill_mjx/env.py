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
from whill_mjx.world.eye import develop, mounted
from whill_mjx.world.photometric import Photometry, augment, draw_photometry, neutral
from whill_mjx.world.randomize import randomize_looks
from whill_mjx.world.render import Quality, pinhole, render
from whill_mjx.world.render.rich import floor_light
from whill_mjx.world.rich import furnish, paint
from whill_mjx.world.scene import Scene, clearance, collides, footprint

END_METRICS = ("success", "collision", "timeout", "diverged", "time_s", "episode_return")
"""Metrics that are 0 except on the last frame of an episode."""

LOOKS = ("plain", "paper", "rich")
TRAIL = 5
"""Poses kept for late images and for the lag of the exposure control."""
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
    rich: bool = False
    """Furnish the room and draw materials, lights and film at random (`whill_mjx.world.rich`), instead of the above."""

    def __post_init__(self) -> None:
        check_fields("environment", ENV, self)

    @property
    def repaints(self) -> bool:
        """Whether two episodes in one world look different."""
        return self.random_looks or self.photometric or self.rich


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
    trail: jax.Array | None = None  # (TRAIL, 7) latest poses of the chassis, newest first; with rich looks only


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
    looks: str | None = None,
) -> tuple[Env, VehicleParams]:
    """Environment, and the nominal parameters of its vehicle.

    Args:
        task: name of a task, or a task with its fields set.
        vehicle: path of a vehicle file, or the name of a preset; None takes the built-in WHILL Model CR.
        layout: "randomised" or "fixed"; None keeps the task's own.
        random_looks, photometric: see `Env`; None means off, except in a randomised corridor, as in the paper.
        height, width: image size [pixels].
        exploring_starts: see `Env`.
        looks: one of LOOKS, which sets `random_looks`, `photometric` and `rich`: "plain" draws nothing, "paper" what
            the paper randomises, "rich" a furnished room. None leaves it to the two arguments.

    Raises:
        ValueError: unknown task, layout, vehicle or looks; a share that is none.
    """
    if looks is not None:
        if looks not in LOOKS:
            raise ValueError(f"looks is {looks!r}; use one of {LOOKS}.")
        random_looks = photometric = looks == "paper"
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
        looks == "rich",
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
    if env.rich:
        lone = getattr(env.task, "name", "") == "corridor"
        scene = furnish(jax.random.fold_in(world_key, 1), world.scene, lone)
        scene = paint(looks_key, scene)
        world = dataclasses.replace(world, scene=scene)
    else:
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
        trail=jnp.broadcast_to(vehicle.qpos[:7], (TRAIL, 7)) if env.rich else None,
    )


def repainted(env: Env, state: State, key: jax.Array) -> State:
    """The state with other colours, light and textures, and another photometric change, where `env` draws them at
    random; shapes, places and motion stay."""
    looks_key, photometry_key, key = jax.random.split(key, 3)
    scene, photometry = state.scene, state.photometry
    if env.rich:
        scene = paint(looks_key, scene)
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
    x, y, yaw = reference_pose(env.model, vehicle.qpos)
    distance = jnp.linalg.norm(goal_position(state.scene) - jnp.stack([x, y]))
    collided = collides(footprint(env.model.spec, x, y, yaw), state.scene.boxes) & ~vehicle.diverged
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
        trail=None if state.trail is None else jnp.concatenate([vehicle.qpos[None, :7], state.trail[:-1]]),
    )
    ends = {"success": reached, "collision": collided, "timeout": truncated, "diverged": vehicle.diverged}
    ends = {name: flag.astype(reward.dtype) for name, flag in ends.items()}
    ends["time_s"] = jnp.where(after.done, step_count * jnp.array(env.model.config.control_dt, float), 0.0)
    ends["episode_return"] = jnp.where(after.done, after.episode_return, 0.0)
    outcome = Outcome(reward, terminated, truncated, ends | _pose_metrics(env, after))
    still = (state, first_outcome(env, state))  # after the end nothing moves, and the end is reported once
    return jax.tree.map(lambda old, new: jnp.where(state.done, old, new), still, (after, outcome))


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
        "clearance": clearance(footprint(env.model.spec, x, y, yaw), state.scene.boxes),
    }


def observe(env: Env, state: State) -> jax.Array:
    """Camera image (H, W, 3) uint8 of one instance."""
    if env.rich:
        return _observe_rich(env, state)
    position, rotation = camera_pose(env.model, state.vehicle.qpos)
    intrinsics = pinhole(env.model.spec.camera.fov_y, env.height, env.width)
    image = render(position, rotation, intrinsics, state.scene, env.height, env.width)
    if not env.photometric:
        return image
    return augment(image, state.photometry, jax.random.fold_in(state.key, state.step_count))


METERED = (0.8, 1.8, 3.5)
"""Distances ahead of the camera at which the exposure control finds the light [m]."""
SHUTTER = 1.0 / 40.0
"""Time for which the shutter of a camera in a room is open [s]."""


def _observe_rich(env: Env, state: State) -> jax.Array:
    """The same with mount, exposure control, film and delay of the camera."""
    eye, lights, trail = state.scene.rich.eye, state.scene.rich.lights, state.trail
    assert trail is not None
    position, rotation = camera_pose(env.model, trail[eye.delay])
    position, rotation = mounted(eye, position, rotation)
    fov = env.model.spec.camera.fov_y * eye.zoom
    intrinsics = pinhole(fov, env.height, env.width)

    then, before = camera_pose(env.model, trail[-1])
    ahead = before[:2, 2] * jax.lax.rsqrt(jnp.sum(before[:2, 2] ** 2) + 1e-6)
    metered = [jnp.log(floor_light(lights, *(then[:2] + far * ahead)) + 1e-4) for far in METERED]
    exposure = 0.5 * jnp.exp(-sum(metered) / len(METERED))
    rich = dataclasses.replace(state.scene.rich, lights=dataclasses.replace(lights, exposure=exposure))
    scene = dataclasses.replace(state.scene, rich=rich)
    image = render(position, rotation, intrinsics, scene, env.height, env.width, RICH)
    turning = state.vehicle.qvel[5] * SHUTTER * intrinsics.fx
    return develop(image, eye, turning, jax.random.fold_in(state.key, state.step_count), state.step_count)


RICH = Quality(antialias=True)

"""The environment of one instance: `reset` and `step`, pure functions without a batch axis."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.io.fields import ENV, check_fields
from whill_mjx.sensors.base import Sensor, Sensors, View, as_sensors, begin_sensors, check_sensor, read_sensors
from whill_mjx.sensors.registry import known_sensors
from whill_mjx.tasks.base import scale_action
from whill_mjx.tasks.check import check_task
from whill_mjx.tasks.parts import BLUE
from whill_mjx.tasks.starts import draw_start
from whill_mjx.tasks.tasks import Task, make_task
from whill_mjx.tasks.terms import Moment
from whill_mjx.vehicle.dynamics import drive, place
from whill_mjx.vehicle.ground import on_ground
from whill_mjx.vehicle.kinematics import body_twist, camera_pose, reference_pose
from whill_mjx.vehicle.model import VehicleModel, build_model
from whill_mjx.vehicle.presets import preset_params
from whill_mjx.vehicle.specs import VehicleSpec
from whill_mjx.vehicle.types import TimeStep, VehicleParams, VehicleState
from whill_mjx.vehicle.vehicle_file import load_vehicle
from whill_mjx.world.collision import first_contact, free_distance, obstacles_of, poses_between, touches
from whill_mjx.world.eye import develop, mounted
from whill_mjx.world.maps.walls import shown
from whill_mjx.world.people.contact import (
    poses_among_people,
    scene_with_people,
    scene_without_people,
    walk_around,
)
from whill_mjx.world.photometric import Photometry, augment, draw_photometry, neutral
from whill_mjx.world.randomize import randomize_looks
from whill_mjx.world.render import Quality, pinhole
from whill_mjx.world.render.draw import draw
from whill_mjx.world.render.rich import floor_light
from whill_mjx.world.rich import furnish, paint, pictures_of
from whill_mjx.world.scene import Scene, footprint

END_METRICS = ("success", "collision", "timeout", "diverged", "time_s", "episode_return")
"""Metrics that are 0 except on the last frame of an episode; the endings of a task come on top (`end_names`)."""
POSE_METRICS = ("x", "y", "yaw", "v", "omega", "goal_distance", "clearance")
"""Metrics of every frame."""
RESERVED = (*POSE_METRICS, "bumped", "timeout", "diverged", "time_s", "episode_return")
"""Names that a task's endings may not have."""
LOOKS = ("plain", "paper", "rich")
"""What changes the picture from episode to episode: nothing, what the paper randomises, a furnished room."""
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
    sensors: Sensors = ()
    """What is observed, as pairs of name and sensor; none shows the camera image alone, as an array."""

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
    sensors: tuple = ()  # memory of the sensors


@struct.dataclass
class Outcome:
    """What one step gives besides the image."""

    reward: jax.Array  # ()
    terminated: jax.Array  # () bool
    truncated: jax.Array  # () bool
    metrics: dict[str, jax.Array]


def make_env(
    task: str | Task = "obstacle_course",
    vehicle: str | Path | VehicleSpec | tuple[VehicleSpec, VehicleParams] | None = None,
    layout: str | None = None,
    random_looks: bool | None = None,
    photometric: bool | None = None,
    height: int = 64,
    width: int = 64,
    exploring_starts: float = 0.0,
    looks: str | None = None,
    observations: Mapping[str, Sensor] | Sequence[str] | None = None,
) -> tuple[Env, VehicleParams]:
    """Environment, and the nominal parameters of its vehicle.

    Args:
        task: a task with its fields set, the name of a known one, package.module:TASK or path/to/file.py:TASK.
        vehicle: path of a vehicle file, the name of a preset, a spec (with the physical base model), or a spec and its
            parameters; None takes the built-in WHILL Model CR.
        layout: "randomised" or "fixed"; None keeps the task's own.
        random_looks, photometric: see `Env`; None takes those of the task's looks, and none where all worlds
            are the same.
        height, width: image size [pixels].
        exploring_starts: see `Env`.
        looks: one of LOOKS, which sets `random_looks`, `photometric` and `rich`: "plain" draws nothing, "paper" what
            the paper randomises, "rich" a furnished room. None takes those of the task, and none where all worlds are
            the same; the two arguments count more than the task's.
        observations: sensors by name, or names of the package's sensors (`whill_mjx.sensors`); observations are then a
            dict. None takes those of the task, and the camera image alone, as an array, where it names none.

    Raises:
        ValueError: unknown task, layout, vehicle, looks or sensor; a method of the task that fails or returns something
            else than it must; a share that is none; rich looks of a task that has
            no lane to furnish.
    """
    task = make_task(task) if isinstance(task, str) else task
    if not isinstance(task, Task):
        raise ValueError(f"task is {task!r}; give a Task such as Corridor(), or the name of one.")
    if layout is not None:
        task = dataclasses.replace(task, layout=layout)
    check_task(task)
    spec, params = as_vehicle(vehicle)
    chosen = task.observations() if observations is None else observations
    if looks is not None:
        random_looks = photometric = None
    looks = _looks_of(task, looks)
    env = Env(
        build_model(spec),
        task,
        height,
        width,
        looks == "paper" if random_looks is None else random_looks,
        looks == "paper" if photometric is None else photometric,
        exploring_starts,
        looks == "rich",
        as_sensors(chosen, known_sensors()),
    )
    _check_own(env, params)
    return env, params


def _check_own(env: Env, params: VehicleParams) -> None:
    """Trace the first frame with a task or sensors from outside this package; ValueError says what is wrong in them."""
    own = {name: sensor for name, sensor in env.sensors if not type(sensor).__module__.startswith("whill_mjx.")}
    if own or not type(env.task).__module__.startswith("whill_mjx."):
        bare = dataclasses.replace(env, sensors=())
        state, _ = jax.eval_shape(lambda seed: reset(bare, params, jax.random.key(seed)), 0)
        for name, sensor in own.items():
            check_sensor(name, sensor, lambda state: view_of(env, params, state), state)


def _looks_of(task: Task, looks: str | None) -> str:
    """The looks asked for, or the task's own; raises ValueError where there are none such."""
    if looks is None:
        looks = task.looks if task.randomised else "plain"
    if looks not in LOOKS:
        raise ValueError(f"looks is {looks!r}; use one of {LOOKS}.")
    if looks == "rich" and not task.lane:
        raise ValueError(f"task {task.name!r} has no lane of three walls that could be furnished; use other looks than "
                         "'rich'.")
    return looks


def as_vehicle(
    vehicle: str | Path | VehicleSpec | tuple[VehicleSpec, VehicleParams] | None,
) -> tuple[VehicleSpec, VehicleParams]:
    """Spec and parameters of a vehicle as `make_env` takes it."""
    if isinstance(vehicle, VehicleSpec):
        return vehicle, preset_params(vehicle, "physical")
    if isinstance(vehicle, tuple):
        if [type(one) for one in vehicle] != [VehicleSpec, VehicleParams]:
            raise ValueError(f"vehicle is {vehicle!r}; a pair is a VehicleSpec and its VehicleParams. Give both.")
        return vehicle
    spec, params, _ = load_vehicle(DEFAULT_VEHICLE if vehicle is None else vehicle)
    return spec, params


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
    outcome = first_outcome(env, state)
    state, obs = sense(env, params, state)
    return state, time_step(obs, outcome, first=jnp.array(True))


def step(env: Env, params: VehicleParams, state: State, action: jax.Array) -> tuple[State, TimeStep]:
    """Advance one instance by one environment step: `action_repeat` control periods, fewer when the episode ends.

    Args:
        env: static model and task.
        params: physical parameters of this instance.
        state: from `reset` or the previous `step`. After the end of an episode nothing moves any more.
        action: (2,) normalised speed and yaw rate, each in [-1, 1]. One that is no number is standstill, and ends the
            episode as `diverged`.

    Returns:
        Next state, and its time step with obs (H, W, 3) uint8, or a dict of the sensors' values, and reward ().
    """
    state, outcome = step_state(env, params, state, action)
    state, obs = sense(env, params, state)
    return state, time_step(obs, outcome, first=jnp.array(False))


def time_step(obs: Any, outcome: Outcome, first: jax.Array) -> TimeStep:
    """Observation and outcome as one time step."""
    return TimeStep(obs, outcome.reward, outcome.terminated, outcome.truncated, first, outcome.metrics)


def reset_state(env: Env, params: VehicleParams, key: jax.Array) -> State:
    """State at the start of an episode, without its image."""
    key, world_key, looks_key, photometry_key = jax.random.split(key, 4)
    world = env.task.sample_world(world_key)
    if env.rich:
        lone = world.scene.boxes.mask.shape[0] - pictures_of(world.scene) == env.task.walls + 1
        world = dataclasses.replace(world, scene=furnish(jax.random.fold_in(world_key, 1), world.scene, lone))
    if env.task.people:
        people_key, dress_key = jax.random.split(jax.random.fold_in(world_key, 2))
        people = env.task.populate(people_key, world)
        world = dataclasses.replace(world, scene=scene_with_people(world.scene, people, dress_key))
    scene = world.scene
    if env.rich:
        scene = paint(looks_key, scene)
        world = dataclasses.replace(world, scene=scene)
    elif env.random_looks:
        scene = randomize_looks(looks_key, scene)
    photometry = draw_photometry(photometry_key) if env.photometric else neutral()
    start = world.start
    if env.exploring_starts:
        start = draw_start(env.exploring_starts, env.task, env.model.spec, world, jax.random.fold_in(world_key, 0))
    vehicle = place(env.model, on_ground(params, scene.ground), start[0], start[1], start[2])
    state = State(
        vehicle=vehicle,
        scene=scene,
        photometry=photometry,
        command=jnp.zeros(2),
        goal_distance=jnp.linalg.norm(env.task.goal(scene) - start[:2]),
        step_count=jnp.zeros((), jnp.int32),
        episode_return=jnp.zeros(()),
        done=jnp.zeros((), bool),
        key=key,
        trail=jnp.broadcast_to(vehicle.qpos[:7], (TRAIL, 7)) if env.rich else None,
    )
    if not env.sensors:
        return state
    return dataclasses.replace(state, sensors=begin_sensors(env.sensors, view_of(env, params, state)))


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
    command, unreadable = scale_action(env.task, action), ~jnp.isfinite(action).all()
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
    vehicle = drive(env.model, on_ground(params, state.scene.ground), state.vehicle, command)
    vehicle = dataclasses.replace(vehicle, diverged=vehicle.diverged | unreadable)
    scene, vehicle, collided = _stopped(env, state, vehicle)
    state = dataclasses.replace(state, scene=scene)
    step_count = state.step_count + 1
    moment = moment_of(env, state, vehicle, command, step_count, collided)
    terms = task.rewards(moment)
    reward, moment = _finite(jnp.asarray(sum(terms.values())), moment)
    vehicle = dataclasses.replace(vehicle, diverged=moment.diverged)
    ends = endings_of(task, moment)
    terminated = jnp.stack(list(ends.values())).any() | vehicle.diverged
    truncated = (step_count >= task.max_steps) & ~terminated
    after = dataclasses.replace(
        state,
        vehicle=vehicle,
        command=command,
        goal_distance=moment.goal_distance,
        step_count=step_count,
        episode_return=state.episode_return + reward,
        done=terminated | truncated,
        trail=None if state.trail is None else jnp.concatenate([vehicle.qpos[None, :7], state.trail[:-1]]),
    )
    ends |= {"timeout": truncated, "diverged": vehicle.diverged}
    ends = {name: flag.astype(reward.dtype) for name, flag in ends.items()}
    ends["time_s"] = jnp.where(after.done, step_count * jnp.array(env.model.config.control_dt, float), 0.0)
    ends["episode_return"] = jnp.where(after.done, after.episode_return, 0.0)
    outcome = Outcome(reward, terminated, truncated, ends | _pose_metrics(env, after))
    still = (state, first_outcome(env, state))  # after the end nothing moves, and the end is reported once
    return jax.tree.map(lambda old, new: jnp.where(state.done, old, new), still, (after, outcome))


def _finite(reward: jax.Array, moment: Moment) -> tuple[jax.Array, Moment]:
    """Reward and moment; one that is no number would stay in a learner for good: it counts 0, and ends the episode."""
    finite = jnp.isfinite(reward)
    return jnp.where(finite, reward, 0.0), dataclasses.replace(moment, diverged=moment.diverged | ~finite)


def _stopped(env: Env, state: State, vehicle: VehicleState) -> tuple[Scene, VehicleState, jax.Array]:
    """Scene and vehicle after a control period, where it first touched something if it did, and whether it did."""
    task, spec, scene = env.task, env.model.spec, state.scene
    before, after = (footprint(spec, *reference_pose(env.model, qpos)) for qpos in (state.vehicle.qpos, vehicle.qpos))
    fastest = max(abs(task.v_min), abs(task.v_max))
    duration = env.model.config.control_dt
    motion = (fastest, task.omega_max, duration, spec.body_length / 2, spec.body_width / 2)
    obstacles = obstacles_of(scene_without_people(scene), after.x, after.y)
    collided, share = first_contact(before, after, obstacles, poses_between(*motion))
    if scene.people is not None:
        scene, ran_into, until = walk_around(scene, before, after, duration, poses_among_people(*motion))
        collided, share = collided | ran_into, jnp.minimum(share, until)
    collided = collided & ~vehicle.diverged
    there = state.vehicle.qpos + share * (vehicle.qpos - state.vehicle.qpos)
    return scene, dataclasses.replace(vehicle, qpos=jnp.where(collided, there, vehicle.qpos)), collided


def moment_of(
    env: Env,
    before: State,
    vehicle: VehicleState,
    command: jax.Array,
    step_count: jax.Array,
    collided: jax.Array | None = None,
) -> Moment:
    """What rewards, endings and observations look at, after a control period that began in a state.

    Args:
        env: static model and task.
        before: at the beginning of the period.
        vehicle: at its end.
        command: (2,) v [m/s] and omega [rad/s] of the period.
        step_count: () control periods since the start of the episode.
        collided: () whether something was touched in the period; None asks whether it is touched at its end.
    """
    x, y, yaw = reference_pose(env.model, vehicle.qpos)
    body = footprint(env.model.spec, x, y, yaw)
    distance = jnp.linalg.norm(env.task.goal(before.scene) - jnp.stack([x, y]))
    if collided is None:
        collided = touches(body, obstacles_of(before.scene, body.x, body.y)) & ~vehicle.diverged
    return Moment(
        scene=before.scene,
        pose=jnp.stack([x, y, yaw]),
        twist=jnp.stack(body_twist(env.model, vehicle.qpos, vehicle.qvel)),
        body=body,
        command=command,
        previous_command=before.command,
        goal_distance=distance,
        previous_goal_distance=before.goal_distance,
        collided=collided,
        reached=(distance <= env.task.goal_radius) & ~collided & ~vehicle.diverged,
        diverged=vehicle.diverged,
        time_s=step_count * jnp.array(env.model.config.control_dt, float),
    )


def endings_of(task: Task, moment: Moment) -> dict[str, jax.Array]:
    """Flags () of the task's endings by name, of which one holds at most; "success" and "collision" among them."""
    ended, flags = moment.diverged, {}
    for name, holds in task.endings(moment).items():
        if name in RESERVED:
            raise ValueError(f"task {task.name!r}: the ending {name!r} is the library's own. Call yours otherwise.")
        flags[name] = jnp.asarray(holds, bool) & ~ended
        ended = ended | flags[name]
    return {name: flags.get(name, jnp.zeros((), bool)) for name in dict.fromkeys(("success", "collision", *flags))}


def end_names(env: Env, state: State) -> tuple[str, ...]:
    """Names of all metrics that are 0 except on the last frame of an episode."""
    here = moment_of(env, state, state.vehicle, state.command, state.step_count)
    return tuple(dict.fromkeys((*END_METRICS, *endings_of(env.task, here))))


def view_of(env: Env, params: VehicleParams, state: State) -> View:
    """One instance as its sensors see it."""
    return View(env, params, state, moment_of(env, state, state.vehicle, state.command, state.step_count))


def sense(env: Env, params: VehicleParams, state: State, seen: State | None = None) -> tuple[State, Any]:
    """State with the memory of the sensors, and what they show: the camera image (H, W, 3) uint8, or a dict by name.

    Called once a step, after the choice between the next state and a new episode. `seen` is the state that cameras look
    at, where an evaluation has moved them.
    """
    seen = state if seen is None else seen
    if not env.sensors:
        return state, observe(env, seen)
    key = jax.random.fold_in(state.key, state.step_count)
    view = view_of(env, params, state)
    memory, obs = read_sensors(env.sensors, state.sensors, view, dataclasses.replace(view, state=seen), key)
    return dataclasses.replace(state, sensors=memory), obs


def first_outcome(env: Env, state: State) -> Outcome:
    """Outcome that goes with the first frame of an episode."""
    false, zero = jnp.zeros((), bool), jnp.zeros(())
    return Outcome(zero, false, false, dict.fromkeys(end_names(env, state), zero) | _pose_metrics(env, state))


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
    } | _people_metrics(state)


def _people_metrics(state: State) -> dict[str, jax.Array]:
    """Count () of people who walked into the vehicle, which stood still, in the last period; of scenes with people."""
    people = state.scene.people
    return {} if people is None else {"bumped": jnp.sum(people.bumped).astype(jnp.float32)}


def observe(env: Env, state: State) -> jax.Array:
    """Camera image (H, W, 3) uint8 of one instance."""
    if env.rich:
        return _observe_rich(env, state)
    position, rotation = camera_pose(env.model, state.vehicle.qpos)
    intrinsics = pinhole(env.model.spec.camera.fov_y, env.height, env.width)
    scene = shown(state.scene, position, rotation, intrinsics)
    image = draw(position, rotation, intrinsics, scene)
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
    scene = shown(dataclasses.replace(state.scene, rich=rich), position, rotation, intrinsics)
    image = draw(position, rotation, intrinsics, scene, RICH)
    turning = state.vehicle.qvel[5] * SHUTTER * intrinsics.fx
    return develop(image, eye, turning, jax.random.fold_in(state.key, state.step_count), state.step_count)


RICH = Quality(antialias=True)

"""How an episode begins, goes on and ends."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from whill_mjx.env.images import observe
from whill_mjx.env.moments import endings_of, event_metrics, first_outcome, moment_of, pose_metrics, view_of
from whill_mjx.env.records import EVENT_METRICS, TRAIL, Env, Outcome, State
from whill_mjx.sensors.base import begin_sensors, read_sensors, without_nan
from whill_mjx.tasks.base import scale_action
from whill_mjx.tasks.parts import BLUE
from whill_mjx.tasks.starts import draw_start
from whill_mjx.tasks.terms import Moment
from whill_mjx.vehicle.dynamics import drive, place
from whill_mjx.vehicle.ground import on_ground
from whill_mjx.vehicle.kinematics import reference_pose
from whill_mjx.vehicle.types import TimeStep, VehicleParams, VehicleState
from whill_mjx.world.collision import first_contact, obstacles_of, poses_between
from whill_mjx.world.paint import paint
from whill_mjx.world.people.contact import poses_among_people, scene_with_people, scene_without_people, walk_around
from whill_mjx.world.photometric import draw_photometry, neutral
from whill_mjx.world.randomize import randomize_looks
from whill_mjx.world.rich import furnish, pictures_of
from whill_mjx.world.scene import Scene, footprint


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


def unpainted(state: State) -> State:
    """The state without what `repainted` draws and without what no image shows: less to keep, to look at it again."""
    scene = dataclasses.replace(state.scene, rich=None)
    unmoved: dict[str, Any] = dict.fromkeys(("encoder", "odometry", "diverged"))
    unseen: dict[str, Any] = dict.fromkeys(("command", "goal_distance", "episode_return", "done", "key"))
    vehicle = dataclasses.replace(state.vehicle, memory=(), **unmoved)
    return dataclasses.replace(state, scene=scene, vehicle=vehicle, sensors=(), **unseen)


def step_state(env: Env, params: VehicleParams, state: State, action: jax.Array) -> tuple[State, Outcome]:
    """State and outcome after one environment step, without the image."""
    command, unreadable = scale_action(env.task, action), ~jnp.isfinite(action).all()
    if env.task.action_repeat == 1:
        return _control_period(env, params, state, command, unreadable)

    def repeat(carry, _):
        before, so_far = carry
        after, outcome = _control_period(env, params, before, command, unreadable)
        sums = {name: so_far.metrics[name] + value for name, value in outcome.metrics.items() if name in EVENT_METRICS}
        reward = so_far.reward + outcome.reward
        outcome = dataclasses.replace(outcome, reward=reward, metrics=outcome.metrics | sums)
        return jax.tree.map(lambda old, new: jnp.where(before.done, old, new), carry, (after, outcome)), None

    carry = (state, first_outcome(env, state))
    return jax.lax.scan(repeat, carry, None, length=env.task.action_repeat)[0]


def _control_period(
    env: Env, params: VehicleParams, state: State, command: jax.Array, unreadable: jax.Array
) -> tuple[State, Outcome]:
    """One control period, its reward and whether it ended the episode; an `unreadable` action () ends it."""
    task = env.task
    vehicle = drive(env.model, on_ground(params, state.scene.ground), state.vehicle, command)
    vehicle = dataclasses.replace(vehicle, diverged=vehicle.diverged | unreadable | _lies_on_its_back(vehicle.qpos))
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
    outcome = Outcome(reward, terminated, truncated, ends | pose_metrics(env, after) | event_metrics(after))
    still = (state, first_outcome(env, state, ends))  # after the end nothing moves, and the end is reported once
    return jax.tree.map(lambda old, new: jnp.where(state.done, old, new), still, (after, outcome))


def _lies_on_its_back(qpos: jax.Array) -> jax.Array:
    """() whether the chassis' upward axis points below the horizon."""
    return qpos[4] ** 2 + qpos[5] ** 2 > 0.5


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


def sense(env: Env, params: VehicleParams, state: State, seen: State | None = None) -> tuple[State, Any]:
    """State with the memory of the sensors, and what they show: the camera image (H, W, 3) uint8, or a dict by name.

    Called once a step, after the choice between the next state and a new episode. A reading that is no finite number is
    shown as 0, and ends the episode as `diverged` at the next step. `seen` is the state that cameras look at, where an
    evaluation has moved them.
    """
    seen = state if seen is None else seen
    if not env.sensors:
        return state, observe(env, seen)
    key = jax.random.fold_in(state.key, state.step_count)
    view = view_of(env, params, state)
    memory, obs = read_sensors(env.sensors, state.sensors, view, dataclasses.replace(view, state=seen), key)
    obs, odd = without_nan(env.sensors, obs)
    vehicle = dataclasses.replace(state.vehicle, diverged=state.vehicle.diverged | odd)
    return dataclasses.replace(state, sensors=memory, vehicle=vehicle), obs

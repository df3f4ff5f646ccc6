"""What rewards, endings, sensors and metrics look at."""

from __future__ import annotations

from collections.abc import Iterable

import jax
import jax.numpy as jnp

from whill_mjx.env.records import END_METRICS, RESERVED, Env, Outcome, State
from whill_mjx.sensors.base import View
from whill_mjx.tasks.tasks import Task
from whill_mjx.tasks.terms import Moment
from whill_mjx.vehicle.kinematics import body_twist, reference_pose
from whill_mjx.vehicle.types import VehicleParams, VehicleState
from whill_mjx.world.collision import free_distance, obstacles_of, touches
from whill_mjx.world.scene import footprint


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


def first_outcome(env: Env, state: State, names: Iterable[str] | None = None) -> Outcome:
    """Outcome that goes with the first frame of an episode, and with every frame after its end.

    `names` are those of `end_names`; None asks the task's endings, which JAX traces for that.
    """
    false, zero = jnp.zeros((), bool), jnp.zeros(())
    nothing = jax.tree.map(jnp.zeros_like, event_metrics(state))
    ends = dict.fromkeys(end_names(env, state) if names is None else names, zero)
    return Outcome(zero, false, false, ends | pose_metrics(env, state) | nothing)


def pose_metrics(env: Env, state: State) -> dict[str, jax.Array]:
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


def event_metrics(state: State) -> dict[str, jax.Array]:
    """Counts () of what happened in the last control period: people who first walked into the vehicle."""
    people = state.scene.people
    return {} if people is None else {"bumped": jnp.sum(people.bumped).astype(jnp.float32)}

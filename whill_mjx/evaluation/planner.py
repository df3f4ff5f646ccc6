"""A planner that knows the true scene and pose: the ceiling that a camera policy is compared with.

Cross-entropy search over speed and yaw-rate profiles of a unicycle with the vehicle's ramp and lag, replanned in every
step. Its own model is simpler than the vehicle, so what it reaches is a lower bound of the optimum.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp

from whill_mjx.env import Env, State
from whill_mjx.tasks.base import Task
from whill_mjx.tasks.terms import Moment
from whill_mjx.vehicle.kinematics import body_twist, reference_pose
from whill_mjx.world.collision import obstacles_of, touches
from whill_mjx.world.scene import Scene, footprint


@dataclass(frozen=True)
class PlannerConfig:
    """Size and style of the search."""

    horizon_s: float = 5.2
    """How far the plan looks ahead [s]."""
    steps: int = 40
    """Steps of the planner's own model over the horizon."""
    knots: int = 10
    """Points between which speed and yaw rate are interpolated."""
    samples: int = 64
    """Profiles tried per round."""
    elites: int = 12
    """Best profiles that the next round is drawn around."""
    first_rounds: int = 12
    """Rounds at the start of an episode."""
    first_samples: int = 256
    """Profiles per round at the start; with few, the search may miss the one gap that is open."""
    starts: int = 3
    """Searches at the start, of which the best plan is taken: one alone sometimes ends at a gap that leads nowhere."""
    rounds: int = 2
    """Rounds in each later step."""
    spread_v: float = 0.15
    """Spread of the speed in the first round, in units of the action."""
    spread_omega: float = 0.4
    """The same of the yaw rate."""
    margin: float = 0.06
    """Distance from boxes below which a plan is penalised [m]."""
    margin_cost: float = 8.0
    """Penalty per control period spent closer than that."""
    hurry: float = 1.0
    """Penalty per control period: the reward's own is so small that dawdling would pay by smoother turns."""
    acceleration: float = 1.7
    """Ramp of the speed [m/s^2]; the yaw rate follows in proportion to the track."""
    lag: tuple[float, float] = (0.065, 0.10)
    """Time constants with which speed and yaw rate follow the ramp [s]; those of the built-in vehicle."""


class Effort(NamedTuple):
    """How long and how far one search looks around the plan that it begins with."""

    rounds: int
    samples: int
    width: float
    """Over the usual spread."""


class Begin(NamedTuple):
    """What a plan begins with."""

    scene: Scene
    motion: jax.Array
    """(5,) true x, y, yaw, v, omega."""
    command: jax.Array
    """(2,) speed and yaw rate commanded last."""
    step_count: jax.Array | int = 0
    """() control periods that have passed."""


class Period(NamedTuple):
    """One step of the planner's own model, as a task's rewards and endings see it."""

    pose: jax.Array
    twist: jax.Array
    command: jax.Array
    earlier: jax.Array
    distance: jax.Array
    farther: jax.Array
    time_s: jax.Array


def for_task(task: Task) -> PlannerConfig:
    """Settings that suit a task's speed: slow tasks look further ahead with longer steps."""
    if task.v_max >= 0.8:
        return PlannerConfig()
    # A penalty for each period must not add up to more than a collision costs, or crashing early would pay.
    return PlannerConfig(
        horizon_s=16.0, steps=64, knots=12, spread_v=0.6, spread_omega=0.6, hurry=0.05, margin_cost=2.0
    )


def first_plan(config: PlannerConfig, env: Env, state: State, key: jax.Array) -> jax.Array:
    """Plan (knots, 2) of actions for an episode that begins: a search from full speed straight on."""
    straight = jnp.tile(jnp.array([1.0, 0.0]), (config.knots, 1))
    effort = Effort(config.first_rounds, config.first_samples, 2.0)
    keys = jax.random.split(key, config.starts)
    plans, values = jax.vmap(lambda key: _search(config, env, state, straight, key, effort))(keys)
    return plans[jnp.argmax(values)]


def plan_action(
    config: PlannerConfig, env: Env, state: State, plan: jax.Array, key: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Next action (2,) of one instance, and the plan to hand in at the next step.

    Args:
        config: size of the search.
        env: static model and task.
        state: true state of the instance.
        plan: (knots, 2) actions, the first one now; from the previous step or `first_plan`.
        key: random key.
    """
    plan, _ = _search(config, env, state, plan, key, Effort(config.rounds, config.samples, 0.4))
    return plan[0], _later(config, plan, env.model.config.control_dt * env.task.action_repeat)


def _search(
    config: PlannerConfig, env: Env, state: State, plan: jax.Array, key: jax.Array, effort: Effort
) -> tuple[jax.Array, jax.Array]:
    """Best plan (knots, 2) of the last of some rounds that begin around `plan`, and its predicted return ()."""
    begin = Begin(state.scene, _start(env, state), state.command, state.step_count)
    score = jax.vmap(lambda actions: predicted_return(config, env, begin, actions))

    def one_round(carry, round_key):
        mean, deviation = carry
        noise = jax.random.normal(round_key, (effort.samples, config.knots, 2))
        tried = jnp.clip(mean + deviation * noise.at[0].set(0.0), -1.0, 1.0)
        values, order = jax.lax.top_k(score(tried), config.elites)
        elite = tried[order]
        return (elite.mean(0), elite.std(0) + 0.01), (elite[0], values[0])

    deviation = jnp.broadcast_to(effort.width * jnp.array([config.spread_v, config.spread_omega]), plan.shape)
    _, (best, values) = jax.lax.scan(one_round, (plan, deviation), jax.random.split(key, effort.rounds))
    return best[-1], values[-1]


def predicted_return(config: PlannerConfig, env: Env, begin: Begin, actions: jax.Array) -> jax.Array:
    """() return of a profile (knots, 2) in the planner's own model, less the cost of passing too close."""
    scene, start, before, step_count = begin
    task, dt = env.task, config.horizon_s / config.steps
    goal = task.goal(scene)
    periods = dt / env.model.config.control_dt  # control periods per step of this model
    profile = _resample(config, actions)  # (steps, 2)
    low, high = jnp.array([task.v_min, -task.omega_max]), jnp.array([task.v_max, task.omega_max])
    commands = low + (profile + 1.0) / 2.0 * (high - low)
    poses, speeds = predicted_motion(config, env, start, before, commands, dt)
    distance = jnp.linalg.norm(goal - poses[:, :2], axis=1)
    farther = jnp.concatenate([jnp.linalg.norm(goal - start[:2])[None], distance[:-1]])
    earlier = jnp.concatenate([before[None], commands[:-1]])
    near = _touches(config, env, scene, poses, config.margin)
    time_s = step_count * jnp.array(env.model.config.control_dt, float) + dt * jnp.arange(1, config.steps + 1)

    def look(period: Period):
        pose, twist, command, earlier, distance, farther, time_s = period
        body = footprint(env.model.spec, pose[0], pose[1], pose[2])
        collided = touches(body, obstacles_of(scene, body.x, body.y))
        reached = (distance <= task.goal_radius) & ~collided
        never = jnp.zeros((), bool)
        moment = Moment(
            scene, pose, twist, body, command, earlier, distance, farther, collided, reached, never, time_s
        )
        ends = jnp.stack([jnp.asarray(holds, bool) for holds in task.endings(moment).values()])
        return {name: jnp.asarray(value, float) for name, value in task.rewards(moment).items()}, jnp.any(ends)

    terms, ends = jax.vmap(look)(Period(poses, speeds, commands, earlier, distance, farther, time_s))
    for name in task.per_period:
        if name in terms:
            terms[name] = terms[name] * periods
    rewards = sum(terms.values()) - periods * (config.hurry + config.margin_cost * near)
    ended = jnp.cumsum(ends) - ends > 0  # after the end
    return jnp.sum(jnp.where(ended, 0.0, rewards))


def predicted_poses(
    config: PlannerConfig, env: Env, start: jax.Array, before: jax.Array, commands: jax.Array, dt: float
) -> jax.Array:
    """Poses (T, 3) of `predicted_motion`."""
    return predicted_motion(config, env, start, before, commands, dt)[0]


def predicted_motion(
    config: PlannerConfig, env: Env, start: jax.Array, before: jax.Array, commands: jax.Array, dt: float
) -> tuple[jax.Array, jax.Array]:
    """Poses (T, 3) x, y, yaw and speeds (T, 2) v, omega after each of commands (T, 2), held for dt [s].

    The planner's own model is a unicycle: speed and yaw rate follow a ramp towards the command with a first-order lag.
    `start` and `before` are motion and command of `Begin`.
    """
    limit = jnp.array([config.acceleration, 2.0 * config.acceleration / env.model.spec.track])
    lag = jnp.array(config.lag)
    kept = jnp.exp(-dt / lag)

    def one_step(carry, command):
        (x, y, yaw), speed, ramped = carry
        change = jnp.clip(command - ramped, -limit * dt, limit * dt)
        # The exact answer of lag dv/dt + v = ramped to a ramp; `speed` is v and omega.
        after = ramped + change - lag * change / dt * (1 - kept) + (speed - ramped) * kept
        travelled, turned = (speed + after) / 2 * dt
        x, y = x + travelled * jnp.cos(yaw + turned / 2), y + travelled * jnp.sin(yaw + turned / 2)
        pose = jnp.stack([x, y, yaw + turned])
        return (pose, after, ramped + change), (pose, after)

    # The ramp is ahead of the vehicle by its lag, or has come to the command.
    ramped = start[3:] + jnp.clip(before - start[3:], -limit * lag, limit * lag)
    return jax.lax.scan(one_step, (start[:3], start[3:], ramped), commands)[1]


def _touches(config: PlannerConfig, env: Env, scene: Scene, poses: jax.Array, margin: float) -> jax.Array:
    """(steps,) bool: does the vehicle, grown by `margin` on each side, touch anything at these poses (steps, 3)?"""

    def at(pose):
        vehicle = footprint(env.model.spec, pose[0], pose[1], pose[2])
        grown = dataclasses.replace(
            vehicle, half_length=vehicle.half_length + margin, half_width=vehicle.half_width + margin
        )
        return touches(grown, obstacles_of(scene, grown.x, grown.y))

    return jax.vmap(at)(poses)


def _start(env: Env, state: State) -> jax.Array:
    """(5,) true x, y, yaw, v, omega."""
    x, y, yaw = reference_pose(env.model, state.vehicle.qpos)
    v, omega = body_twist(env.model, state.vehicle.qpos, state.vehicle.qvel)
    return jnp.stack([x, y, yaw, v, omega])


def _resample(config: PlannerConfig, actions: jax.Array) -> jax.Array:
    """(steps, 2) profile between the knots."""
    at = jnp.linspace(0.0, config.knots - 1.0, config.steps)
    return _interpolate(actions, at)


def _later(config: PlannerConfig, actions: jax.Array, seconds: float) -> jax.Array:
    """The same profile seen `seconds` later, its last value held."""
    knot_s = config.horizon_s / (config.knots - 1)
    return _interpolate(actions, jnp.minimum(jnp.arange(config.knots) + seconds / knot_s, config.knots - 1.0))


def _interpolate(actions: jax.Array, at: jax.Array) -> jax.Array:
    grid = jnp.arange(actions.shape[0], dtype=jnp.float32)
    return jnp.stack([jnp.interp(at, grid, actions[:, 0]), jnp.interp(at, grid, actions[:, 1])], 1)

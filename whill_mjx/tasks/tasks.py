"""The two tasks of the reference paper: their worlds, rewards and endings.

The world frame has its origin under the driven-axle centre at the nominal start, x towards the goal. The paper gives
neither the course's layout nor the corridor's width; both are chosen here and stay, so that figures compare.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import ClassVar

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.io.fields import TASK, check_fields
from whill_mjx.world.scene import Boxes, Marker, Scene, box, default_looks, stack_boxes

LAYOUTS = ("randomised", "fixed")


@dataclass(frozen=True)
class Task:
    """What both tasks share. Hashable: a static argument of compiled functions."""

    v_min: float = -1.0
    """Forward speed at action -1 [m/s]."""
    v_max: float = 1.0
    """Forward speed at action +1 [m/s]."""
    omega_max: float = 1.0
    """Yaw rate at action +1 [rad/s]; -1 gives the opposite."""
    max_steps: int = 150
    """Control periods after which an episode is truncated."""
    action_repeat: int = 1
    """Control periods per environment step; their rewards are summed."""
    goal_radius: float = 1.0
    """Distance of the driven-axle centre from the goal centre that counts as arrival [m]."""
    goal_reward: float = 100.0
    collision_reward: float = -50.0
    progress_gain: float = 30.0
    """Reward per metre that the distance to the goal has shrunk."""
    step_reward: float = -0.05
    smoothness_gain: float = 1.0
    """Reward lost per rad/s that the commanded yaw rate has changed."""
    layout: str = "randomised"
    """"randomised" draws a new world for each episode, "fixed" is always the same one."""

    def __post_init__(self) -> None:
        check_fields("task", TASK, self)
        if self.layout not in LAYOUTS:
            raise ValueError(f"layout is {self.layout!r}; use one of {LAYOUTS}.")
        if self.v_max <= self.v_min or self.omega_max <= 0:
            raise ValueError(f"limits v {self.v_min}..{self.v_max}, omega {self.omega_max} are empty; widen them.")
        if self.action_repeat < 1 or self.max_steps < 1:
            raise ValueError(f"action_repeat {self.action_repeat} and max_steps {self.max_steps} must be at least 1.")

    @property
    def randomised(self) -> bool:
        """Whether worlds differ between episodes."""
        return self.layout == "randomised"


@dataclass(frozen=True)
class ObstacleCourse(Task):
    """Two gates on the way to a goal 5.3 m ahead, between walls. Driving straight on hits the first gate.

    A gate is a pair of low boxes, one to each side of a gap, that leave no second way through. The boxes are lower than
    the camera, so the goal marker above them is in sight from the start, and so is the second gap above the first gate.
    """

    name: ClassVar[str] = "obstacle_course"
    gates: int = 2
    """1 leaves out the second gate: an easier course for short trainings on a CPU."""
    goal_x: float = 5.3
    """Distance of the goal centre [m]: 4.3 m to go until arrival."""
    gate_x: tuple[float, float] = (2.30, 3.90)
    """Places of the gates [m]."""


@dataclass(frozen=True)
class Corridor(Task):
    """The paper's laboratory corridor: a cardboard box between the vehicle and a blue square 4.5 m ahead."""

    name: ClassVar[str] = "corridor"
    v_min: float = 0.0
    v_max: float = 0.3
    omega_max: float = 0.6
    max_steps: int = 300
    smoothness_gain: float = 0.0
    goal_x: float = 4.5
    """Distance of the goal marker [m]."""
    box_x: float = 2.5
    """Distance of the cardboard box before its randomisation; 2 and 3 in the paper's evaluation [m]."""
    width: float = 2.4
    """Distance between the walls [m]."""


TASKS: dict[str, type[Task]] = {"obstacle_course": ObstacleCourse, "corridor": Corridor}


def make_task(name: str, **changes) -> Task:
    """Task by name, with some of its fields changed; ValueError names the known tasks and fields."""
    if name not in TASKS:
        raise ValueError(f"unknown task {name!r} (known: {', '.join(TASKS)}).")
    known = {field.name for field in fields(TASKS[name])}
    unknown = sorted(set(changes) - known)
    if unknown:
        raise ValueError(f"task {name!r} has no field {unknown[0]!r} (known: {', '.join(sorted(known))}).")
    return TASKS[name](**changes)


@struct.dataclass
class World:
    """Scene and start of one episode."""

    scene: Scene
    start: jax.Array  # (3,) x [m], y [m], yaw [rad] of the driven-axle centre


def scale_action(task: Task, action: jax.Array) -> jax.Array:
    """Command (2,) of v [m/s] and omega [rad/s] for an action (2,), clipped to [-1, 1]; standstill where one is NaN."""
    stands = jnp.isnan(action).any()
    action = jnp.clip(jnp.nan_to_num(action, nan=0.0, posinf=1.0, neginf=-1.0), -1.0, 1.0)
    v = task.v_min + (action[0] + 1.0) / 2.0 * (task.v_max - task.v_min)
    return jnp.where(stands, 0.0, jnp.stack([v, action[1] * task.omega_max]))


def reward_terms(
    task: Task, progress: jax.Array, omega_change: jax.Array, reached: jax.Array, collided: jax.Array
) -> dict[str, jax.Array]:
    """The terms of the reward of one control period; their sum is the reward. A collision outweighs an arrival.

    Args:
        task: gains.
        progress: () m by which the goal came nearer.
        omega_change: () rad/s, change of the commanded yaw rate.
        reached, collided: () bool.
    """
    return {
        "goal": task.goal_reward * (reached & ~collided),
        "collision": task.collision_reward * collided,
        "progress": task.progress_gain * progress,
        "time": jnp.asarray(task.step_reward),
        "smoothness": -task.smoothness_gain * jnp.abs(omega_change),
    }


def goal_position(scene: Scene) -> jax.Array:
    """(2,) m: goal centre on the ground."""
    return scene.marker.position[:2]


def sample_world(task: Task, key: jax.Array) -> World:
    """World of one episode; the key is not used by fixed layouts."""
    if isinstance(task, ObstacleCourse):
        return _course(task, key)
    if isinstance(task, Corridor):
        return _corridor(task, key)
    raise TypeError(f"no world is defined for {type(task).__name__}; use one of {sorted(TASKS)}.")


BLUE = (0.04, 0.16, 0.90)
WALL = (0.78, 0.76, 0.72)
CARDBOARD = (0.62, 0.44, 0.26)
OBSTACLES = ((0.78, 0.20, 0.16), (0.88, 0.58, 0.14), (0.26, 0.55, 0.24), (0.66, 0.46, 0.28))


def _course(task: ObstacleCourse, key: jax.Array) -> World:
    """Gaps of the gates, their sizes, walls, goal and heading at the start; all lengths in m."""
    draw = _Draws(key if task.randomised else None)
    heading = draw(-0.20, 0.20, fixed=0.0)
    ahead = task.gate_x[0] * jnp.tan(heading)  # where driving straight on would cross the first gate
    side = draw.sign()
    gap_1 = side * draw(0.42, 0.66, fixed=0.50)
    gap_1 = jnp.where(jnp.abs(gap_1 - ahead) < 0.40, ahead - side * 0.40, gap_1)  # straight on must not lead through
    gap_2 = jnp.clip(gap_1 + side * draw(-0.70, 0.30, fixed=-0.65), -0.66, 0.66)
    wall = draw(1.60, 1.90, fixed=1.75)
    goal_y = jnp.clip(gap_2 + draw(-0.50, 0.50, fixed=-0.10), -0.60, 0.60)
    boxes = [*_walls(wall, task.goal_x + 2.5)]
    for gate, gap in enumerate([gap_1, gap_2][: task.gates]):
        x = task.gate_x[gate] + draw(-0.10, 0.10, fixed=0.0)
        gap_width = draw(0.96, 1.10, fixed=1.04)
        for part, direction in enumerate((1.0, -1.0)):
            inner = direction * gap + gap_width / 2  # signed distance of the box's near end from the centre line
            outer = wall - draw(0.0, 0.35, fixed=0.1)
            length, height = draw(0.25, 0.50, fixed=0.35), draw(0.35, 0.62, fixed=0.5)
            colour = jnp.array(OBSTACLES[2 * gate + part])
            boxes.append(box(x, direction * (inner + outer) / 2, length, outer - inner, height, colour))
    marker = _marker(task.goal_x, goal_y, size=0.6, height=1.05)
    start = jnp.stack([jnp.zeros(()), jnp.zeros(()), heading])
    return World(Scene(stack_boxes(boxes), marker, default_looks()), start)


def _corridor(task: Corridor, key: jax.Array) -> World:
    """Randomised as in the paper: start +-0.3 m and +-15 degrees, box +-1.0 m along and +-0.5 m across."""
    draw = _Draws(key if task.randomised else None)
    box_x, box_y = task.box_x + draw(-1.0, 1.0, fixed=0.0), draw(-0.5, 0.5, fixed=0.0)
    x, y = draw(-0.3, 0.3, fixed=0.0), draw(-0.3, 0.3, fixed=0.0)
    start = jnp.stack([x, y, jnp.deg2rad(draw(-15.0, 15.0, fixed=0.0))])
    cardboard = box(box_x, box_y, 0.40, 0.40, 0.45, jnp.array(CARDBOARD))
    boxes = stack_boxes([*_walls(jnp.asarray(task.width / 2), task.goal_x + 2.0), cardboard])
    return World(Scene(boxes, _marker(task.goal_x, jnp.zeros(()), size=0.5, height=0.55), default_looks()), start)


def _walls(half_width: jax.Array, end_x: float) -> tuple[Boxes, Boxes, Boxes]:
    """Left, right and far wall of a lane that begins 2 m behind the start."""
    thickness, height, begin_x = 0.2, 2.0, -2.0
    middle, length = (begin_x + end_x) / 2, end_x - begin_x
    aside = half_width + thickness / 2
    colour, dark = jnp.array(WALL), 0.85 * jnp.array(WALL)
    return (
        box(middle, aside, length, thickness, height, colour),
        box(middle, -aside, length, thickness, height, colour),
        box(end_x, 0.0, thickness, 2 * half_width + 2 * thickness, height, dark),
    )


def _marker(x: float, y: jax.Array, size: float, height: float) -> Marker:
    """Blue square of edge `size`, its centre `height` above the ground."""
    position = jnp.stack([jnp.asarray(value, float) for value in (x, y, height)])
    return Marker(position, jnp.array([0.02, size / 2, size / 2]), jnp.zeros(()), jnp.array(BLUE))


class _Draws:
    """Uniform numbers from one key, each from its own; without a key every draw gives its fixed value."""

    def __init__(self, key: jax.Array | None):
        self.key, self.count = key, 0

    def __call__(self, low: float, high: float, fixed: float) -> jax.Array:
        if self.key is None:
            return jnp.asarray(fixed, float)
        self.count += 1
        return jax.random.uniform(jax.random.fold_in(self.key, self.count), minval=low, maxval=high)

    def sign(self) -> jax.Array:
        """-1 or 1; 1 when fixed."""
        return jnp.where(self(0.0, 1.0, fixed=1.0) < 0.5, -1.0, 1.0)

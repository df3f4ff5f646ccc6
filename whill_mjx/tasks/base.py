"""What a task is: a frozen record that draws worlds, pays rewards, ends episodes and says what is observed.

A task of your own is a subclass with fields of its own; every method and every table below has a default. The library
asks the task and never its name. docs/tasks.md shows one.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.io.fields import BUDGET, TASK, Field, check_fields, shown
from whill_mjx.tasks import terms
from whill_mjx.tasks.parts import Draws, make_marker, room
from whill_mjx.tasks.terms import Moment
from whill_mjx.vehicle.specs import VehicleSpec
from whill_mjx.world.people.crowd import Crowd, People
from whill_mjx.world.people.places import in_sight
from whill_mjx.world.scene import Scene, default_looks

LAYOUTS = ("randomised", "fixed")
COMMON_SWEEPS = (
    "start_y=-0.4:0.4:5 start_yaw_deg=-20:20:5",
    "light=0.4:1.6:5 latency_s=0,0.1,0.2,0.3",
    "camera_pitch_deg=-6:6:5 camera_z=-0.1:0.1:5",
    "body.mass=0.75x,1x,1.25x,1.5x command_delay.delay=0,0.1,0.2,0.3",
)
"""What a standard evaluation varies in any task: start, light and latency, camera, vehicle."""


@struct.dataclass
class World:
    """Scene and start of one episode."""

    scene: Scene
    """Boxes, goal marker and looks."""
    start: jax.Array  # (3,) x [m], y [m], yaw [rad] of the driven-axle centre


@dataclass(frozen=True)
class Budget:
    """How long a preset trains a task, and with which settings of the learner."""

    steps: int
    """Environment steps, summed over instances."""
    eval_every: int | None = None
    """Environment steps between evaluations; None takes a twentieth of all."""
    eval_episodes: int | None = None
    """Episodes of an evaluation inside the run; None takes the preset's."""
    instances: int | None = None
    """Vehicles side by side; None takes the preset's."""
    exploring_starts: float = 0.0
    """Share of training episodes that begin anywhere on the way to the goal."""
    second_tries: float = 0.0
    """Share of the failed worlds that are begun again."""
    stop_success: float | None = None
    """End when two evaluations in a row reach this share of successes."""
    fields: Mapping[str, Any] = field(default_factory=dict)
    """Fields of the task that this preset changes."""
    learner: Mapping[str, Any] = field(default_factory=dict)
    """Settings of the world model that it changes (`dreamer.DreamerConfig`)."""
    ppo: Mapping[str, Any] = field(default_factory=dict)
    """Settings of the model-free baseline that it changes (`whill_mjx.learning.ppo.PpoConfig`)."""

    def __post_init__(self) -> None:
        check_fields("budget", BUDGET, self)
        for name in ("fields", "learner", "ppo"):
            if not isinstance(getattr(self, name), Mapping):
                raise ValueError(f"budget: {name} is {shown(getattr(self, name))}; it must be a dict of settings by "
                                 "name. Correct it.")


@dataclass(frozen=True)
class Task:
    """A goal in an open room, and what all tasks share. Hashable: a static argument of compiled functions."""

    name: ClassVar[str] = "open_room"
    """How results call it; a subclass that gives none is called by the name of its class."""
    budgets: ClassVar[Mapping[str, Budget]] = {}
    """Training budget by preset. A subclass starts without any: it never trains by the budget of another task."""
    sweeps: ClassVar[tuple[str, ...]] = COMMON_SWEEPS
    """What `evaluate --sweep standard` varies."""
    looks: ClassVar[str] = "plain"
    """How randomised worlds look (`whill_mjx.env.LOOKS`): "plain" as they are drawn, "paper" painted at random, "rich"
    furnished."""
    lane: ClassVar[bool] = False
    """Whether the first boxes are the left, right and far wall of a lane, as `rich` looks need."""
    walls: ClassVar[int] = 4
    """How many of the first boxes of a scene are walls; sweeps move those behind them."""
    ranges: ClassVar[tuple[Field, ...]] = ()
    """Range of each field of its own; of two numbers the lower one comes first."""
    rising: ClassVar[tuple[str, ...]] = ()
    """Two such fields of which the first is the lower one."""
    per_period: ClassVar[tuple[str, ...]] = ("time",)
    """Reward terms paid in every control period, whatever happens in it. The planner, whose steps are longer than one
    period, scales these."""

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
    """Reward of an arrival."""
    collision_reward: float = -50.0
    """Reward of a collision."""
    progress_gain: float = 30.0
    """Reward per metre that the distance to the goal has shrunk."""
    step_reward: float = -0.05
    """Reward of every control period."""
    smoothness_gain: float = 1.0
    """Reward lost per rad/s that the commanded yaw rate has changed."""
    layout: str = "randomised"
    """"randomised" draws a new world for each episode, "fixed" is always the same one."""
    people: int = 0
    """People who walk around."""
    people_within: float = 10.0
    """Greatest distance at which they begin, from the vehicle's start [m]."""
    yielding: float = 0.5
    """Share of them who make way for the vehicle."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "name" not in cls.__dict__:
            cls.name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", cls.__name__).lower()
        if "budgets" not in cls.__dict__:
            cls.budgets = {}

    def __post_init__(self) -> None:
        check_fields("task", (*TASK, *self.ranges), self)
        pairs = {one.name: getattr(self, one.name) for one in self.ranges if one.kind == "numbers" and one.count == 2}
        if self.rising:
            pairs[" and ".join(self.rising)] = tuple(getattr(self, name) for name in self.rising)
        for name, (low, high) in pairs.items():
            if low > high:
                raise ValueError(f"task: {name}: {low:g}, {high:g}; the lower number comes first. Correct one.")
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

    def draws(self, key: jax.Array) -> Draws:
        """Numbers to draw a world with; in a fixed layout each is its fixed value."""
        return Draws(key if self.randomised else None)

    def sample_world(self, key: jax.Array) -> World:
        """World of one episode; fixed layouts do not use the key."""
        draw = self.draws(key)
        distance, angle = draw(2.0, 4.0, fixed=3.0), draw(-0.8, 0.8, fixed=0.4)
        marker = make_marker(distance * jnp.cos(angle), distance * jnp.sin(angle), size=0.5, height=0.55)
        return World(Scene(room(5.0), marker, default_looks()), jnp.zeros(3))

    def checksum(self) -> str | None:
        """Checksum of the files that worlds are drawn from: with others, a training is another one. None: no files."""
        return None

    @property
    def crowd(self) -> Crowd:
        """What the people of an episode are like."""
        return Crowd(count=self.people, within=self.people_within, yielding=self.yielding)

    def populate(self, key: jax.Array, world: World) -> People:
        """The `people` of an episode: they walk to and fro between points in sight of each other."""
        return in_sight(key, world.scene, world.start, self.crowd)

    def for_vehicle(self, spec: VehicleSpec) -> Task:
        """The task as a vehicle of this size needs it; `make_env` takes it for its vehicle. By default as it is."""
        return self

    def goal(self, scene: Scene) -> jax.Array:
        """(2,) m: where to go; `Moment.goal_distance` is measured to it."""
        return goal_position(scene)

    def rewards(self, moment: Moment) -> dict[str, jax.Array]:
        """Terms () of the reward of one control period by name, without a unit; their sum is the reward.

        The defaults are the paper's. A collision outweighs an arrival.
        """
        change = moment.command[1] - moment.previous_command[1]
        return reward_terms(self, terms.progress(moment), change, moment.reached, moment.collided)

    def endings(self, moment: Moment) -> dict[str, jax.Array]:
        """Flags () bool by name: an episode ends, and is counted, by the first one that holds.

        "success" is what evaluations count as such. "timeout" and "diverged" are the library's own.
        """
        return {"collision": moment.collided, "success": moment.reached}

    def observations(self) -> Mapping[str, Any]:
        """Sensors by name (`whill_mjx.sensors`); none shows the camera image alone, as an array."""
        return {}


def reward_terms(
    task: Task, progress: jax.Array, omega_change: jax.Array, reached: jax.Array, collided: jax.Array
) -> dict[str, jax.Array]:
    """The paper's terms of the reward of one control period.

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
    """(2,) m: centre of the goal marker on the ground."""
    return scene.marker.position[:2]


def scale_action(task: Task, action: jax.Array) -> jax.Array:
    """Command (2,) of v [m/s] and omega [rad/s] for an action (2,), clipped to [-1, 1]; standstill where one is NaN or
    infinite."""
    stands = ~jnp.isfinite(action).all()
    action = jnp.clip(jnp.nan_to_num(action), -1.0, 1.0)
    v = task.v_min + (action[0] + 1.0) / 2.0 * (task.v_max - task.v_min)
    return jnp.where(stands, 0.0, jnp.stack([v, action[1] * task.omega_max]))

"""An environment of one instance, its state between two steps, and what a step gives."""

from __future__ import annotations

from dataclasses import dataclass

import jax
from flax import struct

from whill_mjx.io.fields import ENV, check_fields
from whill_mjx.sensors.base import Sensors
from whill_mjx.tasks.tasks import Task
from whill_mjx.vehicle.model import VehicleModel
from whill_mjx.vehicle.types import VehicleState
from whill_mjx.world.photometric import Photometry
from whill_mjx.world.scene import Scene

END_METRICS = ("success", "collision", "timeout", "diverged", "time_s", "episode_return")
"""Metrics that are 0 except on the last frame of an episode; the endings of a task come on top (`end_names`)."""
POSE_METRICS = ("x", "y", "yaw", "v", "omega", "goal_distance", "clearance")
"""Metrics of every frame."""
EVENT_METRICS = ("bumped",)
"""Counts of what happened since the previous step; 0 on the first frame of an episode and after its end."""
RESERVED = (*POSE_METRICS, *EVENT_METRICS, "timeout", "diverged", "time_s", "episode_return")
"""Names that a task's endings may not have."""
TRAIL = 5
"""Poses kept for late images and for the lag of the exposure control."""


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

"""Docking: come to rest at a pose, not only at a point."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from whill_mjx.io.fields import Field
from whill_mjx.sensors.base import Reading, Sensor, View
from whill_mjx.sensors.commands import Commands
from whill_mjx.sensors.goal import Goal
from whill_mjx.sensors.odometry import Odometry
from whill_mjx.tasks import terms
from whill_mjx.tasks.base import COMMON_SWEEPS, Task, World
from whill_mjx.tasks.parts import WALL, make_marker, room
from whill_mjx.tasks.terms import Moment
from whill_mjx.world.scene import Scene, box, default_looks, stack_boxes


@dataclass(frozen=True)
class DockHeading(Sensor):
    """(1,) angle from the vehicle's heading to that of the dock [rad]."""

    def reading(self, env: Any) -> Reading:
        return Reading((1,))

    def measure(self, memory: Any, view: View, key: jax.Array) -> tuple[Any, jax.Array]:
        return memory, terms.heading_error(view.moment, view.moment.scene.marker.yaw)[None]

    def mirrored(self, value: jax.Array) -> jax.Array:  # type: ignore[override]
        return -value


@dataclass(frozen=True)
class Docking(Task):
    """Stand still within 0.12 m of the dock and within 8 degrees of its direction, between its two cheeks."""

    name: ClassVar[str] = "docking"
    ranges: ClassVar[tuple[Field, ...]] = (
        Field("heading_tolerance", "rad", 0.0, 3.2), Field("rest_speed", "m/s", 0.0, 20.0),
        Field("alignment_gain", "1/rad", -1e9, 1e9),
    )  # fmt: skip
    per_period: ClassVar[tuple[str, ...]] = ("time", "alignment")
    sweeps: ClassVar[tuple[str, ...]] = COMMON_SWEEPS[:1] + COMMON_SWEEPS[3:]

    v_min: float = -0.3
    v_max: float = 0.5
    omega_max: float = 0.8
    max_steps: int = 300
    goal_radius: float = 0.12
    smoothness_gain: float = 0.1
    heading_tolerance: float = 0.14
    """Largest deviation from the direction of the dock [rad]."""
    rest_speed: float = 0.05
    """Largest speed of a corner of the vehicle that counts as standing [m/s]."""
    alignment_gain: float = 0.5
    """Reward lost in each period per rad of deviation from the dock's direction, within 1 m of it."""

    def sample_world(self, key: jax.Array) -> World:
        """Place and direction of the dock."""
        draw = self.draws(key)
        dock_x, dock_y, yaw = draw(2.2, 3.0, fixed=2.6), draw(-0.8, 0.8, fixed=0.3), draw(-0.5, 0.5, fixed=0.2)
        c, s = jnp.cos(yaw), jnp.sin(yaw)
        boxes = [room(5.0)]
        for side in (1.0, -1.0):  # the cheeks, beside the standing vehicle
            ahead, aside = 0.4, side * 0.55
            x, y = dock_x + ahead * c - aside * s, dock_y + ahead * s + aside * c
            boxes.append(box(x, y, 0.8, 0.1, 0.5, 0.8 * jnp.array(WALL), yaw))
        marker = make_marker(dock_x, dock_y, size=0.4, height=0.9, yaw=yaw)
        return World(Scene(stack_boxes(boxes), marker, default_looks()), jnp.zeros(3))

    def docked(self, moment: Moment) -> jax.Array:
        """() bool: at the dock, along it, and no corner of the vehicle moves faster than `rest_speed`."""
        straight = jnp.abs(terms.heading_error(moment, moment.scene.marker.yaw)) < self.heading_tolerance
        return moment.reached & straight & (terms.fastest_corner(moment) < self.rest_speed)

    def rewards(self, moment: Moment) -> dict[str, jax.Array]:
        turned = jnp.abs(terms.heading_error(moment, moment.scene.marker.yaw))
        near = moment.goal_distance < 1.0
        return {
            **super().rewards(moment),
            "goal": self.goal_reward * self.docked(moment),
            "alignment": -self.alignment_gain * turned * near,
        }

    def endings(self, moment: Moment) -> dict[str, jax.Array]:
        return {"collision": moment.collided, "success": self.docked(moment)}

    def observations(self) -> Mapping[str, Any]:
        return {"goal": Goal(), "dock_heading": DockHeading(), "odometry": Odometry(), "commands": Commands(1)}

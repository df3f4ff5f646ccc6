"""Point goals in real maps among people, half of whom make no way: the paper's future work."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import jax

from whill_mjx.io.fields import Field
from whill_mjx.sensors.camera import Camera
from whill_mjx.sensors.commands import Commands
from whill_mjx.sensors.goal import Goal
from whill_mjx.sensors.lidar import Lidar
from whill_mjx.sensors.odometry import Odometry
from whill_mjx.tasks import terms
from whill_mjx.tasks.base import Budget
from whill_mjx.tasks.map_goal import MapGoal
from whill_mjx.tasks.terms import Moment

SENSES = ("camera", "lidar", "both")
CHEST = 1.1
"""Height of the scanner [m]: of people it sees the trunk, which is wider than legs and does not swing."""


@dataclass(frozen=True)
class AmongPeople(MapGoal):
    """Drive to a point in a map among eight people, half of whom ignore the vehicle.

    The vehicle knows where the goal is, its speeds and its last command; it sees, scans, or both.
    """

    name: ClassVar[str] = "among_people"
    per_period: ClassVar[tuple[str, ...]] = ("time", "haste")
    ranges: ClassVar[tuple[Field, ...]] = (
        *MapGoal.ranges, Field("haste_gain", "-", 0.0, 1e9), Field("haste_time", "s", 0.01, 100.0),
    )  # fmt: skip
    budgets: ClassVar[dict[str, Budget]] = {
        "wallclock": Budget(
            120_000_000, eval_every=6_000_000, second_tries=0.5, stop_success=0.97,
            ppo=dict(readings=4, scan=90, discount=0.999, lr=5e-4),
        ),
        "cpu": Budget(1_000_000, eval_every=250_000, instances=32, fields={"action_repeat": 2, "senses": "lidar"},
                      ppo=dict(rollout=64, minibatches=8, readings=3, scan=90)),
    }  # fmt: skip

    map: str = "made:0,made:1"
    """As of `map_goal`; floor plans of ours unless you give others."""
    people: int = 8
    collision_reward: float = -600.0
    """Far more than an arrival earns, so that waiting for a person pays."""
    haste_gain: float = 10.0
    """Reward lost in every control period per m/s of haste towards a person (`tasks.terms.haste`)."""
    haste_time: float = 1.0
    """Time in which the vehicle may touch nobody at its present speed [s]; it needs about that to stop."""
    senses: str = "both"
    """"camera", "lidar" or "both"."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.senses not in SENSES:
            raise ValueError(f"senses is {self.senses!r}; use one of {SENSES}.")

    def rewards(self, moment: Moment) -> dict[str, jax.Array]:
        haste = terms.haste(moment, self.haste_time)
        return {**super().rewards(moment), "haste": -self.haste_gain * haste}

    def observations(self) -> Mapping[str, Any]:
        seen: dict[str, Any] = {"goal": Goal(), "odometry": Odometry(), "commands": Commands(1)}
        if self.senses != "lidar":
            seen["camera"] = Camera()
        if self.senses != "camera":
            seen["lidar"] = Lidar(rays=180, reach=8.0, z=CHEST, noise=0.01, dropouts=0.01)
        return seen

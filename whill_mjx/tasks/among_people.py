"""Point goals in real maps among people, half of whom make no way: the paper's future work."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from whill_mjx.sensors.camera import Camera
from whill_mjx.sensors.commands import Commands
from whill_mjx.sensors.goal import Goal
from whill_mjx.sensors.lidar import Lidar
from whill_mjx.tasks.base import Budget
from whill_mjx.tasks.map_goal import MapGoal

SENSES = ("camera", "lidar", "both")


@dataclass(frozen=True)
class AmongPeople(MapGoal):
    """Drive to a point in a map among eight people, half of whom ignore the vehicle.

    The vehicle knows where the goal is and its last command; it sees, scans, or both.
    """

    name: ClassVar[str] = "among_people"
    budgets: ClassVar[dict[str, Budget]] = {
        "wallclock": Budget(
            40_000_000, eval_every=2_000_000, second_tries=0.5, stop_success=0.97, fields={"action_repeat": 2},
            ppo=dict(readings=3, scan=90, discount=0.995, lr=5e-4),
        ),
        "cpu": Budget(1_000_000, eval_every=250_000, instances=32, fields={"action_repeat": 2, "senses": "lidar"},
                      ppo=dict(rollout=64, minibatches=8, readings=3, scan=90)),
    }  # fmt: skip

    map: str = "made:0,made:1"
    """As of `map_goal`; floor plans of ours unless you give others."""
    people: int = 8
    collision_reward: float = -200.0
    senses: str = "both"
    """"camera", "lidar" or "both"."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.senses not in SENSES:
            raise ValueError(f"senses is {self.senses!r}; use one of {SENSES}.")

    def observations(self) -> Mapping[str, Any]:
        seen: dict[str, Any] = {"goal": Goal(), "commands": Commands(1)}
        if self.senses != "lidar":
            seen["camera"] = Camera()
        if self.senses != "camera":
            seen["lidar"] = Lidar(rays=180, reach=8.0, z=0.3, noise=0.01, dropouts=0.01)
        return seen

"""The contact plant in a policy's world: `bridge.simulate POLICY --simulator benchmarks.loop_world:contact_vehicle`.

Scene and camera are those of the policy's task. What moves in it is the contact plant, which shares no code with the
vehicle that the policy was trained on.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.plant.base import TICK
from benchmarks.plant.draw import draw_effect
from benchmarks.plant.make import Experiment, plan
from benchmarks.plant.online import OnlinePlant
from bridge.simulation.moved_simulator import MovedSimulator


class PlantMover:
    """A contact plant of one day; each episode is a trial of its own."""

    def __init__(self, seed: int, draw: int | None) -> None:
        setting, _ = plan(Experiment({} if draw is None else draw_effect(draw), seed, 1.0, True))
        self._plant = OnlinePlant(setting)
        self._episode = -1
        self.odometry = np.zeros(5)
        """(5,) x, y, yaw, v, omega as last reported."""

    def place(self, x: float, y: float, yaw: float) -> None:
        """Stand at the start of the next trial."""
        self._episode += 1
        self._plant.place(self._episode, (x, y, yaw))
        self.odometry = np.zeros(5)

    def advance(self, v: float, omega: float, seconds: float) -> None:
        """Drive with a command."""
        self._plant.command(self._plant.t, v, omega)
        self._plant.advance(round(seconds / TICK))
        rows, _ = self._plant.reports()
        if len(rows):
            self.odometry = rows[-1, 1:]

    @property
    def motion(self) -> np.ndarray:
        """(5,) true x, y, yaw, v, omega."""
        return np.array(self._plant.state)


def contact_vehicle(task: str = "corridor", vehicle: str | Path | None = None, size: tuple[int, int] = (64, 64),
                    plant_seed: int = 0, draw: int | None = None, **changes: Any) -> MovedSimulator:
    """One contact plant that drives episodes of a task.

    Args:
        task, vehicle, size, changes: as of `bridge.simulation.chair_simulator.ChairSimulator`.
        plant_seed: of the day.
        draw: number that draws the effect in the plant; None: no effect.
    """
    return MovedSimulator(PlantMover(plant_seed, draw), task, vehicle, size, **changes)

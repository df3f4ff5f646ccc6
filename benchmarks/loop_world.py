"""The contact plant in a policy's world: `bridge.simulate POLICY --simulator benchmarks.loop_world:ContactVehicle`.

Scene and camera are those of the policy's task. What moves in it is the contact plant, which shares no code with the
vehicle that the policy was trained on.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.plant.base import TICK
from benchmarks.plant.draw import draw_effect
from benchmarks.plant.make import plan
from benchmarks.plant.online import OnlinePlant
from bridge.simulate import ChairSimulator
from bridge.simulated import Frame


class ContactVehicle(ChairSimulator):
    """One contact plant that drives episodes of a task."""

    def __init__(self, task: str = "corridor", vehicle: str | Path | None = None, size: tuple[int, int] = (64, 64),
                 plant_seed: int = 0, draw: int | None = None, **changes: Any) -> None:
        """Prepare the world of a task and the plant of a day; the vehicle gives the camera alone.

        Args:
            task, vehicle, size, changes: as of `ChairSimulator`.
            plant_seed: of the day.
            draw: number that draws the effect in the plant; None: no effect.
        """
        super().__init__(task, vehicle, size, **changes)
        setting, _ = plan({} if draw is None else draw_effect(draw), plant_seed, 1.0, True)
        self._plant = OnlinePlant(setting)
        self._odometry = np.zeros(5)
        self._look = self._make_look()

    def _make_look(self) -> Any:
        """Return the function that puts the vehicle into the scene and says what the camera and the task see."""
        import jax
        import jax.numpy as jnp

        from whill_mjx.env import endings_of, moment_of, observe
        from whill_mjx.vehicle.dynamics import place

        env, params = self.env, self.params

        def look(state: Any, pose: Any, command: Any) -> Any:
            vehicle = place(env.model, params, pose[0], pose[1], pose[2], pose[3], pose[4])
            count = state.step_count + 1
            moment = moment_of(env, state, vehicle, command, count)
            ends = endings_of(env.task, moment)
            after = dataclasses.replace(state, vehicle=vehicle, command=jnp.asarray(command), step_count=count,
                                        goal_distance=moment.goal_distance)
            late = count >= env.task.max_steps
            over = jnp.stack([*ends.values()]).any()
            return after, observe(env, after), ends["collision"], ends["success"], over, late

        return jax.jit(look)

    def reset(self, seed: int) -> Frame:
        """Begin the episode of a seed."""
        frame = super().reset(seed)
        self._plant.place(seed, (frame.x, frame.y, frame.yaw))
        self._odometry = np.zeros(5)
        return dataclasses.replace(frame, odometry=(0.0,) * 5)

    def step(self, v: float, omega: float) -> Frame:
        """Advance one control period."""
        low, high = self._low, self._low + self._span
        command = np.clip([v, omega], low, high)
        self._plant.command(self._plant.t, float(command[0]), float(command[1]))
        self._plant.advance(round(self.period / TICK))
        rows, _ = self._plant.reports()
        if len(rows):
            self._odometry = rows[-1, 1:]
        pose = np.array(self._plant.state, np.float32)
        self._state, image, collided, reached, ended, late = self._look(self._state, pose, command.astype(np.float32))
        x, y, yaw, speed, turn = (float(one) for one in pose)
        reported = [float(one) for one in self._odometry]
        return Frame(np.asarray(image), x, y, yaw, speed, turn, collided=bool(collided), reached_goal=bool(reached),
                     done=bool(ended | late), terminated=bool(ended), ranges=np.asarray(self._scan(self._state)),
                     odometry=(reported[0], reported[1], reported[2], reported[3], reported[4]))

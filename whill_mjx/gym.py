"""Gymnasium adapter for host-side users: one instance, compiled once per kind of environment and then reused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import jax
import numpy as np

from whill_mjx.env import make_env, reset, step
from whill_mjx.tasks.tasks import Task

INFO = ("x", "y", "yaw", "v", "omega", "goal_distance", "clearance")
ENDINGS = ("success", "collision", "diverged")


class WhillEnv(gymnasium.Env):
    """A task as a `gymnasium.Env`: images (64, 64, 3) uint8 in, actions (2,) in [-1, 1] out.

    `info` holds x, y [m], yaw [rad] of the driven-axle centre, v [m/s], omega [rad/s], goal_distance, clearance [m] and
    the flags success, collision and diverged.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(
        self,
        task: str | Task = "obstacle_course",
        vehicle: str | Path | None = None,
        layout: str | None = "randomised",
        render_mode: str | None = None,
    ):
        """Build the environment; nothing is compiled before the first `reset`.

        Args:
            task: name of a task, or a task with its fields set.
            vehicle: path of a vehicle file or name of a preset; None takes the WHILL Model CR.
            layout: "randomised" or "fixed"; None keeps the task's own.
            render_mode: "rgb_array" or None.

        Raises:
            ValueError: unknown task, vehicle, layout or render mode.
        """
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(f"render_mode is {render_mode!r}; use one of {self.metadata['render_modes']} or None.")
        self.render_mode = render_mode
        env, params = make_env(task, vehicle, layout)
        self.env, self.params = env, params
        self.observation_space = gymnasium.spaces.Box(0, 255, (env.height, env.width, 3), np.uint8)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self._reset = jax.jit(lambda params, key: reset(env, params, key))
        self._step = jax.jit(lambda params, state, action: step(env, params, state, action))
        self._state: Any = None
        self._image: np.ndarray | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode; the same seed gives the same world."""
        super().reset(seed=seed)
        key = jax.random.key(int(self.np_random.integers(2**31)))
        self._state, time_step = self._reset(self.params, key)
        self._image = np.asarray(time_step.obs)
        return self._image, _info(time_step.metrics)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One environment step; RuntimeError before the first `reset`."""
        if self._state is None:
            raise RuntimeError("step was called before reset; call reset() first.")
        action = np.asarray(action, np.float32)
        if action.shape != (2,):
            raise ValueError(f"the action has shape {action.shape}; it must be (2,): speed and yaw rate in [-1, 1].")
        self._state, time_step = self._step(self.params, self._state, action)
        self._image = np.asarray(time_step.obs)
        info = _info(time_step.metrics)
        return self._image, float(time_step.reward), bool(time_step.terminated), bool(time_step.truncated), info

    def render(self) -> np.ndarray | None:
        """The camera image (H, W, 3) uint8 in mode "rgb_array", otherwise None."""
        return self._image if self.render_mode == "rgb_array" else None


def _info(metrics: dict[str, jax.Array]) -> dict[str, Any]:
    return {name: float(metrics[name]) for name in INFO} | {name: bool(metrics[name]) for name in ENDINGS}

"""Gymnasium for one vehicle: `WhillEnv`, and an id for every known task, such as WhillCorridor-v0.

Importing this module registers the ids; `gymnasium.make("whill_mjx.gym:WhillCorridor-v0")` imports it by itself.
Many vehicles in one program are `whill_mjx.gym.vector.WhillVectorEnv`, which `gymnasium.make_vec` makes.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import jax
import numpy as np

from whill_mjx.gym.kinds import Carried, Kind, as_actions, check_process, condition_of, find_kind, info_names
from whill_mjx.sensors.base import Sensor
from whill_mjx.tasks.tasks import TASKS, Task, in_camel
from whill_mjx.vehicle.specs import VehicleSpec
from whill_mjx.vehicle.types import VehicleParams


class WhillEnv(Carried, gymnasium.Env):
    """A task as a `gymnasium.Env`: actions (2,) in [-1, 1] in, an image (64, 64, 3) uint8 or a dict of sensors out.

    `info` holds x, y [m], yaw [rad] of the driven-axle centre, v [m/s], omega [rad/s], goal_distance, clearance [m],
    the flags success, collision, diverged, and those of the task's other endings. Among people, the number `bumped`
    counts who walked into the vehicle since the last step. It can be pickled and copied.
    """

    metadata = {"render_modes": ["rgb_array", "human"], "render_fps": 10}

    def __init__(
        self,
        task: str | Task = "obstacle_course",
        vehicle: str | Path | VehicleSpec | tuple[VehicleSpec, VehicleParams] | None = None,
        layout: str | None = "randomised",
        render_mode: str | None = None,
        *,
        observations: Mapping[str, Sensor] | Sequence[str] | None = None,
        height: int = 64,
        width: int = 64,
        looks: str | None = None,
        spread: float = 0.0,
        device: str | None = "cpu",
    ):
        """Build the environment; nothing is compiled before the first `reset` of its kind.

        Args:
            task: a task with its fields set, the name of a known one, package.module:TASK or path/to/file.py:TASK.
            vehicle: path of a vehicle file, name of a preset, a spec, or a spec and its parameters; None takes the
                WHILL Model CR.
            layout: "randomised" or "fixed"; None keeps the task's own.
            render_mode: "rgb_array" gives the camera image, "human" shows it in a window; None neither.
            observations: sensors by name, or names of the package's sensors; None takes the task's.
            height, width: size of the camera image [pixels].
            looks: "plain", "paper" or "rich", as in `make_env`; None takes the task's.
            spread: relative spread of the vehicle's parameters, drawn anew for each episode.
            device: where JAX computes it, such as "gpu"; None takes JAX's own choice. One vehicle is ready earlier and
                steps faster on a processor.

        Raises:
            ValueError: unknown task, vehicle, layout, sensor, device or render mode; "human" without a display.
        """
        self.render_mode = check_render_mode(render_mode, self.metadata["render_modes"])
        self._arguments = {
            "task": task, "vehicle": vehicle, "layout": layout, "observations": observations, "height": height,
            "width": width, "looks": looks, "spread": spread, "device": device,
        }  # fmt: skip
        self._state: Any = None
        self._image: np.ndarray | None = None
        self._take(find_kind(self._arguments))

    def _take(self, kind: Kind) -> None:
        self._kind = kind
        self.env, self.params = kind.batch.env, kind.batch.params
        self.observation_space, self.action_space = kind.observation_space, kind.action_space
        self.metadata = {**self.metadata, "render_fps": kind.steps_per_second}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode; the same seed gives the same world.

        Args:
            seed: of this and all later episodes.
            options: changes of this episode, such as {"start_y": 0.2, "light": 0.5} (`whill_mjx.gym.kinds.OPTIONS`).

        Raises:
            ValueError: an unknown option.
        """
        check_process()
        condition = condition_of(options)
        super().reset(seed=seed)
        number = np.uint32(self.np_random.integers(2**31))
        self._state, time_step = self._kind.reset(number, condition)
        return self._shown(time_step), _info(time_step.metrics)

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """One environment step.

        Args:
            action: (2,) normalised speed and yaw rate, each in [-1, 1].

        Raises:
            RuntimeError: before the first `reset`.
            ValueError: an action of another shape or type.
        """
        if self._state is None:
            raise RuntimeError("step was called before reset; call reset() first.")
        action = as_actions(action, (2,))
        check_process()
        self._state, time_step = self._kind.step(self._state, action)
        ends = bool(time_step.terminated), bool(time_step.truncated)
        return self._shown(time_step), float(time_step.reward), *ends, _info(time_step.metrics)

    def render(self) -> np.ndarray | None:
        """The camera image (H, W, 3) uint8 in mode "rgb_array", otherwise None."""
        if self.render_mode != "rgb_array" or self._state is None:
            return None
        return self._picture()

    def close(self) -> None:
        """Close the window, if there is one."""
        if self.render_mode == "human":
            close_window()

    def _shown(self, time_step: Any) -> Any:
        obs = jax.tree.map(np.array, time_step.obs)  # copies: JAX's own cannot be changed in place
        self._image = None if isinstance(obs, dict) else obs.copy()
        if self.render_mode == "human":
            show_window(self._picture())
        return obs

    def _picture(self) -> np.ndarray:
        if self._image is None:
            self._image = np.asarray(self._kind.picture(self._state))
        return self._image


def _info(metrics: dict[str, jax.Array]) -> dict[str, Any]:
    numbers, flags = info_names(metrics)
    return {name: float(metrics[name]) for name in numbers} | {name: bool(metrics[name]) for name in flags}


def check_render_mode(mode: str | None, known: Sequence[str]) -> str | None:
    """The mode, if it is known and can be served; ValueError says why not."""
    if mode is not None and mode not in known:
        raise ValueError(f"render_mode is {mode!r}; use one of {list(known)} or None.")
    if mode == "human":
        if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
            raise ValueError("render_mode 'human' opens a window, but there is no display (DISPLAY is not set). Use "
                             "'rgb_array', or start the program on a desktop.")
        import cv2

        if "GUI:                           NONE" in cv2.getBuildInformation():
            raise ValueError("render_mode 'human' opens a window, but this OpenCV has none (opencv-python-headless). "
                             "Use 'rgb_array', or install opencv-python instead.")
    return mode


def show_window(image: np.ndarray) -> None:
    """Show an image (H, W, 3) uint8, enlarged to about 512 pixels."""
    import cv2

    scale = max(1, 512 // image.shape[0])
    cv2.imshow("whill_mjx", image.repeat(scale, 0).repeat(scale, 1)[..., ::-1])
    cv2.waitKey(1)


def close_window() -> None:
    """Close the window of `show_window`."""
    import cv2

    cv2.destroyAllWindows()


def env_id(task: Task) -> str:
    """Gymnasium's id of a task: WhillObstacleCourse-v0 of obstacle_course."""
    return f"Whill{in_camel(task.name)}-v0"


def register_id(task: Task) -> str:
    """Register the id of a task, and return it."""
    identity = env_id(task)
    gymnasium.register(
        identity, entry_point="whill_mjx.gym:WhillEnv", vector_entry_point="whill_mjx.gym.vector:WhillVectorEnv",
        kwargs={"task": task.name},
    )  # fmt: skip
    return identity


for _task in TASKS.values():
    if env_id(_task) not in gymnasium.registry:
        register_id(_task)

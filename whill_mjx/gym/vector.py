"""Gymnasium for many vehicles: N instances in one compiled program."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import jax
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from whill_mjx.gym import check_render_mode
from whill_mjx.gym.kinds import Carried, Kind, as_actions, check_process, condition_of, find_kind, info_names
from whill_mjx.io.fields import BATCH, check, shown
from whill_mjx.sensors.base import Sensor
from whill_mjx.tasks.tasks import Task
from whill_mjx.vehicle.specs import VehicleSpec
from whill_mjx.vehicle.types import VehicleParams


class WhillVectorEnv(Carried, gymnasium.vector.VectorEnv):
    """N instances of a task as a `gymnasium.vector.VectorEnv`, with all three modes of beginning anew.

    Instance i of `reset(seed=s)` begins in the world of `WhillEnv` after `reset(seed=s + i)`. Later episodes get keys
    of their own, inside the program.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(
        self,
        num_envs: int = 1,
        task: str | Task = "obstacle_course",
        vehicle: str | Path | VehicleSpec | tuple[VehicleSpec, VehicleParams] | None = None,
        layout: str | None = "randomised",
        render_mode: str | None = None,
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        observations: Mapping[str, Sensor] | Sequence[str] | None = None,
        height: int = 64,
        width: int = 64,
        looks: str | None = None,
        spread: float = 0.0,
    ):
        """Build the environment; nothing is compiled before the first `reset`.

        Args:
            num_envs: N.
            autoreset_mode: NEXT_STEP (the fastest: an instance that has ended ignores its next action and begins anew),
                SAME_STEP (it begins anew at once; the last frame is info["final_obs"]), or DISABLED
                (`reset(options={"reset_mask": mask})` does).
            task, vehicle, layout, render_mode, observations, height, width, looks, spread: as of `WhillEnv`.

        Raises:
            ValueError: of `WhillEnv`; a number of instances below 1; an unknown mode.
        """
        self.num_envs = check("WhillVectorEnv", BATCH[0], num_envs, "num_envs")
        modes = [one.value for one in AutoresetMode]
        if autoreset_mode not in (*AutoresetMode, *modes):
            raise ValueError(f"autoreset_mode is {shown(autoreset_mode)}; use one of {modes}.")
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}
        self.render_mode = check_render_mode(render_mode, self.metadata["render_modes"])
        self._arguments = {
            "task": task, "vehicle": vehicle, "layout": layout, "observations": observations, "height": height,
            "width": width, "looks": looks, "spread": spread,
        }  # fmt: skip
        self._take(find_kind(self._arguments))
        self._randoms: list[np.random.Generator] | None = None
        self._state: Any = None
        self._step: Any = None  # the last time step
        self._ended = np.zeros(self.num_envs, bool)

    def _take(self, kind: Kind) -> None:
        self._kind = kind
        self.single_observation_space, self.single_action_space = kind.observation_space, kind.action_space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.metadata = {**self.metadata, "render_fps": kind.steps_per_second}

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode in every instance, or in those of options["reset_mask"].

        Args:
            seed: of instance 0, those after it get the next numbers; or one for each. Instances that go on keep theirs.
            options: as of `WhillEnv`; and "reset_mask" (N,) bool.

        Raises:
            ValueError: an unknown option, a mask of another shape, or as many seeds as there are not instances.
        """
        check_process()
        options = dict(options) if isinstance(options, Mapping) else options
        mask = options.pop("reset_mask", None) if isinstance(options, dict) else None
        mask = None if mask is None else np.asarray(mask)
        condition = condition_of(options)
        numbers = self._numbers(seed, mask)
        if mask is None:
            self._state, self._step = self._kind.reset_all(numbers, condition)
            self._ended[:] = False
            return self._observed(self._step)
        if self._state is None:
            raise RuntimeError("reset with a reset_mask was called before reset; call reset() first.")
        if condition is not None:
            raise ValueError("reset_mask goes with no other option. Give either alone.")
        self._state, self._step = self._kind.restart(self._state, self._step, mask, numbers)
        self._ended[mask] = False
        return self._observed(self._step, mask)

    def step(self, actions: np.ndarray) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One environment step of every instance; actions (N, 2) in [-1, 1].

        Raises:
            RuntimeError: before the first `reset`, or after the end of an instance in mode DISABLED.
        """
        if self._state is None:
            raise RuntimeError("step was called before reset; call reset() first.")
        actions = as_actions(actions, (self.num_envs, 2))
        check_process()
        if self.autoreset_mode == AutoresetMode.DISABLED and self._ended.any():
            raise RuntimeError(f"instances {np.flatnonzero(self._ended).tolist()} have ended; begin them anew with "
                               "reset(options={'reset_mask': mask}).")
        advance = self._kind.step_or_reset if self.autoreset_mode == AutoresetMode.NEXT_STEP else self._kind.step_all
        self._state, self._step = advance(self._state, actions)
        reward = np.asarray(self._step.reward, np.float64)
        terminated, truncated = np.array(self._step.terminated), np.array(self._step.truncated)
        ended = terminated | truncated
        self._ended = ended.copy()
        obs, now = self._observed(self._step)
        if self.autoreset_mode != AutoresetMode.SAME_STEP or not ended.any():
            return obs, reward, terminated, truncated, now
        info: dict[str, Any] = {}
        for index in np.flatnonzero(ended):
            last = jax.tree.map(lambda leaf, index=index: leaf[index], obs)
            named = {name: value[index].item() for name, value in now.items() if not name.startswith("_")}
            info = self._add_info(info, {"final_obs": last, "final_info": named}, int(index))
        self._state, self._step = self._kind.restart(self._state, self._step, ended, self._numbers(None, ended))
        obs, now = self._observed(self._step)
        return obs, reward, terminated, truncated, {**now, **info}

    def render(self) -> tuple[np.ndarray, ...] | None:
        """The camera images (H, W, 3) uint8 of all instances in mode "rgb_array", otherwise None."""
        if self.render_mode != "rgb_array" or self._state is None:
            return None
        if not isinstance(self._step.obs, dict):
            return tuple(np.asarray(self._step.obs))
        return tuple(np.asarray(jax.vmap(self._kind.picture)(self._state)))

    def _numbers(self, seed: Any, mask: np.ndarray | None) -> np.ndarray:
        """(N,) uint32 numbers of new episodes, which their random keys are made of."""
        count = self.num_envs
        if mask is not None:
            if mask.shape != (count,) or mask.dtype != np.bool_ or not mask.any():
                raise ValueError(f"reset_mask has shape {mask.shape} and type {mask.dtype}; it must be ({count},) bool "
                                 "with at least one True.")
        if seed is None or isinstance(seed, int | np.integer):
            seeds = [None if seed is None else int(seed) + index for index in range(count)]
        else:
            seeds = list(seed) if isinstance(seed, Sequence | np.ndarray) else [seed]
            if len(seeds) != count or not all(one is None or isinstance(one, int | np.integer) for one in seeds):
                raise ValueError(f"seed is {shown(seed)}; it must be a whole number, or a list of {count}, one for "
                                 "each instance.")
        if self._randoms is None:
            self._randoms = [gymnasium.utils.seeding.np_random(None)[0] for _ in range(count)]
        numbers = np.zeros(count, np.uint32)
        for index in range(count) if mask is None else np.flatnonzero(mask):
            one = seeds[index]
            if one is not None:
                self._randoms[index] = gymnasium.utils.seeding.np_random(int(one))[0]
            numbers[index] = self._randoms[index].integers(2**31)
        return numbers

    def _observed(self, step: Any, mask: np.ndarray | None = None) -> tuple[Any, dict[str, Any]]:
        """Observations and info as arrays of the host."""
        obs = jax.tree.map(np.array, step.obs)
        numbers, flags = info_names(step.metrics)
        there = np.ones(self.num_envs, bool) if mask is None else np.asarray(mask)
        info: dict[str, Any] = {name: np.array(step.metrics[name]) for name in numbers}
        info |= {name: np.asarray(step.metrics[name]) > 0.5 for name in flags}
        return obs, {**info, **{f"_{name}": there.copy() for name in info}}

"""`WhillVectorEnv` as Stable-Baselines3 takes it; the package is not installed with this one."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
from gymnasium.vector import AutoresetMode

from whill_mjx.gym.vector import WhillVectorEnv


def as_sb3(env: WhillVectorEnv) -> Any:
    """A `stable_baselines3.common.vec_env.VecEnv` of all instances; dict observations need "MultiInputPolicy".

    Raises:
        ValueError: an environment whose instances do not begin anew within the step that ends them.
        ImportError: Stable-Baselines3 is not installed.
    """
    from stable_baselines3.common.vec_env import VecEnv

    if env.autoreset_mode != AutoresetMode.SAME_STEP:
        raise ValueError(f"autoreset_mode is {env.autoreset_mode.value}; Stable-Baselines3 needs SAME_STEP. Make the "
                         "environment with autoreset_mode=AutoresetMode.SAME_STEP.")

    class Adapter(VecEnv):
        """The instances of `env`."""

        def __init__(self) -> None:
            super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
            self.actions = np.zeros((env.num_envs, 2), np.float32)

        def reset(self) -> Any:
            obs, _ = env.reset(seed=self._seeds if self._seeds[0] is not None else None)
            self._reset_seeds()
            return obs

        def step_async(self, actions: np.ndarray) -> None:
            self.actions = actions

        def step_wait(self) -> Any:
            obs, reward, terminated, truncated, info = env.step(self.actions)
            infos: list[dict[str, Any]] = [{} for _ in range(env.num_envs)]
            for index in np.flatnonzero(terminated | truncated):
                last, named = info["final_obs"][index], jax.tree.map(lambda leaf, i=index: leaf[i], info["final_info"])
                infos[index] = {**named, "terminal_observation": last,
                                "TimeLimit.truncated": bool(truncated[index] & ~terminated[index])}  # fmt: skip
            return obs, reward.astype(np.float32), terminated | truncated, infos

        def close(self) -> None:
            env.close()

        def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
            return [getattr(env, attr_name) for _ in self._get_indices(indices)]

        def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
            raise ValueError(f"{attr_name}: all instances are one environment. Make another one with this value.")

        def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
            raise ValueError(f"{method_name}: instances have no methods of their own. Call that of WhillVectorEnv.")

        def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
            return [False for _ in self._get_indices(indices)]

    return Adapter()

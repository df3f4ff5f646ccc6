"""The Gymnasium adapter."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from whill_mjx.gym import WhillEnv


@pytest.fixture(scope="module")
def env():
    return WhillEnv(task="obstacle_course", render_mode="rgb_array")


def test_gymnasiums_own_checker_is_satisfied(env):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*spec.*")  # not made by gymnasium.make
        check_env(env, skip_render_check=True)


def test_seeds_decide_the_world_and_info_tells_the_pose(env):
    one, info = env.reset(seed=3)
    other, _ = env.reset(seed=3)
    third, _ = env.reset(seed=4)
    np.testing.assert_array_equal(one, other)
    assert (one != third).any()
    assert {"x", "y", "yaw", "v", "omega", "collision", "success"} <= set(info)
    assert info["x"] == pytest.approx(0.0, abs=1e-4) and info["collision"] is False
    obs, reward, terminated, truncated, info = env.step(np.array([1.0, 0.0]))
    assert info["v"] > 0.05 and isinstance(reward, float) and terminated is False and truncated is False
    np.testing.assert_array_equal(env.render(), obs)


def test_misuse_is_explained():
    fresh = WhillEnv()
    assert fresh.render() is None
    with pytest.raises(RuntimeError, match="reset"):
        fresh.step(np.zeros(2))
    with pytest.raises(ValueError, match="rgb_array"):
        WhillEnv(render_mode="human")


def test_actions_of_a_wrong_shape_are_refused(env):
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"\(3,\)"):
        env.step(np.zeros(3))

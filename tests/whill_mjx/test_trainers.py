"""Environments with the interfaces of other packages' trainers, and their PPO on point goals.

Brax, RSL-RL, Stable-Baselines3 and PyTorch are not installed with this package. Tests that need them run in an
environment of their own, whose Python PEER_PYTHON names (CONTRIBUTING.md).
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from whill_mjx.gym.brax import BraxEnv, BraxState
from whill_mjx.tasks.point_goal import PointGoal

ROOT = Path(__file__).parents[2]
PEER = os.environ.get("PEER_PYTHON")
SMALL = PointGoal(boxes=1, max_steps=40)
peer = pytest.mark.skipif(not PEER, reason="PEER_PYTHON names no Python that has torch and the trainers")


def in_peer(*arguments: str) -> str:
    environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
    done = subprocess.run([PEER, *arguments], env=environment, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_a_trainer_of_brax_can_scan_a_task_and_ends_it_itself():
    env = BraxEnv(SMALL)

    @jax.jit
    def roll(key):
        state = env.reset(key)
        state = state.replace(info={"steps": jnp.zeros(())})  # as wrappers add to it
        shapes = jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), state)
        after, path = jax.lax.scan(lambda s, _: (env.step(s, jnp.array([-1.0, 0.0])),) * 2, state, None, length=60)
        return after, path, shapes == jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), after)

    assert env.observation_size == 2 + 36 + 2 and env.action_size == 2 and env.episode_length == 40
    with pytest.raises(ValueError, match="no vector"):
        BraxEnv("corridor")
    after, path, same = roll(jax.random.PRNGKey(0))
    assert same and isinstance(after, BraxState) and set(after.info) == {"steps"}
    assert path.obs.shape == (60, env.observation_size)
    assert not path.done.any()  # it stands still, and the limit of 40 steps is the trainer's
    np.testing.assert_allclose(path.reward[5:], SMALL.step_reward, atol=1e-3)


@pytest.mark.long
@peer
def test_braxs_own_wrappers_begin_a_task_anew():
    in_peer("-c", """
import jax, jax.numpy as jnp
from brax.envs.wrappers.training import wrap
from whill_mjx.gym.brax import BraxEnv
from whill_mjx.tasks.point_goal import PointGoal
env = BraxEnv(PointGoal(boxes=1))
many = wrap(env, episode_length=5)
state = jax.jit(many.reset)(jax.random.split(jax.random.PRNGKey(0), 3))
step, first = jax.jit(many.step), state.obs
for number in range(1, 6):
    state = step(state, jnp.ones((3, 2)))
    assert state.obs.shape == (3, env.observation_size)
assert state.done.all() and state.info["truncation"].all() and (state.obs == first).all()
state = step(state, jnp.ones((3, 2)))
assert not state.done.any() and not (state.obs == first).all()
""")  # fmt: skip


@pytest.mark.long
@peer
def test_rsl_rls_own_runner_trains_on_a_task(tmp_path):
    in_peer("-c", """
import sys, torch
from rsl_rl.runners import OnPolicyRunner
from whill_mjx.gym.rsl_rl import RslRlVecEnv
from whill_mjx.tasks.point_goal import PointGoal
env = RslRlVecEnv(4, PointGoal(boxes=1, max_steps=6))
assert env.get_observations()["policy"].shape == (4, 40)
for number in range(6):
    obs, reward, done, extras = env.step(torch.tensor([[-1.0, 0.0]] * 4))
    assert reward.shape == (4,) and bool(done.any()) == (number == 5)
assert extras["time_outs"].all() and (env.episode_length_buf == 0).all()
model = {"class_name": "MLPModel", "hidden_dims": [16], "activation": "elu", "obs_normalization": False}
actor = {**model, "distribution_cfg": {"class_name": "GaussianDistribution", "init_std": 1.0, "std_type": "scalar"}}
algorithm = {"class_name": "PPO", "num_learning_epochs": 1, "num_mini_batches": 2}
config = {"num_steps_per_env": 4, "save_interval": 100, "obs_groups": {"actor": ["policy"], "critic": ["policy"]},
          "actor": actor, "critic": model, "algorithm": algorithm, "logger": "tensorboard"}
OnPolicyRunner(env, config, log_dir=None, device="cpu").learn(2, init_at_random_ep_len=True)
""")  # fmt: skip


@pytest.mark.long
@peer
@pytest.mark.parametrize("learner", ["sb3", "loop"])
def test_ppo_of_another_package_learns_point_goals(learner):
    said = in_peer("-m", "benchmarks.state_ppo", "--learner", learner, "--minutes", "60", "--no-record")
    assert f"{learner}_point_goal_minutes" in said, said


def test_the_environments_of_other_trainers_need_none_of_their_packages():
    code = "import whill_mjx.gym.brax, whill_mjx.gym.rsl_rl, whill_mjx.gym.sb3, sys; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout.strip() == "False", done.stderr


@pytest.mark.quick
def test_the_class_of_a_task_is_no_task():
    with pytest.raises(ValueError, match="^task is <class .*give a Task such as"):
        BraxEnv(PointGoal)

"""A tiny problem for PPO, and its training as a command of seconds: folder, signals and resuming are the real ones.

    python tests/whill_mjx/half_lit.py --out RUN --seed 0
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

from whill_mjx.io.command_line import listen, run

if __name__ == "__main__":
    listen()

import jax
import jax.numpy as jnp
from flax import struct

from dreamer.policy_files.export import flatten_weights, save_arrays
from dreamer.train import TrainingOptions
from whill_mjx.io.folders import claim_folder, whole_file
from whill_mjx.learning.ppo import PpoConfig
from whill_mjx.learning.ppo_training import Length, train_ppo

TINY = PpoConfig(stack=2, width=32, channels=(8, 8, 8), rollout=16, epochs=4, minibatches=4, lr=3e-3)
COUNT, ITERATIONS = 4, 40


@struct.dataclass
class Step:
    obs: jax.Array
    reward: jax.Array
    is_first: jax.Array
    is_last: jax.Array
    is_terminal: jax.Array
    metrics: dict


def half_lit_env(count, length=4):
    """One half of the image is lit; the first action component should point there: reward 1 - |a - side| / 2.

    Episodes last `length` steps, and the step after the end resets and ignores its action.
    """

    def emit(key, age, reward, first):
        side = jnp.where(jax.vmap(jax.random.bernoulli)(jax.vmap(jax.random.fold_in)(key, age)), 1.0, -1.0)
        columns = jnp.arange(8) >= 4
        lit = jnp.where((side > 0)[:, None], columns, ~columns)
        obs = jnp.broadcast_to((255 * lit)[:, None, :, None], (count, 8, 8, 3)).astype(jnp.uint8)
        last = age >= length
        return side, Step(obs, reward, first, last, last, {"success": reward})

    def reset(key):
        keys, age = jax.random.split(key, count), jnp.zeros(count, jnp.int32)
        side, step = emit(keys, age, jnp.zeros(count), jnp.ones(count, bool))
        return (keys, age, side, step.is_last), step

    def step(state, action):
        keys, age, side, ended = state
        keys = jnp.where(ended, jax.vmap(lambda key: jax.random.fold_in(key, 99))(keys), keys)
        age = jnp.where(ended, 0, age + 1)
        reward = jnp.where(ended, 0.0, 1.0 - jnp.abs(action[:, 0] - side) / 2)
        side, step = emit(keys, age, reward, ended)
        return (keys, age, side, step.is_last), step

    return SimpleNamespace(num_envs=count, obs_shape=(8, 8, 3), action_dim=2, reset=reset, step=step)


@dataclass(frozen=True)
class Options:
    out: Path
    seed: int = 0


def main(options):
    """Train, with a checkpoint and a line of the log after every iteration, and leave the parameters."""
    with claim_folder(options.out, "half_lit", ("result.npz",)) as claim:
        claim.settle({"seed": options.seed})
        each = COUNT * TINY.rollout

        def evaluate(params, env_steps):
            time.sleep(0.02)  # so that a kill finds it at work
            return {"norm": float(jnp.linalg.norm(jax.tree.leaves(params)[-1]))}

        how = TrainingOptions(eval_fn=evaluate, eval_every=each, checkpoint_every_s=0.0, progress=False)
        params, *_ = train_ppo(half_lit_env(COUNT), TINY, options.out, Length(ITERATIONS * each), options.seed, how)
        with whole_file(options.out / "result.npz") as path:
            save_arrays(path, flatten_weights(params))


def cli():
    """Command line."""
    run(Options, main, __doc__, positional=False)


if __name__ == "__main__":
    cli()

"""Whether a training can fit into this machine, from sizes alone, before anything is made."""

from __future__ import annotations

import math
import os

import jax
import numpy as np

from whill_mjx.env import Env
from whill_mjx.learning.setup import Preset

FLOAT, HALF = 4, 2


def check_memory(preset: Preset, learner: str, env: Env) -> None:
    """Raise ValueError where what a training must keep at once is more than host and devices have together."""
    sizes, there = least_memory(preset, learner, observed_bytes(env)), machine_memory()
    needed = sum(sizes.values())
    if needed > there:
        what, most = max(sizes.items(), key=lambda pair: pair[1])
        raise ValueError(f"this training needs at least {needed / 1e9:.3g} GB, {most / 1e9:.3g} of them for {what}; "
                         f"this machine has {there / 1e9:.3g}. Ask for less of it.")


def least_memory(preset: Preset, learner: str, observed: int) -> dict[str, float]:
    """Bytes of the largest parts of a training by the settings that they follow from; each is a lower bound.

    Args:
        preset: with the options' changes.
        learner: "dreamer" or "ppo".
        observed: bytes of one observation.
    """
    instances = float(preset.instances) * observed
    if learner == "ppo":
        ppo = preset.ppo
        return {f"instances ({preset.instances})": instances,
                f"rollout ({ppo.rollout}) of all instances": instances * ppo.rollout,
                f"width ({ppo.width})": 3.0 * FLOAT * ppo.width * max(ppo.channels)}  # fmt: skip
    config = preset.learner
    kept = min(config.replay_capacity, preset.total_steps + config.pretrain_steps) * (1.0 + config.mirror)
    sequences = float(config.batch_size) * config.batch_length
    imagined = float(config.batch_size) * config.start_steps * config.imag_horizon
    return {f"instances ({preset.instances})": instances,
            f"replay_capacity ({config.replay_capacity})": kept * (HALF * config.deter if config.redraw else observed),
            f"batch_size ({config.batch_size}) x batch_length ({config.batch_length})":
                sequences * (observed + HALF * config.deter),
            f"imag_horizon ({config.imag_horizon}) from all states of a batch": imagined * HALF * config.deter,
            f"deter ({config.deter})": 3.0 * FLOAT * config.deter * (config.deter / config.blocks + config.hidden),
            f"units ({config.units})": 3.0 * FLOAT * config.units * config.deter}  # fmt: skip


def observed_bytes(env: Env) -> int:
    """Bytes of one observation of an environment."""
    readings = [sensor.reading(env) for _, sensor in env.sensors]
    return sum(math.prod(one.shape) * np.dtype(one.dtype).itemsize for one in readings) or 3 * env.height * env.width


def machine_memory() -> float:
    """Bytes of memory of this host and of its devices."""
    host = float(os.sysconf("SC_PHYS_PAGES")) * os.sysconf("SC_PAGE_SIZE")
    return host + sum((device.memory_stats() or {}).get("bytes_limit", 0) for device in jax.local_devices())

"""The state that a training begins with: made anew or read from its last checkpoint; and how it is kept."""

from __future__ import annotations

import functools
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np

from dreamer.config import DreamerConfig
from dreamer.experience import host_replay, pretrain, replay
from dreamer.experience.iteration import TrainState, compile_init
from dreamer.training import checkpoint, parallel, seeds
from dreamer.training.metrics_log import write_atomically
from dreamer.training.programs import Place, compiled
from dreamer.types import FunctionalEnv


def check_seed(out: Path, seed: int | Sequence[int], resume: bool) -> None:
    """Raise ValueError where a run would go on with another seed than it was begun with."""
    path = out / "config.json"
    if not resume or not path.exists() or not checkpoint.complete(out / "checkpoints"):
        return
    try:
        begun = json.loads(path.read_text())["seed"]
    except (ValueError, KeyError, TypeError, RecursionError):
        return  # the checkpoint has the configuration, and its keys those of the seed
    asked = seed if isinstance(seed, int) else list(seed)
    if begun != asked:
        raise ValueError(f"{out}: the run there was begun with seed {begun}, not {asked}. Give that seed, or another "
                         "folder.")


def first_state(
    env: FunctionalEnv, config: DreamerConfig, out: Path, seed: int | Sequence[int], resume: bool, place: Place
) -> tuple[TrainState, float]:
    """State to start from and the time [s] already spent."""
    mesh = place.mesh
    if resume and checkpoint.complete(out / "checkpoints"):
        template = _init(env, config, seed, Place(None, place.kept), split=mesh is not None)()
        restored = checkpoint.restore(out / "checkpoints", host_replay.revealed(template), config)
        if restored is not None:
            state = host_replay.hidden(restored[0], template)
            if mesh is not None:
                state = parallel.place(state, parallel.state_shardings(mesh, state, env.num_envs))
            return state, float(restored[1]["wall_s"])
    state = _init(env, config, seed, place)()
    if not parallel.is_first_process():
        return state, 0.0
    if not resume:
        for path in checkpoint.complete(out / "checkpoints"):
            checkpoint.remove(path)
    write_atomically(out / "config.json", json.dumps({**asdict(config), "seed": seed}, indent=1) + "\n")
    return state, 0.0


def _init(
    env: FunctionalEnv, config: DreamerConfig, seed: int | Sequence[int], place: Place, split: bool = False
) -> Any:
    """The compiled first state, () -> state; `split`: it will be placed on several devices."""
    alone = isinstance(seed, int) and place.mesh is None and not split
    config = replace(config, replay_memory=_memory(env, config, alone))
    if isinstance(seed, int):
        init = compile_init(env, config, seed, place.mesh)
        if place.kept is None:
            return init
        return functools.partial(compiled("init_state", lambda: init.func.lower(*init.args), place.kept), *init.args)
    return functools.partial(jax.jit(lambda each: seeds.init_states(env, config, each)), np.asarray(seed, np.int32))


def _memory(env: FunctionalEnv, config: DreamerConfig, alone: bool) -> Literal["auto", "device", "host"]:
    """Where the observations of the replay go; `alone`: one seed on one device."""
    if config.replay_memory == "host" and not alone:
        raise ValueError(
            "DreamerConfig.replay_memory = 'host': a replay in the host's memory belongs to one seed on one device. "
            "Give one seed and no devices, or leave it at 'auto' with a smaller replay_capacity."
        )
    if config.redraw:
        return config.replay_memory  # auto: `init_state` sees how much is held
    if config.replay_memory != "auto" or not alone:
        return "host" if config.replay_memory == "host" else "device"
    if fits(env, config):
        return "device"
    size = _observation_bytes(env, config)
    print(
        f"The replay's observations would take {size / 1e9:.1f} GB, more than half of the device's memory: they are "
        "kept in the host's, which is slower. A smaller replay_capacity keeps them on the device.",
        file=sys.stderr,
    )
    return "host"


def fits(env: FunctionalEnv, config: DreamerConfig) -> bool:
    """Whether the device has room for the observations of the replay."""
    return host_replay.fits(_observation_bytes(env, config), jax.devices()[0])


def _observation_bytes(env: FunctionalEnv, config: DreamerConfig) -> int:
    """Size of the observations of the replay."""
    there = replace(config, replay_memory="device")
    memory = jax.eval_shape(lambda: replay.init(there, env.num_envs, env.obs_shape, 1, 1 + config.mirror))
    return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(memory.obs))


def save_state(out: Path, state: TrainState, config: DreamerConfig, wall_s: float) -> Path:
    """Write a checkpoint of the whole run; of the replay only what is filled."""
    rows = state.replay.reward.shape[0]
    used = max(1, min(rows, int(state.replay.written)))
    filled = ("replay.", used, rows) if state.replay.reward.ndim == 2 else None  # of several seeds all is written
    env_steps = int(state.env_steps)
    pretraining = 0 if env_steps else sum(pretrain.counters(state).values())
    state = host_replay.revealed(state)
    moment = checkpoint.Moment(env_steps, wall_s, pretraining)
    path = checkpoint.save(out / "checkpoints", state, config, moment, filled, seeds.count(state.agent.params))
    parallel.wait_for_all("checkpoint written")  # only the first process writes; the others may read it next
    return path

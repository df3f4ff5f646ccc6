"""Digests of lowered programs, or seconds of a fit and a loop, of whichever tree is on the path.

Run by `benchmarks.house` once for each of two trees, as a script: it imports the packages by the places of either.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import re
import time
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

COUNT = 64  # instances


def found(name: str, *modules: str) -> Any:
    """A name from the first of these modules that exists and has it."""
    for module in modules:
        try:
            return getattr(import_module(module), name)
        except (ImportError, AttributeError):
            continue
    raise ImportError(f"{name}: in none of {', '.join(modules)}")


def digest(lowered: Any) -> str:
    """SHA-256 of a lowered program without its places in the sources."""
    return hashlib.sha256(re.sub(r"\s*loc\(.*?\)|#loc.*", "", lowered.as_text()).encode()).hexdigest()


def physics() -> Any:
    """One step of loaded vehicles."""
    random_instances = found("random_instances", "benchmarks.physics_rolls", "benchmarks.physics")
    substep = found("substep", "whill_mjx.vehicle.dynamics", "whill_mjx.vehicle")
    model, params, states = random_instances("loaded", COUNT)
    step = jax.jit(jax.vmap(lambda p, s, c: substep(model, p, s, c)))
    return step.lower(params, states, jnp.zeros((COUNT, 2)))


def environment() -> Any:
    """One control step of the obstacle course with image and auto-reset."""
    from whill_mjx.batch import make_batch
    from whill_mjx.env import make_env

    env, params = make_env("obstacle_course", random_looks=True)
    batch = make_batch(env, params, 8, spread=0.05)
    state = jax.eval_shape(batch.reset, jax.random.key(0))[0]
    return jax.jit(batch.step).lower(state, jnp.zeros((8, 2)))


def learner() -> Any:
    """Four updates of the small network."""
    from benchmarks.learner_updates import advance, begin
    from dreamer.config import preset

    config = preset("size1m")
    state = jax.eval_shape(lambda key: begin(config, key), jax.random.key(0))
    return jax.jit(lambda one, key: advance(config, 4, one, key)).lower(state, jax.random.key(1))


def drives() -> tuple[Any, Any]:
    """The shipped log and a plant of its vehicle."""
    import sysid

    load_log = found("load_log", "sysid.logs.log", "sysid.log")
    vehicle_plant = found("vehicle_plant", "sysid.replay.rollout", "sysid.rollout")
    log = load_log(Path(str(sysid.__file__)).parent / "data" / "chair")
    return log, vehicle_plant(log.spec)


def replay() -> Any:
    """A replay of two drives with one parameter set."""
    make_batch = found("make_batch", "sysid.replay.rollout", "sysid.rollout")
    simulate = found("simulate", "sysid.replay.rollout", "sysid.rollout")
    preset_params = found("preset_params", "whill_mjx.vehicle.presets", "whill_mjx.presets")
    log, plant = drives()
    made = make_batch(log.training[:2], plant.dt)
    batch = made[0] if isinstance(made, tuple) else made
    return jax.jit(lambda params: simulate(plant, params, batch)).lower(preset_params(log.spec, "physical"))


def fit() -> float:
    """Seconds of a quick fit of a few drives of the shipped log, compiled before."""
    from dataclasses import replace

    fit_log = found("fit_log", "sysid.search.fitting", "sysid.fit")
    config = found("FitConfig", "sysid.search.settings", "sysid.fit")
    log, _ = drives()
    few = replace(log, trials=log.training[:4])
    settings = config(quick=True, iterations=4, elsewhere=False)
    fit_log(few, settings)
    began = time.perf_counter()
    fit_log(few, settings)
    return time.perf_counter() - began


def loop() -> float:
    """Seconds of a quick loop over a few drives of the shipped log without a reference, compiled before."""
    from dataclasses import replace

    find: Callable[..., Any]
    try:
        find = found("find_missing", "sysid.verdict.pipeline")
    except ImportError:
        find = found("close_loop", "sysid.close_loop")
    config = found("LoopConfig", "sysid.verdict.result", "sysid.close_loop")
    log, _ = drives()
    few = replace(log, trials=log.training[:4])
    settings = config(quick=True, iterations=4, poses=False)
    find(few, (), settings)
    began = time.perf_counter()
    find(few, (), settings)
    return time.perf_counter() - began


def main() -> None:
    """Write digests or seconds as JSON."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.house_programs", description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="file to write")
    parser.add_argument("--lowered", action="store_true", help="digests of programs")
    parser.add_argument("--times", action="store_true", help="seconds of a fit and a loop")
    options = parser.parse_args()
    written: dict[str, Any] = {}
    if options.lowered:
        written |= {one.__name__: digest(one()) for one in (physics, environment, learner, replay)}
    if options.times:
        written |= {one.__name__: one() for one in (fit, loop)}
    options.out.write_text(json.dumps(written))


if __name__ == "__main__":
    from whill_mjx import share_results

    share_results()
    main()

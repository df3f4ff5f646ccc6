"""Digests of lowered programs, or their seconds with those of a fit and a loop, of whichever tree is on the path.

Run by `benchmarks.house` once for each of two trees, as a script: it imports the packages by the places of either, and
nothing before that, since an older tree has other modules.
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
REPEATS = 5


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


def physics(count: int = COUNT) -> tuple[Any, tuple]:
    """A control period of loaded vehicles, and its arguments."""
    random_instances = found("random_instances", "benchmarks.physics_rolls", "benchmarks.physics")
    drive = found("drive", "whill_mjx.vehicle.dynamics", "whill_mjx.vehicle")
    model, params, states = random_instances("loaded", count)
    return jax.jit(jax.vmap(lambda p, s, c: drive(model, p, s, c))), (params, states, jnp.full((count, 2), 0.3))


def environment(count: int = 8) -> tuple[Any, tuple]:
    """One control step of the obstacle course with image and auto-reset, and its arguments."""
    from whill_mjx.batch import make_batch
    from whill_mjx.env import make_env

    env, params = make_env("obstacle_course", random_looks=True)
    batch = make_batch(env, params, count, spread=0.05)
    state = jax.jit(batch.reset)(jax.random.key(0))[0]
    return jax.jit(batch.step), (state, jnp.full((count, 2), 0.3))


def learner(size: str = "size1m") -> tuple[Any, tuple]:
    """Four updates of a network, and their arguments."""
    from benchmarks.learner_updates import advance, begin
    from dreamer.config import preset

    config = preset(size)
    state = begin(config, jax.random.key(0))
    return jax.jit(lambda one, key: advance(config, 4, one, key)), (state, jax.random.key(1))


def drives() -> tuple[Any, Any]:
    """The shipped log and a plant of its vehicle."""
    import sysid

    load_log = found("load_log", "sysid.logs.log", "sysid.log")
    vehicle_plant = found("vehicle_plant", "sysid.replay.rollout", "sysid.rollout")
    log = load_log(Path(str(sysid.__file__)).parent / "data" / "chair")
    return log, vehicle_plant(log.spec)


def replay() -> tuple[Any, tuple]:
    """A replay of two drives with one parameter set, and its argument."""
    make_batch = found("make_batch", "sysid.replay.rollout", "sysid.rollout")
    simulate = found("simulate", "sysid.replay.rollout", "sysid.rollout")
    preset_params = found("preset_params", "whill_mjx.vehicle.presets", "whill_mjx.presets")
    log, plant = drives()
    made = make_batch(log.training[:2], plant.dt)
    batch = made[0] if isinstance(made, tuple) else made
    return jax.jit(lambda params: simulate(plant, params, batch)), (preset_params(log.spec, "physical"),)


def seconds(function: Any, arguments: tuple, calls: int) -> list[float]:
    """Seconds of each of REPEATS rounds of some calls, compiled before."""
    jax.block_until_ready(function(*arguments))
    taken = []
    for _ in range(REPEATS):
        began = time.perf_counter()
        for _ in range(calls):
            out = function(*arguments)
        jax.block_until_ready(out)
        taken.append(time.perf_counter() - began)
    return taken


def timed(names: list[str]) -> dict[str, list[float]]:
    """Seconds of programs, at sizes that fill the device."""
    large = jax.default_backend() != "cpu"
    jobs: dict[str, Callable[[], list[float]]] = {
        "physics": lambda: seconds(*physics(32768 if large else 256), 50),
        "environment": lambda: seconds(*environment(8192 if large else 64), 20 if large else 5),
        "learner": lambda: seconds(*learner("size12m" if large else "size1m"), 5 if large else 1),
        "fit": lambda: [fit() for _ in range(1 + REPEATS)][1:],
        "loop": lambda: [loop() for _ in range(1 + REPEATS)][1:],
    }
    return {name: jobs[name]() for name in names}


def fit() -> float:
    """Seconds of a quick fit of a few drives of the shipped log; the first one in a process compiles."""
    from dataclasses import replace

    fit_log = found("fit_log", "sysid.search.fitting", "sysid.fit")
    config = found("FitConfig", "sysid.search.settings", "sysid.fit")
    log, _ = drives()
    few = replace(log, trials=log.training[:4])
    settings = config(quick=True, iterations=4, elsewhere=False)
    began = time.perf_counter()
    fit_log(few, settings)
    return time.perf_counter() - began


def loop() -> float:
    """Seconds of a quick loop over a few drives of the shipped log without a reference; the first one compiles."""
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
    began = time.perf_counter()
    find(few, (), settings)
    return time.perf_counter() - began


def main() -> None:
    """Write digests or seconds as JSON."""
    name = "python -m benchmarks.house_programs"
    parser = argparse.ArgumentParser(prog=name, usage=argparse.SUPPRESS, description=__doc__)  # an error is one line
    parser.add_argument("--out", type=Path, required=True, help="file to write")
    parser.add_argument("--lowered", action="store_true", help="digests of programs")
    parser.add_argument("--times", nargs="*", default=[], help="programs whose seconds are wanted")
    options = parser.parse_args()
    written: dict[str, Any] = {}
    if options.lowered:
        for one in (physics, environment, learner, replay):
            function, arguments = one()
            written[one.__name__] = digest(function.lower(*arguments))
    written |= timed(options.times)
    options.out.write_text(json.dumps(written))


if __name__ == "__main__":
    found("share_results", "whill_mjx.processor")()
    main()

"""The kernel that steps a whole control period against the scan over physics steps, in turns.

Both drive the same vehicles with the same commands, and their states are compared after a second.
"""

from __future__ import annotations

import time
import traceback
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.harness import device_name, figure, time_calls
from benchmarks.physics_rolls import random_instances
from whill_mjx.vehicle.dynamics import drive, one_step
from whill_mjx.vehicle.kernel import Launch, Roll, held_in_registers

PERIODS = 10  # of 0.1 s: a second
LAUNCHES = [Launch(), Launch(64, 2), Launch(128, 4), Launch(256, 8), Launch(64, 1)]


def compiled_way(vehicle: str, count: int, launch: Launch | None) -> tuple[Any, int, float]:
    """A call that drives `count` vehicles for a second, its physics steps, and the seconds that compiling it took.

    Args:
        vehicle: see `physics_rolls.vehicle_of`.
        count: vehicles.
        launch: of the kernel; None scans over physics steps.
    """
    model, *arguments = random_instances(vehicle, count, kernel=False)
    commands = jax.random.uniform(jax.random.key(1), (PERIODS, count, 2), minval=-1.0)
    steps, plain = model.config.substeps, partial(drive, model)
    roll = Roll(partial(one_step, model), steps, plain)

    def one(*args: Any) -> Any:
        return plain(*args) if launch is None else held_in_registers(roll, args, launch)

    def second(params: Any, states: Any, commands: jax.Array) -> Any:
        return jax.lax.scan(lambda s, c: (jax.vmap(one)(params, s, c), None), states, commands)[0]

    start = time.perf_counter()
    call = jax.jit(second).lower(*arguments, commands).compile()
    return partial(call, *arguments, commands), count * PERIODS * steps, time.perf_counter() - start


def measure_kernel(vehicle: str, count: int, repeats: int) -> dict[str, dict[str, Any]]:
    """Figures of both ways: rates, their ratio, and how far apart the states are after a second."""
    ways = {"scan": compiled_way(vehicle, count, None), "kernel": compiled_way(vehicle, count, Launch())}
    ends = {name: call() for name, (call, _, _) in ways.items()}
    rates: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(repeats):
        for name, (call, steps, _) in ways.items():
            rates[name].append(steps / time_calls(call, 1)[0])
    ratio = [new / old for new, old in zip(rates["kernel"], rates["scan"], strict=True)]
    distance = differences(ends["kernel"], ends["scan"])
    suffix = f"{count}" if vehicle == "loaded" else f"{count}_{vehicle.removeprefix('whill_cr_').lstrip('+')}"
    figures = {f"kernel_over_scan_{suffix}": {**figure(ratio, "times"), **distance}}
    for name, (_, _, seconds) in ways.items():
        rate = figure(rates[name], "physics steps/s")
        figures[f"{name}_steps_per_s_{suffix}"] = {**rate, "vehicle": vehicle, "compile_s": seconds}
        print(f"{vehicle:18s} {count:7d} {name:6s} {rate['value'] / 1e6:8.1f} M steps/s, compiled in {seconds:.1f} s")
    print(f"{vehicle:18s} {count:7d} {np.median(ratio):.2f} times on {device_name()}, {distance}", flush=True)
    return figures


def differences(found: Any, expected: Any) -> dict[str, float]:
    """Largest differences of position [m] and of qpos and qvel, and the share of instances that diverged."""
    qpos, qvel = (np.abs(np.asarray(getattr(found, name)) - np.asarray(getattr(expected, name)))
                  for name in ("qpos", "qvel"))  # fmt: skip
    return {
        "position_m": float(qpos[:, :3].max()), "qpos": float(qpos.max()), "qvel": float(qvel.max()),
        "median_qvel": float(np.median(qvel.max(1))), "farthest_m": float(jnp.abs(expected.qpos[:, :2]).max()),
        "diverged": float(found.diverged.mean()), "diverged_scan": float(expected.diverged.mean()),
    }  # fmt: skip


def print_launches(vehicle: str, count: int, repeats: int, launches: Sequence[Launch] = LAUNCHES) -> None:
    """Print rates and differences of the scan and of each launch; one that fails prints why."""
    with ThreadPoolExecutor(8) as pool:
        jobs = {launch: pool.submit(compiled_way, vehicle, count, launch) for launch in (None, *launches)}
        expected = None
        for launch, job in jobs.items():
            try:
                call, steps, seconds = job.result()
                end = call()
                expected = end if expected is None else expected
                rate = steps / float(np.median(time_calls(call, repeats)))
                print(f"{vehicle:18s} {count:7d} {launch}: {rate / 1e6:8.1f} M steps/s, compiled in {seconds:.1f} s, "
                      f"{differences(end, expected)}", flush=True)  # fmt: skip
            except Exception:
                print(f"{vehicle:18s} {count:7d} {launch} failed")
                traceback.print_exc(limit=-3)

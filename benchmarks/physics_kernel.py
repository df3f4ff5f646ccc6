"""The kernel that steps a whole control period, against the scan over physics steps, in one call.

    python -m benchmarks.physics_kernel [--vehicles loaded] [--instances 131072 32768 1024]
    python -m benchmarks.physics_kernel --sweep    # block sizes and warps; nothing is recorded

Both ways drive the same vehicles with the same commands. They take turns, and their states are compared after a second.
"""

from __future__ import annotations

import argparse
import time
import traceback
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.harness import device_name, figure, record, time_calls
from benchmarks.physics import CLAIM
from benchmarks.physics_rolls import random_instances
from bridge.options import Parser, whole
from whill_mjx.io.command_line import guarded
from whill_mjx.vehicle.dynamics import drive, one_step
from whill_mjx.vehicle.kernel import Launch, held_in_registers

PERIODS = 10  # of 0.1 s: a second
SWEEP = {
    "plain": None,
    "32 lanes": Launch(),
    "32 lanes, no hoist": Launch(hoist=False),
    "64 lanes, 2 warps": Launch(64, 2),
    "128 lanes, 4 warps": Launch(128, 4),
    "64 lanes, 1 warp": Launch(64, 1),
    "32 lanes, 2 steps": Launch(unroll=2),
    "32 lanes, 5 steps": Launch(unroll=5),
}


def rolled(vehicle: str, count: int, launch: Launch | None, periods: int = PERIODS) -> tuple[Any, tuple, int]:
    """A function of parameters, states and commands that drives `count` instances, its arguments, and its steps."""
    model, params, states = random_instances(vehicle, count, kernel=False)
    commands = jax.random.uniform(jax.random.key(1), (periods, count, 2), minval=-1.0)
    steps, plain = model.config.substeps, partial(drive, model)

    def one(*args: Any) -> Any:
        return (
            plain(*args) if launch is None else held_in_registers(partial(one_step, model), steps, plain, args, launch)
        )

    def roll(params: Any, states: Any, commands: jax.Array) -> Any:
        return jax.lax.scan(lambda s, c: (jax.vmap(one)(params, s, c), None), states, commands)[0]

    return jax.jit(roll), (params, states, commands), count * periods * steps


def compiled(vehicle: str, count: int, launch: Launch | None) -> tuple[Any, tuple, int, float]:
    """`rolled`, compiled, and the seconds that it took."""
    function, arguments, steps = rolled(vehicle, count, launch)
    start = time.perf_counter()
    return function.lower(*arguments).compile(), arguments, steps, time.perf_counter() - start


def differences(found: Any, expected: Any) -> dict[str, float]:
    """Largest difference of position [m], of the whole qpos and qvel, and the share of instances that diverged."""
    qpos, qvel = (np.abs(np.asarray(getattr(found, name)) - np.asarray(getattr(expected, name)))
                  for name in ("qpos", "qvel"))  # fmt: skip
    far = float(jnp.abs(expected.qpos[:, :2]).max())
    return {
        "position_m": float(qpos[:, :3].max()),
        "qpos": float(qpos.max()),
        "qvel": float(qvel.max()),
        "median_qvel": float(np.median(qvel.max(1))),
        "farthest_m": far,
        "diverged": float(found.diverged.mean()),
    }


def sweep(vehicle: str, count: int, repeats: int) -> None:
    """Print rates and differences of every launch; one that fails prints why."""
    with ThreadPoolExecutor(8) as pool:
        jobs = {name: pool.submit(compiled, vehicle, count, launch) for name, launch in SWEEP.items()}
        expected = None
        for name, job in jobs.items():
            try:
                function, arguments, steps, seconds = job.result()
                end = function(*arguments)
                expected = end if expected is None else expected
                rate = steps / float(np.median(time_calls(partial(function, *arguments), repeats)))
                print(f"{count:7d} {name:20s} {rate / 1e6:9.1f} M steps/s, compiled in {seconds:.0f} s, "
                      f"{differences(end, expected)}", flush=True)  # fmt: skip
            except Exception:
                print(f"{count:7d} {name:20s} failed")
                traceback.print_exc(limit=-3)


def compare(vehicle: str, count: int, repeats: int) -> None:
    """Print and record both ways, in turns."""
    ways = {"scan": compiled(vehicle, count, None), "kernel": compiled(vehicle, count, Launch())}
    ends = {name: way[0](*way[1]) for name, way in ways.items()}
    rates: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(repeats):
        for name, (function, arguments, steps, _) in ways.items():
            rates[name].append(steps / time_calls(partial(function, *arguments), 1)[0])
    ratio = [new / old for new, old in zip(rates["kernel"], rates["scan"], strict=True)]
    apart = differences(ends["kernel"], ends["scan"])
    suffix = f"{count}" if vehicle == "loaded" else f"{count}_{vehicle.removeprefix('whill_cr_')}"
    figures = {f"{name}_steps_per_s_{suffix}": {
        **figure(rates[name], "physics steps/s"), "vehicle": vehicle, "compile_s": way[3]} for name, way in ways.items()}  # fmt: skip
    record("physics", CLAIM, {**figures, f"kernel_over_scan_{suffix}": {**figure(ratio, "times"), **apart}})
    medians = {name: f"{np.median(one) / 1e6:.1f} M steps/s, compiled in {ways[name][3]:.1f} s"
               for name, one in rates.items()}  # fmt: skip
    print(f"{vehicle} {count:7d} on {device_name()}: {medians}, {np.median(ratio):.2f} times; {apart}", flush=True)


def main() -> None:
    """Run what is asked for."""
    parser = Parser(
        prog="python -m benchmarks.physics_kernel", description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("--vehicles", nargs="+", default=["loaded"])
    parser.add_argument("--instances", type=whole(), nargs="+", default=[131072, 32768, 1024])
    parser.add_argument("--repeats", type=whole(), default=7)
    parser.add_argument("--sweep", action="store_true")
    options = parser.parse_args()
    for vehicle in options.vehicles:
        for count in options.instances:
            try:
                (sweep if options.sweep else compare)(vehicle, count, options.repeats)
            except Exception:  # whatever one size meets, the others are measured
                traceback.print_exc()


if __name__ == "__main__":
    with guarded():
        main()

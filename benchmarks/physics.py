"""Physics throughput: physics steps/s of the free chassis with the paper's base model, parameters different everywhere.

    python -m benchmarks.physics [--instances 1024 32768 131072]
"""

from __future__ import annotations

import argparse
import time

import jax
import jax.numpy as jnp

from benchmarks.harness import figure, record, time_calls
from whill_mjx.model import VehicleModel, build_model
from whill_mjx.presets import preset
from whill_mjx.types import VehicleParams, VehicleState
from whill_mjx.vehicle import drive, place

SPREAD = 0.1  # relative spread of every parameter between instances


def random_instances(vehicle: str, count: int) -> tuple[VehicleModel, VehicleParams, VehicleState]:
    """`count` vehicles at rest with every parameter spread by SPREAD."""
    spec, params = preset(vehicle)
    model = build_model(spec)
    key = jax.random.key(0)

    def scatter(leaf: jax.Array, leaf_key: jax.Array) -> jax.Array:
        return leaf * (1 + SPREAD * jax.random.uniform(leaf_key, (count,), minval=-1.0))

    leaves, tree = jax.tree.flatten(params)
    keys = jax.random.split(key, len(leaves))
    spread = [scatter(leaf, leaf_key) for leaf, leaf_key in zip(leaves, keys, strict=True)]
    scattered = jax.tree.unflatten(tree, spread)
    states = jax.jit(jax.vmap(lambda params: place(model, params, 0.0, 0.0, 0.0)))(scattered)
    return model, scattered, states


def measure(vehicle: str, count: int, periods: int, repeats: int) -> tuple[list[float], float, dict[str, float]]:
    """Physics steps/s of each repeat, compile seconds, and a check of the end state."""
    model, params, states = random_instances(vehicle, count)
    commands = jax.random.uniform(jax.random.key(1), (periods, count, 2), minval=-1.0)

    @jax.jit
    def roll(params: VehicleParams, states: VehicleState, commands: jax.Array) -> VehicleState:
        def period(states: VehicleState, command: jax.Array) -> tuple[VehicleState, None]:
            return jax.vmap(lambda p, s, c: drive(model, p, s, c))(params, states, command), None

        return jax.lax.scan(period, states, commands)[0]

    start = time.perf_counter()
    compiled = roll.lower(params, states, commands).compile()
    compile_s = time.perf_counter() - start
    end = compiled(params, states, commands)
    seconds = time_calls(lambda: compiled(params, states, commands), repeats)
    steps = count * periods * model.config.substeps
    check = {"diverged": float(end.diverged.mean()), "farthest_m": float(jnp.abs(end.qpos[:, :2]).max())}
    return [steps / second for second in seconds], compile_s, check


def main() -> None:
    """Print and record steps/s for every instance count."""
    parser = argparse.ArgumentParser(description=__doc__)
    on_cpu = jax.devices()[0].platform == "cpu"
    parser.add_argument("--instances", type=int, nargs="+", default=[1024, 2048] if on_cpu else [1024, 32768, 131072])
    parser.add_argument("--vehicles", nargs="+", default=["whill_cr_paper", "whill_cr_physical"])
    parser.add_argument("--periods", type=int, default=5 if on_cpu else 20)
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    figures = {"dt_s": figure([0.005], "s")}
    best: list[float] = []
    for vehicle in options.vehicles:
        suffix = "" if vehicle == "whill_cr_paper" else f"_{vehicle.removeprefix('whill_cr_')}"
        for count in options.instances:
            rates, compile_s, check = measure(vehicle, count, options.periods, options.repeats)
            entry = {**figure(rates, "physics steps/s"), "compile_s": compile_s, **check}
            rate = entry["value"] / 1e6
            print(f"{vehicle:18s} {count:7d} instances: {rate:8.2f} M steps/s, compile {compile_s:.1f} s, {check}")
            if not on_cpu:
                figures[f"steps_per_s_{count}{suffix}"] = entry
                if count == 32768:
                    figures[f"simulated_s_per_s_32768{suffix}"] = figure([r * 0.005 for r in rates], "s/s")
            elif not suffix and (not best or entry["value"] > max(best)):
                best = rates
                figures["cpu_steps_per_s"] = {**entry, "instances": count}
    record("physics", "batched vehicle physics: free chassis on mjx.step, parameters different everywhere", figures)


if __name__ == "__main__":
    main()

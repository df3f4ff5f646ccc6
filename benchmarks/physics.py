"""Physics: throughput with parameters different everywhere, what each effect costs, peers, and the time step's error.

    python -m benchmarks.physics [--instances 1024 32768 131072] [--dynamics fused]
    python -m benchmarks.physics --parts timestep    # a figure-eight against one of steps eight times smaller
    python -m benchmarks.physics --parts effects     # each effect added alone to the physical model
    python -m benchmarks.physics --parts peers_step  # the same figure-eight on wheel contacts, as the peers step it
    python -m benchmarks.physics --parts peers       # mjx and C MuJoCo and MuJoCo Warp on a chair with wheel contacts
    python -m benchmarks.physics --parts kernels     # operations of one compiled step, closed form against mjx.step
    python -m benchmarks.physics --parts kernel      # a control period in one GPU kernel against the scan over steps
    python -m benchmarks.physics --parts launches    # block sizes of that kernel; printed only
    python -m benchmarks.physics --parts roofline    # what a step computes and moves, and what an H200 would allow

The figures without a suffix are of "loaded": the physical base model with five more effects, one of each place.
"""

from __future__ import annotations

import argparse
import re
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.harness import figure, record, time_calls
from benchmarks.physics_rolls import BASE, compiled_roll
from bridge.nodes.options import Parser, whole
from whill_mjx.effects import EFFECTS
from whill_mjx.io.command_line import guarded
from whill_mjx.logs.manoeuvres import command_table
from whill_mjx.processor import device_per_core
from whill_mjx.vehicle.config import VehicleConfig
from whill_mjx.vehicle.dynamics import drive, place
from whill_mjx.vehicle.kinematics import reference_pose
from whill_mjx.vehicle.model import VehicleModel, build_model
from whill_mjx.vehicle.parameters import set_values
from whill_mjx.vehicle.presets import preset
from whill_mjx.vehicle.types import VehicleState

CLAIM = "batched vehicle physics: free chassis, parameters different everywhere"
DRIVES = ("pid_drive", "forward_slip", "rolling_contact", "unnamed")  # of the other base model, or not one effect
DT = VehicleConfig().physics_dt
SLIPPERY = 0.1
"""Friction of a floor on which the chair's wheels break away whenever it starts or stops."""
PARTS = ("timestep", "kernels", "kernel", "launches", "speed", "roofline", "effects", "peers_step", "peers")


def measure(
    vehicle: str, count: int, periods: int, repeats: int, dynamics: str = "fused"
) -> tuple[list[float], dict[str, float]]:
    """Physics steps/s of each repeat; compile seconds, bytes per instance, and a check of the end state."""
    start = time.perf_counter()
    model, compiled, arguments = compiled_roll(vehicle, count, periods, dynamics)
    about = {"compile_s": time.perf_counter() - start}
    end = compiled(*arguments)
    seconds = time_calls(lambda: compiled(*arguments), repeats)
    steps = count * periods * model.config.substeps
    about |= {"diverged": float(end.diverged.mean()), "farthest_m": float(jnp.abs(end.qpos[:, :2]).max())}
    about |= {f"{name}_bytes_per_instance": total / count for name, total in memory(compiled, arguments).items()}
    return [steps / second for second in seconds], about


def memory(compiled: Any, arguments: tuple) -> dict[str, float]:
    """Bytes of the parameters, of the state, and of all that the compiled call holds beside the commands."""
    params, states, commands = (sum(leaf.nbytes for leaf in jax.tree.leaves(part)) for part in arguments)
    sizes = {"params": params, "state": states}
    analysis = compiled.memory_analysis()
    if analysis is not None:
        held = analysis.argument_size_in_bytes + analysis.output_size_in_bytes + analysis.temp_size_in_bytes
        sizes["all"] = held - commands
    return sizes


def record_effects(options: argparse.Namespace, on_cpu: bool) -> None:
    """Print and record what each effect adds to a physics step of the physical base model, one after the other.

    Its drive and the base model's take turns, so that what else the host does falls on both. An effect that fails is
    named and left out.
    """
    have = {effect.name for effect in preset(BASE)[1].effects}
    names = options.effects or [name for name in EFFECTS if name not in {*have, *DRIVES}]
    vehicles = [BASE, *(f"+{name}" for name in names), "loaded"]
    count, periods = max(min(options.instances), 1024 if on_cpu else 32768), max(options.periods // 4, 1)
    start = time.perf_counter()
    with ThreadPoolExecutor(2 if on_cpu else 8) as pool:
        jobs = {vehicle: pool.submit(compiled_roll, vehicle, count, periods, options.dynamics) for vehicle in vehicles}
    print(f"{len(jobs)} vehicles compiled in {time.perf_counter() - start:.0f} s")
    base = _step_timer(jobs.pop(BASE).result())
    for vehicle, job in jobs.items():
        name = vehicle.removeprefix("+")
        try:
            timer = _step_timer(job.result())
            pairs = [(base(), timer()) for _ in range(options.repeats)]
        except Exception as error:  # whatever one effect meets, the others are measured
            print(f"  {name:26s} left out, {type(error).__name__}: {str(error).splitlines()[:1]}")
            continue
        without = float(np.median([pair[0] for pair in pairs]))
        added = figure([(one - alone) * 1e6 for alone, one in pairs], "us")
        share = added["value"] * 1e-6 / without
        print(f"  {name:26s} {added['value']:+8.2f} us, {100 * share:+6.1f} % of {without * 1e6:.1f} us", flush=True)
        record("physics", CLAIM, {
            "step_us_base": {**figure([pair[0] * 1e6 for pair in pairs], "us"), "instances": count},
            f"added_us_{name}": {**added, "instances": count, "share_of_base": share},
        })  # fmt: skip


def _step_timer(rolled: tuple[VehicleModel, Any, tuple]) -> Callable[[], float]:
    """Measures the seconds of one physics step of a compiled drive, once warmed up."""
    model, compiled, arguments = rolled
    steps = arguments[2].shape[0] * model.config.substeps
    time_calls(partial(compiled, *arguments), 1)
    return lambda: time_calls(partial(compiled, *arguments), 1, warm_up=0)[0] / steps


def record_peers_step() -> None:
    """Print and record the error of the peers' time steps."""
    from benchmarks.physics_peers_step import measure_steps

    record("physics", CLAIM, measure_steps())


def record_peers(options: argparse.Namespace, on_cpu: bool) -> None:
    """Print and record the peers."""
    from benchmarks.physics_peers import measure_peers

    worlds = options.worlds or (64 if on_cpu else 8192)
    record("physics", CLAIM, measure_peers(worlds, 20 if on_cpu else 100, min(options.repeats, 3)))


def kernels_per_step(vehicle: str, dynamics: str) -> int:
    """Fused loops, products and library calls in the compiled loop over physics steps: what a GPU launches per step
    where no kernel takes a whole control period."""
    _, compiled, _ = compiled_roll(vehicle, 1024, 1, dynamics, kernel=False)
    bodies = re.split(r"\n(?=%|ENTRY)", compiled.as_text())
    kernel = re.compile(r" (?:fusion|dot|custom-call|copy)\(")
    return max(len(kernel.findall(body)) for body in bodies if not body.startswith("ENTRY"))


def timestep_errors(vehicle: str, dt: float, grip: float | None = None) -> tuple[float, float, float]:
    """Largest differences of a figure-eight at step dt from one at dt / 8, in float64.

    Args:
        grip: friction of driven wheels, instead of the preset's.

    Returns:
        Position of the reference point [m], heading [rad], speed of the wheels' rims [m/s].
    """
    with jax.enable_x64(True):
        spec, params = preset(vehicle)
        if grip is not None:
            params = set_values(params, ("slip_traction.mu",), jnp.array([grip]))
        table = jnp.asarray(command_table("figure_eight")[:, 1:])
        drives = []
        for step in (dt, dt / 8):
            build_model.cache_clear()
            model = build_model(spec, VehicleConfig(physics_dt=step))

            def record(state: VehicleState, command: jax.Array, model=model) -> tuple[VehicleState, jax.Array]:
                state = drive(model, params, state, command)
                rims = state.qvel[6:8] * spec.wheel_radius
                return state, jnp.concatenate([jnp.stack(reference_pose(model, state.qpos)), rims])

            start = place(model, params, 0.0, 0.0, 0.0)
            drives.append(np.array(jax.jit(lambda s, record=record: jax.lax.scan(record, s, table)[1])(start)))
        build_model.cache_clear()
    coarse, fine = drives
    turn = np.abs(np.unwrap(coarse[:, 2]) - np.unwrap(fine[:, 2])).max()
    position = np.hypot(*(coarse[:, :2] - fine[:, :2]).T).max()
    return float(position), float(turn), float(np.abs(coarse[:, 3:] - fine[:, 3:]).max())


def record_timestep(vehicle: str = "whill_cr_physical") -> None:
    """Print and record the error of each time step, and the largest one within 2 mm and 2 mrad."""
    figures, within = {}, []
    for grip in (None, SLIPPERY):
        floor = "" if grip is None else f"_grip_{grip:g}"
        for dt in (0.01, 0.005, 0.0025, 0.00125):
            position, turn, rim = timestep_errors(vehicle, dt, grip)
            print(f"{vehicle}{floor} dt {dt * 1e3:5.2f} ms: {position * 1e3:.3f} mm, {turn * 1e3:.3f} mrad, "
                  f"{rim * 1e3:.2f} mm/s")
            figures[f"figure_eight_error{floor}_dt_{dt * 1e3:g}ms"] = {
                **figure([position * 1e3], "mm"), "yaw_mrad": turn * 1e3, "rim_mm_per_s": rim * 1e3}
            within += [dt] if grip is None and position <= 2e-3 and turn <= 2e-3 else []
    if within:
        figures["largest_dt_within_2mm_2mrad"] = figure([max(within)], "s")
    record("physics", CLAIM, figures)


def record_kernels(vehicle: str = "whill_cr_physical") -> None:
    """Print and record the operations of one compiled physics step."""
    figures = {}
    for dynamics in ("fused", "mjx"):
        count = kernels_per_step(vehicle, dynamics)
        print(f"{vehicle}, {dynamics}: {count} kernels per physics step")
        figures[f"kernels_per_step_{dynamics}_{jax.devices()[0].platform}"] = figure([count], "kernels")
    record("physics", CLAIM, figures)


def compare_ways(options: argparse.Namespace) -> None:
    """Print and record the kernel of whole control periods beside the scan, and print its launches."""
    from benchmarks.physics_kernel import measure_kernel, print_launches

    for vehicle in options.vehicles:
        for count in options.instances:
            if "launches" in options.parts:
                print_launches(vehicle, count, options.repeats)
            if "kernel" in options.parts:
                record("physics", CLAIM, measure_kernel(vehicle, count, options.repeats))


def record_roofline() -> None:
    """Print and record what a step computes and moves, and how far the recorded rates are from the limits."""
    from benchmarks.physics_profile import measure_roofline

    record("physics", CLAIM, measure_roofline())


def record_speed(options: argparse.Namespace, on_cpu: bool) -> None:
    """Print and record steps/s for every instance count."""
    figures = {"dt_s": figure([DT], "s")}
    best: list[float] = []
    for vehicle in options.vehicles:
        suffix = "" if vehicle == "loaded" else f"_{vehicle.removeprefix('whill_cr_')}"
        suffix += "" if options.dynamics == "fused" else f"_{options.dynamics}"
        for count in options.instances:
            rates, about = measure(vehicle, count, options.periods, options.repeats, options.dynamics)
            entry = {**figure(rates, "physics steps/s"), "vehicle": vehicle, **about}
            rounded = {name: float(f"{value:.3g}") for name, value in about.items()}
            print(f"{vehicle:18s} {count:7d} instances: {entry['value'] / 1e6:8.2f} M steps/s, {rounded}")
            if not on_cpu:
                figures[f"steps_per_s_{count}{suffix}"] = entry
                if count == 32768:
                    figures[f"simulated_s_per_s_32768{suffix}"] = figure([r * DT for r in rates], "s/s")
            elif suffix:
                figures[f"cpu_steps_per_s_{count}{suffix}"] = entry
            elif not best or entry["value"] > max(best):
                best = rates
                figures["cpu_steps_per_s"] = {**entry, "instances": count}
    record("physics", CLAIM, figures)


def main() -> None:
    """Print and record the parts asked for."""
    parser = Parser(
        prog="python -m benchmarks.physics", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    on_cpu = device_per_core(1)[0].platform == "cpu"
    counts = [512, 1024, 2048] if on_cpu else [1024, 32768, 131072]
    parser.add_argument("--instances", type=whole(), nargs="+", default=counts)
    parser.add_argument("--vehicles", nargs="+", default=["loaded", BASE, "whill_cr_paper"])
    parser.add_argument("--periods", type=whole(), default=5 if on_cpu else 20)
    parser.add_argument("--repeats", type=whole(), default=5)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=["speed"])
    parser.add_argument("--effects", nargs="+", choices=sorted(EFFECTS), help="of the part effects; default: all")
    parser.add_argument("--worlds", type=whole(0), default=0, help="of the peers; default 8192, on a CPU 64")
    parser.add_argument("--dynamics", choices=("fused", "mjx"), default="fused")
    options = parser.parse_args()
    if "timestep" in options.parts:
        record_timestep()
    if "kernels" in options.parts:
        record_kernels()
    if {"kernel", "launches"} & set(options.parts):
        compare_ways(options)
    if "speed" in options.parts:
        record_speed(options, on_cpu)
    if "roofline" in options.parts:
        record_roofline()
    if "effects" in options.parts:
        record_effects(options, on_cpu)
    if "peers_step" in options.parts:
        record_peers_step()
    if "peers" in options.parts:
        record_peers(options, on_cpu)


if __name__ == "__main__":
    with guarded():
        main()

"""What one physics step computes and moves, and how far the measured rate is from what the hardware could do.

Counted for "loaded" (`benchmarks.physics`), for one instance and one physics step:

- arithmetic of the traced step: every operation on single numbers once, as XLA counts them before it fuses anything;
- what must move if a kernel does one step: parameters and state read, state written, one command read. A kernel that
  kept an instance in registers for a whole control period would move that once a period;
- what the compiled loop over physics steps moves: operands and results of its kernels. It depends on the backend, as
  does how much arithmetic its kernels repeat instead of storing it.

The limits are arithmetic on data-sheet numbers of one H200, not measurements; the measured rates are read from the
record. A straight line through times per step at three counts of instances separates what every step costs (launching
its kernels) from what every instance adds.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.harness import RESULTS, device_name, figure

H200 = "calculated for one NVIDIA H200"
FLOPS = 67e12  # 1/s, float32 without tensor cores; a fused multiply-add counts as two
BANDWIDTH = 4.8e12  # bytes/s of its memory
ISSUE = 132 * 4 * 32 * 1.98e9  # 1/s, instructions of single threads: multiprocessors, schedulers, threads, clock
INSTRUCTIONS = {"transcendental": 25, "division": 8, "other": 1}
"""Instructions of one operation; those of sin, tanh, exp, log, sqrt and of divisions are estimates."""
KERNEL = re.compile(r"%([\w.-]+) = (.*?) (?:fusion|dot|custom-call|copy)\(([^)]*)\)")
DEFINED = re.compile(r"%([\w.-]+) = (.*?) [\w-]+\(")
ARRAY = re.compile(r"\b(pred|[suf]\d+|bf16)\[([\d,]*)\]")


@dataclass(frozen=True)
class Work:
    """Of one instance in one physics step."""

    operations: float
    """Arithmetic, comparisons and selections, divisions among them."""
    divisions: float
    transcendentals: float
    moved: float
    """Bytes that have to be read or written where a kernel does one step."""

    @property
    def limits(self) -> dict[str, float]:
        """Largest rates [physics steps/s] that arithmetic, issue of instructions and memory allow."""
        instructions = (
            (self.operations - self.divisions) * INSTRUCTIONS["other"]
            + self.divisions * INSTRUCTIONS["division"]
            + self.transcendentals * INSTRUCTIONS["transcendental"]
        )
        return {
            "arithmetic": FLOPS / (self.operations + self.transcendentals),
            "issue": ISSUE / instructions,
            "memory": BANDWIDTH / self.moved,
        }


def work_of(vehicle: str, count: int = 64) -> Work:
    """Counted from the program before fusion and from the sizes of state and parameters.

    The host's compiler counts, on any machine: an accelerator's may not.
    """
    from benchmarks.physics_rolls import random_instances
    from whill_mjx.vehicle.dynamics import substep

    with jax.default_device(jax.local_devices(backend="cpu")[0]):
        model, params, states = random_instances(vehicle, count)
        step = jax.jit(jax.vmap(lambda p, s, c: substep(model, p, s, c)))
        lowered = step.lower(params, states, jnp.zeros((count, 2)))
    cost: Any = lowered.cost_analysis()
    divisions = lowered.as_text().count("stablehlo.divide")
    sizes = [sum(leaf.nbytes for leaf in jax.tree.leaves(part)) / count for part in (params, states)]
    return Work(cost["flops"] / count, divisions, cost["transcendentals"] / count, sizes[0] + 2 * sizes[1] + 8)


def loop_body(text: str) -> str:
    """The loop over physics steps: the computation with most kernels, the entry left out."""
    bodies = [body for body in re.split(r"\n(?=%|ENTRY)", text) if not body.startswith("ENTRY")]
    return max(bodies, key=lambda body: len(KERNEL.findall(body)))


def traffic(text: str, count: int) -> float:
    """Bytes per instance that the kernels of the loop read and write, from the text of the compiled program.

    Arrays with another leading size than `count`, such as the commands of all steps, count as one number each.
    """
    body = loop_body(text)
    sizes = {name: _bytes(kind, count) for name, kind in DEFINED.findall(body)}
    total = 0.0
    for _, result, operands in KERNEL.findall(body):
        total += _bytes(result, count)
        total += sum(sizes.get(name, 0.0) for name in re.findall(r"%([\w.-]+)", operands))
    return total


def _bytes(kind: str, count: int) -> float:
    """Bytes per instance of a type such as `f32[1024]{0}` or a tuple of such."""
    total = 0.0
    for name, dims in ARRAY.findall(kind):
        width = 1 if name == "pred" else int(re.sub(r"\D", "", name)) // 8
        shape = [int(size) for size in dims.split(",") if size]
        if shape and shape[0] == count:
            total += width * float(np.prod(shape)) / count
        elif shape:
            total += width
    return total


def split_time(rates: dict[int, float]) -> tuple[float, float]:
    """Seconds of a step that do not depend on the count of instances, and seconds that each instance adds.

    A straight line through the smallest and the largest of at least two counts.
    """
    low, high = min(rates), max(rates)
    each = (high / rates[high] - low / rates[low]) / (high - low)
    return low / rates[low] - each * low, each


def recorded_rates(ending: str = "") -> dict[int, float]:
    """Recorded physics steps/s on an H200 by count of instances."""
    path = RESULTS / "physics.json"
    known = json.loads(path.read_text())["figures"] if path.exists() else {}
    named = {re.fullmatch(rf"steps_per_s_(\d+){ending}", name): entry for name, entry in known.items()}
    return {int(match[1]): entry["value"] for match, entry in named.items() if match and "H200" in entry["device"]}


def measure_roofline(vehicle: str = "loaded", count: int = 1024) -> dict[str, dict[str, Any]]:
    """Figures of work, limits and distance from them."""
    from benchmarks.physics_rolls import compiled_roll

    work, platform = work_of(vehicle), jax.devices()[0].platform
    compiled = compiled_roll(vehicle, count, 1, kernel=False)[1]
    moved = traffic(compiled.as_text(), count)
    counted = compiled.cost_analysis()  # a loop's body counts once; None where the compiler does not count
    figures = {
        "operations_per_step": {**figure([work.operations], "operations", "counted"), "divisions": work.divisions},
        "transcendentals_per_step": figure([work.transcendentals], "operations", "counted"),
        "bytes_per_step": figure([work.moved], "bytes", "counted"),
        f"moved_bytes_per_step_{platform}": figure([moved], "bytes", device_name()),
    }
    print(f"{vehicle}: {work.operations:.0f} operations, {work.transcendentals:.0f} transcendentals, "
          f"{work.moved:.0f} bytes must move; compiled for {platform} {moved:.0f} bytes")
    if counted and "flops" in counted:
        done = counted["flops"] / count
        figures[f"compiled_operations_per_step_{platform}"] = figure([done], "operations", device_name())
        print(f"  compiled for {platform} {done:.0f} operations")
    for name, limit in work.limits.items():
        figures[f"limit_{name}_steps_per_s"] = figure([limit], "physics steps/s", H200)
        print(f"  {name:10s} allows {limit / 1e9:6.2f} G steps/s")
    return figures | _distances(work, recorded_rates() if vehicle == "loaded" else {})


def _distances(work: Work, rates: dict[int, float]) -> dict[str, dict[str, Any]]:
    """Share of the lowest limit that the recorded rates reach, and where their time goes."""
    lowest = min(work.limits.values())
    figures = {}
    for count, rate in sorted(rates.items()):
        figures[f"share_of_limit_{count}"] = figure([rate / lowest], "share", H200)
        print(f"  {count:6d} instances: {count / rate * 1e6:6.1f} us a step, {rate / lowest:.1%} of the limit")
    if len(rates) > 1:
        fixed, each = split_time(rates)
        figures["step_us_fixed"] = figure([fixed * 1e6], "us", H200)
        figures["step_ns_per_instance"] = figure([each * 1e9], "ns", H200)
        print(f"  {fixed * 1e6:.1f} us a step whatever the count, {each * 1e9:.3f} ns for every instance: "
              f"{work.moved / each / 1e12:.2f} TB/s of what must move")  # fmt: skip
    return figures

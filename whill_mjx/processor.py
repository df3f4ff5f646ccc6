"""Asks XLA to share work between results on a processor.

A physics step has some four thousand operations and sixty results. XLA's fusion for processors gives each result a loop
of its own, in which everything that leads to it is computed again: 24,000 operations a step. Its fusion of several
results into one loop is off by default, and no option of a single `jax.jit` turns it on; with it a step has 2,500.

The option is one of the whole process, and XLA aborts with it on programs of other people: `mjx.step` of two cylinders
or two boxes on a plane. So no import asks for it. Our commands do before JAX starts, unless they step a user's robot.

Vectors of 512 bits are asked for too, where the processor has them: LLVM prefers 256, with which the camera takes half
as long again.

Loops with many results are not made of vectors by default: their results might lie over one another, which takes more
than 128 comparisons to rule out. LLVM is asked to make them, where no accelerator is there, which would read the option
too. A replay of drives then takes four fifths of the time. All versions of JAX that the package allows know both
options; another one ends with an unknown one.

What is left are two hundred loops a step, each a task that a scheduler starts: for a few vehicles that takes longer
than their arithmetic. `as_one_function` has a part of a program compiled as a single function.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

OPTION = "xla_cpu_use_multi_output_fusion"
VECTORS = "-vectorize-memory-check-threshold=4096"
FLAG = "--xla_backend_extra_options"
OWN = (f"{FLAG}={OPTION}", f"{FLAG}={OPTION},{VECTORS}")  # beside an accelerator, and without one
WIDE = "--xla_cpu_prefer_vector_width"
DEVICES = Path("/dev")
ACCELERATORS = ("nvidia[0-9]*", "nvhost*", "dxg", "kfd", "accel*", "vfio/[0-9]*")  # NVIDIA, also under WSL, AMD, TPU


def share_results() -> None:
    """Ask for it in XLA_FLAGS, for this process and those that it starts, unless these flags name such options already.

    For processes that step our vehicles on a processor. Call it first: XLA reads the flags when a process compiles its
    first program, and afterwards this changes nothing. Results are the same without it, but for the last bits.
    Accelerators ignore it. XLA aborts with it on some programs of plain MJX.
    """
    own = OWN[no_accelerator()]
    # What a process that started this one has asked for may be for an accelerator that is not used here.
    words = [own if word in OWN else word for word in os.environ.get("XLA_FLAGS", "").split()]
    wanted = [own, f"{WIDE}=512"] if _has_wide_vectors() else [own]
    missing = [word for word in wanted if not any(word.split("=")[0] in given for given in words)]
    os.environ["XLA_FLAGS"] = " ".join([*words, *missing])


def no_accelerator() -> bool:
    """Whether JAX will compute on the host: it was asked to, or there is no device of `ACCELERATORS`."""
    if asked := os.environ.get("JAX_PLATFORMS"):
        return asked == "cpu"
    return not any(any(DEVICES.glob(device)) for device in ACCELERATORS)


def _has_wide_vectors() -> bool:
    try:
        return " avx512f " in Path("/proc/cpuinfo").read_text()
    except OSError:
        return False


def device_per_core(instances: int) -> tuple:
    """JAX devices, one for each core, among which `instances` can be split evenly: `make_batch(devices=...)`.

    A program of small arrays runs on one core, however many there are. Call it before JAX starts; afterwards, and with
    an accelerator, the devices are some of those that there are.
    """
    import jax

    with contextlib.suppress(RuntimeError):
        jax.config.update("jax_num_cpu_devices", cores())
    found = jax.devices()
    return tuple(found[: max(many for many in range(1, len(found) + 1) if instances % many == 0)])


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def shares_results() -> bool:
    """Whether XLA_FLAGS ask for it."""
    return any(word in OWN for word in os.environ.get("XLA_FLAGS", "").split())


def keep_results_apart() -> None:
    """Take back `share_results`, which a process that started this one may have called."""
    if shares_results():
        words = os.environ["XLA_FLAGS"].split()
        os.environ["XLA_FLAGS"] = " ".join(word for word in words if word not in OWN)


def as_one_function(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function` of arrays, compiled on a processor as a single function: its loops run without a task for each.

    Only for arithmetic on single numbers: products of matrices and solvers lose their tuned kernels. Only for some
    hundred instances: larger loops are divided among the cores, which XLA fails to compile within such a function.
    Versions that do not know the attributes ignore them; an accelerator is not asked, it would keep the call apart.
    """
    import jax
    from jax.experimental.xla_metadata import set_xla_metadata

    from whill_mjx.devices import platform

    if platform() != "cpu":
        return function

    def marked(*args: Any) -> Any:
        with set_xla_metadata(xla_cpu_small_call="true", inlineable="false"):
            return jax.jit(function)(*jax.lax.optimization_barrier(args))  # XLA aborts on operands that are constants

    return marked

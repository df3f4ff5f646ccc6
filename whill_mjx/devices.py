"""Which devices a run uses, and how several processes on one or many hosts find each other."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from functools import wraps
from typing import ParamSpec, TypeVar

import jax

P = ParamSpec("P")
R = TypeVar("R")

LAUNCHERS = {
    "SLURM_STEP_NUM_TASKS": "SLURM", "OMPI_COMM_WORLD_SIZE": "Open MPI", "PMI_SIZE": "MPI", "JAX_NUM_PROCESSES": "JAX",
}
"""Variables in which launchers give the number of processes; within SLURM, those of srun and not of the whole job."""


def launched_processes(environment: Mapping[str, str] | None = None) -> tuple[int, str]:
    """Number of processes that a launcher has started, and its name; 1 and "" where there is none."""
    environment = os.environ if environment is None else environment
    for variable, launcher in LAUNCHERS.items():
        text = environment.get(variable, "")
        if text.isdigit() and int(text) > 1:
            return int(text), launcher
    return 1, ""


def join(environment: Mapping[str, str] | None = None) -> int:
    """Join the processes of this run and return their number. To be called before anything else asks for a device.

    SLURM and Open MPI are recognised by JAX itself. Elsewhere (MPI of another make, Kubernetes, by hand) three
    variables say it: JAX_COORDINATOR_ADDRESS (host:port of the first process), JAX_NUM_PROCESSES and JAX_PROCESS_ID;
    PMI_SIZE and PMI_RANK stand in for the last two.

    Raises:
        ValueError: several processes without the coordinator's address, or without the number of this one.
    """
    environment = os.environ if environment is None else environment
    count, launcher = launched_processes(environment)
    if count == 1:
        return 1
    if launcher in ("SLURM", "Open MPI"):
        jax.distributed.initialize()
        return jax.process_count()
    address = environment.get("JAX_COORDINATOR_ADDRESS")
    index = environment.get("JAX_PROCESS_ID", environment.get("PMI_RANK", ""))
    if not address or not index.isdigit():
        raise ValueError(
            f"{count} processes were started ({launcher}), but JAX_COORDINATOR_ADDRESS is {address!r} and "
            f"JAX_PROCESS_ID is {index!r}. Set them to host:port of the first process and to 0..{count - 1}."
        )
    jax.distributed.initialize(address, count, int(index))
    return jax.process_count()


def choose_devices(count: int | None) -> tuple[jax.Device, ...]:
    """The first `count` devices of the run, none for a single one; None takes all of them.

    Raises:
        ValueError: there are fewer, or some of another process would be left out.
    """
    devices = jax.devices()
    if count is not None and not 1 <= count <= len(devices):
        raise ValueError(f"devices = {count}, but there are {len(devices)} ({devices[0].platform}). Give at most that.")
    if jax.process_count() > 1 and count not in (None, len(devices)):
        raise ValueError(f"devices = {count}: {jax.process_count()} processes use all their {len(devices)} devices. "
                         "Leave the option out.")
    chosen = tuple(devices[: count or len(devices)])
    return chosen if len(chosen) > 1 else ()


def platform() -> str:
    """Where programs are compiled now: "cpu", "gpu", ... of `jax.default_device`, or else JAX's own choice."""
    device = jax.config.jax_default_device  # type: ignore[attr-defined]
    if device is None:
        return jax.default_backend()
    return device if isinstance(device, str) else device.platform


def find_device(name: str | None) -> jax.Device | None:
    """The first device of a platform ("cpu", "gpu"); None, JAX's own choice, where that is it or nothing is named.

    Raises:
        ValueError: JAX has no such device here.
    """
    if name is None or name == jax.default_backend():
        return None
    try:
        return jax.local_devices(backend=name)[0]
    except (RuntimeError, AttributeError) as error:  # the second of a name that is no text
        if name == "cpu":
            return None  # JAX_PLATFORMS leaves it out
        raise ValueError(f"device is {name!r}, which JAX does not have here ({error}). Give None for its own choice "
                         f"({jax.default_backend()}).") from error  # fmt: skip


def held_to(device: jax.Device | None, function: Callable[P, R]) -> Callable[P, R]:
    """`function`, such as one that `jax.jit` made, with all that it computes on a device; None changes nothing."""
    if device is None:
        return function

    @wraps(function)
    def there(*args: P.args, **kwargs: P.kwargs) -> R:
        with jax.default_device(device):
            return function(*args, **kwargs)

    return there


def runs_triton() -> bool:
    """Whether programs are compiled now for an NVIDIA GPU of which our kernels are: Ampere or later."""
    if platform() == "cpu":
        return False
    capability = str(getattr(jax.devices()[0], "compute_capability", ""))
    return capability.replace(".", "", 1).isdigit() and float(capability) >= 8.0

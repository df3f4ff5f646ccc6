"""Which devices a run uses, and how several processes on one or many hosts find each other."""

from __future__ import annotations

import os
from collections.abc import Mapping

import jax

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


def runs_triton() -> bool:
    """Whether the default device is an NVIDIA GPU for which our kernels are written: Ampere or later."""
    capability = str(getattr(jax.devices()[0], "compute_capability", ""))
    return capability.replace(".", "", 1).isdigit() and float(capability) >= 8.0

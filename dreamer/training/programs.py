"""How programs are compiled, and compiled programs that are kept whole.

JAX keeps what XLA has compiled by a checksum of the lowered program. So each process traces and lowers it again, which
takes twice as long as reading it. Here a program is kept by a checksum of what it is made of, and a process that finds
it traces nothing.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import jax
import jax.monitoring
from jax.experimental import serialize_executable
from jax.sharding import Mesh

CONCURRENT: dict[str, str | bool] = {"xla_gpu_command_buffer_scheduling_mode": "CONCURRENT"}
"""Kernels that do not wait for each other's results run at the same time."""
CACHE_HIT = "/jax/compilation_cache/cache_hits"
_thread = threading.local()
BEGINNING = b"program\n"
"""Of a file. JAX's own entries begin otherwise: they are packed, and the cache removes those that do not unpack."""


@dataclass(frozen=True)
class Programs:
    """Compiled programs in a folder."""

    folder: Path
    made_of: str
    """Hexadecimal checksum of everything that the programs depend on: code, settings, library versions, device."""

    def __contains__(self, name: str) -> bool:
        return self._path(name).exists()

    def read(self, name: str) -> jax.stages.Compiled | None:
        """A program; None where it is not there, damaged, or cannot be loaded here."""
        try:
            content = self._path(name).read_bytes()
            begin = len(_head(b""))
            if content[:begin] != _head(content[begin:]):
                return None
            return serialize_executable.deserialize_and_load(*pickle.loads(content[begin:]))
        except Exception:  # whatever is wrong with it, it can be compiled
            return None

    def write(self, name: str, program: jax.stages.Compiled) -> None:
        """Keep a program; a full disk, or a program that XLA cannot write, costs a compilation next time."""
        try:
            content = pickle.dumps(serialize_executable.serialize(program))
            self.folder.mkdir(parents=True, exist_ok=True)
            temporary = self.folder / f".{self.made_of}-{name}.{os.getpid()}"
            temporary.write_bytes(_head(content) + content)
            os.replace(temporary, self._path(name))
        except (OSError, ValueError, TypeError, pickle.PicklingError, jax.errors.JaxRuntimeError):
            return

    def _path(self, name: str) -> Path:
        return self.folder / f"{self.made_of}-{name}"


def _head(content: bytes) -> bytes:
    return BEGINNING + hashlib.sha256(content).digest()


@dataclass(frozen=True)
class Place:
    """Where a training's programs run, and where they are kept."""

    mesh: Mesh | None = None
    """Devices that share the work; None for one."""
    kept: Programs | None = None
    """Of a training on one device."""


def compiled(name: str, lower: Callable[[], jax.stages.Lowered], kept: Programs | None) -> jax.stages.Compiled:
    """The kept program of this name, or else what `lower` gives, compiled and kept.

    One that JAX read from its own cache is not kept: XLA writes only part of what it has read itself.
    """
    program = None if kept is None else kept.read(name)
    if program is None:
        lowered = lower()
        _listen()
        reads = _reads()
        program = compile_lowered(lowered)
        if kept is not None and _reads() == reads:
            in_thread(kept.write, name, program)
    return program


@lru_cache(maxsize=1)
def _listen() -> None:
    """Count in each thread, from now on, what JAX reads from its own cache."""

    def heard(event: str, **about: Any) -> None:
        if event == CACHE_HIT:
            _thread.reads = _reads() + 1

    jax.monitoring.register_event_listener(heard)


def _reads() -> int:
    return getattr(_thread, "reads", 0)


class Kept:
    """A function that `jax.jit` made and whose arguments always have the same shapes; its program is kept.

    It is read or compiled at the first call. Without `kept` it is the function itself.
    """

    def __init__(self, name: str, function: Any, kept: Programs | None) -> None:
        self._name, self._function, self._kept = name, function, kept
        self._program: Any = None if kept is not None else function

    def __call__(self, *args: Any) -> Any:
        """What the function returns."""
        if self._program is None:
            self._program = compiled(self._name, lambda: self._function.lower(*args), self._kept)
        return self._program(*args)


def compile_lowered(lowered: jax.stages.Lowered) -> jax.stages.Compiled:
    """A program for one device; on a GPU with `CONCURRENT`, where this version of XLA has the option."""
    if jax.default_backend() == "gpu":
        try:
            return lowered.compile(compiler_options=CONCURRENT)
        except jax.errors.JaxRuntimeError as error:
            if "option" not in str(error):
                raise
    return lowered.compile()


def in_thread(call: Callable[..., Any], *given: Any) -> Future:
    """A call beside what follows. XLA compiles without holding Python's lock; arrays must not be donated meanwhile."""
    threads = ThreadPoolExecutor(1)
    started = threads.submit(call, *given)
    threads.shutdown(wait=False)
    return started

"""What runs side by side on the host's cores: parts of a work, and the compiling of programs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from threading import Lock
from typing import Any, TypeVar

import jax

from whill_mjx.processor import cores

COMPILERS = ThreadPoolExecutor(10)  # as many programs as a search has
_Part = TypeVar("_Part")
_Done = TypeVar("_Done")


def on_processor() -> bool:
    """Whether replays run on the host's own cores; an accelerator takes as long for a few rows as for thousands."""
    return jax.default_backend() == "cpu"


def on_all_cores(work: Callable[[_Part], _Done], parts: Sequence[_Part]) -> list[_Done]:
    """What `work` gives for each of `parts`, side by side on all cores."""
    workers = min(cores(), len(parts))
    if workers < 2:
        return [work(part) for part in parts]
    with ThreadPoolExecutor(workers) as threads:
        return list(threads.map(work, parts))


class Compiled:
    """A function of arrays with one program for each of their shapes; the last arguments may be static."""

    def __init__(self, function: Callable[..., Any], static: int = 0):
        """Take the function, and how many of its last arguments are static."""
        self._function, self._static = function, static
        self._programs: dict[Any, Future[Any]] = {}
        self._lock = Lock()

    def shapes(self, *args: Any) -> Any:
        """What it gives for such arguments, as shapes."""
        arrays, static = self._apart(args)
        return jax.eval_shape(lambda *given: self._function(*given, *static), *arrays)

    def compile(self, *args: Any) -> Future[Any]:
        """The program for arrays like these, or their shapes; it is compiled once, in a thread of its own."""
        arrays, static = self._apart(args)
        leaves, structure = jax.tree.flatten(arrays)
        key = structure, static, tuple((leaf.shape, leaf.dtype) for leaf in leaves)
        with self._lock:
            kept = self._programs.get(key)
            if kept is None or (kept.done() and kept.exception()):  # what failed once is tried again
                shapes = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), arrays)
                self._programs[key] = COMPILERS.submit(self._compile, shapes, static)
            return self._programs[key]

    def __call__(self, *args: Any) -> Any:
        """What the function gives, as soon as it is compiled."""
        return self.compile(*args).result()(*self._apart(args)[0])

    def _compile(self, shapes: tuple[Any, ...], static: tuple[Any, ...]) -> Any:
        count = len(shapes)
        function = jax.jit(self._function, static_argnums=tuple(range(count, count + len(static))))
        return function.lower(*shapes, *static).compile()

    def _apart(self, args: tuple[Any, ...]) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        """Arrays, and what is static."""
        count = len(args) - self._static
        return args[:count], args[count:]

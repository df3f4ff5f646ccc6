"""Steps of long work, kept in a folder: a command that was stopped goes on after its last step, to the same bits.

    with keep_steps(out / "steps", identity):
        for _ in range(rounds):
            state = step("round", lambda: advance(state), state)

The work between the steps must be deterministic: it is done again. A step is found again by a hash of all that led to
it: the identity, the results of the steps before, its name and its own inputs. What does not match is computed anew.
Steps may have steps of their own, whose files vanish when the outer one is kept. Outside `keep_steps`, and in threads,
`step` just computes.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from whill_mjx.io.folders import whole_file
from whill_mjx.io.reading import BROKEN_ARCHIVE

DIGEST = "digest"
"""Name of the array that says what led to a step."""


class Steps:
    """The steps of one piece of work, in a folder."""

    def __init__(self, folder: Path, digest: str):
        """`digest` stands for everything that the first step depends on."""
        self.folder, self._chain, self._number = folder, digest, 0

    def step(self, name: str, compute: Callable[[], Sequence[Any]], inputs: Sequence[Any]) -> list[np.ndarray]:
        """Arrays that `compute` gives, or gave when this very step was kept."""
        digest = _hash(self._chain, name, *map(_bytes, inputs))
        path = self.folder / f"{self._number:06d}.npz"
        found = _read(path, digest)
        if found is None:
            inner = self.folder / path.stem
            with _within(Steps(inner, digest)):
                found = _arrays(compute)
            with whole_file(path) as temporary:
                named: dict[str, Any] = {DIGEST: np.array(digest), **{f"a{i}": one for i, one in enumerate(found)}}
                np.savez(temporary, **named)
            shutil.rmtree(inner, ignore_errors=True)
        self._chain, self._number = _hash(digest, *map(_bytes, found)), self._number + 1
        return found


_KEPT: ContextVar[Steps | None] = ContextVar("steps", default=None)


def step(name: str, compute: Callable[[], Sequence[Any]], *inputs: Any) -> list[np.ndarray]:
    """The arrays that `compute` gives; those kept of an earlier run where `keep_steps` found them.

    Args:
        name: of what is computed.
        compute: returns numbers or arrays; it is not called where the step is found.
        inputs: arrays on which the result depends besides the steps before.
    """
    kept = _KEPT.get()
    return _arrays(compute) if kept is None else kept.step(name, compute, inputs)


def steps_of_rows(
    name: str, compute: Callable[[np.ndarray], Sequence[Any]], rows: np.ndarray, count: int
) -> list[np.ndarray]:
    """The arrays (N, ...) that `compute` gives for rows (N, ...), each `count` rows or more as a step.

    So what is lost by a kill does not grow with the number of rows. Rows that make one step alone are just computed.
    """
    parts = np.array_split(rows, max(len(rows) // count, 1))
    if len(parts) == 1:
        return _arrays(lambda: compute(rows))
    found = [step(name, partial(compute, part), part) for part in parts]
    return [np.concatenate(arrays) for arrays in zip(*found, strict=True)]


@contextmanager
def keep_steps(folder: Path, identity: Mapping[str, Any]) -> Iterator[None]:
    """Keep the steps of the block in a folder, and find those of an earlier run of the same identity there.

    The folder is removed when the block ends well. Otherwise it stays, and an OSError says so.

    Args:
        identity: name -> JSON value of all that the result depends on: data, settings, versions, machine.
    """
    digest = _hash(json.dumps(identity, sort_keys=True, default=str))
    try:
        with _within(Steps(folder, digest)):
            yield
    except OSError as error:
        error.add_note(f"What was computed is in {folder}; the same command goes on there.")
        raise
    shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def _within(steps: Steps) -> Iterator[None]:
    before = _KEPT.set(steps)
    try:
        yield
    finally:
        _KEPT.reset(before)


def _read(path: Path, digest: str) -> list[np.ndarray] | None:
    """The arrays of a step; None where it is not there, is of something else, or is damaged."""
    try:
        with np.load(path, allow_pickle=False) as file:
            if str(file[DIGEST]) != digest:
                return None
            return [file[f"a{i}"] for i in range(len(file.files) - 1)]
    except BROKEN_ARCHIVE:
        return None


def _arrays(compute: Callable[[], Sequence[Any]]) -> list[np.ndarray]:
    """What it gives, in the memory order that a file has: sums depend on the order of their terms."""
    return [np.asarray(array, order="C") for array in compute()]


def _bytes(value: Any) -> bytes:
    array = np.asarray(value)
    return f"{array.dtype.str}{array.shape}".encode() + array.tobytes()


def _hash(*parts: str | bytes) -> str:
    digest = hashlib.sha256()
    for part in parts:
        data = part.encode() if isinstance(part, str) else part
        digest.update(len(data).to_bytes(8, "little") + data)
    return digest.hexdigest()

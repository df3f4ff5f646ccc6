"""Checkpoints of a run: written whole or not at all, checked on reading, the last two kept.

    FOLDER/<env_steps>/state      arrays, by orbax; in pretraining <env_steps>.<what is done of it>
                       meta.json  configuration, counters, and length and checksum of every file
"""

from __future__ import annotations

import dataclasses
import json
import logging
import os
import re
import shutil
import sys
import time
import uuid
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dreamer.training import parallel

KEEP = 2
LEAST_S, SHARE = 60.0, 0.05
"""Time between checkpoints [s] and share of the run's time that they take at most, where no interval is asked for."""
UNFINISHED = ".unfinished-"
SCHEMA = 1
LEARNED = ("params.", "agent.params.", "agent.average.")
"""Where a state has parameters that are learned. An infinite one of a vehicle, in env_state.params, means no limit."""
ENTRIES = {"config": dict, "files": dict, "env_steps": int, "wall_s": int | float}
"""Entries of meta.json and their kinds."""


class CheckpointError(ValueError):
    """A checkpoint that cannot be used."""


Rows = tuple[str, int, int]


class Moment(NamedTuple):
    """When in a training a checkpoint is written."""

    env_steps: int
    """Names the checkpoint."""
    wall_s: float = 0.0
    """Time trained so far [s]."""
    pretraining: int = 0
    """Steps and updates made so far where no counted step has been; part of the name."""


class Pace:
    """When the next checkpoint is due; `with pace:` around the writing of each."""

    def __init__(self, every_s: float | None) -> None:
        """`every_s`: time between two [s]; None goes by what they take."""
        self._every_s, self._took = every_s, 0.0
        self._began = self._ended = time.monotonic()

    def __enter__(self) -> None:
        self._began = time.monotonic()

    def __exit__(self, *error: object) -> None:
        self._ended = time.monotonic()
        self._took = self._ended - self._began

    @property
    def every_s(self) -> float:
        """Time from the end of the last one to the next [s]."""
        return max(LEAST_S, self._took * (1 / SHARE - 1)) if self._every_s is None else self._every_s

    def due(self) -> bool:
        """Whether it is time."""
        return time.monotonic() - self._ended >= self.every_s


def save(
    folder: Path, state: Any, config: Any, moment: Moment, rows: Rows | None = None, seeds: int = 0
) -> Path:
    """Write a checkpoint and return its path; older ones beyond the last two are removed afterwards.

    Args:
        folder: of all checkpoints.
        state: pytree of arrays; typed random keys are allowed.
        config: dataclass with a default for every field; saved beside it and compared on reading.
        moment: of the training.
        rows: (path prefix, used rows, all rows): leaves below the prefix whose first axis has `all rows` are cut to the
            used ones, so that a replay that is not full costs no more than it holds.
        seeds: in a state of several seeds, how many; each leaf has them in its first axis.

    Raises:
        CheckpointError: parameters that are no finite numbers, of all seeds; earlier checkpoints stay.
    """
    import orbax.checkpoint as ocp

    folder.mkdir(parents=True, exist_ok=True)
    _remove_unfinished(folder)
    env_steps, wall_s, pretraining = moment
    target = folder / (f"{env_steps:012d}.{pretraining:012d}" if pretraining else f"{env_steps:012d}")
    arrays = {name: _to_numpy(leaf, name, rows) for name, leaf in _named_leaves(state).items()}
    _check_parameters(folder, arrays, seeds)
    if not parallel.is_first_process():
        return target
    temporary = folder / f"{UNFINISHED}{target.name}-{uuid.uuid4().hex}"  # an interrupted writer may still use its own
    temporary.mkdir()  # with the user's own rights: colleagues resume and evaluate too
    try:
        with _os_errors(target), _checkpointer(ocp) as writer:
            writer.save((temporary / "state").resolve(), {k: v for k, v in arrays.items() if v.size})
        meta = {
            "schema": SCHEMA,
            "env_steps": env_steps,
            "wall_s": wall_s,
            "config": dataclasses.asdict(config),
            "files": {name: _fingerprint(temporary / name) for name in _files(temporary)},
        }
        (temporary / "meta.json").write_text(json.dumps(meta, indent=1))
        if target.exists():
            os.replace(target, temporary.with_name(f"{temporary.name}.old"))
        os.replace(temporary, target)
        _remove_unfinished(folder)
    except (KeyboardInterrupt, SystemExit):
        _hush_writer()
        raise
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    for old in complete(folder)[:-KEEP]:
        shutil.rmtree(old, ignore_errors=True)
    return target


def _check_parameters(folder: Path, arrays: dict[str, np.ndarray], seeds: int) -> None:
    """Refuse to keep a network that has diverged, in place of an earlier one that works; one seed of several may."""
    found = {name: array for name, array in arrays.items() if name.startswith(LEARNED)}
    finite = {name: np.isfinite(array.astype(np.float32)).reshape(seeds or 1, -1).all(1)
              for name, array in found.items()}  # fmt: skip
    wrong = [name for name, each in finite.items() if not each.all()]
    good = np.all(list(finite.values()), axis=0)
    if wrong and not good.any():
        there = ", ".join(path.name for path in complete(folder)) or "none"
        raise CheckpointError(
            f"{folder}: {len(wrong)} of {len(found)} arrays of parameters hold values that are no finite numbers (such "
            f"as {wrong[0]}), so nothing is written. The training has diverged. Look for rewards or observations of "
            "the environment that are NaN, infinite or very large, or lower the learning rate, and start in a new "
            f"folder. Checkpoints from before, here: {there}."
        )
    if wrong:
        lost = ", ".join(str(place) for place in np.flatnonzero(~good))
        warnings.warn(f"{folder}: the training has diverged for {int((~good).sum())} of {seeds} seeds (places {lost}, "
                      f"counted from 0): {wrong[0]}, say, holds values that are no finite numbers. The other seeds go "
                      "on. Leave these out of what you compare.", stacklevel=2)


@contextmanager
def _os_errors(target: Path) -> Iterator[None]:
    """Turn the errors by which tensorstore reports a full disk, say, into an OSError that names the checkpoint."""
    logger = logging.getLogger("absl")  # orbax logs the tracebacks of its threads besides
    before, logger.disabled = logger.disabled, True
    try:
        yield
    except ValueError as error:
        code = re.search(r"os_error_code='(\d+)'", str(error))
        if code is None:
            raise
        raise OSError(int(code[1]), os.strerror(int(code[1])), str(target)) from None
    finally:
        logger.disabled = before


def is_whole(state: Any) -> bool:
    """Whether all arrays of an interrupted run are there: an interrupt may come while the next ones replace them."""
    return not any(isinstance(leaf, jax.Array) and leaf.is_deleted() for leaf in jax.tree.leaves(state))


def _hush_writer() -> None:
    """Threads of an interrupted writer lose their folder and their loop: that is no news to whoever stopped it."""
    logging.getLogger("absl").setLevel(logging.CRITICAL)
    show = sys.excepthook

    def hook(kind: type[BaseException], error: BaseException, trace: Any) -> None:
        if "Event loop is closed" not in str(error):
            show(kind, error, trace)

    sys.excepthook = hook


def _remove_unfinished(folder: Path) -> None:
    """Remove what a killed process has left; one process at a time writes checkpoints."""
    if parallel.is_first_process():
        for path in folder.glob(f"{UNFINISHED}*"):
            shutil.rmtree(path, ignore_errors=True)


def complete(folder: Path) -> list[Path]:
    """Checkpoints in `folder`, oldest first."""
    return sorted(path for path in folder.glob("[0-9]*") if (path / "meta.json").is_file())


def remove(path: Path) -> None:
    """Delete one checkpoint."""
    shutil.rmtree(path)


def restore(folder: Path, template: Any, config: Any) -> tuple[Any, dict[str, Any]] | None:
    """State and meta.json of the newest usable checkpoint, or None where there is none at all.

    A damaged checkpoint is passed over with a warning if an older one is whole.

    Args:
        folder: of all checkpoints.
        template: a state of the wanted structure; gives shapes, dtypes and what is not stored. What is numpy's array in
            it is one in the answer, the rest are JAX's.
        config: must equal the saved one.

    Raises:
        CheckpointError: no usable one, or one of another configuration; names the file, the rule and the remedy.
    """
    paths = complete(folder)
    for path in reversed(paths):
        try:
            return load(path, template, config)
        except Damaged as error:
            if path == paths[0]:
                raise CheckpointError(str(error)) from error
            warnings.warn(f"{error} Going on from the one before it.", stacklevel=2)
    return None


class Damaged(CheckpointError):
    """A checkpoint whose files are not what was written."""


def load(path: Path, template: Any, config: Any) -> tuple[Any, dict[str, Any]]:
    """Read one checkpoint. Arguments and errors as for `restore`."""
    import orbax.checkpoint as ocp

    meta = _read_meta(path)
    _check_config(path, meta["config"], config)
    for name, expected in meta["files"].items():
        if not (path / name).is_file() or _fingerprint(path / name) != expected:
            raise Damaged(
                f"{path / name}: length or checksum is not what was written, so the file is damaged. "
                f"Delete {path} and resume from an older checkpoint, or start in a new folder."
            )
    try:
        with _checkpointer(ocp) as reader:
            arrays = reader.restore((path / "state").resolve())
    except MemoryError:
        raise
    except Exception as error:  # a file that meta.json does not list, say; orbax's errors have no common class
        reason = " ".join(str(error).split())[:160]
        raise Damaged(f"{path / 'state'}: cannot be read ({reason}). Delete {path} and resume from an older "
                      "checkpoint, or start in a new folder.") from None
    leaves = {name: _from_numpy(path, name, leaf, arrays) for name, leaf in _named_leaves(template).items()}
    return jax.tree.unflatten(jax.tree.structure(template), list(leaves.values())), meta


def _checkpointer(ocp: Any) -> Any:
    """Reader and writer of plain arrays, which does not wait for other processes."""
    if jax.process_count() == 1:
        return ocp.PyTreeCheckpointer()
    index = jax.process_index()
    alone = ocp.options.MultiprocessingOptions(
        primary_host=index, active_processes={index}, barrier_sync_key_prefix=f"process{index}"
    )
    handler = ocp.PyTreeCheckpointHandler(multiprocessing_options=alone)
    return ocp.Checkpointer(handler, multiprocessing_options=alone)


def _read_meta(path: Path) -> dict[str, Any]:
    try:
        meta = json.loads((path / "meta.json").read_text(encoding="utf-8"))
        if meta["schema"] == SCHEMA and all(isinstance(meta.get(name), kind) for name, kind in ENTRIES.items()):
            return meta
        problem = f"schema {str(meta['schema'])[:60]} is not {SCHEMA}, or an entry is missing or of another kind"
    except FileNotFoundError:
        raise Damaged(f"{path}: there is no such checkpoint. Resume from an older one or start anew.") from None
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        problem = f"not readable as JSON with the expected entries ({str(error)[:160]})"
    raise Damaged(f"{path / 'meta.json'}: {problem}. Delete {path} or use the version that wrote it.")


def _check_config(path: Path, saved: dict[str, Any], config: Any) -> None:
    current = json.loads(json.dumps(dataclasses.asdict(config)))
    # A field that is newer than the checkpoint had the value that is now its default.
    saved = {**json.loads(json.dumps(dataclasses.asdict(type(config)()))), **saved}
    names = sorted(set(saved) | set(current))
    changed = [f"{n}: saved {saved.get(n)}, now {current.get(n)}" for n in names if saved.get(n) != current.get(n)]
    if changed:
        raise CheckpointError(
            f"{path / 'meta.json'}: the run was made with another configuration ({'; '.join(changed)}). A run is "
            "resumed with its own configuration: restore those values, or start in a new folder."
        )


def _named_leaves(tree: Any) -> dict[str, Any]:
    paths = jax.tree_util.tree_flatten_with_path(tree)[0]
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in paths}


def _is_key(leaf: Any) -> bool:
    return hasattr(leaf, "dtype") and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _to_numpy(leaf: Any, name: str, rows: Rows | None) -> np.ndarray:
    cut = rows is not None and name.startswith(rows[0]) and np.shape(leaf)[:1] == (rows[2],)
    if isinstance(leaf, jax.Array) and not (leaf.is_fully_addressable or leaf.is_fully_replicated):
        leaf = jax.jit(jax.random.key_data)(leaf) if _is_key(leaf) else leaf
        whole = parallel.to_host(leaf)
        return whole[: rows[1]] if rows is not None and cut else whole
    if rows is not None and cut:
        leaf = leaf[: rows[1]]
    return np.asarray(jax.device_get(jax.random.key_data(leaf) if _is_key(leaf) else leaf))


def _from_numpy(path: Path, name: str, leaf: Any, arrays: dict[str, Any]) -> Any:
    plain = jax.eval_shape(jax.random.key_data, leaf) if _is_key(leaf) else leaf
    shape = tuple(plain.shape) if hasattr(plain, "shape") else np.shape(plain)
    if int(np.prod(shape)) == 0:
        return leaf
    if name not in arrays:
        raise CheckpointError(
            f"{path / 'state'}: no array '{name}', which this program needs. The environment or the program has "
            "changed since: resume with the version that wrote it, or start in a new folder."
        )
    value = np.asarray(arrays[name])
    dtype = np.asarray(plain).dtype if not hasattr(plain, "dtype") else plain.dtype
    if value.shape[1:] != shape[1:] or value.ndim != len(shape) or value.shape[:1] > shape[:1] or value.dtype != dtype:
        raise CheckpointError(
            f"{path / 'state'}: array '{name}' is {value.dtype}{value.shape} where {dtype}{shape} is needed. The "
            "environment has changed since: use the same one, or start in a new folder."
        )
    if value.shape != shape:
        value = np.concatenate([value, np.zeros((shape[0] - value.shape[0], *shape[1:]), value.dtype)])
    if isinstance(leaf, np.ndarray):
        return value  # it belongs to the host
    # A copy of its own: the state is donated, and memory shared with numpy must not be.
    array = jnp.array(value, copy=True)
    return jax.random.wrap_key_data(array, impl=jax.random.key_impl(leaf)) if _is_key(leaf) else array


def _files(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def _fingerprint(path: Path) -> list[int]:
    """Length [byte] and CRC-32 of a file."""
    checksum, length = 0, 0
    with path.open("rb") as file:
        while chunk := file.read(1 << 24):
            checksum, length = zlib.crc32(chunk, checksum), length + len(chunk)
    return [length, checksum]

"""A training run over several devices and hosts: instances, replay and batches are split, parameters are everywhere.

The program stays the one of a single device. Only the placement of its arrays is said here; XLA adds the communication,
among it the sum of the gradients. Every draw of random numbers is that of a single device, so that results differ by
the order of floating-point sums alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

AXIS = "instance"


def make_mesh(devices: Sequence[jax.Device], instances: int, batch_size: int) -> Mesh | None:
    """One axis over these devices; None for a single one, which needs no placement.

    Raises:
        ValueError: the instances or the sequences of a batch do not split evenly.
    """
    if len(devices) < 2 and jax.process_count() == 1:
        return None
    for count, what in ((instances, "instances"), (batch_size, "sequences of a batch")):
        if count % len(devices):
            raise ValueError(f"{count} {what} do not split evenly over {len(devices)} devices; change one of them.")
    return Mesh(np.asarray(devices), (AXIS,))


def split(mesh: Mesh | None, tree: Any, axis: int) -> Any:
    """The tree with this axis of its leaves split over the devices; inside a compiled function."""
    if mesh is None:
        return tree
    return jax.lax.with_sharding_constraint(tree, NamedSharding(mesh, PartitionSpec(*[None] * axis, AXIS)))


def state_shardings(mesh: Mesh, state: Any, instances: int) -> Any:
    """Placement of each leaf of a `TrainState` (or of its shapes)."""
    whole, rows = NamedSharding(mesh, PartitionSpec()), NamedSharding(mesh, PartitionSpec(AXIS))
    columns = NamedSharding(mesh, PartitionSpec(None, AXIS))

    def of(path: tuple, leaf: Any) -> NamedSharding:
        field = getattr(path[0], "name", "")
        if field == "replay":
            return columns if len(leaf.shape) >= 2 else whole
        mine = field in ("env_state", "transition", "carry", "episode_return", "episode_length")
        return rows if mine and leaf.shape[:1] == (instances,) else whole

    return jax.tree_util.tree_map_with_path(of, state)


def replicated(mesh: Mesh) -> NamedSharding:
    """A copy on every device."""
    return NamedSharding(mesh, PartitionSpec())


def place(tree: Any, shardings: Any) -> Any:
    """The tree, whose values every process holds, placed on the devices."""
    return jax.tree.map(_place, tree, shardings)


def _place(leaf: Any, sharding: NamedSharding) -> jax.Array:
    if jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        wrap = jax.jit(lambda data: jax.random.wrap_key_data(data, impl=jax.random.key_impl(leaf)),
                       out_shardings=sharding)  # fmt: skip
        return wrap(_place(jax.random.key_data(leaf), sharding))
    value = np.asarray(leaf)
    return jax.make_array_from_callback(value.shape, sharding, lambda index: value[index])


def to_host(leaf: jax.Array) -> np.ndarray:
    """All of an array as numpy's, wherever its parts lie. Every process must call it."""
    if leaf.is_fully_addressable or leaf.is_fully_replicated:
        return np.asarray(leaf)
    from jax.experimental import multihost_utils

    return np.asarray(multihost_utils.process_allgather(leaf, tiled=True))


def wait_for_all(what: str) -> None:
    """Return when every process has come here; at once where there is only one."""
    if jax.process_count() > 1:
        from jax.experimental import multihost_utils

        multihost_utils.sync_global_devices(what)


def agree(flag: bool) -> bool:
    """The first process's answer, on all of them: decisions by the clock must not differ."""
    if jax.process_count() == 1:
        return flag
    from jax.experimental import multihost_utils

    return bool(multihost_utils.broadcast_one_to_all(np.asarray(flag)))


def is_first_process() -> bool:
    """Whether this process writes the files."""
    return jax.process_index() == 0

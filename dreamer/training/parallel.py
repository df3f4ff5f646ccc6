"""A training run over several devices and hosts: instances, replay and batches are split, parameters are everywhere.

Collecting and the replay stay the program of a single device: only the placement of their arrays is said here, and XLA
adds the communication. A gradient step is cut by hand (`over_batch`): each device runs the single device's program on
its own sequences. XLA cannot do that, since time leads: rows merged from (T, B) with B split are no split that it
knows, so it would bring all sequences to every device. What concerns the whole batch says so there, by `mean`, `total`,
`gather` and `own_rows`, which change nothing on a single device. Every draw of random numbers is that of a single
device, so that results differ by the order of floating-point sums alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

AXIS = "instance"


def make_mesh(devices: Sequence[jax.Device], instances: int, batch_size: int) -> Mesh | None:
    """One axis over these devices; None for a single one, which needs no placement.

    Raises:
        ValueError: a device is there twice, or the instances or the sequences of a batch do not split evenly.
    """
    if len(devices) < 2 and jax.process_count() == 1:
        return None
    for count, what in ((instances, "instances"), (batch_size, "sequences of a batch")):
        if count % len(devices):
            raise ValueError(f"{count} {what} do not split evenly over {len(devices)} devices; change one of them.")
    if len(set(devices)) < len(devices):
        raise ValueError(f"devices = {list(devices)}: one of them is there twice. Leave one out.")
    return Mesh(np.asarray(devices), (AXIS,))


def over_batch(mesh: Mesh | None, function: Callable[..., Any], in_axes: Any, out_axes: Any) -> Callable[..., Any]:
    """The function with each device computing its own share of the batch; unchanged without a mesh.

    Args:
        mesh: from `make_mesh`.
        function: treats its sequences alike and apart, but for the functions below.
        in_axes: the axis of each argument that is split, as for `jax.vmap`: a number, None for a copy on every device,
            or a tree of them.
        out_axes: that of the results. What has none must be the same on every device.
    """
    if mesh is None:
        return function

    def specs(axes: Any) -> Any:
        return jax.tree.map(_spec, axes, is_leaf=lambda axis: axis is None)

    # Gradients are those of a device's own share (check_vma would sum them one by one, where they are used).
    return jax.shard_map(function, mesh=mesh, in_specs=specs(in_axes), out_specs=specs(out_axes), check_vma=False)


def _spec(axis: int | None) -> PartitionSpec:
    return PartitionSpec() if axis is None else PartitionSpec(*[None] * axis, AXIS)


def _divided() -> bool:
    """Whether this is traced inside `over_batch`."""
    return AXIS in jax.sharding.get_abstract_mesh().manual_axes


def mean(tree: Any) -> Any:
    """The means over the devices of what each has found in its share."""
    return jax.lax.pmean(tree, AXIS) if _divided() else tree


def total(tree: Any) -> Any:
    """The sums over the devices of what each has found in its share."""
    return jax.lax.psum(tree, AXIS) if _divided() else tree


def gather(x: jax.Array, axis: int) -> jax.Array:
    """The shares of all devices joined along an axis, for what needs the whole batch."""
    return jax.lax.all_gather(x, AXIS, axis=axis, tiled=True) if _divided() else x


def devices() -> int:
    """Devices that share a batch; 1 outside of `over_batch`."""
    return jax.lax.axis_size(AXIS) if _divided() else 1


def own_columns(column: jax.Array, count: int) -> tuple[jax.Array, jax.Array]:
    """Where columns of an array that is split over the devices lie here, and whether they do, else it is `count`.

    Args:
        column: int32 numbers in the whole array.
        count: columns on each device.
    """
    if not _divided():
        return column, jnp.ones(column.shape, bool)
    here = column - jax.lax.axis_index(AXIS) * count
    mine = (here >= 0) & (here < count)
    return jnp.where(mine, here, count), mine


def deal(x: jax.Array, mine: jax.Array, axis: int) -> jax.Array:
    """To each device its share along an axis, of entries of which each lies on one device.

    Args:
        x: every device's entries, for the whole batch.
        mine: (B,) bool, which of them count.
        axis: that of the B sequences.
    """
    if not _divided():
        return x
    x = jnp.where(mine.reshape(mine.shape + (1,) * (x.ndim - axis - 1)), x, jnp.zeros((), x.dtype))
    kind = jnp.uint8 if x.dtype == bool else x.dtype
    return jax.lax.psum_scatter(x.astype(kind), AXIS, scatter_dimension=axis, tiled=True).astype(x.dtype)


def own_rows(draw: Callable[[int], jax.Array], lead: tuple[int, ...]) -> jax.Array:
    """Random numbers for the rows of this device: (steps, M, ...) of those that a single device draws for all rows.

    Args:
        draw: number of rows -> array (steps, rows, ...).
        lead: axes that were merged into the M rows here; the last one is split over the devices.
    """
    rows = math.prod(lead)
    if not _divided():
        return draw(rows)
    count = jax.lax.axis_size(AXIS)
    everyone = draw(rows * count)
    steps, *each = everyone.shape[0], *everyone.shape[2:]
    everyone = everyone.reshape(steps, rows // lead[-1], count, lead[-1], *each)
    own = jax.lax.dynamic_index_in_dim(everyone, jax.lax.axis_index(AXIS), 2, keepdims=False)
    return own.reshape(steps, rows, *each)


def state_shardings(mesh: Mesh, state: Any, instances: int) -> Any:
    """Placement of each leaf of a `TrainState` (or of its shapes)."""
    whole, rows = NamedSharding(mesh, PartitionSpec()), NamedSharding(mesh, PartitionSpec(AXIS))
    columns = NamedSharding(mesh, PartitionSpec(None, AXIS))

    def of(path: tuple, leaf: Any) -> NamedSharding:
        field = getattr(path[0], "name", "")
        if field == "replay":
            return columns if len(leaf.shape) >= 2 else whole
        mine = field in ("env_state", "transition", "carry", "episode_return", "episode_length", "noise")
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

"""Drives in pieces side by side: on an accelerator a replay takes as long as its steps come one after the other.

Wheels, controllers and delays forget: pieces are replayed at the same time, each from a while before it begins with the
speeds measured there, and put together to one drive. What lasts longer (a controller's integral, a battery that sags)
begins anew in each: searches use pieces on their way and end on whole drives.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

LENGTH = 2.75  # s, of a piece
OVERLAP = 2.0
"""Time that is replayed before each [s]: whitened motion differs by 0.2 of its noise (0.05 with 3 s, 0.3 with 1.5 s).
"""


def count(duration: float) -> int:
    """How many pieces a drive of so many seconds is cut into."""
    return max(int(duration / LENGTH), 1)


def begins(records: int, pieces: int) -> np.ndarray:
    """(W,) records at which pieces begin, evenly."""
    return np.arange(pieces) * -(-records // pieces)


def record(
    drive: Callable[[jax.Array, jax.Array], jax.Array], command: jax.Array, start: jax.Array, speeds: jax.Array,
    overlap: int, poses: Sequence[tuple[slice, jax.Array]],
) -> jax.Array:
    """What is recorded (R + 1, C) of a drive in pieces.

    Args:
        drive: (start (5,), command (T, K, 2)) -> records (T + 1, C) of a drive from there.
        command: (R, K, 2) of the whole drive.
        start: (5,) x, y, yaw, v, omega of it.
        speeds: (W, 2) where pieces are begun, `overlap` records before each.
        poses: columns x, y, yaw of each pose that goes on from piece to piece, and where it begins (3,).
    """
    records, pieces = len(command), len(speeds)
    length = -(-records // pieces)
    before = jnp.broadcast_to(start[3:], (overlap, *command.shape[1:]))
    after = jnp.broadcast_to(command[-1:], (pieces * length - records, *command.shape[1:]))
    held = jnp.concatenate([before, command, after])
    index = begins(records, pieces)[:, None] + np.arange(overlap + length)
    starts = jnp.concatenate([jnp.broadcast_to(start[:3], (pieces, 3)), speeds], axis=1)
    paths = jax.vmap(drive)(starts, held[index])[:, overlap:]  # (W, L + 1, C)
    whole = [paths[0], *paths[1:, 1:]]
    for columns, at in poses:
        for piece in range(pieces):
            first = paths[piece, 0, columns]
            turn = at[2] - first[2]
            cos, sin = jnp.cos(turn), jnp.sin(turn)
            x, y, yaw = (whole[piece][:, columns] - first).T
            moved = jnp.stack([at[0] + cos * x - sin * y, at[1] + sin * x + cos * y, at[2] + yaw], axis=-1)
            whole[piece] = whole[piece].at[:, columns].set(moved)
            at = moved[-1]
    return jnp.concatenate(whole)[: records + 1]

"""NumPy or, under a trace, JAX for an array; quaternions; and points by whose differences slopes are found."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def namespace(array: Any) -> Any:
    """`numpy` or `jax.numpy`: whose functions take the array."""
    return array.__array_namespace__() if hasattr(array, "__array_namespace__") else np


def added(array: Any, index: Any, part: Any) -> Any:
    """The array with `part` added at an index: NumPy's in place, of JAX's a new one."""
    if isinstance(array, np.ndarray):
        array[index] += part
        return array
    return array.at[index].add(part)


def rotated(quaternion: Any, vector: Any) -> Any:
    """A vector (3,) turned by quaternions (..., 4) of w, x, y, z."""
    np_ = namespace(quaternion)
    cross = 2 * np_.cross(quaternion[..., 1:], vector)
    return vector + quaternion[..., :1] * cross + np_.cross(quaternion[..., 1:], cross)


def moved(poses: Any, before: Any, after: Any) -> Any:
    """Poses (..., 3) of x, y, yaw after the planar motion that brings a pose `before` (..., 3) to `after`."""
    xp, turn = namespace(poses), after[..., 2] - before[..., 2]
    cos, sin = xp.cos(turn), xp.sin(turn)
    x, y, yaw = (poses[..., i] - before[..., i] for i in range(3))
    return xp.stack([after[..., 0] + cos * x - sin * y, after[..., 1] + sin * x + cos * y, after[..., 2] + yaw],
                    axis=-1)


def quaternion_product(a: jax.Array, b: jax.Array) -> jax.Array:
    """Rotation b, then a (w, x, y, z)."""
    return jnp.stack([
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    ])


@dataclass(frozen=True)
class Quotients:
    """Pairs of points (..., P, P) that differ in one of P coordinates each, of NumPy or, under a trace, of JAX.

    df/dx_p = (f(above_p) - f(below_p)) / (above_pp - below_pp)
    """

    above: Any
    below: Any

    @classmethod
    def central(cls, x: Any, sizes: Any, low: float = 0.0, high: float = 1.0) -> Quotients:
        """About x (..., P), `sizes` (P,) to both sides; one-sided at the bounds `low` and `high`."""
        xp = namespace(x)
        steps = sizes * xp.eye(x.shape[-1])
        above, below = (xp.clip(x[..., None, :] + sign * steps, low, high) for sign in (1, -1))
        return cls(above, below)

    @classmethod
    def forward(cls, x: np.ndarray, sizes: np.ndarray) -> Quotients:
        """From x (P,), where f is known already, `sizes` (P,) upwards."""
        return cls(x + np.diag(sizes), np.broadcast_to(x, (len(x), len(x))))

    def mapped(self, coordinates: Callable[[Any], Any]) -> Quotients:
        """The same points in other coordinates, by which the slopes then are."""
        return Quotients(coordinates(self.above), coordinates(self.below))

    def along(self, at: np.ndarray, simulate: Callable[[np.ndarray], Any]) -> tuple[Any, Any]:
        """What `simulate` gives at points (N, P), and its derivatives (N, ..., P) about them, by one call of it."""
        count, size = at.shape
        found = simulate(np.concatenate([at, self.above.reshape(-1, size), self.below.reshape(-1, size)]))

        def slope(leaf: Any) -> np.ndarray:
            above, below = np.asarray(leaf, float)[count:].reshape(2, count, size, *leaf.shape[1:])
            return np.asarray(self.slopes(above, below))

        return jax.tree.map(lambda leaf: np.asarray(leaf)[:count], found), jax.tree.map(slope, found)

    @property
    def points(self) -> Any:
        """(..., 2 P, P) all points, those above first."""
        return namespace(self.above).concatenate([self.above, self.below], axis=-2)

    def slopes(self, above: Any, below: Any) -> Any:
        """Derivatives (..., K, P) from values (..., P, K) at both sides; K may be any axes."""
        xp = namespace(above)
        spans = xp.diagonal(self.above - self.below, axis1=-2, axis2=-1)  # (..., P)
        more = above.ndim - spans.ndim
        return xp.moveaxis((above - below) / spans.reshape(*spans.shape, *(1,) * more), spans.ndim - 1, -1)

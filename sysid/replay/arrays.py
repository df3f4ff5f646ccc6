"""What lets one text serve NumPy's arrays and, under a trace, those of JAX."""

from __future__ import annotations

from typing import Any

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

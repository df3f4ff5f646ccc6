"""What the learner cannot work with, refused by name before anything is compiled or written."""

from __future__ import annotations

import math
import numbers
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

INT32 = 2**31 - 1
"""Largest counter and seed: they are 32-bit integers on the device."""


def is_whole(value: Any) -> bool:
    """Whether a value is an integer of Python or numpy, and no bool."""
    return isinstance(value, numbers.Integral) and not isinstance(value, bool)


def whole(name: str, value: Any, low: int, high: float = math.inf) -> int:
    """The value as an int; 1e6 and numpy's integers are whole numbers too.

    Raises:
        ValueError: names the argument, the value, the rule and the remedy.
    """
    fits = is_whole(value) or (isinstance(value, float) and value.is_integer())
    if not fits or not low <= value <= high:
        end = f"from {low} to {high}" if high < math.inf else f"of at least {low}"
        raise ValueError(f"{name} = {value!r}: it must be a whole number {end}. Correct it.")
    return int(value)


def check_duration(name: str, value: Any) -> None:
    """Raise ValueError unless the value is a time of at least 0 s, or inf."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not value >= 0:
        raise ValueError(f"{name} = {value!r}: it must be a time [s] of at least 0. Correct it.")


def check_kind(name: str, value: Any, kind: type, remedy: str) -> None:
    """Raise ValueError unless an argument is of its kind."""
    if not isinstance(value, kind):
        raise ValueError(f"{name} is a {type(value).__name__}; it must be a {kind.__name__}. {remedy}")


def as_seeds(seed: Any) -> int | list[int]:
    """A seed, or several different ones, as ints of Python.

    Raises:
        ValueError: none, one that is there twice, or one beyond 32 bits, which would be cut to another one.
    """
    if not isinstance(seed, Sequence | np.ndarray) or isinstance(seed, str) or np.ndim(seed) == 0:
        return whole("seed", seed, -INT32 - 1, INT32)
    seeds = [whole(f"seed[{index}]", one, -INT32 - 1, INT32) for index, one in enumerate(seed)]
    if not seeds or len(set(seeds)) < len(seeds):
        raise ValueError(f"seed = {seeds}: several seeds must be different ones, and at least one. Correct them.")
    return seeds


def check_same(what: str, before: Any, after: Any) -> None:
    """Raise ValueError where a pytree that each step hands on changes: its entries, their shapes or their types.

    Args:
        what: the pytree in words.
        before: as the first step gets it; arrays, or their shapes.
        after: as the step returns it.
    """
    old, new = _kinds(before), _kinds(after)
    for name in dict.fromkeys([*old, *new]):
        if old.get(name) != new.get(name):
            raise ValueError(f"{what}{name} is {new.get(name, 'missing')} after a step, and {old.get(name, 'missing')} "
                             "before it. A step must return what it got: the same entries, shapes and types. Correct "
                             "reset or step.")


def _kinds(tree: Any) -> dict[str, str]:
    """Type and shape of each leaf, as "float32[4, 2]", by its place in the tree."""
    leaves = jax.tree_util.tree_flatten_with_path(tree)[0]
    return {jax.tree_util.keystr(path): kind_of(leaf) for path, leaf in leaves}


def kind_of(leaf: Any) -> str:
    """Type and shape of an array, a number or an array's shape, as "float32[4, 2]"."""
    if not hasattr(leaf, "dtype") and not isinstance(leaf, bool | numbers.Number):
        return f"a {type(leaf).__name__}"
    dtype = leaf.dtype if hasattr(leaf, "dtype") else jnp.result_type(leaf)
    if not jnp.issubdtype(dtype, jax.dtypes.extended):  # a constant of numpy is of 64 bits, until JAX takes it
        dtype = jax.dtypes.canonicalize_dtype(dtype)
    return f"{dtype}{list(np.shape(leaf))}"

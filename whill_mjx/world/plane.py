"""Vectors on the ground plane with x and y apart.

XLA computes arrays whose last axis has two entries one number at a time on a processor; these it computes by vectors.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct


@struct.dataclass
class Vector:
    """Vectors of any shape (...)."""

    x: jax.Array  # (...)
    y: jax.Array  # (...)

    @classmethod
    def of(cls, array: jax.Array) -> Vector:
        """Of an array (..., 2)."""
        return cls(array[..., 0], array[..., 1])

    @classmethod
    def at_angle(cls, angle: jax.Array) -> Vector:
        """The unit vector in a direction (...) [rad]."""
        return cls(jnp.cos(angle), jnp.sin(angle))

    def __add__(self, other: Vector) -> Vector:
        return Vector(self.x + other.x, self.y + other.y)

    def __sub__(self, other: Vector) -> Vector:
        return Vector(self.x - other.x, self.y - other.y)

    def __mul__(self, scale: jax.Array | float) -> Vector:
        return Vector(self.x * scale, self.y * scale)

    def dot(self, other: Vector) -> jax.Array:
        return self.x * other.x + self.y * other.y

    def cross(self, other: Vector) -> jax.Array:
        """Positive where the other lies to the left."""
        return self.x * other.y - self.y * other.x

    @property
    def left(self) -> Vector:
        """Turned to the left by a right angle."""
        return Vector(-self.y, self.x)

    @property
    def length(self) -> jax.Array:
        """Never quite 0, where its derivative would not exist."""
        return jnp.sqrt(self.dot(self) + 1e-12)

    @property
    def angle(self) -> jax.Array:
        """Direction [rad]."""
        return jnp.arctan2(self.y, self.x)

    def unit(self, otherwise: Vector) -> Vector:
        """Of length 1; another vector where it has no length."""
        length = self.length
        return choose(length > 1e-5, self * (1.0 / length), otherwise)

    def at(self, index: Any) -> Vector:
        """Entries of both parts, as an array gives them; None adds an axis."""
        return Vector(self.x[index], self.y[index])

    def stacked(self) -> jax.Array:
        """As an array (..., 2)."""
        return jnp.stack([self.x, self.y], -1)


def choose(condition: jax.Array, one: Vector, other: Vector) -> Vector:
    """One vector where a condition holds, else the other."""
    return Vector(jnp.where(condition, one.x, other.x), jnp.where(condition, one.y, other.y))


def largest(value: jax.Array, vector: Vector) -> tuple[jax.Array, Vector]:
    """Largest (N,) of values (M, N), and the vector (M, N) that belongs to it: the first of equals.

    A processor compares N at a time; `argmax` and a choice by its result take it many times as long.
    """
    most = value.max(0)
    number = jnp.arange(value.shape[0])[:, None]
    first = jnp.where(value == most, number, value.shape[0]).min(0)
    chosen = number == first
    return most, Vector(*(jnp.where(chosen, part, 0.0).sum(0) for part in (vector.x, vector.y)))

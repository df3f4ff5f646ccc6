"""Sums of few terms in one quantity, which may stand for a fitted table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

HARMONICS = 3


@dataclass(frozen=True)
class Term:
    """One term: its columns go into a sum together or not at all."""

    form: str
    """power, harmonic, sign, decay or log."""
    number: float
    """Exponent, harmonic, or the size over which it acts."""

    def of(self, z: np.ndarray) -> np.ndarray:
        """Values (K, c) at z (K,)."""
        match self.form:
            case "harmonic":
                return np.stack([np.sin(self.number * z), np.cos(self.number * z)], axis=-1)
            case "sign":
                return np.tanh(z / self.number)[:, None]
            case "decay":
                return np.exp(-z / self.number)[:, None]
            case "log":
                return np.log1p(np.maximum(z, 0.0) / self.number)[:, None]
            case "size":
                return np.abs(z)[:, None]
        return z[:, None] ** self.number

    def text(self, coefficients: np.ndarray) -> str:
        """The term with its coefficients (c,), with a sign in front."""
        value = float(coefficients[0])
        match self.form:
            case "harmonic":
                size, phase = float(np.hypot(*coefficients)), float(np.arctan2(coefficients[1], coefficients[0]))
                angle = "z" if self.number == 1 else f"{self.number:g} z"
                start = f" {'+' if phase >= 0 else '-'} {abs(phase):.2f}" if abs(phase) >= 0.005 else ""
                return f"+ {size:.3g} sin({angle}{start})"
            case "sign":
                body = f" tanh(z / {self.number:.3g})"
            case "decay":
                body = f" exp(-z / {self.number:.3g})"
            case "log":
                body = f" ln(1 + z / {self.number:.3g})"
            case "size":
                body = " |z|"
            case _:
                body = {0.0: "", 1.0: " z"}.get(self.number, f" z^{self.number:g}")
        return f"{'+' if value >= 0 else '-'} {abs(value):.3g}{body}"


def library(knots: np.ndarray, periodic: bool) -> tuple[Term, ...]:
    """Terms that make sense over a range of a quantity."""
    constant = Term("power", 0.0)
    if periodic:
        return (constant, *(Term("harmonic", float(k)) for k in range(1, HARMONICS + 1)))
    low, high = float(knots[0]), float(knots[-1])
    powers = [Term("power", float(k)) for k in (1, 2, 3)]
    if low < 0:
        return (constant, *powers, Term("size", 1.0), *(Term("sign", share * (high - low)) for share in (0.02, 0.1)))
    sizes = [share * high for share in (0.05, 0.07, 0.1, 0.14, 0.2, 0.28, 0.4, 0.57)]
    return (constant, *powers, *(Term("decay", size) for size in sizes), *(Term("log", size) for size in sizes[:4:2]))


def columns_of(terms: Sequence[Term], knots: np.ndarray) -> tuple[np.ndarray, list[list[int]]]:
    """Basis (2 K, T) of the tables - forces, then torques - and the columns of each term: its force's, its torque's."""
    parts, groups, start = [], [], 0
    for term in terms:
        values = term.of(knots)
        width = values.shape[1]
        parts.append(np.block([[values, np.zeros_like(values)], [np.zeros_like(values), values]]))
        groups.append(list(range(start, start + 2 * width)))
        start += 2 * width
    return np.concatenate(parts, axis=1), groups


def forward_selection(
    matrix: np.ndarray, moments: np.ndarray, size: int, groups: Sequence[Sequence[int]], most: int
) -> list[list[int]]:
    """Terms of the best sum of 1, 2, ... `most` terms: each joins the one before that lowers the squares most.

    Args:
        matrix, moments: products (P + T, P + T) and (P + T,) with the base's P = size columns in front, prior included.
        groups: columns of each term, counted after those of the base.
    """
    chosen: list[int] = []
    path = []
    while len(chosen) < min(most, len(groups)):
        gains = [-np.inf if k in chosen else explained(matrix, moments, size, groups, [*chosen, k])
                 for k in range(len(groups))]
        chosen = [*chosen, int(np.argmax(gains))]
        path.append(list(chosen))
    return path


def explained(matrix: np.ndarray, moments: np.ndarray, size: int, groups: Sequence[Sequence[int]],
              chosen: Sequence[int]) -> float:
    """Explained sum of squares with these terms beside the base."""
    order = [*range(size), *(size + i for k in chosen for i in groups[k])]
    inside = matrix[np.ix_(order, order)].copy()
    inside[np.diag_indices(len(order))] *= 1 + 1e-6
    inside[np.diag_indices(len(order))] += 1e-9
    return float(moments[order] @ np.linalg.solve(inside, moments[order]))


def in_words(terms: Sequence[Term], coefficients: Sequence[np.ndarray], half: int) -> str:
    """The sum of the forces (half 0) or torques (half 1), of coefficients (2 c,) of each term."""
    texts = [term.text(np.split(np.asarray(values), 2)[half]) for term, values in zip(terms, coefficients, strict=True)]
    return " ".join(texts).removeprefix("+ ")

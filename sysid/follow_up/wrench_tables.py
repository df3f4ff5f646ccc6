"""Regression of a residual on tables over one quantity, and on sums of few terms that may stand for them.

All products of columns (one a knot) are multiplied out by manoeuvre, so that fitting to some and asking the others is
algebra.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sysid.missing.unexplained import PHASES, WHEELS, align, wave_turns
from whill_mjx.effects.unnamed import ACROSS, KNOTS, MAP, PERIODIC, QUANTITIES

HARMONICS = 3


@dataclass(frozen=True)
class Term:
    """One term: its columns go into a sum together or not at all."""

    form: str  # harmonic, or one of `FORMS`
    number: float  # exponent, harmonic, or the size over which it acts

    def of(self, z: np.ndarray) -> np.ndarray:
        """Values (K, c) at z (K,)."""
        if self.form == "harmonic":
            return np.stack([np.sin(self.number * z), np.cos(self.number * z)], axis=-1)
        return FORMS[self.form][0](z, self.number)[:, None]

    def text(self, coefficients: np.ndarray) -> str:
        """The term with its coefficients (c,), with a sign in front."""
        if self.form == "harmonic":
            size, phase = float(np.hypot(*coefficients)), float(np.arctan2(coefficients[1], coefficients[0]))
            angle = "z" if self.number == 1 else f"{self.number:g} z"
            start = f" {'+' if phase >= 0 else '-'} {abs(phase):.2f}" if abs(phase) >= 0.005 else ""
            return f"+ {size:.3g} sin({angle}{start})"
        value, body = float(coefficients[0]), FORMS[self.form][1](self.number)
        return f"{'+' if value >= 0 else '-'} {abs(value):.3g}{body}"


FORMS: dict[str, tuple[Callable[[np.ndarray, float], np.ndarray], Callable[[float], str]]] = {
    "power": (lambda z, n: z**n, lambda n: {0.0: "", 1.0: " z"}.get(n, f" z^{n:g}")),
    "sign": (lambda z, n: np.tanh(z / n), " tanh(z / {:.3g})".format),
    "decay": (lambda z, n: np.exp(-z / n), " exp(-z / {:.3g})".format),
    "log": (lambda z, n: np.log1p(np.maximum(z, 0.0) / n), " ln(1 + z / {:.3g})".format),
    "size": (lambda z, _: np.abs(z), lambda _: " |z|"),
}  # fmt: skip
"""Terms of one column: their values at z, and how they read."""


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
    `matrix`, `moments`: products (P + T, P + T) and (P + T,) with the base's P = size columns in front, prior included;
    `groups`: columns of each term, counted after those of the base."""
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


SMOOTHING = (0.01, 0.1, 1.0, 10.0)  # weights of second differences that are tried, as shares of a knot's information
SHRINK = 0.01  # of that weight, on the tables themselves
MOST_TERMS = 3
WORTH = 0.05  # share of the held-back gain that a further term must add


ROWS = KNOTS // ACROSS  # of a map


def _bends(count: int) -> np.ndarray:
    """(count - 2, count) second differences."""
    return np.diff(np.eye(count), 2, axis=0)


@dataclass(frozen=True)
class WrenchTable:
    """Which wrench."""

    quantity: str
    kind: str
    low: float
    high: float
    low_y: float = 0.0
    high_y: float = 1.0

    @property
    def knots(self) -> np.ndarray:
        """(KNOTS,) values of the quantity; of a map (KNOTS, 2) x and y."""
        if self.quantity in PERIODIC:
            return np.arange(KNOTS) * 2 * np.pi / KNOTS
        if self.quantity == MAP:
            across, rows = np.linspace(self.low, self.high, ACROSS), np.linspace(self.low_y, self.high_y, ROWS)
            return np.stack([np.tile(across, ROWS), np.repeat(rows, ACROSS)], axis=-1)
        return np.linspace(self.low, self.high, KNOTS)

    @property
    def roughness(self) -> np.ndarray:
        """(KNOTS, KNOTS) of a table: squares of second differences (a map's both ways), and a bit of its own."""
        if self.quantity == MAP:
            bend = np.concatenate([np.kron(np.eye(ROWS), _bends(ACROSS)), np.kron(_bends(ROWS), np.eye(ACROSS))])
        else:
            bend = _bends(KNOTS)
        return np.asarray(bend.T @ bend + SHRINK * np.eye(KNOTS))

    def parameters(self, wrench: np.ndarray, start: float = 0.0) -> dict[str, float]:
        """Parameters of the effect for a table (2 KNOTS,) of forces [N] and torques [N m], and a start angle [rad]."""
        number = list(QUANTITIES).index(self.quantity) + 1
        found = {"quantity": float(number), "low": self.low, "high": self.high, "low_y": self.low_y,
                 "high_y": self.high_y, "with_motion": float(self.kind == "brake"), "start_angle": start}
        for k in range(KNOTS):
            found[f"force_{k + 1}"] = float(wrench[k])
            found[f"torque_{k + 1}"] = float(wrench[KNOTS + k])
        return found


@dataclass(frozen=True)
class Products:
    """White columns [base | tables] and residual of G groups of trials, multiplied out."""

    matrix: np.ndarray  # (G, P + S, P + S)
    moments: np.ndarray  # (G, P + S)
    square: np.ndarray  # (G,) of the residual

    def mapped(self, basis: np.ndarray) -> Products:
        """The same with the columns of the tables combined by `basis` (S, T)."""
        size = self.matrix.shape[1] - len(basis)
        full = np.zeros((self.matrix.shape[1], size + basis.shape[1]))
        full[:size, :size], full[size:, size:] = np.eye(size), basis
        return Products(full.T @ self.matrix @ full, self.moments @ full, self.square)

    def solve(self, penalty: np.ndarray, groups: Sequence[int] | None = None) -> np.ndarray:
        """Coefficients (P + S,) of the ridge fit to some groups."""
        chosen = list(range(len(self.matrix))) if groups is None else list(groups)
        matrix = self.matrix[chosen].sum(0) + penalty
        matrix[np.diag_indices(len(matrix))] += 1e-9 * max(float(np.diag(matrix).max()), 1e-12)
        return np.asarray(np.linalg.solve(matrix, self.moments[chosen].sum(0)))

    def left(self, coefficients: np.ndarray, group: int) -> float:
        """Squared residual of a group that a fit leaves."""
        return float(self.square[group] - 2 * self.moments[group] @ coefficients
                     + coefficients @ self.matrix[group] @ coefficients)


def multiplied(
    residual: np.ndarray, jacobian: np.ndarray, columns: np.ndarray, groups: Sequence[Sequence[int]]
) -> Products:
    """Products by groups of trials: residual (B, n), Jacobian (B, n, P) of the base, columns (B, n, S) of tables."""
    design = np.concatenate([jacobian, columns], axis=-1)
    flat = [design[list(group)].reshape(-1, design.shape[-1]) for group in groups]
    rest = [residual[list(group)].reshape(-1) for group in groups]
    return Products(np.stack([x.T @ x for x in flat]), np.stack([x.T @ r for x, r in zip(flat, rest, strict=True)]),
                    np.array([float(r @ r) for r in rest]))


def penalties(products: Products, precision: np.ndarray, smoothing: float, table: WrenchTable) -> np.ndarray:
    """(P + S, P + S) prior: base parameters by their spread, tables by their second differences."""
    size = len(precision)
    out = np.zeros(products.matrix.shape[1:])
    out[:size, :size] = precision
    information = np.diag(products.matrix.sum(0))[size:]
    for half in range(2):
        part = slice(size + half * KNOTS, size + (half + 1) * KNOTS)
        weight = max(float(information[half * KNOTS : (half + 1) * KNOTS].mean()), 1e-9)
        out[part, part] = smoothing * weight * table.roughness
    return out


def held_back(products: Products, precision: np.ndarray, table: WrenchTable) -> tuple[np.ndarray, float]:
    """Gain (G,) of the tables on each group when fitted to the others, and the smoothing that does best."""
    best: tuple[np.ndarray, float] | None = None
    for smoothing in SMOOTHING:
        gains = gains_without(products, penalties(products, precision, smoothing, table), len(precision))
        if best is None or gains.sum() > best[0].sum():
            best = gains, smoothing
    assert best is not None
    return best


def gains_without(products: Products, penalty: np.ndarray, size: int) -> np.ndarray:
    """(G,) by how much a fit to the other groups lowers each group's squared residual, beyond the base's P = size."""
    base = Products(products.matrix[:, :size, :size], products.moments[:, :size], products.square)
    count = len(products.square)
    gains = np.zeros(count)
    for g in range(count):
        others = [i for i in range(count) if i != g]
        gains[g] = (base.left(base.solve(penalty[:size, :size], others), g)
                    - products.left(products.solve(penalty, others), g))
    return gains


def few_terms(products: Products, precision: np.ndarray, table: WrenchTable) -> tuple[np.ndarray, tuple[Term, ...]]:
    """The best sum of few terms and its gain (G,) on each group, chosen and fitted on the others; none for a map."""
    if table.quantity == MAP:
        return np.full(len(products.square), -np.inf), ()
    terms = library(table.knots, table.quantity in PERIODIC)
    basis, parts = columns_of(terms, table.knots)
    mapped, size = products.mapped(basis), len(precision)
    prior = np.zeros(mapped.matrix.shape[1:])
    prior[:size, :size] = precision
    count = len(mapped.square)

    def path(groups: Sequence[int]) -> list[list[int]]:
        return forward_selection(mapped.matrix[list(groups)].sum(0) + prior, mapped.moments[list(groups)].sum(0), size,
                                 parts, MOST_TERMS)

    gains = np.zeros((MOST_TERMS, count))
    for g in range(count):
        for k, chosen in enumerate(path([i for i in range(count) if i != g])):
            one, penalty = _only(mapped, parts, chosen, size, prior)
            gains[k, g] = gains_without(one, penalty, size)[g]
    totals = gains.sum(1)
    best = next(k for k in range(MOST_TERMS) if totals[k] >= (1 - WORTH) * totals.max() or k == MOST_TERMS - 1)
    return gains[best], tuple(terms[k] for k in path(range(count))[best])


def _only(products: Products, parts: Sequence[Sequence[int]], chosen: Sequence[int], size: int, prior: np.ndarray
          ) -> tuple[Products, np.ndarray]:
    """Products and prior of the base and some terms."""
    order = [*range(size), *(size + i for k in chosen for i in parts[k])]
    return (Products(products.matrix[:, order][:, :, order], products.moments[:, order], products.square),
            prior[np.ix_(order, order)])


def turned(table: WrenchTable, columns: np.ndarray, residual: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Columns (B, n, 2 KNOTS) with every trial's wheel at its own start angle, and the numbers of these in `PHASES`."""
    count = len(columns)
    if table.quantity not in WHEELS:
        return columns, np.zeros(count, int)
    shape = np.concatenate([np.ones((KNOTS, 1))] + [
        np.stack([np.sin(k * table.knots), np.cos(k * table.knots)], axis=-1) for k in range(1, HARMONICS + 1)], axis=1)
    waves = columns @ np.kron(np.eye(2), shape)
    products = np.einsum("bni,bnj->bij", waves, waves, optimize=True)
    moments = np.einsum("bni,bn->bi", waves, residual)[..., None]
    ridge = 1e-3 * np.diag(np.maximum(np.diagonal(products, axis1=1, axis2=2).sum(0), 1e-12))
    _, phases = align(products, moments, np.kron(np.eye(2), wave_turns(HARMONICS, True)), ridge)
    return np.stack([one @ np.kron(np.eye(2), shift(PHASES[phase])) for one, phase in zip(columns, phases, strict=True)
                     ]), phases


def from_first_wave(terms: Sequence[Term], coefficients: Sequence[np.ndarray]) -> tuple[tuple[np.ndarray, ...], float]:
    """The same waves counted from where the first of the force rises through zero, and the angle [rad] to there."""
    first = next((values for term, values in zip(terms, coefficients, strict=True)
                  if term.form == "harmonic" and term.number == 1), None)
    if first is None:
        return tuple(coefficients), 0.0
    phase, out = float(np.arctan2(first[1], first[0])), []
    for term, values in zip(terms, coefficients, strict=True):
        if term.form == "harmonic":
            cos, sin = np.cos(term.number * phase), np.sin(term.number * phase)
            values = np.kron(np.eye(2), np.array([[cos, sin], [-sin, cos]])) @ values
        out.append(values)
    return tuple(out), phase


def shift(angle: float) -> np.ndarray:
    """(KNOTS, KNOTS) columns of a table whose angle starts elsewhere, by linear interpolation."""
    knots, share = divmod(angle / (2 * np.pi / KNOTS), 1.0)
    one = np.roll(np.eye(KNOTS), int(knots), axis=1)
    return (1 - share) * one + share * np.roll(one, 1, axis=1)

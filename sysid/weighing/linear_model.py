"""Evidence of columns with Gaussian priors under coloured noise, in closed form.

The white residual r of all drives is a sum of columns with Gaussian coefficients and noise:

    r = T theta + bumps + e,    theta ~ N(0, P^-1),    e ~ N(0, sigma^2 (I + lambda OU)),

where the bumps are smooth in time and shared by the drives of a manoeuvre (what a day adds anyway), and sigma is common
and integrated out (Student's t). All sums over rows are made once for each lambda; what follows is algebra on products.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from sysid.weighing.priors import Priors, Setting
from sysid.weighing.saved_evidence import Evidence

WANDERS = 2
"""Simulated sizes, from the smallest, whose responses wander: what is there on other days is small."""
Rows = np.ndarray
"""Columns (C, B, K, m) of all rows, one channel after the other."""


@dataclass(frozen=True)
class Block:
    """Columns under one noise colour: their rows and their products with the bumps, as eigenvectors of those."""

    rows: Rows
    bumps: np.ndarray  # (C, G, D, m)


@dataclass(frozen=True)
class Fit:
    """One set of columns: its log evidence and, at the best setting, its coefficients."""

    log_evidence: float
    setting: Setting
    mean: np.ndarray  # (k,) of the set's own columns
    covariance: np.ndarray  # (k, k)
    variance: float
    """Estimated sigma^2."""


@dataclass(frozen=True)
class Solved:
    """One setting's log evidence and posterior of all kept columns."""

    log_evidence: float
    mean: np.ndarray
    factor: np.ndarray  # Cholesky factor of the posterior precision
    variance: float


@dataclass(frozen=True)
class Smooth:
    """Columns with independent coefficients, along the eigenvectors of their products."""

    values: np.ndarray  # (n,) eigenvalues
    cross: np.ndarray  # (n, m) products with all other columns

    def integrated(self, amplitude: float) -> tuple[np.ndarray, float]:
        """What integrating them out takes from the products (m, m) of the others, and the log determinant."""
        share = amplitude**2 / (1 + amplitude**2 * self.values)
        return (self.cross * share[:, None]).T @ self.cross, float(np.log1p(amplitude**2 * self.values).sum())


@dataclass(frozen=True)
class Products:
    """Products of columns over all rows."""

    matrix: np.ndarray  # (m, m)
    bumps: Smooth
    log_det: float
    """Of the noise's colour."""

    def after_bumps(self, day: float) -> tuple[np.ndarray, float]:
        """With the day's bumps integrated out, and the log determinant."""
        if day == 0:
            return self.matrix, self.log_det
        less, log_det = self.bumps.integrated(day)
        return self.matrix - less, self.log_det + log_det


class Model:
    """The drives of one log with everything that does not depend on the set of effects."""

    def __init__(self, evidence: Evidence, priors: Priors, noise: np.ndarray, shared: np.ndarray | None = None):
        """`noise`, `shared` (C,): standard deviations of each drive's own white noise, and of what replicates share."""
        self.evidence, self.priors = evidence, priors
        self.turn, self.size = replicate_rows(evidence.course, noise, 0 * noise if shared is None else shared)
        self.count = float(evidence.mask.sum())
        self.groups = [np.flatnonzero(evidence.manoeuvre == g) for g in range(int(evidence.manoeuvre.max()) + 1)]
        base = self.rows_of(evidence.base)
        self.wander = wander_columns(evidence, priors)
        self.base = np.concatenate([base, self.rows_of(self.wander)], axis=-1)
        self.base_size = base.shape[-1]
        spread = np.linalg.inv(evidence.spread + 1e-6 * np.eye(len(evidence.spread)))
        self.base_precision = spread
        self._blocks: dict[float, Block] = {}
        self._base_products: dict[float, np.ndarray] = {}
        self._filters: dict[float, np.ndarray] = {}
        self._bumps: dict[float, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}

    def rows_of(self, columns: np.ndarray, channel: int | None = None) -> Rows:
        """(C, B, K, m) of columns (B, K, C, m) or of one column (B, K, C), in units of the channels' noise.

        Replicates are turned into their mean and differences. With a `channel`: (B, K, m) of columns (B, K, m) there.
        """
        if channel is not None:
            scaled = columns * self.evidence.mask[..., channel, None]
            return np.tensordot(self.turn / self.size[channel][:, None], scaled, 1)
        columns = columns[..., None] if columns.ndim == 3 else columns
        scaled = np.moveaxis(columns * self.evidence.mask[..., None], 2, 0)  # (C, B, K, m)
        flat = scaled.reshape(*scaled.shape[:2], -1)
        return np.matmul(self.turn / self.size[..., None], flat).reshape(scaled.shape)

    def block(self, rows: Rows, colour: float, channel: int | None = None) -> Block:
        """Rows under a noise colour; of one channel only, if given."""
        chosen = slice(None) if channel is None else slice(channel, channel + 1)
        coloured = self.coloured(rows, colour)
        bumps, turn = (one[chosen] for one in self._bumps_of(colour)[:2])
        cross = np.matmul(bumps.swapaxes(-1, -2), coloured)  # (C, B, D, m)
        summed = np.stack([cross[:, group].sum(1) for group in self.groups], axis=1)
        return Block(coloured, np.matmul(turn.swapaxes(-1, -2), summed))

    def coloured(self, rows: Rows, colour: float) -> Rows:
        """Rows (..., K, m) filtered for a noise colour."""
        return rows if colour == 0 else np.matmul(self._filter(colour), rows)

    def base_block(self, colour: float) -> Block:
        """Of the base and the wander."""
        if colour not in self._blocks:
            self._blocks[colour] = self.block(self.base, colour)
        return self._blocks[colour]

    def whole_block(self, colour: float, extra: Rows) -> Block:
        """Of the base, the wander and others."""
        base, new = self.base_block(colour), self.block(extra, colour)
        return Block(np.concatenate([base.rows, new.rows], -1), np.concatenate([base.bumps, new.bumps], -1))

    def bump_values(self, colour: float) -> np.ndarray:
        """(C, G, D) eigenvalues of the products of the day's bumps."""
        return self._bumps_of(colour)[2]

    def products(self, colour: float, extra: Rows) -> Products:
        """Products of [base, wander, extra] under a noise colour."""
        base, new = self.base_block(colour), self.block(extra, colour)
        if colour not in self._base_products:
            self._base_products[colour] = times(base.rows, base.rows)
        cross = times(base.rows, new.rows)
        matrix = np.block([[self._base_products[colour], cross], [cross.T, times(new.rows, new.rows)]])
        bumps = np.concatenate([base.bumps, new.bumps], axis=-1)
        smooth = Smooth(self.bump_values(colour).reshape(-1), bumps.reshape(-1, bumps.shape[-1]))
        return Products(matrix, smooth, -2 * self._colour_log(colour))

    def fit(self, columns: np.ndarray, precision: np.ndarray, residual: np.ndarray, calm: bool = True) -> Fit:
        """Log evidence of columns (B, K, C, k) with a prior precision (k, k) for a residual (B, K, C)."""
        size, best = columns.shape[-1], None
        values = []
        extra = np.concatenate([self.rows_of(columns), self.rows_of(residual)], axis=-1)
        for colour, group in by_colour(self.priors.settings(calm)):
            products = self.products(colour, extra)
            for setting in group:
                solved = self.solve(*products.after_bumps(setting.day), setting, precision)
                values.append(solved.log_evidence)
                if best is None or solved.log_evidence > best[0].log_evidence:
                    best = solved, setting
        assert best is not None
        solved, setting = best
        inverse = np.linalg.inv(solved.factor)
        start = len(inverse) - size
        covariance = (inverse.T @ inverse)[start:, start:] * solved.variance
        return Fit(log_sum(values), setting, solved.mean[start:], covariance, solved.variance)

    def solve(self, matrix: np.ndarray, log_det: float, setting: Setting, own: np.ndarray) -> Solved:
        """Log evidence from the products of [base, wander, own, residual]."""
        prior, kept = self.prior(setting.wander, own)
        inside = matrix[np.ix_(kept, kept)]
        factor = np.linalg.cholesky(inside + prior + 1e-9 * np.diag(np.diag(inside) + 1e-9))
        half = np.linalg.solve(factor, matrix[kept, -1])
        square = max(float(matrix[-1, -1] - half @ half), 1e-9)
        log_det += 2 * float(np.log(np.diag(factor)).sum()) - float(np.linalg.slogdet(prior)[1])
        return Solved(self.student(square) - 0.5 * log_det + setting.weight, np.linalg.solve(factor.T, half), factor,
                      max(square / self.count, 1e-9))

    def prior(self, kappa: float, own: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Prior precision of the kept columns of [base, wander, own], and which are kept."""
        total, wander, size = self.base.shape[-1], self.base.shape[-1] - self.base_size, len(own)
        kept = np.arange(total + size)
        if kappa == 0:
            kept = np.concatenate([kept[: self.base_size], kept[total:]])
            wander = 0
        matrix = np.zeros((len(kept),) * 2)
        matrix[: self.base_size, : self.base_size] = self.base_precision
        place = np.arange(self.base_size, self.base_size + wander)
        matrix[place, place] = 1 / max(kappa, 1e-9)
        start = len(kept) - size
        matrix[start:, start:] = own
        return matrix, kept

    def student(self, square: float) -> float:
        """Log density of the squared residual, with sigma^2 integrated out."""
        nu = self.priors.freedom
        return -0.5 * (nu + self.count) * float(np.log((nu + square) / (nu + self.count)))

    def _colour_log(self, colour: float) -> float:
        """Log determinant of the filter over all measured rows."""
        if colour == 0:
            return 0.0
        logs = np.log(np.diag(self._filter(colour)))
        return float((self.evidence.mask * logs[None, :, None]).sum())

    def _filter(self, colour: float) -> np.ndarray:
        """(K, K) inverse Cholesky factor of I + colour OU."""
        if colour not in self._filters:
            bins = self.evidence.mask.shape[1]
            apart = np.abs(np.subtract.outer(np.arange(bins), np.arange(bins))) * self.evidence.width
            matrix = np.eye(bins) + colour * np.exp(-apart / self.priors.colour_time)
            self._filters[colour] = np.linalg.inv(np.linalg.cholesky(matrix))
        return self._filters[colour]

    def _bumps_of(self, colour: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Bumps in time (C, B, K, D), and the eigenvectors (C, G, D, D) and values (C, G, D) of their products."""
        if colour not in self._bumps:
            bins = self.evidence.mask.shape[1]
            shape = bumps(np.arange(bins, dtype=float), 0.0, bins - 1.0, self.priors.day_bumps)
            rows = self.rows_of(np.broadcast_to(shape[None, :, None], (*self.evidence.mask.shape, shape.shape[1])))
            rows = self.coloured(rows, colour)
            each = np.matmul(rows.swapaxes(-1, -2), rows)
            values, turn = np.linalg.eigh(np.stack([each[:, group].sum(1) for group in self.groups], axis=1))
            self._bumps[colour] = rows, turn, np.maximum(values, 0.0)
        return self._bumps[colour]


def replicate_rows(course: np.ndarray, noise: np.ndarray, shared: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Orthonormal (B, B) turn of replicates into their mean and differences, and the noise (C, B) of these rows."""
    turn, size = np.zeros((len(course),) * 2), np.tile(noise[:, None], (1, len(course)))
    for number in np.unique(course):
        mine = np.flatnonzero(course == number)
        count = len(mine)
        basis = np.linalg.qr(np.concatenate([np.ones((count, 1)), np.eye(count)[:, 1:]], axis=1))[0]
        turn[np.ix_(mine, mine)] = basis.T
        size[:, mine[0]] = np.sqrt(noise**2 + count * shared**2)
    return turn, size


def wander_columns(evidence: Evidence, priors: Priors) -> np.ndarray:
    """(B, K, C, w) columns by which every effect at once seems to be there on days without it; their size is 1."""
    parts = []
    for effect in evidence.effects:
        for columns in effect.columns[:WANDERS]:
            place = list(columns)
            value, vector = np.linalg.eigh(evidence.wander[np.ix_(place, place)])
            keep = value > 1e-6
            turn = vector[:, keep] * np.sqrt(np.minimum(value[keep], priors.wander_most))
            parts.append(evidence.columns[..., place] @ turn)
    return np.concatenate([np.zeros((*evidence.mask.shape, 0)), *parts], axis=-1)


def bumps(z: np.ndarray, low: float, high: float, terms: int) -> np.ndarray:
    """(..., terms) smooth bumps that cover a range of z."""
    centre = np.linspace(low, high, terms)
    return np.exp(-0.5 * ((z[..., None] - centre) / ((high - low) / (terms - 1))) ** 2)


def by_colour(settings: Sequence[Setting]) -> Iterator[tuple[float, list[Setting]]]:
    """Settings of each noise colour."""
    for colour in sorted({one.colour for one in settings}):
        yield colour, [one for one in settings if one.colour == colour]


def log_sum(values: Sequence[float] | np.ndarray) -> float:
    """log of the sum of exponentials."""
    top = float(np.max(values))
    return top + float(np.log(np.exp(np.asarray(values) - top).sum()))


def times(a: Rows, b: Rows) -> np.ndarray:
    """Products (m, l) of columns over all rows."""
    return a.reshape(-1, a.shape[-1]).T @ b.reshape(-1, b.shape[-1])

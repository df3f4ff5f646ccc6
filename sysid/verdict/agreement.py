"""Whether manoeuvres agree on an effect: a real one has one size in all that excite it, a lucky one has many."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import special, stats

from sysid.missing.joint_fit import Refit

ALPHA = 0.05  # of the test whether manoeuvres differ on a size
POWER = 0.8  # least power of a manoeuvre to separate an effect from none, to be asked; and of that test
SCATTER = 0.5  # standard deviation from manoeuvre to manoeuvre, as a share of the size, that the test should see
RESAMPLES = 2000
CONFIDENCE = 0.95
FOLLOWED = 0.9  # largest share of a direction's information in one manoeuvre with which its residual is enlarged
RIDGE = 1e-9


@dataclass(frozen=True)
class Heterogeneity:
    """Cochran's test that an effect has one size in all manoeuvres that excite it."""

    asked: np.ndarray  # (G,) bool, manoeuvres that by themselves would separate the effect from none
    q: float  # squared differences from the mean over their variances, about chi-squared (asked - 1) for one size
    p: float
    scatter: float  # standard deviation of the sizes beyond the noise, as a share of the mean
    least: float  # lower 95 % end of it, or less: the mean is not known exactly either
    power: float  # to see a scatter of `SCATTER`

    @property
    def outcome(self) -> str:
        """agree, differ, or untold where a scatter would not have been seen."""
        return "differ" if self.p < ALPHA else "agree" if self.power >= POWER else "untold"


def heterogeneity(factor: np.ndarray, error: np.ndarray) -> Heterogeneity:
    """Whether sizes (G,) with standard errors (G,), as shares of the fitted size, are one.

    A manoeuvre that cannot see the effect has no say. For sizes that scatter by s beside noise of variances e^2,
    q (k - 1) / (k - 1 + c s^2) is about chi-squared, with c = sum w - sum w^2 / sum w and w = 1 / e^2 (DerSimonian and
    Laird 1986).
    """
    visible = special.ndtri(1 - ALPHA / 2) + special.ndtri(POWER)
    asked = error < 1 / visible
    freedom = int(asked.sum()) - 1
    if freedom < 1:
        return Heterogeneity(asked, 0.0, 1.0, 0.0, 0.0, 0.0)
    weight, sizes = error[asked] ** -2.0, factor[asked]
    mean = float((weight * sizes).sum() / weight.sum())
    q = float((weight * (sizes - mean) ** 2).sum())
    spread = float(weight.sum() - np.square(weight).sum() / weight.sum()) / freedom
    limit, unit = float(special.chdtri(freedom, ALPHA)), max(abs(mean), 1e-9)
    scatter = float(np.sqrt(max(q / freedom - 1, 0.0) / spread))
    largest = unit + special.ndtri(1 - ALPHA) * np.sqrt(scatter**2 / (freedom + 1) + 1 / weight.sum())
    least = float(np.sqrt(max(q / limit - 1, 0.0) / spread)) / largest
    power = float(special.chdtrc(freedom, limit / (1 + spread * (SCATTER * unit) ** 2)))
    return Heterogeneity(asked, q, float(special.chdtrc(freedom, q)), scatter / unit, least, power)


def interval_of_sum(values: np.ndarray, seed: int = 0) -> tuple[float, float]:
    """95 % interval of the sum of values (G,), with the values drawn anew."""
    rng = np.random.default_rng(seed)
    sums = values[rng.integers(0, len(values), (RESAMPLES, len(values)))].sum(1)
    low, high = np.quantile(sums, [0.025, 0.975])
    return float(low), float(high)


def errors_of_sizes(
    fit: Refit, groups: Sequence[Sequence[int]], precision: np.ndarray, wander: np.ndarray
) -> np.ndarray:
    """(k,) standard errors of the coordinates: from whole manoeuvres, which a wrong form pulls each its own way, and
    `wander` (k,), the variance of what they seem to be on days without the effects. What a manoeuvre leaves is enlarged
    by how far the fit followed it (bias-reduced linearisation, Bell and McCaffrey 2002)."""
    matrix, size = with_prior(fit, precision), len(fit.u)
    root = np.linalg.inv(np.linalg.cholesky(matrix))
    moved = []
    for group in groups:
        flat = fit.jacobian[list(group)].reshape(-1, len(matrix))
        shares, along = np.linalg.eigh(root @ flat.T @ flat @ root.T)
        score = along.T @ (root @ (flat.T @ fit.residual[list(group)].reshape(-1)))
        moved.append(root.T @ (along @ (score / np.sqrt(1 - np.clip(shares, 0.0, FOLLOWED)))))
    variance = np.maximum(np.diag(root.T @ root), np.square(moved).sum(0))[size:]
    return np.asarray(np.sqrt(variance + wander))


def half_width(groups: Sequence[Sequence[int]]) -> float:
    """Standard errors from a size to the ends of its 95 % interval, which rests on so many manoeuvres."""
    return float(stats.t.ppf((1 + CONFIDENCE) / 2, max(len(groups) - 1, 1)))


def with_prior(fit: Refit, precision: np.ndarray) -> np.ndarray:
    """(P + k, P + k) information of a joint fit, with the precision (P, P) of the base parameters as prior."""
    matrix = fit.products(precision)
    matrix[np.diag_indices(len(matrix))] += 1e-9 * np.diag(matrix).max()
    return matrix


def sizes_apart(
    fit: Refit, part: slice, groups: Sequence[Sequence[int]], precision: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(G,) size that each manoeuvre by itself asks of the coordinates `part` of q, as a factor on the fitted one, and
    its error. All else is as the other manoeuvres have it, and may move as far as they allow. A linear step."""
    size = len(fit.u)
    index = np.arange(size + part.start, size + part.stop)
    matrix = with_prior(fit, precision)
    factors, errors = [], []
    for group in groups:
        chosen = list(group)
        flat = fit.jacobian[chosen].reshape(-1, fit.jacobian.shape[-1])
        column = flat[:, index] @ fit.q[part]
        others = np.delete(flat, index, axis=1)
        prior = np.delete(np.delete(matrix - flat.T @ flat, index, 0), index, 1)
        left = column - others @ np.linalg.solve(others.T @ others + prior, others.T @ column)
        strength = max(float(left @ left), 1e-9)
        factors.append(1 + float(left @ fit.residual[chosen].reshape(-1)) / strength)
        errors.append(strength**-0.5)
    return np.array(factors), np.array(errors)


def foretold(fit: Refit, part: slice, groups: Sequence[Sequence[int]], precision: np.ndarray) -> np.ndarray:
    """(G,) by how much the coordinates `part` of q, fitted to all other manoeuvres, lower the squared residual of each
    manoeuvre, beside a fit without them. Linear, around the joint fit."""
    size, columns = len(fit.u), fit.jacobian.reshape(fit.residual.size, -1)
    index = np.arange(size + part.start, size + part.stop)
    kept = np.delete(np.arange(columns.shape[1]), index)
    prior = np.zeros((columns.shape[1],) * 2)
    prior[:size, :size] = precision
    without = fit.residual + fit.jacobian[..., index] @ fit.q[part]
    return (left_out(columns[:, kept], prior[np.ix_(kept, kept)], without, groups)
            - left_out(columns, prior, fit.residual, groups))


def left_out(design: np.ndarray, prior: np.ndarray, target: np.ndarray, groups: Sequence[Sequence[int]]) -> np.ndarray:
    """(G,) what columns (n, F) with precision (F, F), fitted to the other manoeuvres, leave of the squares of each
    manoeuvre in a target (B, n / B)."""
    flat, columns, out = target.reshape(-1), design.reshape(len(target), -1, design.shape[1]), []
    matrix, right = design.T @ design + prior, design.T @ flat
    for group in groups:
        x, y = columns[list(group)].reshape(-1, design.shape[1]), target[list(group)].reshape(-1)
        out.append(float(np.square(y - x @ solved(matrix - x.T @ x, right - x.T @ y)).sum()))
    return np.array(out)


def log_densities(
    design: np.ndarray, prior: np.ndarray, target: np.ndarray, groups: Sequence[Sequence[int]], noise: float
) -> np.ndarray:
    """(G,) log density of each manoeuvre in a target (B, n / B) with this variance of the noise, as columns (n, F) with
    precision (F, F) predict it from the other manoeuvres. What does not depend on the columns is left out.

    What the other manoeuvres do not determine is unsure, not wrong: an effect may be of another size in each of them.
    """
    columns = design.reshape(len(target), -1, design.shape[1])
    design, flat = design / noise**0.5, target.reshape(-1) / noise**0.5
    whole = design.T @ design + prior, design.T @ flat, float(flat @ flat)

    def evidence(matrix: np.ndarray, right: np.ndarray, squares: float) -> float:
        half = np.linalg.cholesky(matrix + RIDGE * max(float(np.trace(matrix)), 1e-9) * np.eye(len(matrix)))
        return -float(squares - np.square(np.linalg.solve(half, right)).sum()) / 2 - float(np.log(np.diag(half)).sum())

    out = []
    for group in groups:
        x = columns[list(group)].reshape(-1, design.shape[1]) / noise**0.5
        y = target[list(group)].reshape(-1) / noise**0.5
        others = whole[0] - x.T @ x, whole[1] - x.T @ y, whole[2] - float(y @ y)
        out.append(evidence(*whole) - evidence(*others))
    return np.array(out)


def solved(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solution of equations that may be dependent."""
    return np.linalg.solve(matrix + RIDGE * max(float(np.trace(matrix)), 1e-9) * np.eye(len(matrix)), right)


def beside(products: np.ndarray, count: int) -> np.ndarray:
    """(k, k) information on the last k = `count` columns, beside the others."""
    size = len(products) - count
    cross = products[:size, size:]
    return products[size:, size:] - cross.T @ np.linalg.lstsq(products[:size, :size], cross, rcond=None)[0]

"""Confidence intervals of fitted parameters, and which of them the log cannot tell.

Residuals of a driving log are autocorrelated, so the usual (J^T J)^-1 understates the errors several times. The middle
of the sandwich H^-1 M H^-1 is therefore summed over blocks of neighbouring samples whose contributions are added before
they are squared: over whole trials, and over pieces of a few seconds; the larger variance is taken.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sysid.gradient import HUBER, huber_weight
from sysid.objective import Objective

CONFIDENCE = 0.90
PIECES = 8
"""Blocks that each trial is cut into for the second estimate."""
PRIOR_SD = 0.29
"""Standard deviation in unit coordinates of a parameter of which only its bounds are known (uniform)."""
UNIDENTIFIABLE = 0.5
"""Share of the prior's standard deviation above which a parameter counts as not told by the log."""
WALL = 1e-3  # distance to a bound, in unit coordinates, that counts as being on it


@dataclass(frozen=True)
class Estimate:
    """One fitted parameter."""

    name: str
    initial: float
    value: float
    low: float
    """Lower end of the confidence interval; that of the bounds where the log does not tell."""
    high: float
    identifiable: bool
    remark: str
    """Why it is not identifiable, or on which bound it lies; empty otherwise."""


@dataclass(frozen=True)
class Uncertainty:
    """Estimates, and the spectrum of the information in unit coordinates."""

    estimates: tuple[Estimate, ...]
    information: np.ndarray  # (P,) eigenvalues of J^T J / s^2, ascending
    directions: np.ndarray  # (P, P) eigenvectors in the columns
    covariance: np.ndarray  # (P, P) in unit coordinates

    def weak_combinations(self) -> list[str]:
        """Directions that the log does not tell, as the parameters that make them up."""
        names = [estimate.name for estimate in self.estimates]
        found = []
        for value, direction in zip(self.information, self.directions.T, strict=True):
            if value * PRIOR_SD**2 < 1.0 / UNIDENTIFIABLE**2:
                parts = sorted(zip(np.abs(direction), names, direction, strict=True), reverse=True)
                found.append(" ".join(f"{sign:+.2f} {name}" for size, name, sign in parts[:4] if size > 0.2))
        return found


def estimate(
    objective: Objective, u: np.ndarray, confidence: float = CONFIDENCE, robust: bool = False
) -> Uncertainty:
    """Intervals of the parameters at the fitted point u (P,).

    Args:
        robust: u minimises the Huber loss: residuals beyond its bend pull with a constant force and tell no curvature.
    """
    from scipy import stats

    space = objective.space
    residual, jacobian = (array[0] for array in objective.jacobian(u[None]))  # (B, K), (B, K, P)
    trials = len(residual)
    if objective.prior is not None:  # not a measurement: it comes back as a precision
        residual, jacobian = residual[:, : -space.size], jacobian[:, : -space.size]
    if robust:
        inside = np.abs(residual) <= HUBER
        residual = residual * huber_weight(residual)
        hessian = np.einsum("bkp,bkq->pq", jacobian * inside[..., None], jacobian)
    else:
        hessian = np.einsum("bkp,bkq->pq", jacobian, jacobian)
    variance = max(float(np.square(residual).sum()) / max(objective.counted - space.size, 1), 1e-12)
    prior = np.eye(space.size) / PRIOR_SD**2
    by_trial = np.einsum("bkp,bk->bp", jacobian, residual)  # (B, P)
    by_piece = _piece_sums(objective, jacobian, residual)
    inflation = trials / max(trials - 1, 1)
    middles = [variance * hessian, np.einsum("bp,bq->pq", by_piece, by_piece)]
    if trials > space.size:  # fewer blocks than parameters would leave directions without any variance
        middles.append(np.einsum("bp,bq->pq", by_trial, by_trial) * inflation)
    # The prior is weak: it matters only along directions of which the log says nothing.
    scale = max(np.mean([np.trace(middle) for middle in middles]) / max(np.trace(hessian), 1e-12), 1e-12)
    inverse = np.linalg.inv(hessian + scale * prior)
    covariances = [inverse @ (middle + scale**2 * prior) @ inverse for middle in middles]
    if objective.prior is not None:
        # Weighed as it was, that is in units of the data's precision over `scale`; its own variance is 1.
        told = objective.prior.precision
        inverse = np.linalg.inv(hessian + told)
        covariances = [inverse @ (middle + objective.prior.share * told) @ inverse for middle in middles]
    largest = max(covariances, key=np.trace)
    deviation = np.sqrt(np.max([np.diag(covariance) for covariance in covariances], axis=0))
    quantile = float(stats.t.ppf((1 + confidence) / 2, max(trials - 1, 1)))
    information, directions = np.linalg.eigh(hessian / scale)
    estimates = []
    for index, name in enumerate(space.names):
        low = space.to_values(u - quantile * deviation)[index]
        high = space.to_values(u + quantile * deviation)[index]
        told = deviation[index] < UNIDENTIFIABLE * PRIOR_SD
        remark = "" if told else "not identifiable: the log hardly narrows its bounds"
        if told and min(u[index], 1 - u[index]) < WALL:
            remark = f"on its {'lower' if u[index] < 0.5 else 'upper'} bound"
        if not told:
            low, high = min(low, space.high[index]), max(high, space.low[index])
        estimates.append(Estimate(name, float(space.initial[index]), float(space.to_values(u)[index]), float(low),
                                  float(high), bool(told), remark))
    return Uncertainty(tuple(estimates), information, directions, largest)


def inflation(objective: Objective, u: np.ndarray) -> float:
    """How many times the squared residuals count what they tell: their sum over neighbours against that one by one."""
    residual, jacobian = (array[0] for array in objective.jacobian(u[None]))
    hessian = np.einsum("bkp,bkq->pq", jacobian, jacobian)
    pieces = _piece_sums(objective, jacobian, residual * huber_weight(residual))
    told = np.diag(hessian) > 1e-9 * np.diag(hessian).max()
    return max(float(np.median(np.square(pieces).sum(0)[told] / np.diag(hessian)[told])), 1.0)


def _piece_sums(objective: Objective, jacobian: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """(B * PIECES, P) gradient contributions of pieces of trials, all channels of a piece together."""
    measured = objective.measured
    product = jacobian * residual[..., None]
    sums, offset = [], 0
    for table in (measured.pose, measured.odometry):
        size = table[0].size
        part = product[:, offset : offset + size].reshape(len(residual), table.shape[1], table.shape[2], -1).sum(2)
        sums.append(np.stack([piece.sum(1) for piece in np.array_split(part, PIECES, axis=1)], axis=1))
        offset += size
    return (sums[0] + sums[1]).reshape(-1, jacobian.shape[-1])

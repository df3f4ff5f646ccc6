"""Confidence intervals of fitted parameters, and which of them the log cannot determine.

What a log shows of the height of the mass depends on that height. Such an interval ends where the integral of dx / h(x)
is 1, with h a straight line through its half-widths at the fit and at its end: a variance-stabilising transformation
(Bartlett 1947).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sysid.errors.pose_objective import DriveResiduals, without_prior
from sysid.errors.prior import UNKNOWN, expected_sd
from sysid.errors.space import BENT, HUBER, NUISANCE, TERMS, Space, huber_weight, robust_cost
from sysid.intervals.independence import CONFIDENCE, Information, StandardErrors, errors_of, shared_error
from sysid.logs.metrics import replicate_groups
from sysid.search import least_squares
from sysid.search.slopes import average_slopes, likely_by, products

PIECES = 8  # that each trial is cut into
PASSES = 2  # of averaging slopes: over errors by differences, and by averaged slopes
PRIOR_SD = UNKNOWN  # standard deviation in unit coordinates of a parameter of which only its bounds are known (uniform)
UNIDENTIFIABLE = 0.5  # share of the prior's standard deviation from which a log does not determine a parameter
WALL = 1e-3  # distance to a bound, in unit coordinates, that counts as being on it
FOLLOW = 2  # iterations of all others at the end of an interval
NEAR = 0.25  # share of a half-width below which a bound is too near to look how wide the interval is from there
WIDEST = 3.0  # times a half-width at the fit that it may have at the end: an interval then reaches 3.2 of them


@dataclass(frozen=True)
class Estimate:
    name: str
    initial: float
    value: float
    low: float  # lower end of the confidence interval; that of the bounds where the log does not determine it
    high: float
    identifiable: bool
    remark: str  # why it is not identifiable, or on which bound it lies; empty otherwise


@dataclass(frozen=True)
class Uncertainty:
    """Estimates, and the spectrum of the information in unit coordinates."""

    estimates: tuple[Estimate, ...]
    information: np.ndarray  # (P,) eigenvalues of J^T J / s^2, ascending
    directions: np.ndarray  # (P, P) eigenvectors in the columns
    covariance: np.ndarray  # (P, P) in unit coordinates
    deviation: np.ndarray  # (P,) standard errors in unit coordinates
    quantile: np.ndarray  # (P,) standard errors that the intervals reach on either side
    evidence: Information

    @property
    def errors(self) -> StandardErrors:
        """Those of the evidence, which are the same at any point."""
        return StandardErrors(self.deviation, self.quantile, self.covariance)

    def spectrum(self) -> list[tuple[float, str]]:
        """Fisher information along each of its eigenvectors, weakest first, with the parameters that make it up."""
        names, found = [estimate.name for estimate in self.estimates], []
        for value, direction in zip(self.information, self.directions.T, strict=True):
            parts = sorted(zip(np.abs(direction), names, direction, strict=True), reverse=True)
            made_of = " ".join(f"{sign:+.2f} {name}" for size, name, sign in parts[:4] if size > 0.2)
            found.append((float(value), made_of))
        return found

    def weak_combinations(self) -> list[str]:
        """Directions that the log does not determine, as the parameters that make them up."""
        return [parts for value, parts in self.spectrum() if value * PRIOR_SD**2 < 1.0 / UNIDENTIFIABLE**2]


def estimate(
    objective: DriveResiduals, u: np.ndarray, confidence: float = CONFIDENCE, robust: bool = False
) -> Uncertainty:
    """Intervals of the parameters at the fitted point u (P,).

    `robust`: u minimises the Huber loss: residuals beyond its bend pull with a constant force and add no curvature.
    """
    found = _evidence_at(objective, u, robust)
    errors = errors_of(found, confidence)
    evidence = replace(found, ahead=_ahead(objective, found, errors, confidence, robust))
    return uncertainty_of(evidence, objective.space, confidence, errors)


def _ahead(
    objective: DriveResiduals, found: Information, errors: StandardErrors, confidence: float, robust: bool
) -> np.ndarray:
    """(2, P) how many times as wide intervals of `BENT` parameters are from their lower and upper ends; 1 of others."""
    space, u, ahead = objective.space, found.u, np.ones((2, objective.space.size))
    reach, inverse = errors.quantile * errors.deviation, found.inverse
    over = likely_by(found.blocks.sum((0, 1)), found.variance)
    for index in np.flatnonzero([name in BENT for name in space.names]):
        if errors.deviation[index] > UNIDENTIFIABLE * PRIOR_SD:
            continue
        for end, room in enumerate((-u[index], 1.0 - u[index])):
            step = np.clip(room, -reach[index], reach[index])
            share = abs(step) / reach[index]
            if share < NEAR:
                continue
            start = space.moved(u[None], step * inverse[None, :, index] / inverse[index, index])
            start[:, index] = u[index] + step
            there = least_squares.fit(objective, starts=np.clip(start, 0.0, 1.0), stop=least_squares.Stopping(FOLLOW),
                                      robust=robust, frozen=(space.names[index],)).u
            known = errors_of(_evidence_at(objective, there, robust, over), confidence)
            wide = known.quantile[index] * known.deviation[index] / reach[index]
            ahead[end, index] = 1.0 + (wide - 1.0) / share
    return ahead


def stretched(ahead: np.ndarray) -> np.ndarray:
    """Half-widths that an interval reaches which is so many times as wide from its end: x with the integral of 1 / (1 +
    (ahead - 1) x) equal to 1."""
    rise = np.clip(ahead - 1.0, -1.0, WIDEST - 1.0)
    level = np.abs(rise) < 1e-6
    return np.where(level, 1.0, np.expm1(rise) / np.where(level, 1.0, rise))


def _evidence_at(objective: DriveResiduals, u: np.ndarray, robust: bool, over: np.ndarray | None = None) -> Information:
    """Information of drives at a point u (P,), by slopes averaged over errors of a covariance (P, P), or those there.
    """
    space = objective.space
    if over is not None:
        residual, jacobian = average_slopes(objective, u, over)
    else:
        residual, jacobian = (array[0] for array in objective.jacobian(u[None]))  # (B, K), (B, K, P)
        size = float(robust_cost(residual[None], robust)[0]) / objective.counted
        for _ in range(PASSES):
            residual, jacobian = average_slopes(objective, u, likely_by(products(jacobian), size))
    residual, jacobian = (without_prior(objective, one) for one in (residual, jacobian))  # it is no measurement
    bent = jacobian
    if robust:
        bent = jacobian * (np.abs(residual) <= HUBER)[..., None]
        residual = residual * huber_weight(residual)
    scores, blocks = _pieces(objective, jacobian, residual, bent)
    variance = max(float(np.square(residual).sum()) / max(objective.counted - space.size, 1), 1e-12)
    groups = _manoeuvres(objective)
    alike = shared_error(objective.own_frame(residual), groups)
    found = Information(u, scores, blocks, groups, alike, variance, np.zeros((space.size, space.size)), 1.0)
    if objective.prior is not None:  # weighed as it was; its own variance is 1
        return replace(found, precision=objective.prior.precision, share=objective.prior.share)
    # Where nothing is known, the bounds are; they matter only along directions of which the log says nothing.
    return replace(found, precision=np.eye(space.size) / PRIOR_SD**2 * found.scale, share=found.scale)


def uncertainty_of(
    evidence: Information, space: Space, confidence: float = CONFIDENCE, errors: StandardErrors | None = None
) -> Uncertainty:
    """Intervals from the information of a log; `errors` where those of this information are known already."""
    u, errors = evidence.u, errors or errors_of(evidence, confidence)
    information, directions = np.linalg.eigh(evidence.blocks.sum((0, 1)) / evidence.scale)
    reach = errors.quantile * errors.deviation * np.array([[-1], [1]]) * stretched(evidence.ahead)  # (2, P)
    ends = space.to_values(u + reach)
    straight = space.to_values(u) + reach * space.slope(u)
    estimates, expected = [], expected_sd(space)
    for index, (name, low, high) in enumerate(zip(space.names, *ends, strict=True)):
        if name in TERMS:
            low, high = np.clip(straight[:, index], space.low[index], space.high[index])
        narrow = errors.deviation[index] < UNIDENTIFIABLE * expected[index] and name not in NUISANCE
        usual = "its bounds" if expected[index] == PRIOR_SD else "what is usual"
        remark = "" if narrow else f"not identifiable: {NUISANCE.get(name, f'the log hardly narrows {usual}')}"
        if narrow and min(u[index], 1 - u[index]) < WALL:
            remark = f"on its {'lower' if u[index] < 0.5 else 'upper'} bound"
        if name in NUISANCE:
            low, high = space.low[index], space.high[index]
        elif not narrow:
            low, high = min(low, space.high[index]), max(high, space.low[index])
        estimates.append(Estimate(name, float(space.initial[index]), float(space.to_values(u)[index]), float(low),
                                  float(high), bool(narrow), remark))
    return Uncertainty(tuple(estimates), information, directions, errors.covariance, errors.deviation,
                       errors.quantile, evidence)


def inflation(objective: DriveResiduals, u: np.ndarray) -> float:
    """How often the squared residuals count the same information: their sum over neighbours against that one by one."""
    residual, jacobian = (without_prior(objective, array[0]) for array in objective.jacobian(u[None]))
    hessian = np.einsum("bkp,bkq->pq", jacobian, jacobian)
    pieces = _pieces(objective, jacobian, residual * huber_weight(residual), jacobian)[0].reshape(-1, len(u))
    bent = np.diag(hessian) > 1e-9 * np.diag(hessian).max()
    return max(float(np.median(np.square(pieces).sum(0)[bent] / np.diag(hessian)[bent])), 1.0)


def _manoeuvres(objective: DriveResiduals) -> np.ndarray:
    """(B,) which trials are replicates of one another, as a number for each."""
    numbers = np.arange(len(objective.trials))
    place = {id(trial): i for i, trial in enumerate(objective.trials)}
    for group in replicate_groups(objective.trials):
        numbers[[place[id(trial)] for trial in group]] = place[id(group[0])]
    return np.unique(numbers, return_inverse=True)[1]


def _pieces(
    objective: DriveResiduals, jacobian: np.ndarray, residual: np.ndarray, bent: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """J^T r (B, PIECES, P) and J^T J (B, PIECES, P, P) of pieces of trials, all channels of a piece together.

    `bent`: (B, K, P) the Jacobian with which residuals beyond the bend of a robust loss add no curvature.
    """
    piece = objective.pieces(PIECES)
    piece = np.pad(piece, (0, residual.shape[1] - len(piece)))  # errors of the start belong to the first piece
    parts = [np.flatnonzero(piece == k) for k in range(PIECES)]
    scores = [np.einsum("bkp,bk->bp", jacobian[:, part], residual[:, part]) for part in parts]
    blocks = [bent[:, part].swapaxes(1, 2) @ jacobian[:, part] for part in parts]
    return np.stack(scores, axis=1), np.stack(blocks, axis=1)

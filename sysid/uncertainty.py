"""Confidence intervals of fitted parameters, and which of them the log cannot tell.

Residuals of a driving log are autocorrelated, so the usual (J^T J)^-1 understates the errors several times. Trials are
independent drives: the variance is that of their sums (`sysid.sandwich`), whatever the correlation within a drive. What
replicates share is no noise but what the model gets wrong about a manoeuvre; where they share more than chance would
have it, manoeuvres are the independent blocks. Errors may also be shared at a place of their drives alone: where wheels
break away, the mean of many drives is not the drive without disturbances. The pieces of a manoeuvre, all its replicates
together, are blocks of a second kind, and no error is less than either kind has it. Where too few trials tell a
parameter, or where they happen to differ less than pieces of them do, blocks are pieces of trials, and errors are no
less than those of independent samples.
Slopes are averaged over the errors (`sysid.slopes`): by differences over a fixed share of their ranges, delays are told
half as well as they are, and friction, slip and torque limits up to one and a half times.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sysid.gradient import HUBER, huber_weight, robust_cost
from sysid.metrics import replicate_groups
from sysid.objective import Told, without_prior
from sysid.prior import UNKNOWN
from sysid.sandwich import Variance, sandwich
from sysid.slopes import average_slopes, likely
from sysid.space import NUISANCE

CONFIDENCE = 0.90
PIECES = 8
"""Blocks that each trial is cut into where trials are too few."""
ENOUGH = 2.0
"""Degrees of freedom from which the variance between trials is taken: three or four drives that tell a parameter."""
CHANCE = 0.05
"""Probability below which what replicates share is taken for the model's error."""
FLIPS = 999  # draws of the signs of trials
PASSES = 2  # of averaging slopes: over errors as differences tell them, and as averaged slopes do
PRIOR_SD = UNKNOWN
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
    deviation: np.ndarray  # (P,) standard errors in unit coordinates
    quantile: np.ndarray  # (P,) of their Student distributions, at the confidence of the intervals

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
    objective: Told, u: np.ndarray, confidence: float = CONFIDENCE, robust: bool = False
) -> Uncertainty:
    """Intervals of the parameters at the fitted point u (P,).

    Args:
        robust: u minimises the Huber loss: residuals beyond its bend pull with a constant force and tell no curvature.
    """
    from scipy import stats

    space = objective.space
    residual, jacobian = (array[0] for array in objective.jacobian(u[None]))  # (B, K), (B, K, P)
    size = float(robust_cost(residual[None], robust)[0]) / objective.counted
    for _ in range(PASSES):
        residual, jacobian = average_slopes(objective, u, likely(jacobian, size))
    residual, jacobian = (without_prior(objective, one) for one in (residual, jacobian))  # it is no measurement
    told = jacobian
    if robust:
        told = jacobian * (np.abs(residual) <= HUBER)[..., None]
        residual = residual * huber_weight(residual)
    scores, blocks = _pieces(objective, jacobian, residual, told)  # (B, PIECES, P), (B, PIECES, P, P)
    hessian = blocks.sum((0, 1))
    variance = max(float(np.square(residual).sum()) / max(objective.counted - space.size, 1), 1e-12)
    # The prior is weak: it matters only along directions of which the log says nothing.
    scale = max(variance, float(np.square(scores).sum()) / max(np.trace(hessian), 1e-12), 1e-12)
    weak, share = np.eye(space.size) / PRIOR_SD**2 * scale, scale
    if objective.prior is not None:  # weighed as it was; its own variance is 1
        weak, share = objective.prior.precision, objective.prior.share
    inverse = np.linalg.inv(hessian + weak)
    between = sandwich(scores.sum(1), blocks.sum(1), inverse)
    within = sandwich(scores.reshape(-1, space.size), blocks.reshape(-1, space.size, space.size), inverse)
    groups = _manoeuvres(objective)
    across = None
    if shared_error(objective.own_frame(residual), groups) < CHANCE:
        sums = np.eye(groups.max() + 1)[groups].T  # (C, B)
        across = sandwich(sums @ scores.sum(1), np.einsum("cb,bpq->cpq", sums, blocks.sum(1)), inverse)
    places = None
    if len(groups) > groups.max() + 1:
        sums, flat = np.eye(groups.max() + 1)[groups].T, (-1, space.size)
        places = sandwich(np.einsum("cb,bkp->ckp", sums, scores).reshape(flat),
                          np.einsum("cb,bkpq->ckpq", sums, blocks).reshape(*flat, space.size), inverse)
    known = inverse @ weak @ inverse * share  # what the prior's own error adds
    deviation, freedom = _choose(between, within, across, places, np.diag(inverse @ hessian @ inverse) * variance)
    deviation = np.sqrt(deviation**2 + np.diag(known))
    quantile = stats.t.ppf((1 + confidence) / 2, freedom)
    found = [one.covariance for one in (between, within, across, places) if one is not None]
    covariance = max(found, key=np.trace) + known
    information, directions = np.linalg.eigh(hessian / scale)
    estimates = []
    for index, name in enumerate(space.names):
        low = space.to_values(u - quantile * deviation)[index]
        high = space.to_values(u + quantile * deviation)[index]
        narrow = deviation[index] < UNIDENTIFIABLE * PRIOR_SD and name not in NUISANCE
        remark = "" if narrow else f"not identifiable: {NUISANCE.get(name, 'the log hardly narrows its bounds')}"
        if narrow and min(u[index], 1 - u[index]) < WALL:
            remark = f"on its {'lower' if u[index] < 0.5 else 'upper'} bound"
        if name in NUISANCE:
            low, high = space.low[index], space.high[index]
        elif not narrow:
            low, high = min(low, space.high[index]), max(high, space.low[index])
        estimates.append(Estimate(name, float(space.initial[index]), float(space.to_values(u)[index]), float(low),
                                  float(high), bool(narrow), remark))
    return Uncertainty(tuple(estimates), information, directions, covariance, deviation, quantile)


def inflation(objective: Told, u: np.ndarray) -> float:
    """How many times the squared residuals count what they tell: their sum over neighbours against that one by one."""
    residual, jacobian = (without_prior(objective, array[0]) for array in objective.jacobian(u[None]))
    hessian = np.einsum("bkp,bkq->pq", jacobian, jacobian)
    pieces = _pieces(objective, jacobian, residual * huber_weight(residual), jacobian)[0].reshape(-1, len(u))
    told = np.diag(hessian) > 1e-9 * np.diag(hessian).max()
    return max(float(np.median(np.square(pieces).sum(0)[told] / np.diag(hessian)[told])), 1.0)


def shared_error(series: np.ndarray, groups: np.ndarray) -> float:
    """How probable it is that the residuals of independent trials of one group are so much alike.

    Independent trials might as well have had the opposite errors, whatever the correlation within each: their products
    with one another are compared with those for random signs of the trials. 1 without a group of several trials.

    Args:
        series: (B, K) residuals, each trial's in its own frame.
        groups: (B,) number of the group that each is of.
    """
    alike = (groups[:, None] == groups) & ~np.eye(len(groups), dtype=bool)
    if not alike.any():
        return 1.0
    pairs = (series @ series.T) * alike
    signs = np.random.default_rng(0).choice((-1.0, 1.0), (FLIPS, len(groups)))
    drawn = np.einsum("nb,bc,nc->n", signs, pairs, signs, optimize=True)
    return float((1 + (drawn >= pairs.sum()).sum()) / (1 + FLIPS))


def _manoeuvres(objective: Told) -> np.ndarray:
    """(B,) which trials are replicates of one another, as a number for each."""
    numbers = np.arange(len(objective.trials))
    place = {id(trial): i for i, trial in enumerate(objective.trials)}
    for group in replicate_groups(objective.trials):
        numbers[[place[id(trial)] for trial in group]] = place[id(group[0])]
    return np.unique(numbers, return_inverse=True)[1]


def _choose(
    between: Variance, within: Variance, across: Variance | None, places: Variance | None, independent: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Standard errors (P,) and their degrees of freedom: between trials where they know it, or else within them.

    A few trials may by chance differ little: no interval is narrower than what varies within them allows.

    Args:
        between, within: trials are the blocks, or pieces of them.
        across: manoeuvres are the blocks, where the model is wrong about them; then no error is less than that.
        places: pieces of manoeuvres are the blocks, where there are replicates; no interval is narrower than that.
        independent: (P,) variances if all samples were independent.
    """
    enough = (between.freedom >= ENOUGH) & (between.told > 0.5)
    pieces, drives = np.maximum(np.diag(within.covariance), independent), np.diag(between.covariance)
    enough &= _width(drives, between.freedom) >= _width(pieces, within.freedom)
    variance = np.where(enough, drives, pieces)
    freedom = np.where(enough, between.freedom, within.freedom)
    if across is not None:
        wrong = (across.told > 0.5) & (np.diag(across.covariance) > variance)
        variance = np.where(wrong, np.diag(across.covariance), variance)
        freedom = np.where(wrong, across.freedom, freedom)
    if places is not None:
        drives = np.diag(places.covariance)
        shared = (places.told > 0.5) & (places.freedom >= ENOUGH)
        shared &= _width(drives, places.freedom) > _width(variance, freedom)
        variance = np.where(shared, drives, variance)
        freedom = np.where(shared, places.freedom, freedom)
    return np.sqrt(variance), np.maximum(freedom, 1.0)


def _width(variance: np.ndarray, freedom: np.ndarray) -> np.ndarray:
    """Half widths (P,) of intervals."""
    from scipy import stats

    return stats.t.ppf((1 + CONFIDENCE) / 2, np.maximum(freedom, 1.0)) * np.sqrt(variance)


def _pieces(
    objective: Told, jacobian: np.ndarray, residual: np.ndarray, told: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """J^T r (B, PIECES, P) and J^T J (B, PIECES, P, P) of pieces of trials, all channels of a piece together.

    Args:
        told: (B, K, P) the Jacobian with which residuals beyond the bend of a robust loss tell no curvature.
    """
    piece = objective.pieces(PIECES)
    piece = np.pad(piece, (0, residual.shape[1] - len(piece)))  # errors of the start belong to the first piece
    parts = [np.flatnonzero(piece == k) for k in range(PIECES)]
    scores = [np.einsum("bkp,bk->bp", jacobian[:, part], residual[:, part]) for part in parts]
    blocks = [told[:, part].swapaxes(1, 2) @ jacobian[:, part] for part in parts]
    return np.stack(scores, axis=1), np.stack(blocks, axis=1)

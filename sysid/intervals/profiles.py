"""Profile likelihoods: how well a log knows one parameter when all others make the best of each of its values.

Their increase is divided by what the sandwich variance exceeds that of independent residuals by (Rotnitzky and Jewell
1990).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sysid.errors.pose_objective import DriveResiduals
from sysid.errors.space import Space, robust_cost
from sysid.intervals.uncertainty import Uncertainty
from sysid.search import least_squares
from sysid.search.result import Progress

POINTS = 9
ITERATIONS = 4
BETTER = 0.02  # of the threshold by which another point must be better to be reported
REACH = 2.0  # how far the grid reaches, in half-widths of the interval from curvature


@dataclass(frozen=True)
class Profile:
    """The profile likelihood of one parameter."""

    name: str
    values: np.ndarray  # (G,) ascending
    cost: np.ndarray  # (G,) mean squared residual, the other parameters at their best
    statistic: np.ndarray  # (G,) 0 at the best; twice the loss of log likelihood
    threshold: float  # of the statistic at the confidence level
    interval: tuple[float | None, float | None]  # where the statistic crosses the threshold, if it does
    others: np.ndarray  # (G, P) values of all parameters
    fitted: float  # value where the fit had ended

    def remark(self, space: Space) -> str:
        """Which ends of the interval are open, and whether the profile found a better point than the fit."""
        index = space.names.index(self.name)
        ends = []
        best = self.statistic.argmin()
        if self.statistic[np.abs(self.values - self.fitted).argmin()] > BETTER * self.threshold:
            ends.append(f"better at {self.values[best]:.4g} than where the fit ended")
        for end, edge, bound in ((self.interval[0], self.values[0], space.low[index]),
                                 (self.interval[1], self.values[-1], space.high[index])):
            side = "below" if bound == space.low[index] else "above"
            if end is None:
                at_bound = abs(edge - bound) < 1e-6 * (space.high[index] - space.low[index])
                ends.append(f"open {side}{': even its bound is allowed' if at_bound else ''}")
        return ", ".join(ends)


def profile(
    objective: DriveResiduals, known: Uncertainty, names: Sequence[str], robust: bool = False, *, points: int = POINTS,
    progress: Progress | None = None,
) -> list[Profile]:
    """Profile likelihoods of `names` at the fitted point, all `points` of a grid searched together; ValueError where a
    name is not searched. `known`: intervals there, which set a grid's reach; a parameter that is not determined gets
    its whole range. `robust`: it is the minimum of the Huber loss."""
    space, u = objective.space, known.evidence.u
    check_names(space, names)
    sd = np.maximum(known.deviation, 1e-8)
    scale = _scale(objective, u, known, sd)
    best = float(robust_cost(objective.residuals(u[None]), robust)[0]) / objective.counted
    found = []
    for name in names:
        index = space.names.index(name)
        quantile = float(known.quantile[index])
        reach = REACH * quantile * sd[index] if known.estimates[index].identifiable else 1.0
        low, high = max(u[index] - reach, 0.0), min(u[index] + reach, 1.0)
        grid = np.unique(np.round(np.append(np.linspace(low, high, points), u[index]), 9))
        # Along the valley: what the others do when this one is moved, to first order.
        slope = known.covariance[:, index] / max(known.covariance[index, index], 1e-16)
        starts = np.clip(space.moved(np.tile(u, (len(grid), 1)), (grid - u[index])[:, None] * slope), 0.0, 1.0)
        starts[:, index] = grid
        result = least_squares.fit(objective, starts=starts, stop=least_squares.Stopping(ITERATIONS), robust=robust,
                                   frozen=(name,), progress=progress)
        order = np.argsort(result.starts[:, index])
        cost = np.minimum(result.start_costs[order], np.where(np.isclose(grid, u[index], atol=1e-9), best, np.inf))
        statistic = (cost - cost.min()) * objective.counted / scale[index]
        values = space.to_values(result.starts[order])
        interval = crossings(values[:, index], statistic, quantile**2)
        found.append(Profile(name, values[:, index], cost, statistic, quantile**2, interval, values,
                             float(space.to_values(u)[index])))
    return found


def check_names(space: Space, names: Sequence[str]) -> None:
    """ValueError where a parameter to be profiled is not searched."""
    for name in names:
        if name not in space.names:
            raise ValueError(f"profile of {name!r}: it is not among the fitted parameters ({', '.join(space.names)}). "
                             "Correct the name, or fit it as well (--parameters).")


def crossings(values: np.ndarray, statistic: np.ndarray, threshold: float) -> tuple[float | None, float | None]:
    """Where the statistic (G,) first exceeds the threshold on either side of its least value; None where it never does.

    Its root is interpolated: it is linear where the profile is a parabola.
    """
    root, level, middle = np.sqrt(statistic), np.sqrt(threshold), int(statistic.argmin())

    def cross(indices: range) -> float | None:
        before = middle
        for i in indices:
            if root[i] > level:
                share = (level - root[before]) / (root[i] - root[before])
                return float(values[before] + share * (values[i] - values[before]))
            before = i
        return None

    return cross(range(middle - 1, -1, -1)), cross(range(middle + 1, len(values)))


def _scale(objective: DriveResiduals, u: np.ndarray, known: Uncertainty, sd: np.ndarray) -> np.ndarray:
    """(P,) by how much squares over-count: sandwich variance over that of independent residuals of variance 1."""
    _, jacobian = (array[0] for array in objective.jacobian(u[None]))
    hessian = np.einsum("bkp,bkq->pq", jacobian, jacobian)
    ridge = 1e-9 * max(float(np.diag(hessian).max()), 1e-12)
    naive = np.diag(np.linalg.inv(hessian + ridge * np.eye(len(u))))
    ratio = np.maximum(sd**2 / naive, 1e-12)
    determined = np.array([one.identifiable for one in known.estimates])
    usual = float(np.median(ratio[determined])) if determined.any() else float(np.median(ratio))
    return np.where(determined, ratio, usual)

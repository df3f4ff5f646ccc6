"""Slopes of residuals over the range that estimates err in: the floor of a cost is jagged, where wheels stick or slip.

A plane is laid through residuals at points of the ellipsoid of the errors (statistical linearisation; Gelb, 1974,
chapter 6).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from sysid.errors.space import Residuals, huber_weight, robust_cost
from sysid.search.gauss_newton import BoxStep, normal_sums
from sysid.search.result import FitResult, Progress
from whill_mjx.io.steps import step

ROTATIONS = 3  # of the ellipsoid's axes, at random: each has points at both ends of all P axes
AT_ONCE = 2**23  # residuals, of points that are replayed together
REFLECTIONS = 8  # passes over the walls of the box; what is outside still then is moved inwards
REACH = 0.08  # largest standard deviation of the points, in unit coordinates: further away lie other valleys
EXACT = 1e-9  # least cost, in squared noise scales: a model that fits to the last bit still has an ellipsoid
ROUNDS, MISSES, WORTH = 24, 3, 2e-4
"""Maximum rounds of a descent; patience; the share of the cost that a round must gain unless squares fall by one."""
DAMPINGS = tuple(np.logspace(-6, 1, 15))  # tried in each round
SIZES = (1.0, 0.3)  # of the ellipsoid, in turn; within the smaller one parameters that move little act linearly


def average_slopes(
    objective: Residuals, u: np.ndarray, covariance: np.ndarray, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (B, K) at u (P,), and their derivatives (B, K, P) averaged over errors of that covariance (P, P),
    reflected into the range."""
    size, random = len(u), np.random.default_rng(seed)
    axes = np.concatenate([np.linalg.qr(random.standard_normal((size, size)))[0] for _ in range(ROTATIONS)])
    steps = np.sqrt(size) * axes @ _root(covariance).T  # as far out as errors are on average
    moves = within(u, np.concatenate([steps, -steps]), covariance)
    weights = np.linalg.pinv(np.column_stack([moves, np.ones(len(moves))]))[:size]  # (P, N)
    residual = objective.residuals(u[None])[0]
    slopes, count = np.zeros((*residual.shape, size)), max(AT_ONCE // residual.size, 1)
    points = np.clip(objective.space.moved(np.tile(u, (len(moves), 1)), moves), 0.0, 1.0)
    for first in range(0, len(moves), count):
        part = slice(first, first + count)
        slopes += np.tensordot(objective.residuals(points[part]), weights[:, part], (0, 1))
    return residual, slopes


def _root(covariance: np.ndarray) -> np.ndarray:
    """R (P, P) with R R^T the covariance."""
    try:
        return np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:  # by rounding, where some parameters are known far better than others
        value, vector = np.linalg.eigh(covariance)
        return vector * np.sqrt(np.maximum(value, 0.0))


def within(u: np.ndarray, moves: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Moves (N, P) from u (P,) that stay in the unit box: a wall reflects a move to the point that is as likely in the
    ellipsoid of the covariance, correlated parameters with it."""
    moves = moves.copy()
    for _ in range(REFLECTIONS):
        for p in range(len(u)):
            beyond = (u[p] + moves[:, p] < 0.0) | (u[p] + moves[:, p] > 1.0)
            moves[beyond] -= 2 * moves[beyond, p, None] * covariance[:, p] / covariance[p, p]
    room = np.where(moves > 0, 1.0 - u, u) / np.maximum(np.abs(moves), 1e-300)
    return moves * np.minimum(room.min(1, keepdims=True), 1.0)


def products(jacobian: np.ndarray) -> np.ndarray:
    """J^T J (P, P) of derivatives (B, K, P)."""
    rows = jacobian.reshape(-1, jacobian.shape[-1])
    return np.asarray(rows.T @ rows)


def likely_by(hessian: np.ndarray, variance: float) -> np.ndarray:
    """Covariance (P, P) of errors in unit coordinates, from J^T J (P, P) of residuals with this variance."""
    return np.linalg.inv(hessian / max(variance, EXACT) + np.eye(len(hessian)) / REACH**2)


def descend(
    objective: Residuals, result: FitResult, robust: bool = False, seed: int = 0, progress: Progress | None = None
) -> FitResult:
    """The result with where damped Gauss-Newton steps with averaged slopes lead from its u, as long as costs fall."""
    u, cost, spent, misses = result.u, result.cost, 0, 0
    box, history = BoxStep(move=objective.space.moved), []
    (hessian,) = step("slopes", lambda: [products(objective.jacobian(u[None])[1][0])], u)
    for number in range(ROUNDS):
        before = cost
        covariance = likely_by(hessian, cost) * SIZES[number % len(SIZES)] ** 2

        def compute(u: np.ndarray = u, covariance: np.ndarray = covariance, seed: int = seed + number) -> list[Any]:
            residual, slopes = average_slopes(objective, u, covariance, seed)
            weight = huber_weight(residual) if robust else None
            (gradient,), (curvature,) = normal_sums(residual[None], slopes[None], weight)
            points = box.points(np.tile(u, (len(DAMPINGS), 1)), gradient, curvature, np.array(DAMPINGS))
            return [products(slopes), points, robust_cost(objective.residuals(points), robust) / objective.counted]

        hessian, points, costs = step("round", compute, u, covariance)
        spent += 1 + 2 * ROTATIONS * len(u) + len(points)
        if costs.min() < cost:
            u, cost = points[costs.argmin()], float(costs.min())
        history.append(cost)
        if progress is not None:
            progress(1, f"cost {cost:.4g}")
        misses = 0 if cost < before * (1 - min(WORTH, 1 / objective.counted)) else misses + 1
        if misses == MISSES:
            break
    return replace(result, u=u, cost=cost, history=np.concatenate([result.history, history]),
                   evaluations=result.evaluations + spent)

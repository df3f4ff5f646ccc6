"""The base model fitted to drives in features: bounded Levenberg-Marquardt, and a prior."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sysid.errors.noise import Whitener
from sysid.errors.space import Space
from sysid.missing.drives import Drives
from sysid.search.result import Progress

DAMPINGS = (0.1, 1.0, 10.0, 100.0)
MAX_STEP = 0.3  # of the range, in one iteration


@dataclass(frozen=True)
class BaseFit:
    """The base model at its best."""

    u: np.ndarray  # (P,) unit coordinates
    cost: float
    """Sum of squared white residuals and of the prior."""


def fit_base(
    drives: Drives, space: Space, whitener: Whitener, start: np.ndarray, sizes: np.ndarray, iterations: int = 15,
    tolerance: float = 1e-3, prior: tuple[np.ndarray, np.ndarray] | None = None,
    progress: Progress | None = None,
) -> BaseFit:
    """Minimise |W (y - f(u))|^2 over the unit box.

    Args:
        drives: replays over exactly the parameters of `space`.
        start: (P,) unit coordinates.
        prior: mean (P,) and precision (P, P) of the unit coordinates.
        sizes: (P,) over which derivatives are taken, in unit coordinates. Differences over what a day changes smooth
            out the roughness of skids, and need no compilation of their own.
    """
    target, mask = drives.target, drives.mask
    middle, precision = prior if prior is not None else (start, np.zeros((len(start), len(start))))

    def penalty(u: np.ndarray) -> float:
        return float((u - middle) @ precision @ (u - middle))

    u, damping, cost = start.copy(), 1e-2, np.inf
    for iteration in range(iterations):
        value, slope = drives.linearised(space.to_values, u, sizes)
        residual = whitener.apply(target - value, mask).reshape(-1)
        jacobian = whitener.apply(slope, mask).reshape(len(residual), -1)
        cost = float(residual @ residual) + penalty(u)
        gradient, hessian = jacobian.T @ residual - precision @ (u - middle), jacobian.T @ jacobian + precision
        tried = np.stack([_step(u, gradient, hessian, damping * factor) for factor in DAMPINGS])
        values = drives.simulate(space.to_values(tried))
        costs = [float(np.square(whitener.apply(target - one, mask)).sum()) + penalty(tried[i])
                 for i, one in enumerate(values)]
        best = int(np.argmin(costs))
        if progress is not None:
            progress(1, f"base fit, cost {min(cost, costs[best]) / (mask > 0).sum():.3f}")
        if costs[best] < cost:
            calm = cost - costs[best] < tolerance * cost
            u, cost = tried[best], costs[best]
            damping = float(np.clip(damping * DAMPINGS[best], 1e-7, 1e4))
            if calm and iteration > 2:
                break
        elif damping >= 1e4:
            break
        else:
            damping = min(damping * 100.0, 1e4)
    return BaseFit(u, cost)


def _step(u: np.ndarray, gradient: np.ndarray, hessian: np.ndarray, damping: float) -> np.ndarray:
    """Damped Gauss-Newton point; parameters at a wall that would leave the box are held."""
    free = ~((u <= 0.0) & (gradient < 0)) & ~((u >= 1.0) & (gradient > 0))
    new = u.copy()
    index = np.flatnonzero(free)
    block = hessian[np.ix_(index, index)]
    scale = np.diag(block) + 1e-6 * max(float(np.diag(hessian).max()), 1e-12)
    step = np.linalg.solve(block + damping * np.diag(scale), gradient[index])
    new[index] = np.clip(u[index] + np.clip(step, -MAX_STEP, MAX_STEP), 0.0, 1.0)
    return new

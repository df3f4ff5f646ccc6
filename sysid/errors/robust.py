"""The Huber loss: squares for small residuals, linear for large ones."""

from __future__ import annotations

from typing import Any

from sysid.replay.arrays import namespace

HUBER = 4.0  # noise scales beyond which a robust fit counts a residual linearly


def huber_weight(residual: Any) -> Any:
    """Weight of the squares whose minimum is that of the Huber loss."""
    xp = namespace(residual)
    return xp.minimum(1.0, HUBER / xp.maximum(xp.abs(residual), 1e-12))


def robust_cost(residual: Any, robust: Any) -> Any:
    """Sum (N,) of squares, or of the Huber loss, over residuals (N, B, K). `robust` may be traced."""
    xp = namespace(residual)
    if robust is False:
        return xp.square(residual).sum((-1, -2))
    size = xp.abs(residual)
    linear = (size > HUBER) & robust
    return xp.where(linear, 2 * HUBER * size - HUBER**2, size**2).sum((-1, -2))

"""Variances of least-squares estimates whose errors are correlated within blocks, and how well those are known.

Gradients are added within a block before they are squared. Each block's residual is divided by the root of what the fit
leaves of independent errors, I - H_gg (CR2, unbiased for those). Few blocks know their own variance badly: its degrees
of freedom are Satterthwaite's. Source: Bell and McCaffrey (2002); Pustejovsky and Tipton (2018).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

LEAST_LEFT = 1e-3
"""Of a direction of which a block keeps less than this share of its errors, its residual says nothing."""


@dataclass(frozen=True)
class Sandwich:
    """How G independent blocks move P estimates."""

    moves: np.ndarray  # (G, P, P): of each block's J^T r, corrected for what the estimates follow
    freedom: np.ndarray  # (P,) degrees of freedom of the variances
    informed: np.ndarray  # (P,) expected variance for independent errors, over what it is then

    def covariance(self, scores: np.ndarray) -> np.ndarray:
        """(P, P) of the estimates, from J_g^T r_g (G, P) of each block at the minimum."""
        moved = np.einsum("gpq,gq->gp", self.moves, scores)
        return moved.T @ moved

    def variances(self, scores: np.ndarray) -> np.ndarray:
        """(N, P) diagonals of covariances, from scores (N, G, P)."""
        return np.square(np.einsum("gpq,ngq->ngp", self.moves, scores, optimize=True)).sum(1)


def sandwich(blocks: np.ndarray, inverse: np.ndarray) -> Sandwich:
    """The variances of a minimum of squares, from J_g^T J_g (G, P, P) of blocks and the inverse (P, P) of their sum."""
    value, vector = np.linalg.eigh(inverse)
    half = (vector * np.sqrt(np.maximum(value, 0.0))) @ vector.T
    share, axes = np.linalg.eigh(half @ blocks @ half)  # (G, P), (G, P, P): of the errors that the estimates follow
    left = 1.0 - np.clip(share, 0.0, 1.0)
    gain = np.where(left > LEAST_LEFT, np.maximum(left, LEAST_LEFT) ** -0.5, 0.0)
    local = axes.swapaxes(1, 2) @ half  # (G, P, P)
    # Of independent errors of variance 1, blocks g and h move p with the covariance lengths_gp (g = h) - z_gp^T z_hp.
    lengths = np.einsum("gkp,gk->gp", local**2, share * gain**2)
    z = axes @ ((share * gain)[..., None] * local)  # (G, P, P)
    freedom, expected = np.empty(len(inverse)), np.empty(len(inverse))
    for p in range(len(inverse)):
        products = np.diag(lengths[:, p]) - z[:, :, p] @ z[:, :, p].T
        expected[p] = np.trace(products)
        freedom[p] = expected[p] ** 2 / max(float(np.square(products).sum()), 1e-300)
    return Sandwich(local.swapaxes(1, 2) @ (gain[..., None] * local), freedom,
                    expected / np.maximum(np.diag(inverse), 1e-300))

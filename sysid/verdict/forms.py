"""What other forms of the effects found so far could do instead of a further effect.

No vehicle follows the catalogue's laws exactly. What such a law leaves is again the effect's own signature, only larger
or smaller with speed, turning, time or manoeuvre, or earlier or later. A further effect that such columns imitate, or
that explains no more than they do, may only mend the form of those before it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sysid.missing.joint_fit import Refit
from sysid.missing.refit import Refitter, without_each

USUAL = 0.5
"""Standard deviation of the sizes of such columns, as a share of the effect."""
MOST = 2.0
"""Largest size of a modulation: it is 1 at the 90 % quantile of the speed."""
RIDGE = 1e-9


@dataclass(frozen=True)
class Forms:
    """The last effect of a joint fit beside other forms of those before it."""

    own: float
    """Share of its signature's square, beside base parameters and the other effects, that they do not imitate."""
    instead: float
    """By how much they lower the cost without it, as a share of what it does."""


def other_forms(refitter: Refitter, fit: Refit, groups: Sequence[Sequence[int]]) -> Forms:
    """Let every effect but the last of a joint fit have another form. Linear, around the fit.

    Args:
        groups: trials of each manoeuvre.
    """
    whole, *less = refitter.drives.simulate(np.stack([fit.values, *without_each(fit, refitter)[:-1]]))
    bent = np.concatenate([refitter.white(modulated(whole - one, whole, groups)) for one in less], axis=-1)
    size, part = len(fit.u), fit.parts[-1]
    columns = fit.jacobian.reshape(-1, fit.jacobian.shape[-1])
    others, mine = np.split(columns, [size + part.start], axis=1)  # the last effect's columns are the last
    bent = bent.reshape(len(columns), -1)
    prior = np.zeros((others.shape[1],) * 2)
    prior[:size, :size] = refitter.precision
    wide = np.pad(prior, (0, bent.shape[1]))
    wide[np.diag_indices(len(wide))] += np.repeat([0.0, USUAL**-2], [len(prior), bent.shape[1]])
    signature = mine @ fit.q[part]
    without_it = fit.residual.reshape(-1) + signature
    forms = np.concatenate([others, bent], axis=1)
    cost = left(without_it, others, prior)
    gain = cost - left(without_it, columns, np.pad(prior, (0, mine.shape[1])))
    return Forms(left(signature, forms, wide) / max(left(signature, others, prior), 1e-9),
                 (cost - left(without_it, forms, wide)) / max(gain, 1e-9))


def modulated(change: np.ndarray, motion: np.ndarray, groups: Sequence[Sequence[int]]) -> np.ndarray:
    """What an effect changes, `change` (B, K, C), in other forms (B, K, C, m): in proportion to functions of the
    features `motion` (B, K, C) and of time, shifted in time, and of a size of its own in each manoeuvre."""
    scale = np.maximum(np.quantile(np.abs(motion[..., :2]), 0.9, axis=(0, 1)), 1e-6)
    v, omega = np.moveaxis(motion[..., :2] / scale, -1, 0)
    time = np.broadcast_to(np.linspace(-1.0, 1.0, motion.shape[1]), v.shape)
    factors = [np.clip(one, -MOST, MOST) for one in (v, np.abs(v), v**2, omega, np.abs(omega), omega**2, time)]
    factors += [np.isin(np.arange(len(v)), group)[:, None] * np.ones_like(v) for group in groups]
    early, late = np.zeros_like(change), np.zeros_like(change)
    early[:, :-1], late[:, 1:] = change[:, 1:], change[:, :-1]
    return np.stack([*(change * one[..., None] for one in factors), (early - late) / 2, early + late - 2 * change], -1)


def left(values: np.ndarray, columns: np.ndarray, prior: np.ndarray) -> float:
    """Least cost of values (n,) after a fit of columns (n, m) with the precision (m, m) of their sizes."""
    matrix = columns.T @ columns + prior
    matrix[np.diag_indices(len(matrix))] += RIDGE * max(float(np.trace(matrix)), 1e-9)
    right = columns.T @ values
    return float(values @ values - right @ np.linalg.solve(matrix, right))

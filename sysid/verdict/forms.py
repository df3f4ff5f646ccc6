"""A further effect beside other forms of those before it.

No vehicle follows the catalogue's laws exactly. What such a law leaves is again the effect's own signature, only larger
or smaller with speed, turning, time or manoeuvre, or earlier or later. Every effect may therefore have another form,
whose columns have a prior of `Thresholds.form` times its size (Kennedy and O'Hagan 2001). What these explain, no
further effect is needed for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sysid.missing.joint_fit import Refit, Replays, without_each

MOST = 2.0
"""Largest size of a modulation: it is 1 at the 90 % quantile of the speed."""
RIDGE = 1e-9


@dataclass(frozen=True)
class Beside:
    """The last effect of a joint fit beside other forms of those before it."""

    gain: float
    """By how much it lowers the cost there."""
    residual: np.ndarray  # (B, n) what is left where every effect may have another form


def beside_forms(refitter: Replays, fit: Refit, groups: Sequence[Sequence[int]], form: float) -> Beside:
    """Let the effects of a joint fit have other forms. Base parameters and sizes move linearly around the fit; the last
    effect is taken away whole, since its columns say little of a dead zone or a limit without it.

    Args:
        groups: trials of each manoeuvre.
        form: root mean square of all forms of an effect together, as a share of what it changes.
    """
    whole, *less = refitter.drives.simulate(np.stack([fit.values, *without_each(fit, refitter)]))
    changes = [refitter.white(whole - one) for one in less]
    bent = [refitter.white(modulated(whole - one, whole, groups)) for one in less]
    bent = [one * (np.square(change).sum() / max(np.square(one).sum(), 1e-12)) ** 0.5
            for one, change in zip(bent, changes, strict=True)]
    size, last = len(fit.u), len(fit.u) + fit.parts[-1].start
    columns, mine = fit.jacobian.reshape(-1, fit.jacobian.shape[-1]), changes[-1].reshape(-1, 1)
    target = fit.residual.reshape(-1) + columns[:, :size] @ (fit.u - refitter.reference.u) + mine[:, 0]
    forms = np.concatenate([one.reshape(len(columns), -1) for one in bent], axis=1)
    before = forms[:, : sum(one.shape[-1] for one in bent[:-1])]
    columns = np.concatenate([columns, mine], axis=1)

    def ridge(effects: np.ndarray, others: np.ndarray) -> tuple[float, np.ndarray]:
        """Least cost of the target, and what is then left (n,)."""
        design = np.concatenate([effects, others], axis=1)
        prior = np.diag(np.repeat([0.0, form**-2], [effects.shape[1], others.shape[1]]))
        prior[:size, :size] = refitter.precision
        matrix = design.T @ design + prior
        matrix[np.diag_indices(len(matrix))] += RIDGE * max(float(np.trace(matrix)), 1e-9)
        right = design.T @ target
        solution = np.linalg.solve(matrix, right)
        return float(target @ target - right @ solution), target - design @ solution

    gain = ridge(columns[:, :last], before)[0] - ridge(columns, before)[0]
    return Beside(max(gain, 0.0), ridge(columns, forms)[1].reshape(fit.residual.shape))


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

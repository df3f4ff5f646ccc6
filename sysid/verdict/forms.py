"""What other forms of the effects found so far could do instead of a further effect.

No vehicle follows the catalogue's laws exactly. What such a law leaves is again the effect's own signature, only larger
or smaller with speed, turning, time or manoeuvre, or earlier or later. A further effect must predict manoeuvres that
were held back beside such columns; else it may only mend the form of those before it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sysid.missing.joint_fit import Refit
from sysid.missing.refit import Refitter, without_each
from sysid.verdict.agreement import foretold, interval_of_sum

USUAL = 0.5
"""Standard deviation of the sizes of such columns, as a share of the effect."""
MOST = 2.0
"""Largest size of a modulation: it is 1 at the 90 % quantile of the speed."""


def beside_forms(refitter: Refitter, fit: Refit, groups: Sequence[Sequence[int]]) -> tuple[float, float]:
    """95 % interval of what the last effect of a joint fit gains in manoeuvres that it was not fitted to, where every
    effect before it may have another form. Linear, around the fit.

    Args:
        groups: trials of each manoeuvre.
    """
    whole, *less = refitter.drives.simulate(np.stack([fit.values, *without_each(fit, refitter)[:-1]]))
    bent = np.concatenate([refitter.white(modulated(whole - one, whole, groups)) for one in less], axis=-1)
    size, count = len(fit.u), bent.shape[-1]
    prior = np.zeros((size + count,) * 2)
    prior[:size, :size] = refitter.precision
    prior[np.diag_indices(len(prior))] += np.repeat([0.0, USUAL**-2], [size, count])
    columns = np.concatenate([fit.jacobian[..., :size], bent, fit.jacobian[..., size:]], axis=-1)
    free = replace(fit, u=np.concatenate([fit.u, np.zeros(count)]), jacobian=columns)
    return interval_of_sum(foretold(free, fit.parts[-1], groups, prior))


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

"""Sensors that are noisier or quieter than on the reference days: measured first, so that it is not taken for an
effect."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sysid.errors.features import channel_names
from sysid.errors.noise import NoiseLevels, NoisyDrives, noise_levels, replicate_groups, steady_bins
from sysid.missing.days import Reference
from sysid.missing.drives import Drives
from sysid.missing.reference import replicate_groups_by_day
from sysid.verdict.result import Prepared


def compared(drives: Drives, at: np.ndarray, reference: Reference, alpha: float) -> NoiseLevels | None:
    """Noise of some drives beside that of the reference days; None where there are no such days.

    Args:
        at: (B, K, C) features of the base model at the reference.
    """
    days = reference.leftovers
    theirs = tuple(one.trial for one in days)
    if not reference.known or reference.simulated:
        return None
    bins = drives.target.shape[1]
    ours = NoisyDrives(reference.target_of(drives) - at, drives.mask, replicate_groups(drives.trials),
                       np.stack([steady_bins(one, bins, reference.width) for one in drives.trials]))
    usual = NoisyDrives(
        np.stack([one.series - reference.expected_on_others(one) for one in days]),
        np.stack([one.mask for one in days]), replicate_groups_by_day(theirs, np.array([one.day for one in days])),
        np.stack([steady_bins(one, len(days[0].series), reference.width) for one in theirs]))
    return noise_levels(ours, usual, channel_names(drives.target.shape[-1]), alpha)


def with_noise(ready: Prepared, levels: NoiseLevels | None) -> Prepared:
    """The vehicle as it is judged where sensors have this noise.

    Noisier channels weigh less. Quieter ones weigh as before: what days differ by is known no better than the noise
    of the reference days lets it be. There the error is compared with the smaller noise instead.
    """
    if levels is None or not levels.changed.any():
        return ready
    reference, wander = ready.reference, ready.wander
    shared, changed = reference.shared, float(levels.changed.mean())
    louder = np.sqrt(levels.louder**2 * (1 - shared) + shared)  # what replicates share is no noise of sensors
    own = float(np.mean(levels.louder**2 * levels.quieter**2 / louder**2)) * (1 - shared)
    common = shared * float(np.mean(1 / louder**2))
    level = own + common
    unsure = 2 * levels.error * np.sqrt(changed / len(levels.changed))
    excess = float(np.hypot(wander.excess / min(level, 1.0), unsure))
    return replace(ready, reference=reference.noisier(louder),
                   wander=replace(wander, excess=excess, scatter=wander.scatter * common / max(shared, 1e-9) / level,
                                  level=level))

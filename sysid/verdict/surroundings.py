"""What differs from the reference days without an effect: the noise of sensors, and the floor.

The floor is compared without the model (`sysid.logs.floor`), in which base parameters may follow it. A quantity that
differs beyond chance (Bonferroni over all) makes another floor; others are its members beyond twice their error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sysid.errors.features import channel_names
from sysid.errors.noise import NoiseLevels, NoisyDrives, noise_levels, replicate_groups, steady_bins
from sysid.logs.floor import BLOCKS, FloorChange, Sums, compared, in_blocks, over_days, sums_of
from sysid.logs.records import Trial
from sysid.missing.days import Reference
from sysid.missing.drives import Drives
from sysid.missing.reference import replicate_groups_by_day
from sysid.verdict.result import Prepared


def floor_change(reference: Reference, trials: Sequence[Trial], alpha: float) -> FloorChange | None:
    """Change of the floor from the reference days to some drives, at a p-value below `alpha`; None where they could not
    show it."""
    if not reference.known or reference.simulated:
        return None
    days: dict[int, list[Sums]] = {}
    for one in reference.leftovers:
        if (sums := sums_of(one.trial)) is not None:
            days.setdefault(0 if reference.blocks else one.day, []).append(sums)
    mine = in_blocks([sums for trial in trials if (sums := sums_of(trial)) is not None])
    alone = len(days) == 1
    theirs = in_blocks(next(iter(days.values()))) if alone else over_days(list(days.values()))
    if mine is None or theirs is None:
        return None
    return compared(theirs, mine, 2 * (BLOCKS - 1) if alone else len(days) - 1, alpha)


def noise_change(drives: Drives, at: np.ndarray, reference: Reference, alpha: float) -> NoiseLevels | None:
    """Noise of some drives beside that of the reference days; None where there are no such days. `at`: (B, K, C)
    features of the base model at the reference."""
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

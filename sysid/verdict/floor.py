"""Another floor: several properties of a vehicle that a floor changes together, as one change with its values.

The search asks what a vehicle lacks; base parameters may move as far as from day to day meanwhile, and what a floor
changes is in there. It is therefore measured without the model (`sysid.logs.floor`): each quantity on the drives is
compared with that on the reference days. One that differs beyond chance (Bonferroni over all of them) makes another
floor; the others are its members where they differ by more than twice their error.
"""

from __future__ import annotations

from collections.abc import Sequence

from sysid.logs.floor import BLOCKS, FloorChange, Sums, compared, in_blocks, over_days, sums_of
from sysid.logs.records import Trial
from sysid.missing.days import Reference


def floor_change(reference: Reference, trials: Sequence[Trial], alpha: float) -> FloorChange | None:
    """Change of the floor from the reference days to some drives; None where they could not show it.

    Args:
        alpha: p-value below which the floor is another one.
    """
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

"""Another floor: several properties of a vehicle that a floor changes together, as one change with its values.

The search asks what a vehicle lacks; base parameters may move as far as from day to day meanwhile, and what a floor
changes is in there. It is therefore measured without the model (`sysid.logs.floor`): each quantity on the drives is
compared with that on the reference days. One that differs beyond chance (Bonferroni over all of them) makes another
floor; the others are its members where they differ by more than twice their error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats

from sysid.logs.floor import BLOCKS, QUANTITIES, Measured, Quantity, Sums, in_blocks, over_days, sums_of
from sysid.logs.log import Trial
from sysid.missing.days import Reference

NAME = "floor"
MEMBER = 2.0
"""Standard errors beyond which a quantity is a member of the change."""
CONFIDENCE = 1.96


@dataclass(frozen=True)
class Member:
    """One quantity of a change, in its own unit."""

    quantity: Quantity
    before: float
    after: float
    interval: tuple[float, float]
    """95 % of its value on these drives."""
    away: float
    """Difference over its standard error; of a time, of its logarithm."""


@dataclass(frozen=True)
class FloorChange:
    """Whether these drives were driven on another floor than the reference days."""

    members: tuple[Member, ...]
    """What differs, furthest first; where the change is real, at least one."""
    p: float
    """Of drives on the same floor, family-wise over all quantities."""
    tried: int
    """How many those are."""
    named: bool

    @property
    def classes(self) -> tuple[str, ...]:
        """Effects that these drives cannot separate in it: of the quantity that differs most first."""
        return tuple(dict.fromkeys(name for one in self.members for name in one.quantity.effects))

    def report(self) -> dict[str, Any]:
        """As in report.json."""
        return {"name": NAME if self.named else None, "p_value": self.p, "tried": self.tried,
                "class": list(self.classes), "members": [
                    {"quantity": one.quantity.name, "unit": one.quantity.unit, "before": one.before,
                     "value": one.after, "interval": list(one.interval), "away": one.away} for one in self.members]}

    def said(self) -> str:
        """In a sentence without its full stop; "" where nothing changed."""
        if not self.named:
            return ""
        parts = [f"{one.quantity.name} {one.before:.3g} -> {one.after:.3g} ({one.interval[0]:.3g} to "
                 f"{one.interval[1]:.3g}){'' if one.quantity.unit == '-' else ' ' + one.quantity.unit}"
                 for one in self.members]
        return f"another floor (p {self.p:.2g}): {', '.join(parts)}"


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


def compared(theirs: Measured, mine: Measured, freedom: float, alpha: float) -> FloorChange | None:
    """Change from what was measured on one floor to what was measured elsewhere, by errors of so many degrees of
    freedom; None where both show nothing."""
    error = np.hypot(mine.error, theirs.error)
    with np.errstate(invalid="ignore", divide="ignore"):
        away = np.where(error > 0, (mine.value - theirs.value) / error, np.nan)
    known = np.flatnonzero(np.isfinite(away))
    if not len(known):
        return None
    p = float(min(1.0, len(known) * 2 * stats.t.sf(np.abs(away[known]).max(), freedom)))
    far = sorted((i for i in known if abs(away[i]) > MEMBER), key=lambda i: -abs(away[i]))
    members = tuple(_member(QUANTITIES[i], theirs.value[i], mine.value[i], mine.error[i], away[i]) for i in far)
    return FloorChange(members, p, len(known), p < alpha)


def _member(quantity: Quantity, before: float, after: float, error: float, away: float) -> Member:
    ends = np.array([before, after, after - CONFIDENCE * error, after + CONFIDENCE * error])
    first, last, low, high = (np.exp(ends) if quantity.lag else ends).tolist()
    return Member(quantity, first, last, (low, high), float(away))

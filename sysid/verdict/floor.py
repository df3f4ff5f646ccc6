"""Another floor: several parameters of the base model that a floor changes together, as one change.

The search asks what a vehicle lacks; base parameters may move as far as from day to day meanwhile, and what a floor
changes is in there: how well a difference of the wheels turns the vehicle, how late, what rolls and what slides. Those
parameters are estimated from the drives alone, and each is compared with its spread over the reference days and with
its error. One that differs by more than chance (Bonferroni over all of them) makes a change of floor; the others are
its members where they differ by more than twice their spread.

Where the days are blocks of one run, drives as long as several blocks are compared as a mean of so many: blocks differ
by what their commands are and by noise, which both average out over a run.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from scipy import stats

from sysid.missing.days import ASSUMED_DAYS, Reference
from sysid.missing.joint_fit import Refit
from sysid.missing.reference import WEAK_PRIOR
from whill_mjx.vehicle.parameters import set_values

FLOOR = (
    "turn_efficiency.efficiency", "turn_efficiency_speed.per_speed", "turn_lag.time_constant", "yaw_scrub.torque",
    "rolling_resistance.mu_r", "slip_traction.mu", "slip_traction.slip_speed", "slip_traction.side_slip_speed",
    "turning_slip.per_yaw_rate", "side_slip.per_yaw_rate",
)  # fmt: skip
"""What a floor changes of a vehicle, where its base model has it."""
NAME = "floor"
MEMBER = 2.0
"""Standard deviations of a day beyond which a parameter is a member of the change."""
CONFIDENCE = 1.96


@dataclass(frozen=True)
class Member:
    """One parameter of a change, in its own unit."""

    parameter: str
    before: float
    after: float
    error: float
    """Standard error of `after`, of these drives alone."""
    away: float
    """Difference over its standard deviation: the spread of days and the error together."""

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the value on these drives."""
        return self.after - CONFIDENCE * self.error, self.after + CONFIDENCE * self.error


@dataclass(frozen=True)
class FloorChange:
    """Whether these drives were driven on another floor than the reference days."""

    members: tuple[Member, ...]
    """The floor's parameters that differ, furthest first; where the change is real, at least one."""
    p: float
    """Of a day on the same floor, family-wise over all of the floor's parameters."""
    tried: int
    """How many those are."""
    named: bool

    def report(self) -> dict[str, Any]:
        """As in report.json."""
        return {"name": NAME if self.named else None, "p_value": self.p, "tried": self.tried, "members": [
            {"parameter": one.parameter, "before": one.before, "value": one.after, "interval": list(one.interval),
             "away": one.away} for one in self.members]}

    def said(self) -> str:
        """In a sentence without its full stop; "" where nothing changed."""
        if not self.named:
            return ""
        parts = [f"{one.parameter} {one.before:.3g} -> {one.after:.3g} ({one.interval[0]:.3g} to {one.interval[1]:.3g})"
                 for one in self.members]
        return f"another floor (p {self.p:.2g}): {', '.join(parts)}"


def floor_change(
    reference: Reference, base: Refit, excess: float, alpha: float, trials: int | None = None
) -> FloorChange | None:
    """Change of the floor from the reference days to the drives of a base fit; None where nothing could show it.

    Args:
        base: the base model fitted to the drives within its spread.
        excess: squared white residual of that fit over its number, less 1.
        alpha: p-value below which the floor is another one.
        trials: number of the drives; they count as one day by default.
    """
    space = reference.space
    index = [i for i, name in enumerate(space.names) if name in FLOOR]
    if not reference.known or reference.simulated or not index or FLOOR[0] not in space.names:
        return None
    size = space.size
    slopes = base.jacobian[..., :size]
    information = np.einsum("bni,bnj->ij", slopes, slopes) + np.eye(size) / WEAK_PRIOR**2
    error = np.linalg.inv(information) * (1 + max(excess, 0.0))
    moved = base.u - reference.u + np.linalg.solve(information, np.einsum("bni,bn->i", slopes, base.residual))
    total = np.sqrt(np.diag(_of_means(reference, trials) * reference.spread + error))
    away = moved / total
    freedom = len(reference.days) - 1 + ASSUMED_DAYS
    each = 2 * stats.t.sf(np.abs(away[index]), freedom)
    p = float(min(1.0, len(index) * each.min()))
    before = space.to_values(reference.u)
    u = np.clip(reference.u + moved, 0.0, 1.0)
    after, slope = space.to_values(u), space.slope(u)
    far = sorted((i for i in index if abs(away[i]) > MEMBER), key=lambda i: -abs(away[i]))
    members = tuple(Member(space.names[i], float(before[i]), float(after[i]), float(np.sqrt(error[i, i]) * slope[i]),
                           float(away[i])) for i in far)
    return FloorChange(members, p, len(index), p < alpha)


def _of_means(reference: Reference, trials: int | None) -> float:
    """Share of a new day's covariance that the difference of the drives from the reference has."""
    days = len(reference.days)
    if not reference.blocks or trials is None:
        return 1.0
    worth = max(trials / (len(reference.leftovers) / days), 1.0)  # blocks that the drives are as long as
    return (1 / worth + 1 / days) / (1 + 1 / days)


def on_floor(params: Any, change: FloorChange) -> Any:
    """A vehicle on the floor of a change: its members moved, all else as it was."""
    names, values = [one.parameter for one in change.members], [one.after for one in change.members]
    return set_values(params, names, jnp.asarray(values, jnp.result_type(float))) if names else params

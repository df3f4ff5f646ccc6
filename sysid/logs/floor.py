"""What a floor changes of a vehicle, measured on it without a model of it.

A gyro beside the wheels' speeds shows what share of their difference turns the body, to 1 %; the command beside them
how late they turn and drive, and how far they fall short. No outside pose is needed. Physical parameters that say the
same are many, and a log determines their sum only: scrub, slip or a wider track. Block jackknife: Kuensch (1989).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats
from scipy.signal import lfilter

from sysid.logs.records import Command, Trial

DT = 0.05  # s, grid of the sums
SETTLED = 2.0  # s of constant commands after which speeds count as reached
LAGS = np.geomspace(0.05, 5.0, 40)  # s that are tried
BLOCKS = 8
LEAST_TURNED = 0.5  # rad/s, root of the summed squares of a quantity's signal below which a block says nothing
NAME = "floor"
MEMBER = 2.0  # standard errors beyond which a quantity is a member of the change
CONFIDENCE = 1.96


@dataclass(frozen=True)
class Quantity:
    """One thing that a floor changes."""

    name: str
    unit: str
    parameter: str  # of the vehicle's model that says most nearly the same
    effects: tuple[str, ...]  # effects that these drives cannot separate in it
    lag: bool = False  # whether it is a time, whose logarithm is estimated


QUANTITIES = (
    Quantity("turn efficiency", "-", "turn_efficiency.efficiency", ("turn_efficiency", "track_width", "yaw_scrub")),
    Quantity("lag of turning", "s", "turn_lag.time_constant", ("turn_lag", "yaw_scrub"), True),
    Quantity("lag ahead", "s", "torque_drive.kp", ("actuator_lag", "acceleration_limit"), True),
    Quantity("wheels' turning over the command's", "-", "yaw_scrub.torque", ("yaw_scrub", "motor_line",
                                                                           "torque_saturation")),
    Quantity("wheels' speed over the command's", "-", "rolling_resistance.mu_r", ("rolling_resistance", "motor_line",
                                                                                "torque_saturation")),
)  # fmt: skip


@dataclass(frozen=True)
class Sums:
    """Of one trial: products that add up over trials."""

    ratios: np.ndarray  # (3, 2) signal times reference, reference squared
    lags: np.ndarray  # (2, K, 3) filtered command squared, it times what follows, what follows squared


@dataclass(frozen=True)
class Measured:
    """Quantities of some drives, lags as logarithms; nan where the drives do not show one."""

    value: np.ndarray  # (Q,)
    error: np.ndarray  # (Q,)


def sums_of(trial: Trial) -> Sums | None:
    """The sums of a trial; None without a gyro or an odometry."""
    if trial.gyro is None or trial.odometry is None or len(trial.gyro.t) < 2:
        return None
    edge = np.arange(0.0, min(trial.odometry.t[-1], trial.gyro.t[-1]) + 1e-9, DT)
    if len(edge) < 3:
        return None
    t = (edge[1:] + edge[:-1]) / 2
    turning = np.diff(np.interp(edge, trial.gyro.t, trial.gyro.turn)) / DT
    v, omega = (np.interp(t, trial.odometry.t, one) for one in (trial.odometry.v, trial.odometry.omega))
    wanted = trial.commanded(t)
    reached = t - last_change(trial.command, t) >= SETTLED
    pairs = ((turning, omega), (omega, wanted[1]), (v, wanted[0]))
    ratios = np.array([[np.sum(one[reached] * other[reached]), np.sum(other[reached] ** 2)] for one, other in pairs])
    return Sums(ratios, np.stack([_lagging(omega, wanted[1], t), _lagging(v, wanted[0], t)]))


def last_change(command: Command, t: np.ndarray) -> np.ndarray:
    """(T,) time of the last command that was another one, at times t (T,); at first that of the trial's start."""
    moved = np.append(True, np.abs(np.diff(command.table[:, 1:], axis=0)).max(1, initial=0.0) > 0)
    changes = np.append(0.0, command.t[moved][1:])
    return np.asarray(changes[np.maximum(np.searchsorted(changes, t + 1e-9, side="right") - 1, 0)])


def _lagging(signal: np.ndarray, wanted: np.ndarray, t: np.ndarray) -> np.ndarray:
    """(K, 3) sums by which any lag explains a signal (T,) as what is wanted (T,) filtered, from where it began."""
    followed = np.stack([lfilter([0.0, 1 - keep], [1.0, -keep], wanted) for keep in np.exp(-DT / LAGS)])
    rest = signal - signal[0] * np.exp(-(t - t[0]) / LAGS[:, None])
    return np.stack([np.sum(followed**2, 1), np.sum(followed * rest, 1), np.sum(rest**2, 1)], axis=-1)


def measure(sums: Sequence[Sums]) -> np.ndarray:
    """(Q,) quantities of drives together."""
    ratios = np.sum([one.ratios for one in sums], axis=0)
    lags = np.sum([one.lags for one in sums], axis=0)
    known = ratios[:, 1] > LEAST_TURNED**2
    first, *others = np.where(known, ratios[:, 0] / np.where(known, ratios[:, 1], 1.0), np.nan).tolist()
    return np.array([first, _best_lag(lags[0]), _best_lag(lags[1]), *others])


def _best_lag(sums: np.ndarray) -> float:
    """Logarithm of the lag that leaves least, between those tried; nan where it is none of them."""
    squares, product, whole = sums.T
    if squares.max() <= LEAST_TURNED**2:
        return float("nan")
    left = whole - product**2 / np.maximum(squares, 1e-12)
    k = int(np.argmin(left))
    if not 0 < k < len(LAGS) - 1:
        return float("nan")
    x = np.log(LAGS[k - 1 : k + 2])
    bend, slope, _ = np.polyfit(x - x[1], left[k - 1 : k + 2], 2)
    return float(x[1] - slope / (2 * bend)) if bend > 0 else float(x[1])


def in_blocks(sums: Sequence[Sums], blocks: int = BLOCKS) -> Measured | None:
    """Quantities with their errors by leaving out blocks of consecutive drives in turn; None with too few drives."""
    if len(sums) < 2 * blocks:
        return None
    parts = np.array_split(np.arange(len(sums)), blocks)
    without = np.array([measure([sums[i] for j, other in enumerate(parts) if j != k for i in other])
                        for k in range(blocks)])
    error = np.sqrt((blocks - 1) / blocks * np.square(without - without.mean(0)).sum(0))
    return Measured(measure(sums), error)


def over_days(days: Sequence[Sequence[Sums]]) -> Measured | None:
    """Mean of the quantities over days, and how far a new day is from it; None with too few days."""
    if len(days) < 3 or not all(days):
        return None
    each = np.array([measure(day) for day in days])
    return Measured(each.mean(0), each.std(0, ddof=1) * np.sqrt(1 + 1 / len(each)))


@dataclass(frozen=True)
class Member:
    """One quantity of a change, in its own unit."""

    quantity: Quantity
    before: float
    after: float
    interval: tuple[float, float]  # 95 % of its value on these drives
    away: float  # difference over its standard error; of a time, of its logarithm


@dataclass(frozen=True)
class FloorChange:
    """Whether these drives were driven on another floor than the reference days."""

    members: tuple[Member, ...]  # what differs, furthest first; where the change is real, at least one
    p: float  # of drives on the same floor, family-wise over all quantities
    tried: int  # how many those are
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


def compared(theirs: Measured, mine: Measured, freedom: float, alpha: float) -> FloorChange | None:
    """Change between two floors, by errors of so many degrees of freedom; None where both show nothing."""
    error = np.hypot(mine.error, theirs.error)
    with np.errstate(invalid="ignore", divide="ignore"):
        away = np.where(error > 0, (mine.value - theirs.value) / error, np.nan)
    known = np.flatnonzero(np.isfinite(away))
    if not len(known):
        return None
    p = float(min(1.0, len(known) * 2 * stats.t.sf(np.abs(away[known]).max(), freedom)))
    far = sorted((i for i in known if abs(away[i]) > MEMBER), key=lambda i: -abs(away[i]))
    members = []
    for i in far:
        reach = CONFIDENCE * mine.error[i]
        ends = np.array([theirs.value[i], mine.value[i], mine.value[i] - reach, mine.value[i] + reach])
        before, after, low, high = (np.exp(ends) if QUANTITIES[i].lag else ends).tolist()
        members.append(Member(QUANTITIES[i], before, after, (low, high), float(away[i])))
    return FloorChange(tuple(members), p, len(known), p < alpha)

"""Clocks of two streams that disagree: one comes later than the other, or runs faster.

Rates of turning and of motion are compared, since no frame changes them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.signal import correlate

from sysid.logs.records import Trial, command_in_force
from sysid.logs.streams import SMOOTHING, speeds

RESPONSE = 0.3  # s that a vehicle takes to follow its command, where nothing else is known
NONE = 0.02  # m/s, below which a speed is none
VARIED = 0.03  # m/s of standard deviation of a speed that shows a direction
WHOLE = 0.8  # likeness that two streams of one motion have
REACH, LAG_DT = 10.0, 0.1  # s of a clock that is looked for, and its steps
LATE = (0.6, 1.5)  # s that the fit does not reach, beside odometry and beside commands, which a vehicle follows late
UNLIKE = 0.3  # of what is not alike without a shift, that may be left with it
LEFT = {"odometry": 0.5, "commands": UNLIKE}
"""The same with a clock that runs fast, beside what is measured and beside commands, which a vehicle follows late."""
APART = 0.3  # s by which clocks must come apart in a drive to be told from a delay
FASTER, RATE_STEP = 0.2, 0.005  # by which a clock may run fast or slow, and steps of the search


def another_clock(name: str, trials: Sequence[Trial], beside: str = "speeds beside it") -> str:
    """A sentence on a stream of which most trials come later or earlier than the speeds beside it; else empty.

    Args:
        beside: "commands" compares with these, though there is an odometry.
    """
    lates = [late for trial in trials if (late := lateness(trial, name, beside == "commands")) is not None]
    if len(lates) <= len([trial for trial in trials if getattr(trial, name) is not None]) / 2:
        return ""
    late = float(np.median(lates))
    return (f"{name}: its motion comes {abs(late):.1f} s {'later' if late > 0 else 'earlier'} than the {beside}: "
            f"another clock. {'Subtract' if late > 0 else 'Add'} {abs(late):.1f} s {'from' if late > 0 else 'to'} its "
            "t.")


def lateness(trial: Trial, name: str, beside: bool = False) -> float | None:
    """By how much a pose's motion comes later than the speeds beside it [s], where that is more than a fit reaches and
    explains what nothing else does; None otherwise.

    Rates of turning and of motion are compared: no frame changes them.

    Args:
        beside: compare with the commands, though there are measured speeds.
    """
    source, odometry = getattr(trial, name), trial.odometry
    if source is None or source.x is None or source.y is None or source.yaw is None or len(source.t) < 20:
        return None
    begin, end = min(source.t[0], trial.command.t[0]), max(source.t[-1], trial.command.t[-1])
    t = np.arange(begin, end, LAG_DT)
    half = max(SMOOTHING / 2, float(np.median(np.diff(source.t))))
    inside = (t > source.t[0] + half) & (t < source.t[-1] - half)
    x, y, yaw = ((np.interp(t + half, source.t, one) - np.interp(t - half, source.t, one)) / (2 * half) * inside
                 for one in (source.x, source.y, source.yaw))
    held = command_in_force(trial.command, t - RESPONSE)
    v, omega = (np.where(held >= 0, one[np.maximum(held, 0)], 0.0) for one in (trial.command.v, trial.command.omega))
    commanded = beside or odometry is None or bool(max(odometry.v.std(), odometry.omega.std()) <= NONE)
    if odometry is not None and not commanded:
        v, omega = (np.interp(t, odometry.t, one, 0.0, 0.0) for one in (odometry.v, odometry.omega))
    pairs = [(ours, theirs) for ours, theirs in ((yaw, omega), (np.hypot(x, y), np.abs(v)))
             if min(ours.std(), theirs.std()) > VARIED]
    if not pairs:
        return None
    most = len(t) - 1
    # A skid drive turns late and little, a circle has one speed: the pair that fits best shows the clock.
    alike = max((correlate(ours, theirs) / max(float(np.linalg.norm(ours) * np.linalg.norm(theirs)), 1e-9)
                 for ours, theirs in pairs), key=np.max)  # outside of its rows nothing moves
    now, k = float(alike[most]), int(np.argmax(alike))
    bend = alike[k - 1] - 2 * alike[k] + alike[k + 1] if 0 < k < 2 * most else 0.0
    late = (k - most + (0.5 * float((alike[k - 1] - alike[k + 1]) / bend) if bend < 0 else 0.0)) * LAG_DT
    near = round(LATE[commanded] / LAG_DT)
    against = -float(alike[most - near : most + near + 1].min())  # where the sign is reversed
    clear = alike[k] > WHOLE and 1 - alike[k] < UNLIKE * (1 - max(now, against))
    return late if clear and abs(late) > LATE[commanded] else None



def running_fast(name: str, trials: Sequence[Trial], beside: str = "commands") -> str:
    """A sentence on a stream whose clock runs faster or slower than that of the odometry or of the commands; else
    empty.

    Args:
        beside: "odometry" or "commands".
    """
    rates = np.arange(-FASTER, FASTER + RATE_STEP / 2, RATE_STEP)
    curves = [curve for trial in trials if (curve := _unlikeness(trial, name, beside, rates)) is not None]
    if not curves:
        return ""
    unlike = np.mean(curves, axis=0)
    k, now = int(np.argmin(unlike)), float(unlike[len(rates) // 2])
    if not 0 < k < len(rates) - 1 or 1 - unlike[k] < WHOLE or unlike[k] > LEFT[beside] * now:
        return ""
    bend = unlike[k - 1] - 2 * unlike[k] + unlike[k + 1]
    rate = rates[k] + (0.5 * float((unlike[k - 1] - unlike[k + 1]) / bend) if bend > 0 else 0.0) * RATE_STEP
    if abs(rate) * max(trial.duration for trial in trials) < APART:
        return ""
    how = f"about {abs(rate):.0%} {'faster' if rate > 0 else 'slower'}"
    return (f"{name}: its clock runs {how} than that of the {beside}: the two come apart by {abs(rate) * 60:.1f} s in "
            f"a minute. Multiply its t by {1 / (1 + rate):.2f}, or that of the {beside} by {1 + rate:.2f}, whichever "
            "clock is wrong.")


def _unlikeness(trial: Trial, name: str, beside: str, rates: np.ndarray) -> np.ndarray | None:
    """How little a stream's motion is like that beside it if its clock runs fast by each of some shares (R,), at
    whatever delay suits best; None where too little moves."""
    ours = speeds(trial, name, smooth=True)
    theirs = _commanded(trial) if beside == "commands" else speeds(trial, "odometry", smooth=True)
    if ours is None or theirs is None:
        return None
    t = np.arange(min(ours[0][0], theirs[0][0]), max(ours[0][-1], theirs[0][-1]), LAG_DT)
    lags = np.arange(-REACH, REACH + LAG_DT / 2, LAG_DT)
    found = []
    for one, other in ((np.abs(ours[1]), np.abs(theirs[1])), (ours[2], theirs[2])):
        if min(one.std(), other.std()) > VARIED:
            stretched = np.stack([np.interp(t * (1 + rate), ours[0], one, 0.0, 0.0) for rate in rates])
            shifted = np.stack([np.interp(t - lag, theirs[0], other, 0.0, 0.0) for lag in lags])
            sizes = [np.linalg.norm(each, axis=1, keepdims=True) + 1e-9 for each in (stretched, shifted)]
            found.append(1 - ((stretched / sizes[0]) @ (shifted / sizes[1]).T).max(axis=1))
    return np.mean(found, axis=0) if found else None


def _commanded(trial: Trial) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times [s], speed and yaw rate that a vehicle has which follows its commands with a usual lag."""
    t = np.arange(trial.command.t[0], max(trial.duration, trial.command.t[-1]), LAG_DT / 2)
    held = np.maximum(command_in_force(trial.command, t), 0)
    v, omega = trial.command.v[held].copy(), trial.command.omega[held].copy()
    share = 1 - np.exp(-LAG_DT / 2 / RESPONSE)
    for k in range(1, len(t)):
        v[k], omega[k] = v[k - 1] + share * (v[k] - v[k - 1]), omega[k - 1] + share * (omega[k] - omega[k - 1])
    return t, v, omega

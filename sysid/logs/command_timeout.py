"""The time-out of a base: how long it drives on where no command comes, from pauses of the commands in a log.

It is the time from the last command to half of the speed, less that from a command out of rest to half of its speed:
the vehicle responds equally late to both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sysid.logs.records import Log, Trial, with_timeout
from sysid.logs.stream_quality import GRID_DT, speeds

QUIET, PAUSE = 2.5, 1.0  # usual intervals between commands, and s, beyond whichever is shorter they pause
ASKED = (0.05, 0.1)  # m/s and rad/s of a command in force that shows whether the vehicle follows it
STOPPED, DRIVING, HALF = 0.1, 0.6, 0.5  # shares of a speed
SETTLED = 0.2  # s for which the vehicle must have stopped
SLOWEST = 2.0  # s in which a vehicle reaches half of a speed
PEAK = 0.1  # s of the greatest speeds
CONFIDENCE = 0.95


@dataclass(frozen=True)
class Stop:
    """A pause of the commands in which the vehicle stops though the last one was to move."""

    begin: float  # s, of the last command
    pause: float  # s until the next
    falls: float  # s from the last command to half of the speed
    lag: float = 0.0  # s in which it falls by a factor of e, where it stopped before its speed had settled


@dataclass(frozen=True)
class Timeout:
    value: float  # s after the last command
    low: float
    high: float  # 95 % interval [s]
    stops: int
    trials: int  # in which it shows
    first: str  # of them the first
    at: float
    pause: float  # s, of its first stop


def command_timeout(trials: Sequence[Trial]) -> Timeout | None:
    """The time-out that pauses of the commands show; None where the vehicle drives on in them, or there are none."""
    from scipy import stats

    found, drives_on = [], list[float]()
    for trial in trials:
        stops, longest = _pauses(trial)
        found += [(trial, stop) for stop in stops]
        drives_on += longest
    if not found or sum(pause > float(np.median([stop.falls for _, stop in found])) + SETTLED for pause in drives_on
                        ) >= len(found):
        return None  # no base with a time-out drives on for longer: something else stopped it
    step = float(np.median([np.median(np.diff(stream.t)) for trial, _ in found
                            if (stream := trial.odometry or trial.ground_truth) is not None]))
    falls = np.array([stop.falls for _, stop in found])
    rises = np.array([rise for trial in trials for rise in responses(trial)] or [0.0])
    lag = float(np.median([stop.lag for _, stop in found]))
    if lag > 0 and not rises.any():
        return None  # the vehicle stops before it has reached what its commands ask for
    value = max(float(np.median(falls) - np.median(rises)), 0.0)
    early = _early(value - _early(value, lag), lag)
    value = max(value - early / 2, 0.0)
    resolution = step**2 / 12
    variance = sum(max(float(np.var(each, ddof=1)) if len(each) > 1 else 0.0, resolution) / len(each)
                   for each in (falls, rises))
    reach = float(stats.t.ppf((1 + CONFIDENCE) / 2, max(len(falls) - 1, 3))) * float(np.sqrt(variance)) + early / 2
    trial, stop = found[0]
    return Timeout(value, max(value - reach, 0.0), value + reach, len(falls), len({one.name for one, _ in found}),
                   trial.name, stop.begin, stop.pause)


def with_own_timeout(log: Log) -> Log:
    """The log with the stops that its base makes by itself, where training trials show them, and a note."""
    if "command_timeout" in log.fields or log.fields.get("input") == "wheels":
        return log
    found = command_timeout(log.training)
    if found is None:
        return log
    trials = tuple(replace(trial, command=with_timeout(trial.command, found.value)) for trial in log.trials)
    note = (f"the base stops by itself {found.value:.2f} s ({found.low:.2f} to {found.high:.2f}) after the last "
            f"command, as {found.stops} pauses of the commands show: replays stop there too")
    return replace(log, trials=trials, notes=(*log.notes, note),
                   fields={**log.fields, "found_timeout": [found.value, found.low, found.high]})


def _pauses(trial: Trial) -> tuple[list[Stop], list[float]]:
    """Pauses of the commands in which the vehicle stops though the last one was to move, and the lengths [s] of those
    in which it drives on."""
    command, rates = trial.command, _rates(trial)
    found, drives_on = list[Stop](), list[float]()
    if rates is None or len(command.t) < 10:
        return found, drives_on
    t = rates[0]
    for k in np.flatnonzero(np.diff(command.t) > _quiet(command.t)):
        begin, end = float(command.t[k]), float(command.t[k + 1])
        channel, asked = _asked(trial, int(k), rates)
        before, inside = (t >= begin) & (t <= begin + SETTLED), (t > begin) & (t < end)
        if abs(asked) < 1.0 or not before.any() or inside.sum() < 5:
            continue
        usual, begins, forwards = float(np.median(channel[before])), begin, channel * np.sign(asked)
        if abs(usual) <= 0.02 or usual * asked < 0 or _is_below_peak(abs(usual), forwards[inside]):
            usual, at = _peak(forwards[inside])  # a command out of rest: it speeds up first
            usual, begins = usual * float(np.sign(asked)), float(t[inside][at])
        inside &= t >= begins
        share = channel[inside] / usual if abs(usual) > 0.02 else np.ones(int(inside.sum()))
        if len(share) < 5:
            continue
        if share[-3:].min() > DRIVING:
            drives_on.append(end - begin)
        stopped = np.abs(share) < STOPPED
        if stopped.sum() * float(np.median(np.diff(t))) < SETTLED or share[:3].min() < DRIVING:
            continue
        first = np.flatnonzero(stopped)[0]
        if (np.abs(share[first:]) > DRIVING)[t[inside][first:] < end - SETTLED].any():
            continue  # it stopped and drove on without a command: something else held it
        half = _crossing(t[inside], share)
        lag = (_crossing(t[inside], share, HALF**2) - half) / np.log(2.0) if begins > begin else 0.0
        found.append(Stop(begin, end - begin, half - begin, lag))
    return found, drives_on


def responses(trial: Trial) -> list[float]:
    """Times from a command out of standstill to half of its speed [s]."""
    command, rates = trial.command, _rates(trial)
    if rates is None:
        return []
    t, found = rates[0], []
    moving = (np.abs(command.v) >= ASKED[0]) | (np.abs(command.omega) >= ASKED[1])
    paused = np.diff(command.t, prepend=command.t[0]) > _quiet(command.t)
    for k in np.flatnonzero(moving & (paused | ~np.append(False, moving[:-1]))):
        begin = float(command.t[k])
        channel, _ = _asked(trial, int(k), rates)
        size = command.v[k] if channel is rates[1] else command.omega[k]
        later = np.flatnonzero((command.v[k:] != command.v[k]) | (command.omega[k:] != command.omega[k]))
        end = min(begin + SLOWEST, float(command.t[k + later[0]]) if len(later) else np.inf)
        before, after = (t > begin - SETTLED) & (t <= begin), (t > begin) & (t <= end)
        if before.sum() < 2 or after.sum() < 5 or np.abs(channel[before] / size).max() > STOPPED:
            continue
        share = channel[after] / size
        settled = float(np.median(share[-3:]))  # its scale is not the command's
        if _is_below_peak(settled, share):  # it has stopped again
            settled = _peak(share)[0]
        if DRIVING < settled < 1 / DRIVING and share[0] < HALF * settled:
            found.append(_crossing(t[after], settled - share, HALF * settled) - begin)
    return found


def _quiet(t: np.ndarray) -> float:
    """Interval [s] between commands at times (T,), beyond which they pause."""
    usual = float(np.median(np.diff(t))) if len(t) > 1 else 0.0
    return max(min(QUIET * usual, PAUSE), SETTLED)


def _early(drives: float, lag: float) -> float:
    """How much earlier than half of its settled speed a vehicle passes half of the speed that it has when it stops, if
    it drives for a time [s] with a first-order lag; with a limited acceleration it is no earlier."""
    return lag * float(np.log(2.0) + np.log1p(-(1 - np.exp(-drives / lag)) / 2)) if lag > 0 else 0.0


def _peak(values: np.ndarray) -> tuple[float, int]:
    """Greatest value (T,), as a mean over `PEAK` seconds, and the first row that reaches it."""
    peak = float(np.sort(values)[-max(round(PEAK / GRID_DT), 1) :].mean())
    return peak, int(np.argmax(values >= peak))


def _is_below_peak(value: float, values: np.ndarray) -> bool:
    return value < DRIVING * _peak(values)[0]


def _rates(trial: Trial) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Times (T,), forward speed and yaw rate that were measured."""
    return next((one for name in ("odometry", "ground_truth") if (one := speeds(trial, name)) is not None), None)


def _asked(trial: Trial, k: int, rates: tuple[np.ndarray, np.ndarray, np.ndarray]) -> tuple[np.ndarray, float]:
    """The speed that command k asks most of, and how many times what shows."""
    sizes = [value / least for value, least in zip((trial.command.v[k], trial.command.omega[k]), ASKED, strict=True)]
    most = int(np.argmax(np.abs(sizes)))
    return rates[most + 1], float(sizes[most])


def _crossing(t: np.ndarray, share: np.ndarray, level: float = HALF) -> float:
    """Time at which a falling signal (T,) first passes a level [s]."""
    below = np.flatnonzero(share < level)
    k = int(below[0]) if len(below) else len(t) - 1
    if k == 0 or not len(below):
        return float(t[k])
    return float(np.interp(level, [share[k], share[k - 1]], [t[k], t[k - 1]]))

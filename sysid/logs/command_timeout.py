"""The time-out of a base: how long it drives on where no command comes, from pauses of the commands in a log.

It is the time from the last command to half of the speed, less that from a command out of rest to half of its speed:
the vehicle responds equally late to both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sysid.logs.records import Log, Trial, with_timeout
from sysid.logs.streams import speeds

QUIET = 2.5  # usual intervals between commands, beyond which they pause
ASKED = (0.05, 0.1)  # m/s and rad/s of a command in force that shows whether the vehicle follows it
STOPPED, DRIVING, HALF = 0.1, 0.6, 0.5  # shares of a speed
SETTLED = 0.2  # s for which the vehicle must have stopped
SLOWEST = 2.0  # s in which a vehicle reaches half of a speed
CONFIDENCE = 0.95


@dataclass(frozen=True)
class Stop:
    """A pause of the commands in which the vehicle stops though the last one was to move."""

    begin: float  # s, of the last command
    pause: float  # s until the next
    falls: float  # s from the last command to half of the speed


@dataclass(frozen=True)
class Timeout:
    """The time-out of a base."""

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

    found = [(trial, stop) for trial in trials for stop in timeout_stops(trial)]
    if not found:
        return None
    step = float(np.median([np.median(np.diff(stream.t)) for trial, _ in found
                            if (stream := trial.odometry or trial.ground_truth) is not None]))
    falls = np.array([stop.falls for _, stop in found])
    rises = np.array([rise for trial in trials for rise in responses(trial)] or [0.0])
    value = max(float(np.median(falls) - np.median(rises)), 0.0)
    resolution = step**2 / 12
    variance = sum(max(float(np.var(each, ddof=1)) if len(each) > 1 else 0.0, resolution) / len(each)
                   for each in (falls, rises))
    reach = float(stats.t.ppf((1 + CONFIDENCE) / 2, max(len(falls) - 1, 3))) * float(np.sqrt(variance))
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


def timeout_stops(trial: Trial) -> list[Stop]:
    """Pauses of the commands in which the vehicle stops though the last one was to move."""
    command, rates = trial.command, _rates(trial)
    if rates is None or len(command.t) < 10:
        return []
    gaps = np.diff(command.t)
    t, found = rates[0], []
    for k in np.flatnonzero(gaps > max(QUIET * float(np.median(gaps)), SETTLED)):
        begin, end = float(command.t[k]), float(command.t[k + 1])
        channel, asked = _asked(trial, int(k), rates)
        before, inside = (t >= begin) & (t <= begin + SETTLED), (t > begin) & (t < end)
        if abs(asked) < 1.0 or not before.any() or inside.sum() < 5:
            continue
        usual = float(np.median(channel[before]))
        share = channel[inside] / usual if abs(usual) > 0.02 else np.ones(int(inside.sum()))
        stopped = np.abs(share) < STOPPED
        if stopped.sum() * float(np.median(np.diff(t))) < SETTLED or share[:3].min() < DRIVING:
            continue
        first = np.flatnonzero(stopped)[0]
        if (np.abs(share[first:]) > DRIVING)[t[inside][first:] < end - SETTLED].any():
            continue  # it stopped and drove on without a command: something else held it
        found.append(Stop(begin, end - begin, _crossing(t[inside], share) - begin))
    return found


def responses(trial: Trial) -> list[float]:
    """Times from a command out of standstill to half of its speed [s]."""
    command, rates = trial.command, _rates(trial)
    if rates is None:
        return []
    t, found = rates[0], []
    moving = (np.abs(command.v) >= ASKED[0]) | (np.abs(command.omega) >= ASKED[1])
    gaps = np.diff(command.t, prepend=command.t[0])
    paused = gaps > max(QUIET * float(np.median(gaps)), SETTLED)
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
        if DRIVING < settled < 1 / DRIVING and share[0] < HALF * settled:
            found.append(_crossing(t[after], settled - share, HALF * settled) - begin)
    return found


def _rates(trial: Trial) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Times (T,), forward speed and yaw rate that were measured."""
    return next((one for name in ("odometry", "ground_truth") if (one := speeds(trial, name)) is not None), None)


def _asked(
    trial: Trial, k: int, rates: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> tuple[np.ndarray, float]:
    """The speed that command k asks most of, and how many times what shows."""
    sizes = [value / least for value, least in zip((trial.command.v[k], trial.command.omega[k]), ASKED, strict=True)]
    most = int(np.argmax(np.abs(sizes)))
    return rates[most + 1], float(sizes[most])


def _crossing(t: np.ndarray, share: np.ndarray, level: float = HALF) -> float:
    """Time at which a falling signal (T,) first passes a level [s]."""
    below = np.flatnonzero(share < level)
    if not len(below):
        return float(t[-1])
    k = int(below[0])
    if k == 0:
        return float(t[0])
    return float(np.interp(level, [share[k], share[k - 1]], [t[k], t[k - 1]]))

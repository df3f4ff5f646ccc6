"""Signs that the time of a log went wrong: rows in bursts, and a clock that was set forward in the drive."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sysid.logs.command_timeout import command_timeout
from sysid.logs.records import Trial, logged_pose

BURST = 0.2  # of the mean interval, below which the median interval shows bursts
BURSTS = 5  # of them at least: one long interval is a pause
PAUSE = (0.5, 5.0)  # s and mean intervals: the least gap that is looked at
MOVED = 0.5  # share of the way that a speed gives over a gap, below which the gap was none
UNEVEN = 0.2  # of the rows of a stream without a rate
LEAST = 0.1  # m or rad of that way; m/s or rad/s of a speed that changes
SETTLED = 3.0  # s after the last command in which a vehicle may still follow it
CHANGED = 0.3  # of the usual range of a speed, in which it changes by itself at most


def time_faults(trials: Sequence[Trial]) -> list[str]:
    """Sentences on streams in bursts, on commands that end too early, and on times of which nothing was recorded."""
    found = []
    for name in ("odometry", "ground_truth"):
        streams = [stream for trial in trials if (stream := getattr(trial, name)) is not None and len(stream.t) > 20]
        bursts = [wait for one in streams if (wait := _between_bursts(one.t))]
        if bursts and len(bursts) >= len(streams) / 2:
            found.append(f"{name}: its rows come in bursts, {max(bursts):.2g} s apart, while most follow one "
                         "another at once: t is a time of receipt. Use the times of measurement; sysid.convert takes "
                         "them with --stamp header.")
    if cut := [(trial.name, rest) for trial in trials if (rest := uncommanded(trial))]:
        name, rest = cut[0]
        found.append(f"command: in {len(cut)} of {len(trials)} trials ({name}) the commands end {rest:.1f} s before "
                     "the odometry, and the vehicle goes on to change its speed: the rest of them was not recorded. "
                     "Cut the trial where they end, or record all of them.")
    if paused := [(trial.name, *outage) for trial in trials if (outage := _outage(trial)) is not None]:
        name, begin, end = paused[0]
        found.append(f"time: in {len(paused)} of {len(trials)} trials ({name}, from {begin:.1f} to {end:.1f} s) no "
                     "stream has a row, commands neither, though they come regularly otherwise: the recording paused, "
                     "and what was sent meanwhile is unknown. Split the trial there.")
    return found


def set_forward(trials: Sequence[Trial]) -> list[str]:
    """A sentence on clocks that were set forward in a drive. What else looks odd in these trials does not count."""
    jumps = [(trial.name, *jump) for trial in trials if (jump := forward_jump(trial)) is not None]
    paused = [trial for trial in trials if _outage(trial) is not None and forward_jump(trial) is None]
    if len(jumps) <= len(paused):  # in some pauses of a recording the vehicle happens to be slow
        return []
    name, at, seconds = jumps[0]
    return [f"time: in {len(jumps)} of {len(trials)} trials ({name}, at {at:.1f} s) t jumps ahead by {seconds:.2g} s "
            "in which the vehicle hardly moved, though it drives before and after: the clock was set forward. Split "
            "the trial there, or take the jump out of all of its streams."]


def _outage(trial: Trial) -> tuple[float, float] | None:
    """Begin and end [s] of the longest time for which all streams pause that come regularly; None without one."""
    streams = [one.t for one in (trial.command, trial.odometry, trial.ground_truth) if one is not None]
    if len(streams) < 2 or min(map(len, streams)) < 20:
        return None
    for steps in map(np.diff, streams):  # as commands that are sent where they change
        if np.mean(np.abs(steps - np.median(steps)) > 0.5 * np.median(steps)) > UNEVEN:
            return None
    rows = np.sort(np.concatenate(streams))
    k = int(np.argmax(np.diff(rows)))
    begin, end = float(rows[k]), float(rows[k + 1])
    longest = max(float(np.median(np.diff(t))) for t in streams)
    return (begin, end) if end - begin > max(PAUSE[0], PAUSE[1] * longest) else None


def pauses(trials: Sequence[Trial]) -> list[str]:
    """A sentence on pauses of the commands in which the base stops by itself."""
    timeout = command_timeout(trials)
    if timeout is None:
        return []
    return [f"command: in {timeout.trials} of {len(trials)} trials ({timeout.first}, at {timeout.at:.1f} s) no command "
            f"comes for {timeout.pause:.2g} s, and the vehicle stops {timeout.value:.2f} s ({timeout.low:.2f} to "
            f"{timeout.high:.2f}) after the last one: its base has a time-out. Fits take it from the log; to state it, "
            f"write command_timeout = {max(timeout.value, 0.01):.2f} into dataset.toml."]


def uncommanded(trial: Trial) -> float:
    """For how long a vehicle changes its speed after it had the time to follow the last command [s]; else 0."""
    stream = trial.odometry
    if stream is None or len(stream.t) < 20:
        return 0.0
    rest = stream.t > trial.command.t[-1] + SETTLED
    if rest.sum() < 2 or np.ptp(stream.t[rest]) < SETTLED:
        return 0.0
    for speed in (stream.v, stream.omega):
        whole, after = (float(np.ptp(np.percentile(one, (5, 95)))) for one in (speed, speed[rest]))
        if after > max(CHANGED * whole, LEAST):
            return float(stream.t[-1] - trial.command.t[-1])
    return 0.0


def forward_jump(trial: Trial) -> tuple[float, float] | None:
    """Time and size [s] of the longest gap in which a pose did not move as its speeds say; None without one.

    Rows that are only lost leave a gap too, but the vehicle drives on in it.
    """
    stream, pose = trial.odometry, logged_pose(trial.odometry, 21)
    if stream is None or pose is None:
        return None
    gaps = np.diff(stream.t)
    expected = np.stack([np.minimum(np.abs(one[1:]), np.abs(one[:-1])) * gaps for one in (stream.v, stream.omega)])
    after = np.minimum(np.arange(len(gaps)) + 3, len(gaps))  # rows that were held up catch up in the next ones
    x, y, turn = (one[after] - one[:-1] for one in pose.values.T)
    moved = np.stack([np.hypot(x, y), np.abs(turn)])
    long = gaps > max(PAUSE[0], PAUSE[1] * float(gaps.mean()))
    still = (expected > LEAST).any(axis=0) & ((moved < MOVED * expected) | (expected <= LEAST)).all(axis=0)
    other, command = trial.ground_truth, trial.command
    changed = command.t[np.append(False, (np.diff(command.v) != 0) | (np.diff(command.omega) != 0))]
    usual = float(np.median(np.diff(command.t))) if len(command.t) > 1 else np.inf
    for k in np.flatnonzero(long & still)[np.argsort(-gaps[long & still])]:
        begin, end = stream.t[k], stream.t[k + 1]
        middle = (begin + end) / 2
        low, high = (3 * begin + end) / 4, (begin + 3 * end) / 4  # half of the gap
        sent = int(((command.t > low) & (command.t < high)).sum())
        if ((changed > low) & (changed < high)).any() or sent > 0.25 * gaps[k] / usual:
            continue  # commands went on in it
        if other is None or not (np.abs(other.t - middle) < gaps[k] / 4).any():  # the outside pose has the gap as well
            return float(stream.t[k]), float(gaps[k])
    return None


def _between_bursts(t: np.ndarray) -> float:
    """Interval between rows (T,) that half of the time is spent in longer ones [s]; 0 where they come in no bursts."""
    steps = np.sort(np.diff(t))
    wait = float(steps[np.searchsorted(np.cumsum(steps), steps.sum() / 2)])
    often = int((steps >= wait).sum()) >= BURSTS
    return wait if often and np.median(steps) < BURST * steps.mean() and wait > 2 * steps.mean() else 0.0

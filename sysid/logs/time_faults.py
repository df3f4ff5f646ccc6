"""Signs that the time of a log went wrong: rows in bursts, and a clock that was set forward in the drive."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sysid.logs.log import OdometryStream, Trial
from sysid.logs.streams import speeds

BURST = 0.2  # of the mean interval, below which the median interval shows bursts
PAUSE = (0.5, 5.0)  # s and mean intervals: the least gap that is looked at
MOVED = 0.5  # share of the way that a speed gives over a gap, below which the gap was none
LEAST = 0.1  # m or rad of that way
QUIET = 2.5  # usual intervals between commands, beyond which they pause
ASKED = (0.05, 0.1)  # m/s and rad/s of a command in force that shows whether the vehicle follows it
RESPONSE = (0.1, 0.6)  # share of a speed that counts as stopped, and as driving
SETTLED = 0.2  # s for which the vehicle must have stopped


def time_faults(trials: Sequence[Trial]) -> list[str]:
    """Sentences on streams in bursts and on times that jump ahead of the motion."""
    found = []
    for name in ("odometry", "ground_truth"):
        streams = [stream for trial in trials if (stream := getattr(trial, name)) is not None and len(stream.t) > 20]
        bursts = [_usual_wait(one.t) for one in streams if _in_bursts(one.t)]
        if bursts and len(bursts) >= len(streams) / 2:
            found.append(f"{name}: its rows come in bursts, {max(bursts):.2g} s apart, while most follow one "
                         "another at once: t is a time of receipt. Use the times of measurement; sysid.convert takes "
                         "them with --stamp header.")
    stops = [(trial.name, *stop) for trial in trials for stop in timeout_stops(trial)]
    if stops:
        name, at, pause, _ = stops[0]
        timeout = float(np.median([stop[3] for stop in stops]))
        found.append(f"command: in {len({stop[0] for stop in stops})} of {len(trials)} trials ({name}, at {at:.1f} s) "
                     f"no command comes for {pause:.2g} s, and the vehicle stops {timeout:.2g} s after the last one: "
                     "its base has a time-out. A replay would drive on: write "
                     f"command_timeout = {max(timeout, 0.01):.2f} into dataset.toml.")
    jumps = [(trial.name, *jump) for trial in trials if (jump := forward_jump(trial)) is not None]
    if jumps:
        name, at, seconds = jumps[0]
        found.append(f"time: in {len(jumps)} of {len(trials)} trials ({name}, at {at:.1f} s) t jumps ahead by "
                     f"{seconds:.2g} s in which the vehicle hardly moved, though it drives before and after: the clock "
                     "was set forward. Split the trial there, or take the jump out of all of its streams.")
    return found


def forward_jump(trial: Trial) -> tuple[float, float] | None:
    """Time and size [s] of the longest gap in which a pose did not move as its speeds say; None without one.

    Rows that are only lost leave a gap too, but the vehicle drives on in it.
    """
    stream = trial.odometry
    if not isinstance(stream, OdometryStream) or stream.x is None or stream.y is None or stream.yaw is None:
        return None
    gaps = np.diff(stream.t)
    if len(gaps) < 20:
        return None
    expected = np.stack([np.minimum(np.abs(one[1:]), np.abs(one[:-1])) * gaps for one in (stream.v, stream.omega)])
    after = np.minimum(np.arange(len(gaps)) + 3, len(gaps))  # rows that were held up catch up in the next ones
    moved = np.stack([np.hypot(stream.x[after] - stream.x[:-1], stream.y[after] - stream.y[:-1]),
                      np.abs(stream.yaw[after] - stream.yaw[:-1])])
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


def timeout_stops(trial: Trial) -> list[tuple[float, float, float]]:
    """Pauses of the commands in which the vehicle stops though the last one was to move: when the pause begins, how
    long it is, and how long after the last command the base stops [s].

    How late the vehicle responds is taken out, by how late it starts after the next command.
    """
    command = trial.command
    rates = next((one for name in ("odometry", "ground_truth") if (one := speeds(trial, name)) is not None), None)
    if rates is None or len(command.t) < 10:
        return []
    gaps = np.diff(command.t)
    usual = float(np.median(gaps))
    t, found = rates[0], []
    for k in np.flatnonzero(gaps > max(QUIET * usual, SETTLED)):
        begin, end = float(command.t[k]), float(command.t[k + 1])
        channel, asked = max(((rate, value / least) for rate, value, least in zip(
            rates[1:], (command.v[k], command.omega[k]), ASKED, strict=True)), key=lambda one: abs(one[1]))
        if abs(asked) < 1.0:
            continue
        before, inside = (t >= begin) & (t <= begin + SETTLED), (t > begin) & (t < end)
        if not before.any() or inside.sum() < 5:
            continue
        usual_speed = float(np.median(channel[before]))
        share = channel[inside] / usual_speed if abs(usual_speed) > 0.02 else np.ones(int(inside.sum()))
        stopped = np.abs(share) < RESPONSE[0]
        if stopped.sum() * float(np.median(np.diff(t))) < SETTLED or share[:3].min() < RESPONSE[1]:
            continue
        first = np.flatnonzero(stopped)[0]
        if (np.abs(share[first:]) > RESPONSE[1])[t[inside][first:] < end - SETTLED].any():
            continue  # it stopped and drove on without a command: something else held it
        falls = float(t[inside][np.flatnonzero(share < 0.5)[0]]) - begin
        after = (t >= end) & (t < end + 2.0)
        back = np.flatnonzero(np.abs(channel[after]) > 0.5 * abs(usual_speed))
        rises = float(t[after][back[0]]) - end if len(back) else 0.0
        found.append((begin, end - begin, max(falls - rises, 0.0)))
    return found


def _in_bursts(t: np.ndarray) -> bool:
    steps = np.diff(t)
    return bool(np.median(steps) < BURST * steps.mean() and _usual_wait(t) > 2 * steps.mean())


def _usual_wait(t: np.ndarray) -> float:
    """The interval between rows (T,) that half of the time is spent in longer ones [s]."""
    steps = np.sort(np.diff(t))
    return float(steps[np.searchsorted(np.cumsum(steps), steps.sum() / 2)])

"""Odometry that is computed at fixed times and reported at others: each row is of the frame before it.

A row's stamp is up to a frame later than what it says: at 1 m/s and 20 ms, 2 cm. Where these ages differ from row to
row they show in steady driving, as uneven steps. Ages that all rows share do not; a fit has `sensor_delay` for them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sysid.logs.records import Trial, command_in_force, logged_pose
from sysid.replay.cores import on_all_cores

ROWS = 8  # of a stretch of steady driving, in which what a parabola over time does not explain is explained by the ages
STEADY = 0.3  # s for which the command must have been in force
LEAST = 0.2  # m/s or rad/s of steady driving
STRETCHES = 30  # that are needed
SHORTEST = 0.004  # s, period of the frames that are looked for
CHUNK = 2.0  # s of one trial that the first search takes together
PHASES = 8  # that are tried
FINER = 8  # times so many in the last search
TRIALS = 12  # that are looked at
AGE = "sensor_delay.speed"  # what stands for the frames of speeds where they do not show
EXPLAINED = 0.5  # share of the squared steps that frames must explain
SAME = 0.01  # of them: what two rates may differ by and be as good


@dataclass(frozen=True)
class Stretches:
    """Steady driving of one trial or of several."""

    t: np.ndarray  # (S, ROWS) s
    parabola: np.ndarray  # (S, ROWS, 3) orthonormal columns: the parabolas over t
    steps: np.ndarray  # (S, ROWS) ways or turns over their mean speed, without the parabola [s]
    weight: np.ndarray  # (S, 1) that speed [m/s or rad/s]
    trial: np.ndarray  # (S,) number of the trial


def at_frames(trials: Sequence[Trial], period: float | None) -> tuple[Trial, ...]:
    """Trials with the odometry's rows at the times of their frames, the latest that steps of `period` [s] allow."""
    return tuple(trials) if period is None else tuple(_at_frames(trial, period) for trial in trials)


def note(period: float) -> str:
    """For the report."""
    return (f"the odometry is computed every {1e3 * period:.4g} ms, so some of its rows are older than others: each "
            "row is moved to the time at which it was computed")


def find_period(trials: Sequence[Trial]) -> float | None:
    """Time between the frames of the odometry [s], or None where rows do not show any."""
    chosen = np.unique(np.linspace(0, len(trials) - 1, min(TRIALS, len(trials))).round().astype(int))
    known = [part for part in (stretches(trials[i], i) for i in chosen) if part is not None]
    if not known:
        return None
    part = Stretches(*map(np.concatenate, zip(*(vars(one).values() for one in known), strict=True)))
    spacing = float(np.median(np.diff(part.t)))
    if len(part.t) < STRETCHES or spacing <= SHORTEST:
        return None
    # Within a chunk frames are where a rate 1 / (PHASES CHUNK) away has them, but for a phase.
    chunk = part.trial * 1000 + (part.t[:, 0] / CHUNK).astype(int)
    rate = _best_rate(part, np.arange(1 / spacing, 1 / SHORTEST, 1 / (PHASES * CHUNK)), chunk)[0]
    longest = max(float(np.ptp(part.t[part.trial == i])) for i in np.unique(part.trial))
    finer = rate + np.linspace(-0.5, 0.5, 1 + 2 * round(PHASES * max(longest / CHUNK, 1.0))) / CHUNK
    rate = _best_rate(part, finer, part.trial)[0]
    finest = rate + (finer[1] - finer[0]) * np.linspace(-1.0, 1.0, 2 * FINER + 1)
    rate, lowest, highest = _best_rate(part, finest, part.trial, FINER * PHASES)
    # Rows at multiples of a time show a rate roughly; clocks are set to round ones.
    round_ones = [float(round(rate)), 1e3 / round(1e3 / rate)]
    rate = next((one for one in round_ones if lowest <= one <= highest), rate)
    left = unexplained(part, 1 / rate, part.trial, FINER * PHASES)
    return 1 / rate if left < (1 - EXPLAINED) * np.square(part.weight * part.steps).sum() else None


def stretches(trial: Trial, number: int = 0, largest: float | None = None) -> Stretches | None:
    """Where a trial's odometry shows steady driving, forward or turning; None where it never does.

    `largest`: step that a steady stretch may have [s]; by default its command must have been in force for a while.
    """
    stream = logged_pose(trial.odometry, ROWS)
    if stream is None:
        return None
    middle = (stream.yaw[1:] + stream.yaw[:-1]) / 2
    way = np.cos(middle) * np.diff(stream.x) + np.sin(middle) * np.diff(stream.y)
    rows = np.arange(0, len(stream.t) - ROWS + 1, ROWS // 2)[:, None] + np.arange(ROWS)
    held = command_in_force(trial.command, stream.t)
    changed = np.r_[True, (np.diff(trial.command.v) != 0) | (np.diff(trial.command.omega) != 0)]
    since = trial.command.t[np.maximum.accumulate(np.where(changed, np.arange(len(changed)), 0))]
    steady = (held[rows[:, 0]] >= 0) & (since[held[rows[:, -1]]] <= stream.t[rows[:, 0]] - STEADY)
    rows = rows[steady] if largest is None else rows
    t, found = stream.t[rows], []
    if not len(t) or not (np.diff(t) > 0).all():
        return None
    powers = (t - t[:, :1])[..., None] ** np.arange(3)
    parabola = np.linalg.qr(powers)[0]
    for value in (np.r_[0.0, np.cumsum(way)], stream.yaw):
        along = value[rows]
        speed = (along[:, -1] - along[:, 0]) / (t[:, -1] - t[:, 0])
        bent = (parabola @ (parabola.swapaxes(1, 2) @ along[..., None]))[..., 0]
        steps = (along - bent) / np.where(speed == 0.0, 1.0, speed)[:, None]
        fast = (np.abs(speed) > LEAST) & (np.abs(steps).max(1) < (np.inf if largest is None else largest))
        steps = steps[fast]
        found.append((t[fast], parabola[fast], steps, np.abs(speed[fast, None])))
    t, parabola, steps, weight = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return Stretches(t, parabola, steps, weight, np.full(len(t), number)) if len(t) else None


def unexplained(part: Stretches, period: float, group: np.ndarray, phases: int = PHASES) -> float:
    """Squared ways [m^2 or rad^2] that frames of a period [s] leave, each group (S,) at its best phase."""
    left = _left(part, period, np.arange(phases) / phases)
    return float(np.add.reduceat(left, np.flatnonzero(np.diff(group, prepend=-1)), axis=1).min(0).sum())


def ages_of(t: np.ndarray, period: float, phase: np.ndarray | float) -> np.ndarray:
    """By how much rows at t are older than their stamps [s], with frames at (n + phase) periods."""
    since = t / period - phase + 1e-6  # a row at a frame is of that frame
    return period * (since - np.floor(since))


def _left(part: Stretches, period: float, phases: np.ndarray) -> np.ndarray:
    """Squared ways (K, S) that frames of each phase leave."""
    t, steps = (np.ascontiguousarray(one.T)[:, None] for one in (part.t, part.steps))  # sums over rows: whole arrays
    along = steps + ages_of(t, period, phases[:, None])  # (ROWS, K, S); steps have no parabola in them
    squares = np.einsum("jks,jks->ks", along, along)
    for column in np.ascontiguousarray(part.parabola.T):
        squares -= np.square(np.einsum("js,jks->ks", column, along))
    return part.weight[:, 0] ** 2 * squares


def _best_rate(
    part: Stretches, rates: np.ndarray, group: np.ndarray, phases: int = PHASES
) -> tuple[float, float, float]:
    """Of rates (N,) [1/s], the one that leaves least in groups (S,) of stretches, and between which all are as good."""
    order = np.argsort(group, kind="stable")
    part = Stretches(*(column[order] for column in vars(part).values()))
    left = np.array(on_all_cores(lambda rate: unexplained(part, 1 / rate, group[order], phases), rates.tolist()))
    worse = np.flatnonzero(left > left.min() + SAME * np.square(part.weight * part.steps).sum())
    best = int(np.argmin(left))
    first, last = max(worse[worse < best], default=-1) + 1, min(worse[worse > best], default=len(rates)) - 1
    return float(rates[(first + last) // 2]), float(rates[first]), float(rates[last])


def _at_frames(trial: Trial, period: float) -> Trial:
    part, stream = stretches(trial, largest=period), trial.odometry
    if part is None or stream is None:
        return trial
    phases = np.arange(FINER * PHASES) / (FINER * PHASES)
    left = _left(part, period, phases).sum(1)
    around = left + np.roll(left, 1) + np.roll(left, -1)  # not at the edge of those that are as good
    ages = ages_of(stream.t, period, float(phases[np.argmin(around)]))
    return replace(trial, odometry=replace(stream, t=np.maximum(stream.t - (ages - ages.min()), 0.0)))

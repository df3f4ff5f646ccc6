"""Drives that repeat one another: the same commands as functions of time, whenever the recording began.

A dataset's commands repeat exactly. A bag's never do: it begins at another moment, and messages come early or late.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sysid.logs.records import Command, Trial

NONE = 1e-3  # m/s or rad/s of a command below which nothing moves
TABLE_DT = 0.01  # s, of the functions that are compared
PERIODS = 1.5  # of the commands, by which a change may come earlier or later
TIMING = (0.05, 0.2)  # s, bounds of that time
VALUE = (2e-3, 0.005)  # m/s or rad/s, and share of the largest command, by which values may differ
LONGEST = 3600.0  # s of drive that are compared
EXACT = 1e-6  # s, m/s and rad/s of differences that are rounding
ROUNDED = 0.02  # s that times of two tables may differ by, row by row, where they are compared row by row
NEAR = 0.25
"""Distance of two commands (root mean square over a drive), as a share of the larger one, at which a model still leaves
nearly the same of both. The error grows at least in proportion to the command: three quarters of it are common."""
GLANCE = 0.5  # s between the instants at which drives are compared first


@dataclass(frozen=True)
class Course:
    """The commands of one drive as a function of time."""

    command: Command
    begin: float  # s, first command to move; nan where none does
    end: float  # s, of the last motion
    period: float  # s, between commands
    distance: float  # m, with both signs counted as positive
    turn: float  # rad, in the same way

    @property
    def moves(self) -> bool:
        """Whether anything is commanded."""
        return bool(np.isfinite(self.begin))

    def at(self, t: np.ndarray) -> np.ndarray:
        """(T, 2) commands in force at times t (T,) since the first motion, 0 before and after the motion."""
        when = self.begin + t
        return np.where((when < self.end)[:, None], self.command.at(when, (0.0, 0.0)).T, 0.0)


def course_of(trial: Trial) -> Course:
    """The commands of a trial; the last one holds until the trial's end."""
    command = trial.command
    ends = [float(stream.t[-1]) for stream in (trial.odometry, trial.ground_truth) if stream is not None]
    last = max([*ends, float(command.t[-1])])
    hold = np.maximum(np.diff(np.append(command.t, last)), 0.0)
    moving = np.flatnonzero((np.abs(command.v) > NONE) | (np.abs(command.omega) > NONE))
    begin = end = float("nan")
    if len(moving):
        begin = float(command.t[moving[0]])
        end = float(command.t[moving[-1] + 1]) if moving[-1] + 1 < len(command.t) else last
    period = float(np.median(np.diff(command.t))) if len(command.t) > 1 else 0.0
    return Course(command, begin, end, period, float((np.abs(command.v) * hold).sum()),
                  float((np.abs(command.omega) * hold).sum()))


def shift_between(a: Course, b: Course) -> float | None:
    """How much later the commands of b come than those of a [s]; None where they are not the same function of time."""
    if len(a.command.t) == len(b.command.t) and np.allclose(a.command.table, b.command.table, rtol=1e-5, atol=EXACT):
        return 0.0
    if not (a.moves and b.moves) or max(a.end - a.begin, b.end - b.begin) > LONGEST:
        return None
    timing = float(np.clip(PERIODS * max(a.period, b.period), *TIMING))
    if abs((a.end - a.begin) - (b.end - b.begin)) > 2 * timing:
        return None
    for one, other in ((a.distance, b.distance), (a.turn, b.turn)):
        if abs(one - other) > 0.1 * max(one, other) + 0.2:
            return None
    t = np.arange(-2 * timing, max(a.end - a.begin, b.end - b.begin) + 2 * timing, TABLE_DT)
    ours, theirs = a.at(t), b.at(t)
    lag = _best_lag(ours, theirs, round(timing / TABLE_DT))
    theirs = b.at(t + lag * TABLE_DT)
    allowed = VALUE[0] + VALUE[1] * np.abs(ours).max(axis=0)
    width = 2 * round(timing / TABLE_DT) + 1
    if not (_within(ours, theirs, allowed, width) and _within(theirs, ours, allowed, width)):
        return None
    return b.begin - a.begin + lag * TABLE_DT


def near(a: Course, b: Course, most: float) -> bool:
    """Whether the commands of two drives, which begin at most `most` s apart in recordings, are nearly the same."""
    if len(a.command.t) == len(b.command.t) and np.allclose(a.command.t, b.command.t, atol=ROUNDED):
        ours, theirs = a.command.table[:, 1:], b.command.table[:, 1:]
    elif not (a.moves and b.moves and abs(a.begin - b.begin) <= most + EXACT
              and abs(a.end - b.end) <= TIMING[1] + most + EXACT):
        return False
    else:
        t = np.arange(0.0, min(max(a.end - a.begin, b.end - b.begin), LONGEST), TABLE_DT)
        ours, theirs = a.at(t), b.at(t)
    apart = np.linalg.norm(ours - theirs, axis=0)
    size = np.maximum(np.linalg.norm(ours, axis=0), np.linalg.norm(theirs, axis=0))
    return bool((apart <= NEAR * size + NONE * np.sqrt(len(ours))).all())


@dataclass(frozen=True)
class Glance:
    """Commands at some instants since the first motion, and between which values they lie around them."""

    values: np.ndarray  # (K, 2)
    low: np.ndarray  # (K, 2)
    high: np.ndarray  # (K, 2)
    length: float  # s of motion; nan where there is none


def glance(course: Course) -> Glance:
    """What is compared of a drive first."""
    if not course.moves or course.end - course.begin > LONGEST:
        return Glance(*(np.zeros((0, 2)),) * 3, float("nan"))
    around = 2 * TIMING[1]  # s by which two commands of replicates may be apart in time
    t = np.arange(0.0, course.end - course.begin, GLANCE)
    near = np.arange(-around, around + TABLE_DT, TABLE_DT)
    table = course.at((t[:, None] + near).ravel()).reshape(len(t), len(near), 2)
    return Glance(course.at(t), table.min(axis=1), table.max(axis=1), course.end - course.begin)


def may_be_alike(a: Glance, b: Glance) -> bool:
    """Whether two drives may have the same commands: whatever `shift_between` accepts passes."""
    count = min(len(a.values), len(b.values))
    if not count:
        return True
    if abs(a.length - b.length) > 2 * TIMING[1]:
        return False
    allowed = VALUE[0] + VALUE[1] * np.maximum(np.abs(a.high), np.abs(a.low)).max(axis=0)
    values = a.values[:count]
    return bool(((values >= b.low[:count] - allowed) & (values <= b.high[:count] + allowed)).all())


def same_course(trials: Sequence[Trial], most: float = np.inf, by_name: bool = True) -> list[list[int]]:
    """Indices of trials of one manoeuvre with the same commands, at most `most` s apart; single ones too.

    Whoever gives two drives of the same commands different names may know of a difference, such as a load; with
    `by_name` False the names do not count.
    """
    courses = [course_of(trial) for trial in trials]
    glances = [glance(course) for course in courses]
    groups: list[list[int]] = []
    of_manoeuvre: dict[str, list[list[int]]] = {}
    for i, trial in enumerate(trials):
        mine = of_manoeuvre.setdefault(trial.manoeuvre if by_name else "", [])
        for group in mine:
            if not may_be_alike(glances[group[0]], glances[i]):
                continue
            shift = shift_between(courses[group[0]], courses[i])
            if shift is not None and abs(shift) <= most + EXACT:
                group.append(i)
                break
        else:
            mine.append([i])
            groups.append(mine[-1])
    return groups


def shifts(trials: Sequence[Trial]) -> np.ndarray:
    """(N,) how much later each trial's commands come than the first one's [s]; 0 where they are not the same."""
    courses = [course_of(trial) for trial in trials]
    return np.array([shift_between(courses[0], course) or 0.0 for course in courses])


def _best_lag(ours: np.ndarray, theirs: np.ndarray, most: int) -> int:
    """Rows by which theirs (T, 2) come later than ours (T, 2), at most so many, where the difference is least."""
    inside = slice(most, len(ours) - most)
    left = {lag: float(np.abs(ours[inside] - np.roll(theirs, -lag, axis=0)[inside]).sum())
            for lag in sorted(range(-most, most + 1), key=abs)}
    return min(left, key=lambda lag: (left[lag], abs(lag)))


def _within(ours: np.ndarray, theirs: np.ndarray, allowed: np.ndarray, width: int) -> bool:
    """Whether each row of ours (T, 2) lies among the rows of theirs that are at most half a width away."""
    from scipy.ndimage import maximum_filter1d, minimum_filter1d

    low = minimum_filter1d(theirs, width, axis=0, mode="nearest")
    high = maximum_filter1d(theirs, width, axis=0, mode="nearest")
    return bool(((ours >= low - allowed) & (ours <= high + allowed)).all())

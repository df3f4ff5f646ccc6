"""Single trials that do not belong to the others of a log: copies, another trial's pose, a late clock, another driver.

What most trials of a log show is a fault of a stream (`sysid.logs.contradictions`).
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence

import numpy as np

from sysid.logs.contradictions import MOVED, STILL, lateness
from sysid.logs.directions import VARIED, WHOLE
from sysid.logs.records import Trial
from sysid.logs.stream_quality import Shift, speeds

NEAR, STEP = 1.0, 0.05  # s by which a pose may be late, and of the grid on which it is compared
FOREIGN = 0.5  # correlation with the odometry's speed, below which a pose is of another drive
BEFORE = 0.1  # s by which a motion comes before its commands that no clock or filter explains


def odd_trials(trials: Sequence[Trial]) -> list[str]:
    """Sentences on trials that do not belong to the others."""
    late = _late(trials)
    return [*_copies(trials), *late, *([] if late else _foreign(trials)), *_driven_otherwise(trials)]


def content_of(trial: Trial) -> str:
    """Hash of all that was recorded of a drive, whatever its name."""
    found = hashlib.sha256(trial.command.table.tobytes())
    for stream in (trial.odometry, trial.ground_truth, trial.gyro):
        for one in (() if stream is None else vars(stream).values()):
            found.update(np.ascontiguousarray(one).tobytes() if isinstance(one, np.ndarray) else b"-")
    return found.hexdigest()


def before_its_commands(channel: str, shifts: Sequence[Mapping[str, Shift]]) -> list[str]:
    """A sentence on a stream whose motion comes before the commands that cause it; `shifts`: `response_shift`."""
    found = {name: [one[name].delay + one[name].lag for one in shifts
                    if name in one and abs(one[name].correlation) > WHOLE] for name in ("v", "omega")}
    known = [float(np.median(delays)) for delays in found.values() if len(delays) > len(shifts) / 2]
    if not known or max(known) > -BEFORE:
        return []
    early = -max(known)
    return [f"{channel}: its motion comes {early:.1f} s before the commands that cause it: two clocks. Add "
            f"{early:.1f} s and the delay of the vehicle to its t, or record both with one clock."]


def short_timeout(trials: Sequence[Trial], timeout: float | None) -> list[str]:
    """A sentence on a stated time-out of the base [s] that ends before the next command comes."""
    steps = [np.diff(trial.command.t[(trial.command.table[:, 1:] != 0).any(axis=1)]) for trial in trials]
    usual = float(np.median(np.concatenate(steps))) if any(map(len, steps)) else 0.0
    if timeout is None or usual <= timeout:
        return []
    return [f"command: command_timeout is {timeout:g} s, but most commands are {usual:.2g} s apart: in replays the "
            "vehicle stops after each of them. Correct it in dataset.toml, or leave it out."]


def _copies(trials: Sequence[Trial]) -> list[str]:
    """A sentence on trials with the same rows."""
    first: dict[str, str] = {}
    same = [(trial.name, first[content]) for trial in trials
            if (content := content_of(trial)) in first or first.setdefault(content, trial.name) != trial.name]
    if not same:
        return []
    return [f"trials: {same[0][0]} has the same rows as {same[0][1]}{_and_more(same)}. A copy is no replicate: it "
            "shows no noise, and what it says counts twice. Leave it out."]


def _late(trials: Sequence[Trial]) -> list[str]:
    """Sentences on poses of a few trials whose clock is another one than in the others."""
    said = []
    for name in ("odometry", "ground_truth"):
        recorded = [trial for trial in trials if getattr(trial, name) is not None]
        late = [(trial.name, seconds) for trial in recorded if (seconds := lateness(trial, name)) is not None]
        if late and len(late) <= len(recorded) / 2:
            trial, seconds = late[0]
            said.append(f"{name}: in {trial}{_and_more(late)} its motion comes {abs(seconds):.1f} s "
                        f"{'later' if seconds > 0 else 'earlier'} than the speeds beside it, in the other trials not. "
                        "Correct its t, or leave the trial out.")
    return said


def _foreign(trials: Sequence[Trial]) -> list[str]:
    """A sentence on outside poses that do not follow the odometry, though those of the other trials do."""
    known = [(trial.name, follows) for trial in trials if (follows := _follows(trial)) is not None]
    foreign = [(name, follows) for name, follows in known if follows < FOREIGN]
    if not foreign or len(foreign) > len(known) / 2 or np.median([follows for _, follows in known]) < WHOLE:
        return []
    return [f"ground_truth: in {foreign[0][0]}{_and_more(foreign)} the outside pose does not follow the odometry, "
            "though it does in the other trials: another trial's file, another body, or wheels that slid. Check it, or "
            "leave the trial out."]


def _follows(trial: Trial) -> float | None:
    """The lower correlation of speeds and of yaw rates of pose and odometry, at the best delay; None without motion."""
    ours, theirs = speeds(trial, "ground_truth", smooth=True), speeds(trial, "odometry", smooth=True)
    if ours is None or theirs is None:
        return None
    t = np.arange(max(ours[0][0], theirs[0][0]), min(ours[0][-1], theirs[0][-1]), STEP)
    if len(t) * STEP < 4 * NEAR:
        return None
    found = []
    for pose, odometry in ((np.abs(ours[1]), np.abs(theirs[1])), (ours[2], theirs[2])):
        wheels = np.interp(t, theirs[0], odometry)
        late = [np.interp(t + lag, ours[0], pose) for lag in np.arange(-NEAR, NEAR + STEP / 2, STEP)]
        if wheels.std() > VARIED:
            found.append(max(_correlation(wheels, one) for one in late))
    return min(found, default=None)


def _correlation(one: np.ndarray, other: np.ndarray) -> float:
    return float(one @ other / max(np.linalg.norm(one) * np.linalg.norm(other), 1e-9))


def _driven_otherwise(trials: Sequence[Trial]) -> list[str]:
    """A sentence on trials in which the vehicle drives without any command, while it obeys them in others."""
    silent = [(trial.name, way) for trial in trials
              if not (np.abs(trial.command.table[:, 1:]) > STILL).any() and (way := _way(trial)) > MOVED]
    if not silent or len(silent) == len(trials):
        return []
    name, way = silent[0]
    return [f"command: in {name}{_and_more(silent)} all commands are zero while the vehicle moves {way:.1f} m: it was "
            "driven by hand, by a joystick or by another topic. Record what it obeyed, or leave the trial out."]


def _way(trial: Trial) -> float:
    """How far the vehicle drives [m], by the odometry's speed or the outside pose's."""
    found = next((one for one in (speeds(trial, "odometry"), speeds(trial, "ground_truth", smooth=True))
                  if one is not None and len(one[0]) > 1), None)
    return 0.0 if found is None else float(np.trapezoid(np.abs(found[1]), found[0]))


def _and_more(found: Sequence[object]) -> str:
    return f" and {len(found) - 1} more" if len(found) > 1 else ""

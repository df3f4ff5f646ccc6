"""Single trials that do not belong to the others of a log: copies, another trial's pose, a late clock, another driver.

What most trials of a log show is a fault of a stream (`sysid.logs.contradictions`).
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence

import numpy as np

from sysid.logs.contradictions import MOVED, STILL, lateness
from sysid.logs.directions import WHOLE
from sysid.logs.metrics import CHANNELS
from sysid.logs.records import Trial
from sysid.logs.stream_quality import Shift, added_up

NEAR, WINDOW, STEP = 1.0, 2.0, 0.05  # s by which a pose may be late, in which turns are compared, and of their grid
TURNING = 0.3  # rad in a window (root mean square): far more than a pose's noise
FOREIGN = 0.5  # cosine of turns by pose and odometry, below which the pose is of another drive
ROUNDED = 1e-3  # s by which intervals of commands may be off
BEFORE = 0.1  # s by which a motion comes before its commands that no clock or filter explains


def odd_trials(trials: Sequence[Trial], sound: Sequence[str] = CHANNELS) -> list[str]:
    """Sentences on trials that do not belong to the others; `sound`: streams in which most trials show no fault."""
    late = [said for name in sound for said in _late(name, trials)]
    foreign = [] if late or len(sound) < len(CHANNELS) else _foreign(trials)
    return [*_copies(trials), *late, *foreign, *_driven_otherwise(trials)]


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
                    if name in one and one[name].correlation > WHOLE] for name in ("v", "omega")}
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
    if timeout is None or usual <= timeout + ROUNDED:
        return []
    return [f"command: command_timeout is {timeout:g} s, but most commands are {usual:.2g} s apart: in replays the "
            "vehicle stops after each of them. Correct it in dataset.toml, or leave it out."]


def _copies(trials: Sequence[Trial]) -> list[str]:
    """A sentence on drives with the same rows."""
    first, same = dict[str, str](), list[tuple[str, str]]()
    for trial in trials:
        if trial.command.table[:, 1:].any():  # trials at rest may look alike
            content = content_of(trial)
            if content in first:
                same.append((trial.name, first[content]))
            first.setdefault(content, trial.name)
    if not same:
        return []
    return [f"trials: {same[0][0]} has the same rows as {same[0][1]}{_and_more(same)}. A copy is no replicate: it "
            "shows no noise, and what it says counts twice. Leave it out."]


def _late(name: str, trials: Sequence[Trial]) -> list[str]:
    """A sentence on a pose that is late or early in some trials; in most of them it is the clock of the stream."""
    recorded = [trial for trial in trials if getattr(trial, name) is not None]
    late = [(trial.name, seconds) for trial in recorded if (seconds := lateness(trial, name)) is not None]
    if not late or len(late) > len(recorded) / 2:
        return []
    trial, seconds = late[0]
    return [f"{name}: in {trial}{_and_more(late)} its motion comes {abs(seconds):.1f} s "
            f"{'later' if seconds > 0 else 'earlier'} than the speeds beside it. Correct its t, or leave the trial "
            "out."]


def _foreign(trials: Sequence[Trial]) -> list[str]:
    """A sentence on outside poses that do not turn with the odometry, though those of most trials do."""
    known = [(trial.name, alike) for trial in trials if (alike := _turns_alike(trial)) is not None]
    foreign = [(name, alike) for name, alike in known if alike < FOREIGN]
    if not foreign or np.median([alike for _, alike in known]) < WHOLE:
        return []
    return [f"ground_truth: in {foreign[0][0]}{_and_more(foreign)} the outside pose does not turn with the odometry, "
            "though it does in most trials: another trial's file, another body, or wheels that slid. Check it, or "
            "leave the trial out."]


def _turns_alike(trial: Trial) -> float | None:
    """Cosine of what pose and odometry turn by in two seconds, at the best delay; None where neither turns much."""
    pose, odometry = trial.ground_truth, trial.odometry
    if pose is None or odometry is None or min(len(pose.t), len(odometry.t)) < 2:
        return None
    t = np.arange(max(pose.t[0], odometry.t[0]) + NEAR, min(pose.t[-1], odometry.t[-1]) - NEAR - WINDOW, STEP)
    if len(t) * STEP < WINDOW:
        return None
    yaw = added_up(odometry.t, odometry.omega, np.concatenate([t, t + WINDOW]))
    wheels, found = np.subtract(*yaw.reshape(2, -1)[::-1]), []
    for late in np.arange(-NEAR, NEAR + STEP / 2, STEP):
        turned = np.interp(t + late + WINDOW, pose.t, pose.yaw) - np.interp(t + late, pose.t, pose.yaw)
        sizes = [float(np.linalg.norm(one)) for one in (wheels, turned)]
        if max(sizes) > TURNING * np.sqrt(len(t)):
            found.append(float(wheels @ turned) / max(sizes[0] * sizes[1], 1e-9))
    return max(found, default=None)


def _driven_otherwise(trials: Sequence[Trial]) -> list[str]:
    """A sentence on trials in which the vehicle drives off without any command, while it obeys them in others."""
    silent = [(trial.name, way) for trial in trials if not (np.abs(trial.command.table[:, 1:]) > STILL).any()
              and trial.start.v == trial.start.omega == 0.0 and (way := _way(trial)) > MOVED]
    if not silent or len(silent) == len(trials):
        return []
    name, way = silent[0]
    return [f"command: in {name}{_and_more(silent)} all commands are zero while the vehicle moves {way:.1f} m: it was "
            "driven by hand, by a joystick or by another topic. Record what it obeyed, or leave the trial out."]


def _way(trial: Trial) -> float:
    """How far the vehicle gets [m], by the outside pose or else the odometry's speed: noise does not add up."""
    if (pose := trial.ground_truth) is not None:
        return float(np.hypot(np.ptp(pose.x), np.ptp(pose.y)))
    odometry = trial.odometry
    return 0.0 if odometry is None else float(np.ptp(added_up(odometry.t, odometry.v, odometry.t)))


def _and_more(found: Sequence[object]) -> str:
    return f" and {len(found) - 1} more" if len(found) > 1 else ""

"""One trial of a driving-log dataset, written row by row while it is driven."""

import contextlib
import itertools
import math
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, Any

from bridge.nodes.exits import OptionError
from bridge.recording.mcap_file import McapWriter

COLUMNS = {
    "command": ("t", "v", "omega"),
    "odometry": ("t", "x", "y", "yaw", "v", "omega", "stamp"),
    "ground_truth": ("t", "x", "y", "yaw", "stamp"),
    "imu": ("t", "gyro", "stamp"),
}
MCAP = "recording.mcap"
"""File of a trial with the whole messages of all topics."""
TRIAL_NAME = re.compile(r"[A-Za-z0-9][\w.-]*")
PARTIAL = re.compile(r"\.(?P<trial>[A-Za-z0-9][\w.-]*)\.partial-(?P<process>\d+)")


def left_out(counts: Mapping[str, int]) -> list[str]:
    """Return a sentence for each stream of which measurements were left out, by how many."""
    return [f"{stream}: {count} messages were left out: a number is not finite, an orientation is all zeros, or an "
            "IMU measures no yaw rate. Correct the publisher." for stream, count in counts.items() if count]


class TrialWriter:
    """Writes the streams of one trial. Times count from the first pose; the command then in force becomes row one."""

    def __init__(self, dataset: str | Path, trial: str) -> None:
        """Open the trial for writing.

        Raises:
            ValueError: the trial exists already, or its name is no plain file name.
        """
        self.folder = self.check(dataset, trial)
        self.folder.parent.mkdir(parents=True, exist_ok=True)
        self._partial = Path(dataset) / f".{trial}.partial-{os.getpid()}"
        try:
            self._partial.mkdir()
        except FileExistsError:
            raise OptionError(f"{self._partial}: is a recording that was killed. Make a trial of it with --recover, or "
                              "remove it.") from None
        self._files: dict[str, IO[str]] = {}
        self._mcap: McapWriter | None = None
        self._origin: float | None = None
        self._waiting: tuple[float, float] | None = None
        self._last: dict[str, float] = {}
        self._first_pose: tuple[float, float, float] | None = None
        self._yaw: float | None = None
        self.rows = dict.fromkeys(COLUMNS, 0)
        self.left_out = dict.fromkeys(COLUMNS, 0)
        """Measurements with a number that is not finite: a log holds no holes."""

    @staticmethod
    def check(dataset: str | Path, trial: str) -> Path:
        """Return the folder of a trial that can be recorded.

        Raises:
            ValueError: as the constructor.
        """
        if not TRIAL_NAME.fullmatch(trial):
            raise OptionError(f"trial {trial!r}: must be letters, digits, '_', '-', '.', because it names a folder. "
                              "Choose another name, like circle_1.")
        folder = Path(dataset) / "trials" / trial
        if folder.exists():
            raise OptionError(f"{folder}: exists already; a recording never replaces another. Choose another name.")
        return folder

    def begin(self, t: float) -> None:
        """Let times count from t [s] instead of the first pose, so that repeats of a drive have the same times.

        What was measured up to then is left out: it may come late, and be of the time before the vehicle was put to its
        start.
        """
        self._origin = t
        self._last = {stream: 0.0 for stream in COLUMNS if stream != "command"}

    def command(self, t: float, v: float, omega: float) -> None:
        """Add a command: t [s] of any steady clock, v [m/s], omega [rad/s]."""
        if self._origin is None:
            self._waiting = (v, omega)
        else:
            self._add("command", t, v, omega)

    def odometry(self, t: float, pose: Sequence[float], twist: Sequence[float], stamp: float = 0.0) -> None:
        """Add what the vehicle's odometry reports; it is moved to start at the origin with heading 0, yaw unwrapped.

        `pose` is x, y [m] and yaw [rad], `twist` v [m/s] and omega [rad/s]. `stamp` [s] is the message's own time, on
        whatever clock the vehicle has; 0 where it has none.
        """
        if self._is_early("odometry", t):
            return
        if not self._is_finite("odometry", t, *pose, *twist, stamp):
            return  # before its pose becomes the origin, or the heading that all later ones go on from
        x, y, yaw = pose
        if self._first_pose is None or self._yaw is None:
            self._first_pose, self._yaw = (x, y, yaw), yaw
        x0, y0, yaw0 = self._first_pose
        self._yaw += math.remainder(yaw - self._yaw, 2 * math.pi)
        dx, dy = x - x0, y - y0
        along = math.cos(yaw0) * dx + math.sin(yaw0) * dy
        left = -math.sin(yaw0) * dx + math.cos(yaw0) * dy
        self._add("odometry", t, along, left, self._yaw - yaw0, *twist, stamp)

    def ground_truth(self, t: float, x: float, y: float, yaw: float, stamp: float = 0.0) -> None:
        """Add an outside measurement of the drive-axle centre in the room."""
        self._add("ground_truth", t, x, y, yaw, stamp)

    def imu(self, t: float, gyro: float, stamp: float = 0.0) -> None:
        """Add the yaw rate [rad/s] of an inertial measurement unit."""
        self._add("imu", t, gyro, stamp)

    def message(self, topic: str, kind: Any, data: bytes, received: int = 0) -> None:
        """Add a whole message, serialised, of a topic and a class to the trial's MCAP file; times as `McapWriter`."""
        if self._mcap is None:
            self._mcap = McapWriter(self._partial / MCAP)
        self._mcap.write(topic, kind, data, received)

    def flush(self) -> None:
        """Hand the rows so far to the operating system."""
        for file in self._files.values():
            file.flush()
        if self._mcap is not None:
            self._mcap.flush()

    def close(self) -> Path:
        """End the recording: give the trial its name and return its folder.

        Raises:
            OSError: the last rows could not be written; the rest lies in the folder that the message names.
        """
        failure = None
        for file in self._files.values():
            try:
                file.flush()
                os.fsync(file.fileno())
            except OSError as error:
                failure = error
            finally:
                with contextlib.suppress(OSError):
                    file.close()
        if self._mcap is not None:
            try:
                self._mcap.close()
            except OSError as error:
                failure = error
        if failure is not None:
            raise OSError(failure.errno, f"{failure.strerror}: the recording is cut off; what was written lies in "
                                         f"{self._partial}. Make room and record again")
        os.replace(self._partial, self.folder)
        return self.folder

    @property
    def is_empty(self) -> bool:
        """Whether nothing was recorded so far."""
        return not self._files and self._mcap is None

    def drop(self) -> None:
        """End a recording that is empty, and leave no trial: the dataset could not be read with it."""
        self._partial.rmdir()
        with contextlib.suppress(OSError):
            self.folder.parent.rmdir()  # where it holds no other trial

    def put_aside(self) -> Path:
        """End a recording that is no trial, such as a stopped drive; return its folder, below `aborted` in the dataset.

        Raises:
            OSError: as `close`.
        """
        aside = self.folder.parent.with_name("aborted")
        aside.mkdir(exist_ok=True)
        names = (f"{self.folder.name}.{k}" for k in itertools.count(1))
        self.folder = aside / next(name for name in names if not (aside / name).exists())
        return self.close()

    def _is_early(self, stream: str, t: float) -> bool:
        """Return whether a time is before the start of the trial, or no later than the last row of the stream."""
        if self._origin is None:
            return False
        since = round(t - self._origin, 6)
        return since < 0 or since <= self._last.get(stream, -math.inf)

    def _is_finite(self, stream: str, *values: float) -> bool:
        """Return whether all numbers of a measurement are finite; count one that is not."""
        finite = all(map(math.isfinite, values))
        self.left_out[stream] += not finite
        return finite

    def _add(self, stream: str, t: float, *values: float) -> None:
        if not self._is_finite(stream, t, *values):
            return
        if stream not in self._files:
            self._files[stream] = open(self._partial / f"{stream}.csv", "w", encoding="utf-8")
            self._files[stream].write(",".join(COLUMNS[stream]) + "\n")
        if self._origin is None:
            self._origin = t
            if self._waiting is not None:
                self._add("command", t, *self._waiting)
        if self._is_early(stream, t):
            return  # stamped before the start, or two messages within a microsecond
        t = round(t - self._origin, 6) + 0.0  # a time a little before the start is 0 and not -0
        self._last[stream] = t
        self._files[stream].write(f"{t:.6f}," + ",".join(f"{value:.6f}" for value in values) + "\n")
        self.rows[stream] += 1

"""A long recording in trials: one for each drive between two standstills."""

import itertools
import tempfile
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

from bridge.recording.trial_writer import COLUMNS, TrialWriter

STANDING = (0.01, 0.02)
"""Speeds below which a vehicle counts as standing: v [m/s], omega [rad/s]; odometry is never quite silent."""


class Spool:
    """The whole messages of the last seconds, on disk: images of a standstill would fill the memory.

    They are in two files without a name, which vanish with the process. When the newer one is old enough, it takes the
    place of the older one.
    """

    def __init__(self, folder: Path, seconds: float) -> None:
        """Keep so many seconds of messages, and up to twice as many, in a folder that exists by the first one."""
        self._folder, self._seconds = folder, seconds
        self._parts: list[tuple[float, IO[bytes], list[tuple[float, str, Any, int, int]]]] = []

    def put(self, now: float, topic: str, kind: Any, data: bytes) -> None:
        """Add a message at a steady time [s]."""
        if not self._parts or now - self._parts[-1][0] > self._seconds:
            for _, old, _ in self._parts[:-1]:
                old.close()
            self._parts = [*self._parts[-1:], (now, tempfile.TemporaryFile(dir=self._folder), [])]
        _, file, index = self._parts[-1]
        file.write(data)
        index.append((now, topic, kind, len(data), time.time_ns()))

    def take(self, since: float) -> Iterator[tuple[str, Any, bytes, int]]:
        """Hand out the messages from a steady time [s] on, the oldest first, with the Unix time of receipt [ns]."""
        parts, self._parts = self._parts, []
        for _, file, index in parts:
            file.seek(0)
            for at, topic, kind, length, received in index:
                data = file.read(length)
                if at >= since:
                    yield topic, kind, data, received
            file.close()


class SplitWriter:
    """Takes what a `TrialWriter` takes, and makes a trial of each drive.

    A trial begins some seconds before the first motion, and ends when the vehicle has stood for as long. What comes
    while it stands longer is dropped.
    """

    def __init__(self, dataset: str | Path, stem: str, seconds: float,
                 on_trial: Callable[[Path, Mapping[str, int]], None], clock: Callable[[], float] = time.monotonic
                 ) -> None:
        """Write trials STEM_1, STEM_2 and so on; numbers that are taken are left out.

        Args:
            dataset: folder of the dataset.
            stem: of the names of its trials.
            seconds: of standstill that end a drive.
            on_trial: called with the folder and the rows of each trial that is whole.
            clock: steady clock [s].

        Raises:
            ValueError: the name is no plain file name.
        """
        TrialWriter.check(dataset, f"{stem}_0")
        self.rows: Counter[str] = Counter(dict.fromkeys(COLUMNS, 0))
        """Of all whole trials."""
        self.left_out: Counter[str] = Counter()
        """Of all whole trials, as of `TrialWriter`."""
        self.trials: list[Path] = []
        self._dataset, self._stem, self._seconds, self._on_trial, self._clock = dataset, stem, seconds, on_trial, clock
        self._writer: TrialWriter | None = None
        self._waiting: deque[tuple[float, str, tuple[Any, ...]]] = deque()
        self._spool = Spool(Path(dataset), seconds)
        self._moved = 0.0

    def command(self, t: float, v: float, omega: float) -> None:
        """Add a command."""
        self._take("command", (t, v, omega), bool(v or omega))

    def odometry(self, t: float, pose: Sequence[float], twist: Sequence[float], stamp: float = 0.0) -> None:
        """Add what the odometry reports, as of `TrialWriter`."""
        v, omega = twist
        self._take("odometry", (t, pose, twist, stamp), abs(v) > STANDING[0] or abs(omega) > STANDING[1])

    def ground_truth(self, t: float, x: float, y: float, yaw: float, stamp: float = 0.0) -> None:
        """Add an outside measurement."""
        self._take("ground_truth", (t, x, y, yaw, stamp))

    def imu(self, t: float, gyro: float, stamp: float = 0.0) -> None:
        """Add a yaw rate."""
        self._take("imu", (t, gyro, stamp))

    def message(self, topic: str, kind: Any, data: bytes) -> None:
        """Add a whole message; while the vehicle stands it waits on disk."""
        if self._writer is not None:
            self._take("message", (topic, kind, data))
        else:
            self._spool.put(self._clock(), topic, kind, data)

    def flush(self) -> None:
        """Hand the rows so far to the operating system; end the drive where nothing has come for long."""
        if self._writer is not None:
            self._writer.flush()
            self._end_if_over(self._clock())

    def close(self) -> Path | None:
        """End the last trial, where a drive goes on; return its folder."""
        writer, self._writer = self._writer, None
        if writer is None:
            return None
        folder = writer.close()
        self.trials.append(folder)
        self.rows.update(writer.rows)
        self.left_out.update(writer.left_out)
        self._on_trial(folder, writer.rows)
        return folder

    def _take(self, name: str, values: tuple[Any, ...], moves: bool = False) -> None:
        now = self._clock()
        if moves:
            self._moved = now
            if self._writer is None:
                self._begin()
        if self._writer is not None:
            getattr(self._writer, name)(*values)
            self._end_if_over(now)
            return
        self._waiting.append((now, name, values))
        while now - self._waiting[0][0] > self._seconds:
            self._waiting.popleft()

    def _begin(self) -> None:
        trials = Path(self._dataset) / "trials"
        name = next(name for name in (f"{self._stem}_{k}" for k in itertools.count(1)) if not (trials / name).exists())
        self._writer = TrialWriter(self._dataset, name)
        for _, what, values in self._waiting:
            getattr(self._writer, what)(*values)
        self._waiting.clear()
        for message in self._spool.take(self._clock() - self._seconds):
            self._writer.message(*message)

    def _end_if_over(self, now: float) -> None:
        if now - self._moved > self._seconds:
            self.close()

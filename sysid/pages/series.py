"""Measured and replayed motion of all trials of a fit, beside the fit: `RUN/series.npz`.

Per trial and channel the time (T,) and, for "measured", "ideal", "initial" and "fitted", the columns x, y, yaw of the
outside pose (T, 3) and x, y, yaw, v, omega of the odometry (T, 5); columns that were not logged are nan.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sysid.logs.metrics import CHANNELS, ideal_replay
from sysid.logs.planar import turned_by
from sysid.logs.records import Prediction, Trial
from whill_mjx.io.folders import whole_file
from whill_mjx.io.reading import read_arrays

REPLAYED = ("measured", "ideal", "initial", "fitted")
FILE = "series.npz"
COLUMNS = {"ground_truth": 3, "odometry": 5}
AGAIN = "Fit again; without the file, the trials are replayed."


@dataclass(frozen=True)
class Channel:
    t: np.ndarray  # (T,) s
    values: dict[str, np.ndarray]  # "measured" and the names of replays -> (T, 3) or (T, 5)

    def error(self, replay: str = "fitted") -> np.ndarray:
        """Replayed minus measured (T, C); position along and left of the measured heading, yaw as an angle."""
        measured = self.values["measured"]
        error = self.values[replay] - measured
        error[:, 0], error[:, 1] = turned_by(error[:, 0], error[:, 1], -measured[:, 2])
        error[:, 2] = np.angle(np.exp(1j * error[:, 2]))
        return error


@dataclass(frozen=True)
class TrialSeries:
    name: str
    held_out: bool
    start: tuple[float, float, float]  # x, y [m], yaw [rad] in the room
    channels: dict[str, Channel]

    @property
    def label(self) -> str:
        """Its name, and whether it was held out."""
        return self.name + (" (held out)" if self.held_out else "")


def collect(trials: Sequence[Trial], initial: Sequence[Prediction], fitted: Sequence[Prediction]) -> list[TrialSeries]:
    """Series of trials and their three replays."""
    return replayed(trials, {"ideal": list(map(ideal_replay, trials)), "initial": initial, "fitted": fitted})


def replayed(trials: Sequence[Trial], replays: Mapping[str, Sequence[Prediction]]) -> list[TrialSeries]:
    """Series of trials as measured and as replayed."""
    found = []
    for number, trial in enumerate(trials):
        sources = {"measured": trial, **{name: each[number] for name, each in replays.items()}}
        channels = {channel: Channel(getattr(trial, channel).t, {name: getattr(source, channel).values
                                                                 for name, source in sources.items()})
                    for channel in CHANNELS if getattr(trial, channel) is not None}
        start = trial.start.x, trial.start.y, trial.start.yaw
        found.append(TrialSeries(trial.name, trial.held_out, start, channels))
    return found


def save(folder: Path, series: Sequence[TrialSeries]) -> Path:
    """Write the series into a run folder, whole or not at all."""
    arrays: dict[str, Any] = {}
    about = []
    for index, trial in enumerate(series):
        about.append({"name": trial.name, "held_out": trial.held_out, "start": trial.start,
                      "channels": list(trial.channels)})
        for name, channel in trial.channels.items():
            arrays[f"{index}.{name}.t"] = channel.t
            arrays |= {f"{index}.{name}.{replay}": values.astype(np.float32)
                       for replay, values in channel.values.items()}
    path = Path(folder) / FILE
    with whole_file(path) as temporary:
        np.savez_compressed(temporary, about=np.array(json.dumps(about)), **arrays)
    return path


def load(folder: Path) -> list[TrialSeries]:
    """Series of a run folder; FileNotFoundError where it has none."""
    path = Path(folder) / FILE
    arrays = read_arrays(path, "missing. Fit again, or give the dataset, to replay the trials.", AGAIN)
    try:
        about = json.loads(str(arrays.pop("about")))
        return [_trial_series(path, arrays, str(index), one) for index, one in enumerate(about)]
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        text = str(error)
        raise ValueError(text if text.startswith(str(path)) else f"{path}: is not whole ({text[:160]!r}). {AGAIN}"
                         ) from None


def _trial_series(path: Path, arrays: dict[str, np.ndarray], index: str, about: dict[str, Any]) -> TrialSeries:
    """The series of one trial, of the right shapes."""
    channels = {}
    for name in about["channels"]:
        t = arrays[f"{index}.{name}.t"]
        shape = (len(t), COLUMNS[name])
        values = {replay: arrays[f"{index}.{name}.{replay}"] for replay in REPLAYED}
        for replay, table in (("t", t[:, None]), *values.items()):
            wanted = (len(t), 1) if replay == "t" else shape
            if table.shape != wanted or table.dtype.kind != "f":
                raise ValueError(f"{path}: {index}.{name}.{replay} is {table.dtype} of shape {table.shape}; it must be "
                                 f"numbers of shape {wanted}. {AGAIN}")
        channels[name] = Channel(t, {replay: table.astype(float) for replay, table in values.items()})
    x, y, yaw = (float(value) for value in about["start"])
    return TrialSeries(str(about["name"]), bool(about["held_out"]), (x, y, yaw), channels)

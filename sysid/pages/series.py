"""Measured and replayed motion of all trials of a fit, beside the fit: `RUN/series.npz`.

Per trial and channel the time (T,) and, for "measured", "ideal", "initial" and "fitted", the columns x, y, yaw of the
outside pose (T, 3) and x, y, yaw, v, omega of the odometry (T, 5); columns that were not logged are nan.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sysid.logs.metrics import CHANNELS, ideal_replay
from sysid.logs.records import Prediction, Trial
from whill_mjx.io.folders import whole_file
from whill_mjx.io.reading import read_arrays

REPLAYED = ("measured", "ideal", "initial", "fitted")
FILE = "series.npz"
COLUMNS = {"ground_truth": 3, "odometry": 5}
AGAIN = "Fit again; without the file, the trials are replayed."


@dataclass(frozen=True)
class Channel:
    """One channel of one trial."""

    t: np.ndarray  # (T,) s
    values: dict[str, np.ndarray]  # "measured", "ideal", "initial", "fitted" -> (T, 3) or (T, 5)

    def error(self, replay: str = "fitted") -> np.ndarray:
        """Replayed minus measured (T, C); position along and left of the measured heading, yaw as an angle."""
        measured = self.values["measured"]
        error = self.values[replay] - measured
        cos, sin = np.cos(measured[:, 2]), np.sin(measured[:, 2])
        x, y = error[:, 0].copy(), error[:, 1].copy()
        error[:, 0], error[:, 1] = cos * x + sin * y, -sin * x + cos * y
        error[:, 2] = np.angle(np.exp(1j * error[:, 2]))
        return error


@dataclass(frozen=True)
class TrialSeries:
    """All channels of one trial."""

    name: str
    held_out: bool
    start: tuple[float, float, float]  # x, y [m], yaw [rad] in the room
    channels: dict[str, Channel]


def collect(
    trials: Sequence[Trial], initial: Sequence[Prediction], fitted: Sequence[Prediction]
) -> list[TrialSeries]:
    """Series of trials and their two replays."""
    found = []
    for trial, before, after in zip(trials, initial, fitted, strict=True):
        sources = {"measured": trial, "ideal": ideal_replay(trial), "initial": before, "fitted": after}
        channels = {}
        for channel in CHANNELS:
            stream = getattr(trial, channel)
            if stream is not None:
                channels[channel] = Channel(stream.t, {name: getattr(source, channel).values
                                                       for name, source in sources.items()})
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


def replay(run: Path, report: dict[str, Any]) -> list[TrialSeries]:
    """Series of a run folder without the file: load its dataset and replay the vehicle before and after the fit.

    FileNotFoundError or ValueError where the dataset has moved or changed since the fit.
    """
    import jax
    import jax.numpy as jnp

    from sysid.logs.measured import load_any
    from sysid.replay.rollout import Replay, make_batch, predictions, vehicle_plant
    from whill_mjx.vehicle.config import VehicleConfig
    from whill_mjx.vehicle.parameters import set_values
    from whill_mjx.vehicle.vehicle_file import load_vehicle

    dataset = report["dataset"]
    log = load_any(dataset["path"], train=tuple(dataset.get("train") or ()),
                   held_out=tuple(dataset.get("held_out_selection") or ()))
    if log.sha256 != dataset["sha256"]:
        raise ValueError(f"{dataset['path']}: has changed since {run / 'report.json'} was written (SHA-256 "
                         f"{log.sha256[:12]}, then {dataset['sha256'][:12]}). Fit it again.")
    spec, params, _ = load_vehicle(run / "vehicle.toml")
    plant = vehicle_plant(spec, VehicleConfig(physics_dt=report["settings"].get("physics_dt", 0.005)))
    names = [one["name"] for one in report["parameters"]]
    trials = (*log.training, *log.held_out)
    batch, _ = make_batch(trials, plant.dt)
    replayed = Replay(plant, batch, lambda values: set_values(params, names, values)).simulate(
        np.array([[one[key] for one in report["parameters"]] for key in ("initial", "value")], float))
    before, after = (predictions(trials, jax.tree.map(lambda leaf, k=k: jnp.asarray(leaf)[k], replayed))
                     for k in (0, 1))
    return collect(trials, before, after)

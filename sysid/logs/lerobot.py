"""Reads and writes LeRobotDataset v3: parquet and JSON, without the package `lerobot`.

    meta/info.json                              version, fps, features with the names of their parts, paths, splits
    meta/tasks.parquet                          task_index of each task, which is the index of the table
    meta/episodes/chunk-000/file-000.parquet    episode_index, tasks, length, where its rows are
    meta/stats.json                             of each feature
    data/chunk-000/file-000.parquet             all features that are no video, a row for each frame

A drive is an episode. Its commands are `action`, its odometry `observation.state`, its outside pose
`observation.ground_truth`. All streams of the format share one clock of constant rate, so commands move to the nearest
frame, and measurements are interpolated. Version 2 is read as well; it has one file for each episode.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sysid.logs.log import read_fields, spec_from_fields
from sysid.logs.records import Log, Trial, logged_pose
from sysid.logs.sources import LEROBOT_INFO
from sysid.logs.tables.columns import Table
from whill_mjx.io.fields import shown
from whill_mjx.io.reading import LONGEST_REASON, read_json
from whill_mjx.logs.dataset import write_fields, write_json
from whill_mjx.vehicle.specs import VehicleSpec

VERSION = "v3.0"
OURS = "meta/dataset.toml"  # nominal geometry, which the format has no place for
DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
STEM = "frames"  # what the rows of an episode are called, as a file of columns
NUMBERS = ("float16", "float32", "float64", "int16", "int32", "int64", "uint8", "uint16", "bool")
COUNTERS = ("frame_index", "episode_index", "index", "task_index")
FEATURES = {
    "action": ("command", ("v [m/s]", "omega [rad/s]")),
    "observation.state": ("odometry", ("x [m]", "y [m]", "yaw [rad]", "v [m/s]", "omega [rad/s]")),
    "observation.ground_truth": ("ground_truth", ("x [m]", "y [m]", "yaw [rad]")),
}  # feature -> stream and names of its parts, as they are written
WIDEST = 10_000  # numbers of a feature in a row
NEEDED = "{what} needs the package pyarrow, for its parquet files. Install it: pip install 'whill-mjx[lerobot]'."
AGAIN = "Record or download the dataset again."


@dataclass(frozen=True)
class Episodes:
    """The drives of a LeRobotDataset."""

    drives: Sequence[tuple[str, Table]] = ()  # name and columns of each, named FEATURE/PART
    held_out: tuple[str, ...] = ()  # episodes of another split than train
    spec: VehicleSpec | None = None  # nominal geometry, where `write` noted it
    notes: tuple[str, ...] = ()


def read(path: Path) -> Episodes:
    """The episodes of a LeRobotDataset, v3 or v2; ValueError where it is none or pyarrow is not installed."""
    pa = _pyarrow(f"{path}: reading a LeRobotDataset")
    try:
        return _read(pa, path)
    except (KeyError, IndexError, TypeError, AttributeError, ArithmeticError, RecursionError) as error:
        reason = f"{type(error).__name__}: {str(error)[:LONGEST_REASON]}"
        raise ValueError(f"{path}: {LEROBOT_INFO} and the files beside it do not go together ({reason}). "
                         f"{AGAIN}") from None


def _read(pa: Any, path: Path) -> Episodes:
    info = read_json(path / LEROBOT_INFO, "missing.", AGAIN)
    parts = _parts(path, info)
    files = sorted((path / "data").glob("*/*.parquet"))
    if not files:
        raise ValueError(f"{path}: no data/chunk-*/*.parquet in it. {AGAIN}")
    rows: dict[int, list[dict[str, np.ndarray]]] = {}
    for file in files:
        for number, found in _file_episodes(pa, file, parts):
            rows.setdefault(number, []).append(found)
    tasks, names, count = _task_names(pa, path), _trial_names(pa, path), Counter[str]()
    drives, numbers = [], sorted(rows)
    for number in numbers:
        joined = {name: np.concatenate([one[name] for one in rows[number]]) for name in rows[number][0]}
        task = tasks.get(int(joined.pop("task_index", np.zeros(1))[0]), "")
        stem = re.sub(r"[^\w-]+", "_", task).strip("_")[:40] or "episode"
        count[stem] += 1
        order = np.argsort(joined.pop("frame_index", joined["timestamp"]), kind="stable")
        drives.append((names.get(number, f"{stem}_{count[stem]}"),
                       Table(STEM, {name: values[order] for name, values in joined.items()})))
    held = _held_out(info, numbers)
    left = sorted(set(info["features"]) - {name.partition("/")[0] for name in parts} - set(COUNTERS))
    notes = [f"{len(drives)} episodes at {info.get('fps')} frames/s"]
    notes += [f"left out, since they are no rows of numbers: {', '.join(left)}"] if left else []
    spec = spec_from_fields(path / OURS, read_fields(path / OURS))[0] if (path / OURS).exists() else None
    return Episodes(drives, tuple(name for number, (name, _) in zip(numbers, drives, strict=True) if number in held),
                    spec, tuple(notes))


def write(folder: Path, log: Log, fps: int | None = None) -> list[str]:
    """Write the trials of a log as a LeRobotDataset v3 into an empty folder, and return notes.

    `fps`: frames per second; by default the rate of the measurements. ValueError where pyarrow is not installed, or
    trials differ in what was measured.
    """
    pa = _pyarrow("writing a LeRobotDataset")
    trials = (*log.training, *log.held_out)  # so that each split is one range
    having = [[stream for stream, _ in FEATURES.values() if getattr(trial, stream) is not None] for trial in trials]
    for trial, streams in zip(trials, having, strict=True):
        if streams != having[0]:
            raise ValueError(f"{log.name}: {trial.name} and {trials[0].name} differ in their streams; all episodes of "
                             "a LeRobotDataset have the same. Write them into datasets of their own.")
    rates = [(len(stream.t) - 1) / (stream.t[-1] - stream.t[0]) for trial in trials
             if (stream := trial.odometry or trial.ground_truth) is not None]
    fps = fps or max(round(float(np.median(rates))), 1)
    features = {name: parts for name, (stream, parts) in FEATURES.items() if stream in streams}
    tasks = list(dict.fromkeys(trial.manoeuvre for trial in trials))
    frames = [_frames(trial, fps, features) for trial in trials]
    lengths = [len(one["timestamp"]) for one in frames]
    whole = {name: np.concatenate([one[name] for one in frames]) for name in frames[0]}
    whole |= {"frame_index": np.concatenate([np.arange(length) for length in lengths]),
              "episode_index": np.repeat(np.arange(len(trials)), lengths), "index": np.arange(sum(lengths)),
              "task_index": np.repeat([tasks.index(trial.manoeuvre) for trial in trials], lengths)}
    _write_rows(pa, folder / DATA.format(chunk_index=0, file_index=0), whole, lengths)
    _write_episodes(pa, folder, trials, lengths)
    _write_tasks(pa, folder, tasks)
    tables = {name: values.reshape(len(values), -1).astype(float) for name, values in whole.items()}
    write_json(folder / "meta/stats.json", {name: {
        **{of: getattr(table, of)(0).tolist() for of in ("min", "max", "mean", "std")}, "count": [len(table)]}
        for name, table in tables.items()})
    write_json(folder / LEROBOT_INFO, _info(log, fps, features, tasks, lengths))
    write_fields(folder / "meta", log.spec)
    return [f"{len(trials)} episodes of {sum(lengths)} frames at {fps} frames/s: commands move to the nearest frame, "
            f"by {500 / fps:.0f} ms at most, and measurements are interpolated"]


def _pyarrow(what: str) -> Any:
    """The package that reads and writes parquet; ValueError where it is not installed."""
    try:
        import pyarrow.parquet
    except ImportError:
        raise ValueError(NEEDED.format(what=what)) from None
    return pyarrow


def _read_table(pa: Any, file: Path) -> dict[str, list[Any]]:
    """Columns of a parquet file that are no images; ValueError where it is none."""
    try:
        names = pa.parquet.read_schema(file).names
        numbers = [name for name in names if not name.startswith(("observation.image", "stats/"))]
        return dict(pa.parquet.read_table(file, columns=numbers).to_pydict())
    except (OSError, ValueError) as error:
        raise ValueError(f"{file}: is no whole parquet file ({str(error)[:120]}). {AGAIN}") from None


def _parts(path: Path, info: Mapping[str, Any]) -> dict[str, tuple[str, int]]:
    """Column of numbers, named FEATURE/PART -> its feature and place in it."""
    features = info.get("features")
    if not isinstance(features, dict) or "timestamp" not in features:
        raise ValueError(f"{path / LEROBOT_INFO}: no features with a timestamp. {AGAIN}")
    found: dict[str, tuple[str, int]] = {}
    for name, about in features.items():
        shape = list(about.get("shape") or [1])
        if about.get("dtype") not in NUMBERS or len(shape) != 1 or name in COUNTERS:
            continue
        if not isinstance(shape[0], int) or not 0 < shape[0] <= WIDEST:
            raise ValueError(f"{path / LEROBOT_INFO}: the shape of {shown(name)} is {shown(shape)}; at most {WIDEST} "
                             f"numbers are read. {AGAIN}")
        names = about.get("names")
        if isinstance(names, dict):  # {"motors": [...]} of version 2
            lists = [one for one in names.values() if isinstance(one, list)]
            names = lists[0] if lists else list(names)
        if not isinstance(names, list) or len(names) != shape[0]:
            names = [str(k) for k in range(shape[0])]
        for place, part in enumerate(names):
            alone = shape[0] == 1 and ("timestamp" in name or part == "0")
            found[name if alone else f"{name}/{part}"] = name, place
    return found


def _file_episodes(
    pa: Any, file: Path, parts: Mapping[str, tuple[str, int]]
) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
    """Index and columns of the episodes in one file."""
    table = _read_table(pa, file)
    wanted = dict.fromkeys(feature for feature, _ in parts.values())
    missing = sorted((set(wanted) | {"episode_index"}) - set(table))
    if missing:
        raise ValueError(f"{file}: no column {shown(missing[0])}, which {LEROBOT_INFO} names. {AGAIN}")
    also = [name for name in ("episode_index", "frame_index", "task_index") if name in table]
    try:
        arrays = {name: np.array(table[name], float).reshape(len(table[name]), -1) for name in (*wanted, *also)}
    except (TypeError, ValueError):
        raise ValueError(f"{file}: its rows are no numbers of one width. {AGAIN}") from None
    columns = {name: arrays[feature][:, place] for name, (feature, place) in parts.items()}
    columns |= {name: arrays[name][:, 0] for name in also[1:]}
    numbers = arrays["episode_index"][:, 0].astype(int)
    for number in dict.fromkeys(numbers.tolist()):
        yield number, {name: values[numbers == number] for name, values in columns.items()}


def _task_names(pa: Any, path: Path) -> dict[int, str]:
    if (file := path / "meta/tasks.parquet").exists():
        table = _read_table(pa, file)
        texts = next((table[name] for name in ("task", "__index_level_0__") if name in table), [])
        return dict(zip(table.get("task_index", []), map(str, texts), strict=False))
    if (file := path / "meta/tasks.jsonl").exists():
        try:
            rows = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines() if line.strip()]
            return {int(row["task_index"]): str(row["task"]) for row in rows}
        except (KeyError, TypeError, ValueError, RecursionError):
            raise ValueError(f"{file}: is no list of tasks. {AGAIN}") from None
    return {}


def _trial_names(pa: Any, path: Path) -> dict[int, str]:
    """Name of the trial of each episode, where `write` noted it."""
    found: dict[int, str] = {}
    for file in sorted((path / "meta/episodes").glob("*/*.parquet")):
        table = _read_table(pa, file)
        if {"trial", "episode_index"} <= set(table):
            found |= dict(zip(table["episode_index"], map(str, table["trial"]), strict=True))
    return found


def _held_out(info: Mapping[str, Any], numbers: Sequence[int]) -> set[int]:
    """Episodes of splits that are not for training; none where there is no other split."""
    splits = info.get("splits")
    texts = splits if isinstance(splits, dict) else {}
    ranges = {name: match for name, text in texts.items()
              if (match := re.fullmatch(r"(\d{1,9}):(\d{1,9})", str(text)))}  # fmt: skip
    return {number for name, match in ranges.items() if name != "train" and "train" in ranges
            for number in numbers if int(match[1]) <= number < int(match[2])}


def _frames(trial: Trial, fps: int, features: Mapping[str, Sequence[str]]) -> dict[str, np.ndarray]:
    """A trial on a clock of constant rate: features (T, C), and timestamp (T,)."""
    times = [stream.t for stream in (trial.odometry, trial.ground_truth) if stream is not None]
    begin, end = max(float(t[0]) for t in times), min(float(t[-1]) for t in times)
    t = np.arange(int(np.floor((end - begin) * fps + 1e-6)) + 1) / fps
    found = {}
    for name in features:
        stream = getattr(trial, FEATURES[name][0])
        if name == "action":
            values = stream.at(begin + t + 0.5 / fps, (0.0, 0.0)).T
        elif logged_pose(stream) is None:
            raise ValueError(f"{trial.name}: the odometry has no pose. Convert the log to a dataset first, which dead "
                             "reckons it.")
        else:
            values = np.column_stack([np.interp(begin + t, stream.t, column) for column in stream.values.T])
        found[name] = values.astype(np.float32)
    return {**found, "timestamp": t.astype(np.float32)}


def _write_rows(pa: Any, path: Path, columns: Mapping[str, np.ndarray], lengths: Sequence[int]) -> None:
    """Write rows, one row group for each episode."""
    arrays = {name: pa.array(values) if values.ndim == 1 else pa.FixedSizeListArray.from_arrays(
        pa.array(values.ravel()), values.shape[1]) for name, values in columns.items()}
    table = pa.table(arrays)
    path.parent.mkdir(parents=True, exist_ok=True)
    with pa.parquet.ParquetWriter(path, table.schema, compression="snappy") as writer:
        for end, length in zip(np.cumsum(lengths), lengths, strict=True):
            writer.write_table(table.slice(end - length, length))


def _write_episodes(pa: Any, folder: Path, trials: Sequence[Trial], lengths: Sequence[int]) -> None:
    path = folder / "meta/episodes/chunk-000/file-000.parquet"
    path.parent.mkdir(parents=True, exist_ok=True)
    ends, zeros = np.cumsum(lengths), np.zeros(len(trials), int)
    pa.parquet.write_table(pa.table({
        "episode_index": np.arange(len(trials)), "tasks": [[trial.manoeuvre] for trial in trials], "length": lengths,
        "trial": [trial.name for trial in trials], "dataset_from_index": ends - lengths, "dataset_to_index": ends,
        "data/chunk_index": zeros, "data/file_index": zeros, "meta/episodes/chunk_index": zeros,
        "meta/episodes/file_index": zeros}), path)


def _write_tasks(pa: Any, folder: Path, tasks: Sequence[str]) -> None:
    """Write the table of tasks; pandas, which LeRobot reads it with, takes the task as its index."""
    index = {"name": "task", "field_name": "task", "pandas_type": "unicode", "numpy_type": "object", "metadata": None}
    column = {**index, "name": "task_index", "field_name": "task_index", "pandas_type": "int64", "numpy_type": "int64"}
    about = {"index_columns": ["task"], "column_indexes": [], "columns": [column, index], "pandas_version": "2.0.0"}
    table = pa.table({"task_index": np.arange(len(tasks)), "task": list(tasks)})
    pa.parquet.write_table(table.replace_schema_metadata({"pandas": json.dumps(about)}), folder / "meta/tasks.parquet")


def _info(log: Log, fps: int, features: Mapping[str, Sequence[str]], tasks: Sequence[str], lengths: Sequence[int]
          ) -> dict[str, Any]:
    whole = {name: {"dtype": "float32", "shape": [len(parts)], "names": list(parts)}
             for name, parts in features.items()}
    count, training = len(lengths), len(log.training)
    splits = {"train": f"0:{training}"} | ({"test": f"{training}:{count}"} if training < count else {})
    return {
        "codebase_version": VERSION, "robot_type": log.spec.name, "total_episodes": count,
        "total_frames": int(sum(lengths)), "total_tasks": len(tasks), "chunks_size": 1000,
        "data_files_size_in_mb": 100, "video_files_size_in_mb": 200, "fps": fps, "splits": splits, "data_path": DATA,
        "video_path": None,
        "features": {**whole, "timestamp": {"dtype": "float32", "shape": [1], "names": None},
                     **{name: {"dtype": "int64", "shape": [1], "names": None} for name in COUNTERS}}}

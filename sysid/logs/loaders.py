"""One loader of all logs that a fit can read: datasets, and two published measured sets in their original form."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from sysid.logs.command_timeout import with_own_timeout
from sysid.logs.log import load_log
from sysid.logs.published.drive_norlab import load_drive, most_runs
from sysid.logs.published.mrclam import ROBOTS, load_mrclam, mrclam_files, mrclam_robots
from sysid.logs.records import Log
from sysid.logs.sources import about
from sysid.logs.stream_quality import without_held
from sysid.logs.unusable import without_lost, without_standing
from sysid.logs.windows import in_windows

Form = Literal["auto", "dataset", "drive_norlab", "mrclam"]
"""Forms of data that `load_any` reads."""


def detect_format(path: str | Path) -> str:
    """"dataset", "drive_norlab" or "mrclam", by the files in the folder; ValueError when it is none of them."""
    path = Path(path)
    if not path.is_dir():
        raise (ValueError if path.exists() else FileNotFoundError)(f"{path}: {about(path)}")
    if (path / "dataset.toml").exists() or (path / "trials").exists():
        return "dataset"
    if mrclam_files(path, "[1-5]", "Odometry"):
        return "mrclam"
    if any(path.glob("*.npz")) and not (path / "report.json").exists():  # a fit keeps its series so
        return "drive_norlab"
    raise ValueError(f"{path}: {about(path)}")


def is_known(path: Path) -> bool:
    """Whether a folder is a dataset or a measured set."""
    try:
        return bool(detect_format(path))
    except (ValueError, FileNotFoundError):
        return False


def split(log: Log, train: tuple[str, ...], held_out: tuple[str, ...]) -> Log:
    """Log with only the selected trials, marked as training or held-out.

    A selection is GROUP, RUN, or RUN:FROM-TO with shares of the run's time, e.g. "warthog_asphalt_a:0-0.667".
    """
    chosen: dict[str, bool] = {}
    for selections, is_held_out in ((train, False), (held_out, True)):
        for selection in selections:
            names = _selected(log, selection)
            for name in names:
                if chosen.get(name, is_held_out) != is_held_out:
                    raise ValueError(f"trial {name} is selected for training and as held out; "
                                     "make the selections disjoint.")
                chosen[name] = is_held_out
    return replace(log, trials=tuple(replace(trial, held_out=chosen[trial.name])
                                     for trial in log.trials if trial.name in chosen))


def _selected(log: Log, selection: str) -> list[str]:
    key, _, share = selection.partition(":")
    names = [trial.name for trial in log.trials if key in (trial.name.split("/")[0], trial.group, trial.name)]
    if not names:
        known = sorted({trial.name.split("/")[0] for trial in log.trials} | {trial.group for trial in log.trials})
        raise ValueError(f"selection {selection!r} matches no trial (known: {', '.join(known)}).")
    if not share:
        return names
    try:
        low, high = (float(value) for value in share.split("-"))
    except ValueError:
        raise ValueError(f"selection {selection!r}: {share!r} must be FROM-TO, shares of the run, e.g. 0-0.667."
                         ) from None
    chosen = [name for i, name in enumerate(names) if low <= i / len(names) < high]
    if not chosen:
        raise ValueError(f"selection {selection!r}: no trial of {len(names)} lies there. Give shares FROM-TO of 0 to "
                         "1, the smaller one first.")
    return chosen


def load_any(path: str | Path, form: str = "auto", train: tuple[str, ...] = (), held_out: tuple[str, ...] = (),
             chained: bool = False) -> Log:
    """Load a folder in any known format; `train` and `held_out` select among the measured sets' trials.

    Training trials of DRIVE whose outside pose was lost are left out (`sysid.logs.unusable`), and so are a
    dataset's rows that were held between updates (`without_held`). A base that stops by itself where no command comes
    does so in replays too (`sysid.logs.command_timeout`). A note says each.
    """
    form = detect_format(path) if form == "auto" else form
    if form == "dataset" and held_out and not train:
        raise ValueError(f"{path}: its dataset.toml says which trials are held out. Give --train beside --held-out "
                         "to choose both here, or leave --held-out out.")
    if form == "dataset":
        log: Log = in_windows(with_own_timeout(_without_held(load_log(path))))
        return without_standing(split(log, train, held_out) if train else log, str(path))
    if not train:
        raise ValueError(f"{path}: a {form} set does not say which trials to fit. Give --train, for example "
                         + ("warthog_sand_1" if form == "drive_norlab" else "robot1 robot2 robot3")
                         + ", and --held-out.")
    keys: list[Any] = [selection.partition(":")[0] for selection in (*train, *held_out)]
    if form == "drive_norlab":
        return without_lost(split(load_drive(path, tuple(keys), chained), train, held_out))
    if form == "mrclam":
        return split(load_mrclam(path, mrclam_robots(keys)), train, held_out)
    raise ValueError(f"unknown format {form!r} (known: auto, dataset, drive_norlab, mrclam).")


def _without_held(log: Log) -> Log:
    """The log without held rows, and a note where there were any."""
    trials = tuple(without_held(trial) for trial in log.trials)
    before, after = (sum(len(stream.t) for trial in some for stream in (trial.odometry, trial.ground_truth)
                         if stream is not None) for some in (log.trials, trials))
    if after == before:
        return log
    return replace(log, trials=trials, notes=(*log.notes,
        f"{before - after} of {before} rows of odometry and outside pose repeat the row before while the vehicle "
        "moves: they were held between updates and are not scored again"))


def load_whole(path: str | Path, select: tuple[str, ...] = (), form: str = "auto") -> Log:
    """Any known log without a split into training and held-out trials where it declares none.

    DRIVE windows are chained to steps of 6 s: two seconds are too short to compare clocks. Of a DRIVE folder, the runs
    of the robot that has most of them.
    """
    form = detect_format(path) if form == "auto" else form
    keys = tuple(dict.fromkeys(one.partition(":")[0] for one in select))
    if form == "dataset":
        log: Log = load_log(path)
    elif form == "drive_norlab":
        log = load_drive(path, keys or most_runs(Path(path)), chained=True)
    else:
        log = load_mrclam(path, mrclam_robots(keys or ROBOTS))
    return split(log, select, ()) if select else log

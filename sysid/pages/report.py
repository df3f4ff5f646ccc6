"""The report of a fit: report.json, its tables, and the page that people read."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sysid.errors.pose_objective import Noise
from sysid.logs.loaders import load_any
from sysid.logs.metrics import METRICS, UNITS, ideal_replay, own_floor, score
from sysid.logs.records import Prediction, Trial
from sysid.pages.fit_page import REPLAYS, fit_sections, headline
from sysid.pages.series import FILE, TrialSeries, collect, load
from sysid.replay.rollout import Replay, make_batch, predictions, vehicle_plant
from whill_mjx.io.fields import Field, check_table, shown
from whill_mjx.io.formats import upgraded
from whill_mjx.io.html import Section, html_page
from whill_mjx.io.reading import read_json
from whill_mjx.logs.dataset import write_text
from whill_mjx.vehicle.config import VehicleConfig
from whill_mjx.vehicle.parameters import set_values
from whill_mjx.vehicle.vehicle_file import load_vehicle

SCHEMA = 1
KIND = "sysid-report"
AGAIN = "Fit the log again."
REPORT = tuple(
    Field(name, kind=kind, remedy=AGAIN) for kind, names in (
        ("table", ("dataset", "settings", "model", "noise", "summary", "search")),
        ("list", ("parameters", "fixed", "errors")),
    ) for name in names
)  # fmt: skip
"""Entries that every report has, as they are read."""


def error_rows(trials: tuple[Trial, ...], initial: list[Prediction], fitted: list[Prediction]) -> list[dict[str, Any]]:
    """Errors of each trial and channel for the three replays."""
    rows = []
    for trial, before, after in zip(trials, initial, fitted, strict=True):
        scores = [score(trial, prediction) for prediction in (ideal_replay(trial), before, after)]
        for channel in scores[0]:
            tables = [one[channel] for one in scores]
            metrics = {metric: dict(zip(REPLAYS, (table[metric] for table in tables), strict=True))
                       for metric in METRICS if tables[0][metric] is not None}
            rows.append({"trial": trial.name, "manoeuvre": trial.manoeuvre, "group": trial.group,
                         "held_out": trial.held_out, "channel": channel, "metrics": metrics})
    return rows


def summarise(rows: Iterable[dict[str, Any]], floor: dict[str, dict[str, float | None]] | None) -> dict[str, Any]:
    """Mean over trials per channel and metric of the three replays, beside the noise floor."""
    rows = list(rows)
    summary: dict[str, Any] = {}
    for channel in dict.fromkeys(row["channel"] for row in rows):
        mine = [row for row in rows if row["channel"] == channel]
        summary[channel] = {"trials": len(mine)}
        for metric in METRICS:
            found = [row["metrics"][metric] for row in mine if metric in row["metrics"]]
            if found:
                summary[channel][metric] = {
                    **{replay: float(np.mean([one[replay] for one in found])) for replay in REPLAYS},
                    "unit": UNITS[metric], "noise_floor": floor[channel][metric] if floor else None}
    return summary


def summaries(rows: list[dict[str, Any]], trials: tuple[Trial, ...]) -> dict[str, Any]:
    """`noise_floor`, `summary` and `groups` of the report."""
    parts = {"training": False, "held_out": True}
    floors = {part: own_floor(trials, held) or None for part, held in parts.items()}
    groups = sorted({row["group"] for row in rows})
    return {
        "noise_floor": floors,
        "summary": {part: summarise((row for row in rows if row["held_out"] is held), floors[part])
                    for part, held in parts.items()},
        "groups": {} if len(groups) < 2 else {
            group: {part: summarise((row for row in rows if row["held_out"] is held and row["group"] == group), None)
                    for part, held in parts.items()} for group in groups},
    }


def write_report(path: Path, report: dict[str, Any]) -> None:
    """Write JSON, whole or not at all; numbers that are not finite become null."""
    write_text(path, json.dumps(plain(report), indent=1) + "\n")


def read_report(run: Path) -> dict[str, Any]:
    """Content of RUN/report.json; FileNotFoundError, ValueError where it is missing or none of a fit."""
    path = Path(run) / "report.json"
    report = read_json(path, "missing. Give the folder that `python -m sysid.fit DATASET --out RUN` wrote.", AGAIN)
    report = upgraded(KIND, report)
    if report.get("kind") != KIND or report.get("schema") != SCHEMA:
        raise ValueError(f"{path}: kind {shown(report.get('kind'))}, schema {shown(report.get('schema'))}; this "
                         f"program reads {KIND!r}, schema {SCHEMA}. {AGAIN}")
    check_table(str(path), REPORT, report, others=True)
    return report


def noise_of(run: Path) -> Noise:
    """The noise of a log as the report of its fit has it; ValueError for a report without it."""
    outside, own = (tuple(f"{channel}.{key}" for key in keys) for channel, keys in (
        ("ground_truth", ("x", "y", "yaw")), ("odometry", ("x", "y", "yaw", "v", "omega"))))
    fields = [Field(key, "SI", 1e-12, 1e6, remedy="Fit the log again.") for key in (*outside, *own)]
    found = read_report(run)["noise"].get("scale")
    scale = check_table(str(run / "report.json"), fields, found, "noise.scale", others=True)
    return Noise(np.array([scale[key] for key in outside]), np.array([scale[key] for key in own]), "fit")


def write_html(run: Path, series: Sequence[TrialSeries] | None = None, sections: Sequence[Section] = ()) -> Path:
    """Write RUN/report.html from RUN/report.json, self-contained, with more `sections` first. `series`: motion of the
    trials; by default RUN/series.npz, or else the trials are replayed from the dataset."""
    run = Path(run)
    report = read_report(run)
    if series is None:
        series = load(run) if (run / FILE).is_file() else replay(run, report)
    try:
        page = html_page(f"Fit of {report['dataset']['vehicle']} to the log {report['dataset']['name']}",
                         [*sections, *fit_sections(report, series)], f"data SHA-256 {report['dataset']['sha256'][:16]}",
                         kind="Fit", lead=headline(report))
    except (KeyError, IndexError, TypeError, AttributeError, ValueError, ArithmeticError) as error:
        raise ValueError(f"{run / 'report.json'}: is not whole, or not of this {FILE} ({type(error).__name__}: "
                         f"{str(error)[:160]}). {AGAIN}") from error
    write_text(run / "report.html", page)
    return run / "report.html"


def replay(run: Path, report: dict[str, Any]) -> list[TrialSeries]:
    """Series of a run folder without the file: replays of its dataset by the vehicle before and after the fit.
    FileNotFoundError or ValueError where the dataset has moved or changed since."""
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
    return collect(trials, predictions(trials, replayed, 0), predictions(trials, replayed, 1))


def code_hashes() -> dict[str, str]:
    """SHA-256 over names and contents of the packages' sources, and the versions of what they run on."""
    from importlib.metadata import PackageNotFoundError, version

    found = {}
    for package in ("whill_mjx", "sysid"):
        root, digest = Path(__file__).parents[2] / package, hashlib.sha256()
        for path in sorted(root.rglob("*.py")):
            digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
        found[f"{package} sources SHA-256"] = digest.hexdigest()
    for name in ("jax", "mujoco-mjx", "numpy", "optuna"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


def table(report: dict[str, Any]) -> str:
    """The summary as text."""
    lines = [f"{'trials':9} {'channel':13} {'RMSE':23} {'ideal':>9} {'initial':>9} {'fitted':>9} {'floor':>9}"]
    for part, channels in report["summary"].items():
        for channel, metrics in channels.items():
            for metric in (name for name in METRICS if name in metrics):
                one = metrics[metric]
                floor = "-" if one["noise_floor"] is None else f"{one['noise_floor']:.4f}"
                errors = " ".join(f"{one[replay]:9.4f}" for replay in REPLAYS)
                lines.append(f"{part:9} {channel:13} {metric + ' ' + one['unit']:23} {errors} {floor:>9}")
    return "\n".join(lines)


def parameter_table(report: dict[str, Any]) -> str:
    """Fitted parameters with their intervals as text."""
    lines = []
    for one in report["parameters"]:
        low, high = one["interval"]
        lines.append(f"{one['name']:32} {one['initial']:10.4g} -> {one['value']:10.4g}  [{low:.4g}, {high:.4g}] "
                     f"{one['unit']} {one['remark']}".rstrip())
    return "\n".join(lines)


def plain(value: Any) -> Any:
    """The same with arrays as lists, numpy numbers as Python ones and numbers that are not finite as null."""
    if isinstance(value, dict):
        return {str(key): plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [plain(one) for one in value]
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value

"""What a fit writes besides its pages: report.json (entries: docs/formats.md), the origin in its vehicle file, and
sentences on the sizes and the tracked point that it found."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from sysid.errors.prior import moved
from sysid.intervals import uncertainty
from sysid.intervals.uncertainty import Estimate
from sysid.logs import odometry_frames
from sysid.logs.loaders import load_any
from sysid.logs.metrics import score
from sysid.logs.records import Log, Prediction, Trial
from sysid.missing.fit_statistics import statistics_of
from sysid.pages.fit_page import choose
from sysid.pages.plots import write_plots
from sysid.pages.report import KIND, SCHEMA, code_hashes, error_rows, summaries, write_html, write_report
from sysid.pages.series import collect, save
from sysid.replay.models import Model, Twin, describe_parameters, get_parameters, save_model
from sysid.replay.rollout import Replay, make_batch, predictions, vehicle_plant
from sysid.search import starts, thin
from sysid.search.fitting import Fit, fit_log, predict, subject
from sysid.search.result import Progress
from sysid.search.settings import FitConfig
from sysid.search.studies import without_secrets
from whill_mjx.vehicle.config import VehicleConfig
from whill_mjx.vehicle.specs import VehicleSpec
from whill_mjx.vehicle.vehicle_file import save_vehicle


@dataclass(frozen=True)
class Loaded:
    """A log that was read before, and what its report says of where it came from."""

    log: Log
    path: str | Path
    source: dict[str, Any] = field(default_factory=dict)  # more to note beside it


def make_report(data: Loaded, config: FitConfig, fit: Fit, rows: list[dict[str, Any]]) -> dict[str, Any]:
    """The report of a fit (entries: docs/formats.md)."""
    log = data.log
    about = describe_parameters(fit.params)
    parameters = [
        {"name": one.name, "meaning": about[one.name].description, "unit": about[one.name].unit,
         "initial": one.initial, "value": one.value,
         "interval": [one.low, one.high], "confidence": uncertainty.CONFIDENCE,
         "bounds": [float(fit.space.low[i]), float(fit.space.high[i])], "identifiable": one.identifiable,
         "remark": one.remark}
        for i, one in enumerate(fit.uncertainty.estimates)]
    fixed = [{"name": name, "value": float(get_parameters(fit.params, [name])[0]), "reason": reason}
             for name, reason in fit.space.fixed]
    searches = [result for result in (fit.scan, fit.coarse, fit.search) if result is not None]
    ends = fit.coarse if fit.coarse is not None and len(fit.coarse.start_costs) > 1 else fit.search
    return {
        "schema": SCHEMA, "kind": KIND,
        "dataset": {"name": log.name, "path": str(data.path), "sha256": log.sha256, "vehicle": log.spec.name,
                    "notes": [*log.notes, *thin.notes(fit.space),
                              *calibration_notes(fit.uncertainty.estimates, log.spec, log.training, fit.stated),
                              *(fit.model.notes if fit.model is not None else ())],
                    "training": [trial.name for trial in log.training],
                    "held_out": [trial.name for trial in log.held_out],
                    **({"command_timeout": dict(zip(("value", "low", "high"), found, strict=True))} if (
                        found := log.fields.get("found_timeout")) else {}), **data.source},
        "code": code_hashes(),
        "settings": {**asdict(config), "storage": without_secrets(config.storage),
                     "vehicle": None if config.vehicle is None else str(config.vehicle)},
        "model": {"preset": config.preset if fit.model is None else fit.model.name,
                  "effects": [effect.name for effect in fit.params.effects]},
        "noise": {"source": fit.noise.source, "scale": fit.noise.as_dict()},
        "parameters": parameters, "fixed": fixed,
        "prior": None if fit.prior is None else {
            "file": str(config.vehicle), "assumed_spread": config.spread, "moved": moved(fit.prior, fit.space, fit.u)},
        "profiles": [{"name": one.name, "unit": about[one.name].unit, "values": one.values, "cost": one.cost,
                      "statistic": one.statistic, "threshold": one.threshold, "interval": list(one.interval),
                      "remark": one.remark(fit.space)} for one in fit.likelihoods],
        "spectrum": [{"information": value, "combination": parts} for value, parts in fit.uncertainty.spectrum()],
        "weak_combinations": fit.uncertainty.weak_combinations(),
        "search": {"evaluations": sum(result.evaluations for result in searches), "seconds": fit.seconds,
                   "cost_initial": fit.initial_cost, "cost": fit.cost,
                   "start_costs": ends.start_costs if ends is not None else [],
                   "starts_agreeing": starts.agreeing(ends.start_costs) if ends is not None else None,
                   "delay_profiles": [{"name": name, "values": grid, "cost": costs}
                                      for name, grid, costs in fit.profiles]},
        **summaries(rows, log.trials), "errors": rows,
    }


def provenance(report: dict[str, Any]) -> dict[str, Any]:
    """What the vehicle file says of its origin."""
    summary = report["summary"]["held_out"] or report["summary"]["training"]
    errors = {f"{channel}_{metric}": one["fitted"] for channel, metrics in summary.items()
              for metric, one in metrics.items() if isinstance(one, dict)}
    return {"made_by": "sysid.fit", "dataset": report["dataset"]["name"], "dataset_sha256": report["dataset"]["sha256"],
            "preset": report["model"]["preset"], "method": report["settings"]["method"],
            "seed": report["settings"]["seed"], "cost": report["search"]["cost"],
            "interval_confidence": uncertainty.CONFIDENCE,
            "scored_on": "held_out" if report["summary"]["held_out"] else "training", "rmse": errors,
            "not_identifiable": [one["name"] for one in report["parameters"] if not one["identifiable"]]}


def fit_dataset(
    path: str | Path | Loaded, out: str | Path, quick: bool = False, config: FitConfig | None = None,
    progress: Progress | None = None, model: Model | None = None,
) -> dict[str, Any]:
    """Fit a dataset and write report.json (returned), report.html, plots and vehicle.toml into the folder `out`.

    Of another model than the simulator's vehicle, model.toml is written, model.xml where it came from an MJCF or URDF
    file, and vehicle.toml where a vehicle of the simulator drives alike.

    Args:
        path: dataset folder, or a log that was read before.
        quick: overrides `config.quick` where true.
        model: as of `fit_log`.
    """
    config = config or FitConfig()
    config = replace(config, quick=quick or config.quick)
    data = path if isinstance(path, Loaded) else Loaded(load_any(path), path)
    log, model = subject(data.log, config, model)
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    fit = fit_log(log, config, progress, model=model)
    if progress is not None:
        progress(0, "writing the report")
    if fit.frame is not None:
        log = replace(log, trials=odometry_frames.at_frames(log.trials, fit.frame),
                      notes=(*log.notes, odometry_frames.note(fit.frame)))
    trials = (*log.training, *log.held_out)
    initial, fitted = predict(fit, trials)
    rows = error_rows(trials, initial, fitted)
    report = make_report(replace(data, log=log), config, fit, rows)
    if log.spec.drive == "skid" and fit.model is None:
        report["dataset"]["notes"] += track_notes(fitted[: len(log.training)], fit, log.spec)
    twin = None if fit.model is None or fit.model.vehicle is None else fit.model.vehicle(fit.params, log.spec)
    if isinstance(twin, str):
        report["dataset"]["notes"].append(f"no vehicle of the simulator is written: {twin}")
    elif twin is not None:
        replays = _twin_replays(twin, trials, config.physics_dt, fit.frame)
        _save_twin(out, twin, fit, log, replays[: len(log.training)], provenance(report))
        report["dataset"]["notes"].append(_twin_note(log, replays, fitted))
    write_report(out / "report.json", report)
    series = collect(trials, initial, fitted)
    write_plots(out, choose(series), rows)
    save(out, series)
    write_html(out, series)
    intervals = {one.name: (one.low, one.high) for one in fit.uncertainty.estimates if one.identifiable}
    if fit.model is None:
        known = statistics_of(log.training, fitted[: len(log.training)], log.spec.track, fit.space.names,
                              fit.uncertainty.deviation * fit.space.slope(fit.u), fit.uncertainty.covariance)
        save_vehicle(out / "vehicle.toml", log.spec, fit.params, intervals, provenance(report), known.as_table())
    else:
        save_model(out, fit.model, fit.params, intervals, provenance(report))
    return report


def _twin_replays(twin: Twin, trials: tuple[Trial, ...], physics_dt: float, frame: float | None) -> list[Prediction]:
    """Replays of trials by the vehicle that drives as a fitted model does; `frame` as of a `Plant` [s]."""
    plant = replace(vehicle_plant(twin.spec, VehicleConfig(physics_dt=physics_dt)), frame=frame)
    batch, _ = make_batch(trials, plant.dt)
    simulated = Replay(plant, batch, lambda _: twin.params).simulate(np.zeros((1, 1)))
    return predictions(trials, simulated, 0)


def _save_twin(out: Path, twin: Twin, fit: Fit, log: Log, replays: Sequence[Prediction], origin: dict[str, Any]
               ) -> None:
    """Write the vehicle that drives as a fitted model does, with what its `replays` leave of the training trials."""
    known = [k for k, name in enumerate(fit.space.names) if name in twin.shared]
    meaning = [twin.shared[fit.space.names[k]] for k in known]
    factors = np.array([factor for _, factor, _ in meaning])
    error = (fit.uncertainty.deviation * fit.space.slope(fit.u))[known] * factors
    statistics = statistics_of(log.training, replays, log.spec.track, [one[0] for one in meaning], error,
                               fit.uncertainty.covariance[np.ix_(known, known)])
    intervals = {name: (one.low * factor + offset, one.high * factor + offset)
                 for one in fit.uncertainty.estimates if one.identifiable and one.name in twin.shared
                 for name, factor, offset in (twin.shared[one.name],)}
    save_vehicle(out / "vehicle.toml", twin.spec, twin.params, intervals, origin, statistics.as_table())


def _twin_note(log: Log, replays: Sequence[Prediction], fitted: Sequence[Prediction]) -> str:
    """How far the vehicle and the model are from the drives; replays of all trials, training ones first."""
    first = len(log.training) if log.held_out else 0
    trials = (*log.training, *log.held_out)[first:]
    ours, theirs = (np.mean([_distance(trial, replay) for trial, replay in zip(trials, every[first:], strict=True)])
                    for every in (replays, fitted))
    return (f"vehicle.toml is the vehicle of the simulator that drives alike: it is {1000 * ours:.2g} mm off in "
            f"{'held-out' if first else 'training'} drives, the model of your file {1000 * theirs:.2g} mm")


def _distance(trial: Trial, replay: Prediction) -> float:
    """Position error against the outside pose, or else against the odometry [m]."""
    found = score(trial, replay)
    return float(found["ground_truth" if trial.ground_truth is not None else "odometry"]["trajectory"] or 0.0)


SCALE = "odometry_scale.angular"
TURNS = 0.05  # rad, standard deviation of the yaw, below which drives do not turn
LEAST = 5e-4  # share of a size, or of a scale, that counts as nothing
SIZES = {
    "wheel radius": ("wheel_radius_difference.common", "wheels.radius"),
    "track": ("track_width.error", "wheels.track"),
}
UNKNOWN = ("Without an outside pose this log does not separate errors of wheel radius, track and odometry's scale "
           "from one another: they are taken as stated, and the odometry's path has their error.")


def calibration_notes(
    estimates: Sequence[Estimate], spec: VehicleSpec, trials: Sequence[Trial], kept: Sequence[str] = ()
) -> list[str]:
    """Sentences on radius, track, the odometry's scales and the tracked point, also on what a log leaves open, and on
    groups that keep their stated values (`sysid.search.stated`)."""
    notes = _notes(estimates, spec, trials)
    if kept:
        notes.append(f"Stated values are kept for {', '.join(kept)}: free ones did not predict held-back drives "
                     "better.")
    return notes


def effective_track(drives: Sequence[Prediction | Trial], track: float, scale: float = 1.0) -> float | None:
    """Track [m] of a robot on two wheels that turns as far by the same wheel speeds; None where no drive turns.

    The odometry's yaw over that of the outside pose, times the `track` that it takes [m]; `scale`: of the odometry's
    yaw over that of its wheels.
    """
    along, turned, samples = 0.0, 0.0, 0
    for drive in drives:
        pose, odometry = drive.ground_truth, drive.odometry
        if pose is None or odometry is None or odometry.yaw is None or len(pose.t) < 2:
            continue
        yaw = np.interp(odometry.t, pose.t, pose.yaw)
        yaw, wheels = yaw - yaw.mean(), odometry.yaw - np.mean(odometry.yaw)
        along, turned = along + float(yaw @ wheels), turned + float(yaw @ yaw)
        samples += len(yaw)
    if not (turned > samples * TURNS**2 and np.isfinite(along)):  # a replay that diverged is no number
        return None
    return along / turned * track / scale


def track_notes(replays: Sequence[Prediction], fit: Fit, spec: VehicleSpec) -> list[str]:
    """What a skid-steered vehicle's drives determine of its track, by fitted replays of them."""
    names = list(describe_parameters(fit.params))
    scale = float(get_parameters(fit.params, [SCALE])[0]) if SCALE in names else 1.0
    track = effective_track(replays, spec.track, scale)
    if track is None:
        return []
    found = [f"The effective track is {track:.4g} m, {track / spec.track:.3g} times the stated one. Wheels that slide "
             "in every turn do not determine the track between them: it is taken as stated."]
    if "pose_mount.x" in fit.space.names:
        found.append("How far ahead the tracked point lies follows from the point about which the vehicle turns. Loads "
                     "and grip of sliding wheels move that by centimetres, so measure it.")
    return found


def _notes(estimates: Sequence[Estimate], spec: VehicleSpec, trials: Sequence[Trial]) -> list[str]:
    found = {one.name: one for one in estimates}
    if not any(trial.ground_truth is not None for trial in trials):
        return [UNKNOWN]
    if not any(name in found for names in SIZES.values() for name in names) and "pose_mount.x" not in found:
        return []
    stated = {"wheel radius": spec.wheel_radius, "track": spec.track}
    notes, open_ones = [], []
    for what, names in SIZES.items():
        one = next((found[name] for name in names if name in found), None)
        if one is None:
            continue
        if not one.identifiable:
            open_ones.append(what)
            continue
        relative = one.name == names[0]  # otherwise in metres
        value, low, high = (1 + x if relative else x / stated[what] for x in (one.value, one.low, one.high))
        notes.append(_size(what, stated[what], value, low, high))
    for what, name in (("distance", "odometry_scale.linear"), ("yaw", "odometry_scale.angular")):
        one = found.get(name)
        if one is not None and one.identifiable and abs(one.value - 1) > LEAST and not one.low <= 1 <= one.high:
            notes.append(f"The odometry reports {one.value:.4f} times the {what} of wheels of the stated sizes "
                         f"({one.low:.4f} to {one.high:.4f}): it takes other sizes than the controller.")
    if "pose_mount.x" in found:
        x, y, yaw = (found[f"pose_mount.{axis}"] for axis in ("x", "y", "yaw"))
        at_zero = [one for one in (x, y, yaw) if one.identifiable and one.low <= 0 <= one.high]
        if len(at_zero) == 3:
            near = 1000 * max(-x.low, x.high, -y.low, y.high)
            angle = math.degrees(max(-yaw.low, yaw.high))
            return [*notes, f"The outside pose follows the reference point, within {near:.1f} mm and {angle:.2f} "
                            "degrees."]
        sides = [f"{abs(one.value):.4f} m {names[one.value < 0]} ({_range(one, 4)})"
                 for one, names in ((x, ("ahead of", "behind")), (y, ("left of", "right of")))
                 if one.identifiable]
        if sides:
            notes.append(f"The tracked point lies {' and '.join(sides)} the reference point.")
        if yaw.identifiable:
            notes.append(f"Its heading is turned by {abs(math.degrees(yaw.value)):.2f} degrees to the "
                         f"{'left' if yaw.value >= 0 else 'right'} of the vehicle's "
                         f"({_range(yaw, 2, math.degrees)} degrees).")
        open_ones += [f"the tracked point's {axis}" for axis, one in (("x", x), ("y", y), ("heading", yaw))
                      if not one.identifiable]
    if open_ones:
        notes.append(f"This log does not determine {', '.join(open_ones)}: drive turns on the spot and straight lines.")
    return notes


def _size(what: str, stated: float, value: float, low: float, high: float) -> str:
    interval = f"{stated * low:.4g} to {stated * high:.4g} m"
    if abs(value - 1) < LEAST or low <= 1 <= high:
        return f"The {what} is as stated, {stated:.4g} m ({interval})."
    side = "larger" if value > 1 else "smaller"
    return (f"The {what} is {stated * value:.4g} m ({interval}), {abs(value - 1):.1%} {side} than the stated "
            f"{stated:.4g} m.")


def _range(one: Estimate, digits: int, unit: Callable[[float], float] = float) -> str:
    """The interval of the size of an estimate: of one below 0 to the other side, as the text beside it has no sign."""
    low, high = (one.low, one.high) if one.value >= 0 else (-one.high, -one.low)
    return f"{unit(low):.{digits}f} to {unit(high):.{digits}f}"

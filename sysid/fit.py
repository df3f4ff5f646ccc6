"""Fit a vehicle to a driving log: `python -m sysid.fit DATASET --out RUN`.

Only training trials are fitted; held-out ones are predicted once, at the end, by the initial and the fitted vehicle.
Writes RUN/report.json and RUN/report.html (`sysid.report`), RUN/series.npz, RUN/*.png and RUN/vehicle.toml.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np

from sysid import command_line, gradient, starts, tpe, uncertainty
from sysid.courses import make_courses
from sysid.log import Log, Trial
from sysid.measured import load_any
from sysid.metrics import Prediction
from sysid.objective import Noise, Objective, estimate_noise
from sysid.prior import SPREAD, Prior, make_prior, moved
from sysid.report import (
    KIND,
    SCHEMA,
    code_hashes,
    error_rows,
    parameter_table,
    summaries,
    table,
    write_html,
    write_report,
)
from sysid.result import FitResult, Progress
from sysid.rollout import Plant, predictions, vehicle_plant
from sysid.series import collect, save
from sysid.space import Space, make_space
from whill_mjx.config import VehicleConfig
from whill_mjx.parameters import describe, get_values, set_values
from whill_mjx.presets import preset_params
from whill_mjx.types import VehicleParams

QUICK_TRIALS = 24  # trials fitted in quick mode, spread over the log
QUICK_EVALUATIONS = 64
QUICK_ITERATIONS = 14
FEATURE_ITERATIONS = 20
VALLEY = 0.05  # share of the cost by which another delay may be worse and still be searched from


@dataclass(frozen=True)
class FitConfig:
    """How a log is fitted."""

    preset: Literal["paper", "physical"] = "physical"
    """Base model whose parameters are fitted."""
    method: Literal["features", "lm", "tpe", "both"] = "features"
    """features: gradient search on motion in short bins, then on poses. lm: on poses at once. tpe: global search. both:
    a short global search that gives the gradient search on poses its starts."""
    trials: int = 192
    """Parameter sets that the global search tries."""
    starts: int = 1
    """Starts of the gradient search: the initial values, and random ones or the best of the global search (both: at
    least one of them)."""
    iterations: int = 40
    """Iterations of the gradient search on poses."""
    seed: int = 0
    """Seed of both searches."""
    quick: bool = False
    """Fewer trials, candidates and iterations: minutes on two cores."""
    channels: Literal["both", "ground_truth", "odometry"] = "both"
    """Which measurements are fitted; all are scored."""
    robust: bool = True
    """Count large residuals linearly (Huber): a model is least exact where wheels skid."""
    parameters: tuple[str, ...] = ()
    """Names to fit; by default all that a driving log can tell."""
    effects: tuple[str, ...] = ()
    """Effects of the catalogue (docs/effects.md) that the model gets as well, fitted from where they do nothing."""
    physics_dt: float = 0.005
    """Physics step [s]."""
    vehicle: Path | None = None
    """Vehicle file of an earlier fit: where the search starts, and what is known before (instead of the preset)."""
    spread: float = SPREAD
    """With a vehicle file: standard deviation of a parameter from day to day, as a share of its value (assumed)."""


@dataclass(frozen=True)
class Fit:
    """A fitted vehicle and what is known of it."""

    params: Any
    """`VehicleParams` at the fitted values."""
    initial_params: Any
    space: Space
    uncertainty: uncertainty.Uncertainty
    noise: Noise
    scan: FitResult | None
    """Result of the global search."""
    coarse: FitResult | None
    """Result of the search on features, of all its starts."""
    search: FitResult | None
    """Result of the gradient search."""
    u: np.ndarray  # (P,) fitted unit coordinates
    initial_cost: float
    cost: float
    """Mean squared residual in noise scales (large ones counted linearly); J in metres where method is "tpe"."""
    profiles: list[tuple[str, np.ndarray, np.ndarray]]
    seconds: float
    plant: Plant
    prior: Prior | None = None


def fit_log(log: Log, config: FitConfig | None = None, progress: Progress | None = None, params: Any = None) -> Fit:
    """Fit the training trials of a log.

    Args:
        log: its held-out trials are not looked at.
        params: where the search starts; by default the preset's values for the log's vehicle.
    """
    config = config or FitConfig()
    began = time.perf_counter()
    trials = tuple(_keep_channels(trial, config.channels) for trial in log.training)
    if not trials:
        raise ValueError(f"log {log.name!r} has no training trial. Take some out of held_out, or select with --train.")
    if config.quick and len(trials) > QUICK_TRIALS:
        trials = tuple(trials[i] for i in np.linspace(0, len(trials) - 1, QUICK_TRIALS).round().astype(int))
    plant = vehicle_plant(log.spec, VehicleConfig(physics_dt=config.physics_dt))
    prior_intervals: dict[str, tuple[float, float]] = {}
    if config.vehicle is not None:
        params, prior_intervals = _earlier(config.vehicle, log)
    params = preset_params(log.spec, config.preset) if params is None else params
    params = with_effects(params, config.effects)
    space = make_space(params, log.spec, config.parameters or None)
    objective = make_objective(plant, params, space, trials, estimate_noise(log.training))

    scan = coarse = search = None
    points = gradient.random_starts(space, config.starts, config.seed)
    iterations = min(config.iterations, QUICK_ITERATIONS) if config.quick else config.iterations
    profiles: list[tuple[str, np.ndarray, np.ndarray]] = []
    if config.method in ("tpe", "both"):
        evaluations = min(config.trials, QUICK_EVALUATIONS) if config.quick else config.trials
        cost = "paper" if config.method == "tpe" else "weighted"
        count = max(min(config.starts, 2) if config.quick else config.starts, 2)
        scan = tpe.fit(objective, space, evaluations=evaluations, seed=config.seed, cost=cost, best=count - 1,
                       progress=progress)
        points = np.concatenate([points[:1], scan.starts])[:count]
    elif config.method == "features":
        coarse = starts.fit(objective, points, log.spec.track, FEATURE_ITERATIONS, progress)
        points = coarse.u[None]
    if config.vehicle is not None and config.method != "tpe":
        share = uncertainty.inflation(objective, points[0])
        objective = replace(objective, prior=replace(make_prior(space, prior_intervals, config.spread), share=share))
    if config.method == "tpe":
        assert scan is not None
        u, initial_cost, final_cost = scan.u, scan.initial_cost, scan.cost
    else:
        search, objective, profiles = _gradient_search(objective, space, points, iterations, config, progress)
        u, final_cost = search.u, search.cost
        first = objective.residuals(space.to_unit(space.initial)[None])
        initial_cost = float(gradient.robust_cost(first, config.robust)[0]) / objective.counted
    known = uncertainty.estimate(objective, u, robust=config.robust and config.method != "tpe")
    fitted = set_values(params, space.names, jax.numpy.asarray(space.to_values(u), jax.numpy.result_type(float)))
    return Fit(fitted, params, space, known, objective.noise, scan, coarse, search, u, initial_cost, final_cost,
               profiles, time.perf_counter() - began, plant, objective.prior)


def _earlier(path: Path, log: Log) -> tuple[Any, dict[str, tuple[float, float]]]:
    """Parameters and intervals of a vehicle file; ValueError where it is of another vehicle than the log."""
    from whill_mjx.vehicle_file import load_intervals, load_vehicle

    spec, params, _ = load_vehicle(path)
    for name in ("wheel_radius", "track", "wheelbase", "drive"):
        if getattr(spec, name) != getattr(log.spec, name):
            raise ValueError(f"{path}: {name} is {getattr(spec, name)}, but {getattr(log.spec, name)} in {log.name!r}. "
                             "The vehicle file must be of the same vehicle; correct dataset.toml or leave it out.")
    return params, load_intervals(path)


def with_effects(params: Any, names: Sequence[str]) -> Any:
    """The vehicle with more effects of the catalogue, where they do nothing or next to nothing."""
    from whill_mjx.effects import EFFECTS, make_effect
    from whill_mjx.effects.base import PLACES, place_of

    have = {effect.name for effect in params.effects}
    for name in names:
        if name not in EFFECTS:
            raise ValueError(f"no effect {name!r} (known: {', '.join(EFFECTS)}). Correct --effects.")
    added = [make_effect(name) for name in dict.fromkeys(names) if name not in have]
    order = list(EFFECTS)
    added.sort(key=lambda effect: (PLACES.index(place_of(effect)), order.index(effect.name)))
    params = VehicleParams(params.body, (*params.effects, *added))
    about = {name: one for name, one in describe(params).items() if name.partition(".")[0] not in have | {"body"}}
    endless = [name for name, one in about.items() if not np.isfinite(one.neutral)]
    if not endless:
        return params
    return set_values(params, endless, jax.numpy.asarray([about[name].high for name in endless],
                                                         jax.numpy.result_type(float)))


def make_objective(plant: Plant, params: Any, space: Space, trials: tuple[Trial, ...], noise: Noise) -> Objective:
    """Objective over the space's parameters; the others keep their values in `params`."""
    replay, measured = make_courses(plant, trials, lambda values: set_values(params, space.names, values), params)
    return Objective(replay, space, trials, measured, noise)


def predict(fit: Fit, trials: tuple[Trial, ...]) -> tuple[list[Prediction], list[Prediction]]:
    """Replays of trials with the initial and with the fitted vehicle."""
    if not trials:
        return [], []
    names = fit.space.names
    replay, _ = make_courses(fit.plant, trials, lambda values: set_values(fit.params, names, values), fit.params)
    values = np.stack([np.asarray(get_values(one, names)) for one in (fit.initial_params, fit.params)])
    simulated = replay.simulate(values)
    initial, fitted = (predictions(trials, jax.tree.map(lambda leaf, i=i: leaf[i], simulated)) for i in (0, 1))
    return initial, fitted


def fit_dataset(
    path: str | Path, out: str | Path, quick: bool = False, config: FitConfig | None = None, log: Log | None = None,
    progress: Progress | None = None, source: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """Fit a dataset and write report.json, report.html, plots and vehicle.toml into the folder `out`.

    Args:
        path: dataset folder; only named in the report when `log` is given.
        quick: overrides `config.quick` where true.
        log: an already loaded log.
        source: more to note in the report's `dataset`.

    Returns:
        The report.
    """
    from sysid.plots import write_plots
    from whill_mjx.vehicle_file import save_vehicle

    config = config or FitConfig()
    config = replace(config, quick=quick or config.quick)
    log = load_any(path) if log is None else log
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    fit = fit_log(log, config, progress)
    trials = (*log.training, *log.held_out)
    initial, fitted = predict(fit, trials)
    rows = error_rows(trials, initial, fitted)
    report = make_report(log, config, fit, rows, str(path), source)
    write_report(out / "report.json", report)
    write_plots(out, trials, initial, fitted, rows)
    series = collect(trials, initial, fitted)
    save(out, series)
    write_html(out, series)
    intervals = {one.name: (one.low, one.high) for one in fit.uncertainty.estimates if one.identifiable}
    save_vehicle(out / "vehicle.toml", log.spec, fit.params, intervals, provenance(report))
    return report


def make_report(
    log: Log, config: FitConfig, fit: Fit, rows: list[dict[str, Any]], path: str, source: dict[str, Any] | None = None
) -> dict[str, Any]:
    """The report of a fit (keys in `sysid.report`)."""
    about = describe(fit.params)
    parameters = [
        {"name": one.name, "unit": about[one.name].unit, "initial": one.initial, "value": one.value,
         "interval": [one.low, one.high], "confidence": uncertainty.CONFIDENCE,
         "bounds": [float(fit.space.low[i]), float(fit.space.high[i])], "identifiable": one.identifiable,
         "remark": one.remark}
        for i, one in enumerate(fit.uncertainty.estimates)]
    fixed = [{"name": name, "value": float(get_values(fit.params, [name])[0]), "reason": reason}
             for name, reason in fit.space.fixed]
    searches = [result for result in (fit.scan, fit.coarse, fit.search) if result is not None]
    ends = fit.coarse if fit.coarse is not None and len(fit.coarse.start_costs) > 1 else fit.search
    return {
        "schema": SCHEMA, "kind": KIND,
        "dataset": {"name": log.name, "path": path, "sha256": log.sha256, "vehicle": log.spec.name,
                    "notes": list(log.notes), "training": [trial.name for trial in log.training],
                    "held_out": [trial.name for trial in log.held_out], **(source or {})},
        "code": code_hashes(),
        "settings": {**asdict(config), "vehicle": None if config.vehicle is None else str(config.vehicle)},
        "model": {"preset": config.preset, "effects": [effect.name for effect in fit.params.effects]},
        "noise": {"source": fit.noise.source, "scale": fit.noise.as_dict()},
        "parameters": parameters, "fixed": fixed,
        "prior": None if fit.prior is None else {
            "file": str(config.vehicle), "assumed_spread": config.spread, "moved": moved(fit.prior, fit.space, fit.u)},
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
            "scored_on": "held_out" if report["summary"]["held_out"] else "training", "rmse": errors,
            "not_identifiable": [one["name"] for one in report["parameters"] if not one["identifiable"]]}


def _gradient_search(
    objective: Objective, space: Space, starts: np.ndarray, iterations: int, config: FitConfig,
    progress: Progress | None,
) -> tuple[FitResult, Objective, list[tuple[str, np.ndarray, np.ndarray]]]:
    """LM from all starts; delays are then profiled on a grid, and LM tries another valley that is about as deep. Noise
    scales that are mere defaults are replaced by the size of the residual and LM continues."""

    def search(objective: Objective, starts: np.ndarray, iterations: int) -> FitResult:
        return gradient.fit(objective, space, starts=starts, iterations=iterations, robust=config.robust,
                            progress=progress)

    result = search(objective, starts, iterations)
    if objective.noise.source == "defaults":
        objective = objective.with_noise(objective.residual_noise(result.u))
        result = search(objective, result.starts, iterations)
    found = gradient.profile_delays(objective, space, result.u, robust=config.robust)
    for name, _, costs, followed in found:
        here = result.u[space.names.index(name)]
        apart = np.abs(followed[:, space.names.index(name)] - here) > 1e-6
        other = followed[apart][costs[apart].argmin()]
        if costs[apart].min() < result.cost * (1 + VALLEY):
            new = search(objective, other[None], iterations)
            result = new if new.cost < result.cost else result
    return result, objective, [(name, grid, costs) for name, grid, costs, _ in found]


def _keep_channels(trial: Trial, channels: str) -> Trial:
    if channels == "ground_truth" and trial.ground_truth is not None:
        return replace(trial, odometry=None)
    if channels == "odometry" and trial.odometry is not None:
        return replace(trial, ground_truth=None)
    return trial


def expected_steps(config: FitConfig) -> int:
    """How far the progress bar goes at most."""
    scan = min(config.trials, QUICK_EVALUATIONS) if config.quick else config.trials
    iterations = min(config.iterations, QUICK_ITERATIONS) if config.quick else config.iterations
    first = {"features": FEATURE_ITERATIONS * 3 // 2, "lm": 0}.get(config.method, scan)
    return first + (iterations if config.method != "tpe" else 0)


@dataclass(frozen=True, kw_only=True)
class Arguments(FitConfig):
    """Command line of `python -m sysid.fit`."""

    dataset: Path
    """Folder with the driving log."""

    out: Path = Path("runs/fit")
    """Folder for report.json, plots and vehicle.toml."""
    format: Literal["auto", "dataset", "drive_norlab", "mrclam"] = "auto"
    """Form of the data; found out by default."""
    train: tuple[str, ...] = ()
    """Trials to fit in a measured set: RUN, GROUP or RUN:FROM-TO, e.g. warthog_asphalt_a:0-0.667 or robot1."""
    held_out: tuple[str, ...] = ()
    """Trials to predict in a measured set, in the same form."""
    chained: bool = False
    """DRIVE: 6 s steps, chained from 2 s windows, instead of the windows."""
    close_loop: bool = False
    """Then ask what the model lacks, into OUT/close_loop (`sysid.close_loop`)."""
    reference: tuple[Path, ...] = ()
    """For that: drives of the same vehicle on other days."""


def main(arguments: Arguments) -> None:
    """Load, fit, write and print the summary."""
    dataset = arguments.dataset
    settings = FitConfig(**{name: getattr(arguments, name) for name in FitConfig.__dataclass_fields__})
    log = load_any(dataset, arguments.format, arguments.train, arguments.held_out, arguments.chained)
    for note in log.notes:
        print(note)
    progress, close = command_line.progress_bar(expected_steps(settings))
    try:
        report = fit_dataset(dataset, arguments.out, config=settings, log=log, progress=progress,
                             source={"train": arguments.train, "held_out_selection": arguments.held_out})
    finally:
        close()
    print(parameter_table(report))
    if report["prior"] is not None:
        print(f"Against {settings.vehicle}, assuming {settings.spread:.0%} from day to day:")
        for one in report["prior"]["moved"]:
            if not one["within"]:
                print(f"  {one['name']}: {one['before']:.4g} -> {one['after']:.4g}, {one['deviations']:+.1f} standard "
                      "deviations")
        print(f"  {sum(one['within'] for one in report['prior']['moved'])} parameters stayed within 90 %")
    print(table(report))
    print(f"wrote {arguments.out / 'report.html'}, report.json, vehicle.toml and the plots")
    if arguments.close_loop:
        from sysid.close_loop import LoopConfig, run

        references = [load_any(path) for path in arguments.reference]
        if settings.preset != "physical":
            print("the loop starts from the physical base model")
        run(log, references, arguments.out / "close_loop", LoopConfig(quick=settings.quick, seed=settings.seed))


def cli() -> None:
    """Command line."""
    command_line.run(Arguments, main, __doc__)


if __name__ == "__main__":
    cli()

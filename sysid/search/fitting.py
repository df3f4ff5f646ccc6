"""Fit a vehicle or a model to the training trials of a log, and predict others with it."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np

from sysid.errors.bin_objective import FeatureObjective, make_features_objective
from sysid.errors.pose_objective import DriveResiduals, Noise, Objective, Replays, estimate_noise
from sysid.errors.prior import Prior, bounds_alone, make_prior
from sysid.errors.space import Space, make_space, robust_cost, searched
from sysid.intervals import uncertainty
from sysid.intervals.profiles import Profile, check_names, profile
from sysid.logs import odometry_frames
from sysid.logs.log import of_file
from sysid.logs.records import CHANNEL_NAMES, Log, Prediction, Trial
from sysid.logs.sources import refuse_recording
from sysid.replay import models
from sysid.replay.differences import DifferenceReplay, make_replay
from sysid.replay.model_files import load_model
from sysid.replay.models import Model
from sysid.replay.records import Plant
from sysid.replay.rollout import predictions, vehicle_plant
from sysid.replay.wheel_model import wheel_model
from sysid.search import least_squares, settings, slopes, starts, studies, thin
from sysid.search.result import FitResult, Progress, Stages
from sysid.search.settings import FitConfig
from sysid.search.stated import chosen_sizes
from sysid.search.studies import StudyPlace
from sysid.search.valleys import FIRST, LOOK, gradient_search
from whill_mjx.io.command_line import check_options
from whill_mjx.vehicle.config import VehicleConfig
from whill_mjx.vehicle.presets import preset_params
from whill_mjx.vehicle.vehicle_file import load_intervals, read_vehicle

PASSIVE = "slip_traction.mu_free"
CENTRE = ("body.com_x", "body.com_y", "body.com_z")  # of a skid-steered robot they move the tracked point only
INSTEAD = ("{} is skid-steered: the simulator's vehicle is fitted in its place, with the file's mass distribution and "
           "places of wheels")


@dataclass(frozen=True)
class Fit:
    """A fitted vehicle and what is known of it."""

    params: Any  # `VehicleParams` at the fitted values
    initial_params: Any
    space: Space
    uncertainty: uncertainty.Uncertainty
    noise: Noise
    scan: FitResult | None  # result of the global search
    coarse: FitResult | None  # result of the search on features, of all its starts
    search: FitResult | None  # result of the gradient search
    u: np.ndarray  # (P,) fitted unit coordinates
    initial_cost: float
    cost: float  # mean squared white residual (large ones counted linearly); J in metres after a global search
    profiles: list[tuple[str, np.ndarray, np.ndarray]]
    seconds: float
    plant: Plant
    prior: Prior | None = None  # of an earlier vehicle file
    model: Model | None = None  # what was fitted in place of the simulator's vehicle
    likelihoods: tuple[Profile, ...] = ()  # profile likelihoods of the parameters that `profile` names
    frame: float | None = None  # time between frames of the odometry [s] (`sysid.logs.odometry_frames`)
    stated: tuple[str, ...] = ()  # groups of sizes that keep their stated values (`sysid.search.stated`)
    replay: Replays | None = None  # of the training trials; what it has compiled serves other trials too


def fit_log(
    log: Log, config: FitConfig | None = None, progress: Progress | None = None, params: Any = None,
    model: Model | None = None,
) -> Fit:
    """Fit the training trials of a log; its held-out trials are not looked at.

    The search starts at `params`, by default the preset's values for the log's vehicle. `model` is fitted in place of
    the simulator's vehicle, by default what `config.model` names.
    """
    config = config or FitConfig()
    check_options(config)
    began = time.perf_counter()
    log, model = subject(log, config, model)
    given = make_problem(log, config, params, model)
    if given.plant.host is not None:
        config = replace(config, elsewhere=False)
    space, objective = given.space, given.objective
    wanted = profiled(space, config)
    if isinstance(objective.replay, DifferenceReplay):
        for trials in (objective.trials, odometry_frames.at_frames((*log.training, *log.held_out), given.frame)):
            objective.replay.compile(trials)  # `predict` replays all of them
    iterations = min(config.iterations, settings.QUICK_ITERATIONS) if config.quick else config.iterations
    stages = Stages(progress, 1 if config.method in settings.GLOBAL else 3 if config.method == "lm" else 4)
    scan, coarse, points = _first_points(log, given, config, stages)
    if config.vehicle is not None:
        objective = replace(objective, prior=make_prior(space, given.intervals, config.spread))
    chosen: DriveResiduals = choose(objective, points[0], log.spec.track, config, stages)
    robust, search = config.robust and config.method not in settings.GLOBAL, None
    stated: tuple[str, ...] = ()
    profiles: list[tuple[str, np.ndarray, np.ndarray]] = []
    if config.method in settings.GLOBAL:
        assert scan is not None
        u, initial_cost, final_cost = scan.u, scan.initial_cost, scan.cost
    else:
        search, chosen, profiles = gradient_search(chosen, points, iterations, config, stages)
        u, final_cost = search.u, search.cost
        residuals = chosen.residuals(space.to_unit(space.initial)[None])
        initial_cost = float(robust_cost(residuals, config.robust)[0]) / chosen.counted
    known = uncertainty.estimate(chosen, u, robust=robust)
    traced = profile(chosen, known, wanted, config.robust, progress=progress) if wanted else []
    if config.calibrate and not config.all_sizes and config.vehicle is None and config.method not in settings.GLOBAL:
        if progress is not None:
            progress(0, "sizes: stated or free")
        sizes = chosen_sizes(chosen, objective.renewed(u), known, final_cost, config.parameters, robust)
        u, final_cost, stated = sizes.u, sizes.cost, sizes.names
        # What the drives say of stated sizes counts as well, and they say it where all are free.
        if stated:
            known = uncertainty.uncertainty_of(replace(known.evidence, u=u), space, errors=known.errors)
    objective = objective.renewed(u)  # its noise is reported
    values = jax.numpy.asarray(space.to_values(u), jax.numpy.result_type(float))
    fitted = models.set_parameters(given.params, space.names, values)
    earlier = chosen.prior if config.vehicle is not None else None
    return Fit(fitted, given.params, space, known, objective.noise, scan, coarse, search, u, initial_cost, final_cost,
               profiles, time.perf_counter() - began, given.plant, earlier, given.model, tuple(traced), given.frame,
               stated, given.objective.replay)


def _first_points(
    log: Log, given: Problem, config: FitConfig, stages: Stages
) -> tuple[FitResult | None, FitResult | None, np.ndarray]:
    """Results of the global search and of that on features, where there is one, and points (S, P) for LM."""
    space, objective = given.space, given.objective
    points = least_squares.random_starts(space, config.starts, config.seed)
    if config.method in (*settings.GLOBAL, "both"):
        evaluations = min(config.trials, settings.QUICK_EVALUATIONS) if config.quick else config.trials
        cost = "paper" if config.method in settings.GLOBAL else "weighted"
        count = max(min(config.starts, 2) if config.quick else config.starts, 2)
        problem = {"data": log.sha256, "trials": ", ".join(trial.name for trial in objective.trials),
                   "channels": config.channels, "model": config.preset if given.model is None else given.model.name,
                   "step": f"{given.plant.dt:g}"}
        search = studies.GlobalSearch(evaluations, config.seed, cost, "cmaes" if config.method == "cmaes" else "tpe",
                                  count - 1)
        place = StudyPlace(config.storage, config.study, problem)
        scan = studies.global_search(objective, space, search, place, stages.begin("global search"))
        return scan, None, np.concatenate([points[:1], scan.starts])[:count]
    if config.method == "features":
        first = stages.begin("features of motion")
        starts.compile_ahead(objective, log.spec.track)
        points = starts.draw(objective, range(config.starts), log.spec.track, config.seed, progress=first)
        coarse = starts.fit(objective, points, log.spec.track, settings.FEATURE_ITERATIONS, first)
        return None, coarse, coarse.u[None]
    return None, None, points


def choose(
    objective: Objective, u: np.ndarray, track: float, config: FitConfig, stages: Stages | None = None
) -> DriveResiduals:
    """Choose the last objective of a search, whole poses or motion in bins, with the weight of its prior.

    Least squares of whole poses are efficient where only the sensors err. Disturbances add up along a drive: motion in
    bins then holds more information. `u`: (P,) where the search begins or that on features ended; `track` in m.
    """
    if config.method in settings.GLOBAL:
        return objective
    progress = stages.begin("whole poses") if stages else None
    near = least_squares.fit(objective, starts=u[None], stop=least_squares.Stopping(settings.TRIED),
                             robust=config.robust, progress=progress)
    share = uncertainty.inflation(objective, near.u)
    chosen: Objective | FeatureObjective = objective
    if config.method == "features" and share >= settings.TOGETHER:
        binned = make_features_objective(objective, track)
        if binned.enough:
            chosen = binned.renewed(u)
            share = uncertainty.inflation(chosen, u)
    return chosen if chosen.prior is None else replace(chosen, prior=replace(chosen.prior, share=share))


@dataclass(frozen=True)
class Problem:
    plant: Plant
    params: Any  # where it starts
    space: Space
    objective: Objective  # over the training trials
    intervals: dict[str, tuple[float, float]]  # of an earlier vehicle file
    model: Model | None
    frame: float | None = None  # time between the frames of the odometry [s], which the trials' rows are at


def make_problem(log: Log, config: FitConfig, params: Any = None, model: Model | None = None) -> Problem:
    """The search for a log's vehicle or model; arguments and errors as of `fit_log`."""
    trials = _training(log, config)
    if config.quick and len(trials) > settings.QUICK_TRIALS:
        trials = tuple(trials[i] for i in np.linspace(0, len(trials) - 1, settings.QUICK_TRIALS).round().astype(int))
    frame = odometry_frames.find_period(trials)
    trials = odometry_frames.at_frames(trials, frame)
    model, plant, params, space, intervals = _subject(log, config, trials, params, model)
    plant = replace(plant, frame=frame)
    if frame is not None and odometry_frames.AGE in space.names and odometry_frames.AGE not in config.parameters:
        space = space.without(odometry_frames.AGE, "speeds are those of the odometry's frames")
    noise = estimate_noise(odometry_frames.at_frames(log.training, frame))
    objective = make_objective(plant, params, space, trials, noise)
    objective = replace(objective, prior=bounds_alone(space))
    return Problem(plant, params, space, objective, intervals, model, frame)


def check_settings(log: Log, config: FitConfig) -> Model | None:
    """Raise ValueError or FileNotFoundError for settings that cannot fit a log; returns the model that they name."""
    log, model = subject(log, config)
    space = _subject(log, config, _training(log, config), None, model)[3]
    profiled(space, config)
    return model


def _training(log: Log, config: FitConfig) -> tuple[Trial, ...]:
    """The training trials with the channels that are fitted."""
    if not log.training:
        raise ValueError(f"log {log.name!r} has no training trial. Take some out of held_out, or select with --train.")
    thin.check_moves(log)
    trials = tuple(_keep_channels(trial, config.channels) for trial in log.training if _has(trial, config.channels))
    if not trials:
        raise ValueError(f"--channels {config.channels}: no training trial of {log.name!r} has "
                         f"{CHANNEL_NAMES[config.channels]}. Leave the option out, or name the other channel.")
    return trials


def _subject(
    log: Log, config: FitConfig, trials: tuple[Trial, ...], params: Any = None, model: Model | None = None
) -> tuple[Model | None, Plant, Any, Space, dict[str, tuple[float, float]]]:
    """The model where it is not the simulator's vehicle, its plant, where the search starts, the free parameters, and
    intervals of an earlier vehicle file."""
    intervals: dict[str, tuple[float, float]] = {}
    if model is None and config.model:
        model = load_model(config.model, log.spec, config.wheels, config.parameters)
    elif model is None and log.fields.get("input") == "wheels":
        model = wheel_model(log.spec)
    if model is not None and config.vehicle is not None:
        raise ValueError(f"{config.vehicle}: a vehicle file says nothing about the model {model.name!r}. Leave "
                         "--vehicle or --model out.")
    start, start_of_file = None, model is not None and model.instead is not None
    if model is not None and model.instead is not None:
        start, model = model.instead(log.spec).params, None
    if model is not None:
        alone: tuple[str, ...] = ()
        model = model.with_effects((*config.effects, *models.gyro_effects(trials)))
        if config.calibrate and not config.parameters:
            model, alone = models.calibrated(model, trials)
        plant, params = model.plant, model.params if params is None else params
        wanted = [name for name in models.describe_parameters(params) if name not in alone]
        space = models.model_space(params, config.parameters or wanted)
        if not config.calibrate or not any(trial.ground_truth is not None for trial in trials):
            why = "no outside pose shows it" if config.calibrate else "not selected"
            for name in [one for one in space.names if one.startswith("wheels.") and one not in config.parameters]:
                space = space.without(name, why)
    else:
        plant = vehicle_plant(log.spec, VehicleConfig(physics_dt=config.physics_dt))
        given = params is not None
        if config.vehicle is not None:
            params, intervals = read_vehicle(config.vehicle)[1], load_intervals(config.vehicle)
        start = preset_params(log.spec, config.preset) if start is None else start
        params = start if params is None else params
        receipt = log.fields.get("pose_stamps") == "receipt"
        measured = () if given else models.measured_effects(params, log.spec, trials, receipt=receipt)
        sizes = models.calibration_effects(params, log.spec, trials) if config.calibrate and not given else ()
        params = models.with_effects(params, (*config.effects, *measured, *sizes, *models.gyro_effects(trials)))
        space = make_space(params, log.spec, config.parameters or searched(params, config.effects))
        kept = dict.fromkeys((PASSIVE,), "all wheels are driven") if log.spec.drive == "skid" else {}
        kept |= dict.fromkeys(CENTRE, "the robot's file states it") if start_of_file else {}
        for name, why in kept.items():
            space = space.without(name, why) if name in space.names and name not in config.parameters else space
    if model is None or model.around:  # else a person chose what is fitted
        space = thin.without_hidden(space, log.select(lambda one: not one.held_out), config.parameters)
    return model, plant, params, space, intervals


def profiled(space: Space, config: FitConfig) -> tuple[str, ...]:
    """Parameters whose profile is wanted; ValueError where there can be none."""
    wanted = tuple(space.names) if config.profile == ("all",) else config.profile
    check_names(space, wanted)
    if wanted and config.method in settings.GLOBAL:
        raise ValueError(f"--profile with --method {config.method}: a global search ends beside the minimum that a "
                         "profile starts from. Use --method features, lm or both.")
    return wanted


def subject(log: Log, config: FitConfig, model: Model | None = None) -> tuple[Log, Model | None]:
    """The log as one of the vehicle that is fitted, and the model that is given or that the settings name.

    Where a vehicle of the simulator takes the model's place, sizes and inertias that the log does not state are those
    of the model's file. ValueError or FileNotFoundError for settings that name neither.
    """
    log = of_earlier(log, config)
    without = [trial.name for trial in log.training if not _has(trial, config.channels)]
    if without:
        channel = CHANNEL_NAMES[config.channels]
        note = f"--channels {config.channels}: {', '.join(without)} have no {channel} and are left out"
        log = log if note in log.notes else replace(log, notes=(*log.notes, note))
    if model is None and config.model:
        model = load_model(config.model, log.spec, config.wheels, config.parameters)
    if model is None or model.instead is None:
        return log, model
    spec = model.instead(log.spec).spec
    log = of_file(replace(log, spec=replace(log.spec, drive=spec.drive)), spec, model.name)
    new = [note for note in (INSTEAD.format(model.name), *model.notes) if note not in log.notes]
    return replace(log, notes=(*log.notes, *new)), model


def of_earlier(log: Log, config: FitConfig) -> Log:
    """The log as one of the vehicle of an earlier file, where the settings name one."""
    if config.vehicle is None or config.model:
        return log
    refuse_recording(config.vehicle, "a vehicle file.")
    return of_file(log, read_vehicle(config.vehicle)[0], str(config.vehicle))


def make_objective(plant: Plant, params: Any, space: Space, trials: tuple[Trial, ...], noise: Noise) -> Objective:
    """Objective over the space's parameters; the others keep their values in `params`."""
    replay, measured = make_replay(plant, params, space, trials)
    return Objective(replay, space, trials, measured, noise)


def predict(fit: Fit, trials: tuple[Trial, ...]) -> tuple[list[Prediction], list[Prediction]]:
    """Replays of trials with the initial and with the fitted vehicle."""
    if not trials:
        return [], []
    replay, _ = make_replay(fit.plant, fit.params, fit.space, trials, fit.replay)
    values = np.stack([np.asarray(models.get_parameters(one, fit.space.names))
                       for one in (fit.initial_params, fit.params)])
    simulated = replay.simulate(values)
    return predictions(trials, simulated, 0), predictions(trials, simulated, 1)


def _has(trial: Trial, channels: str) -> bool:
    return channels == "both" or getattr(trial, channels) is not None


def _keep_channels(trial: Trial, channels: str) -> Trial:
    if channels == "ground_truth":
        return replace(trial, odometry=None)
    return replace(trial, ground_truth=None) if channels == "odometry" else trial


def expected_steps(config: FitConfig) -> int:
    """How far the progress bar goes, unless searches from elsewhere lead on."""
    scan = min(config.trials, settings.QUICK_EVALUATIONS) if config.quick else config.trials
    iterations = min(config.iterations, settings.QUICK_ITERATIONS) if config.quick else config.iterations
    drawn = starts.FIRST + starts.STEPS if config.starts > 1 else 0
    first = {"features": drawn + settings.FEATURE_ITERATIONS * 3 // 2, "lm": 0}.get(config.method, scan)
    elsewhere = FIRST + 5 * min(LOOK, iterations) + slopes.MISSES if config.elsewhere else 0
    return first + (settings.TRIED + iterations + elsewhere if config.method not in settings.GLOBAL else 0)

"""Proposes the next manoeuvre: `python -m sysid.design VEHICLE_OR_RUN --out command.csv --space 6 4`.

Of a library of manoeuvres within limits of speed and room, the one is chosen that shrinks the uncertainty of the
parameters most: A-optimal (the sum of variances, which the largest uncertainty rules) or D-optimal (the volume), both
on the subspace that driving can tell at all. `best_splitting_manoeuvre` chooses the one that best separates two effects
(T-optimality: what is left of one's signature after the base parameters and the other have explained what they can).

Residuals of driving logs are autocorrelated: information is divided by INFLATION, so that planned intervals are honest.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from sysid import command_line
from sysid.errors.pose_objective import DEFAULT_NOISE, Noise, Objective
from sysid.errors.space import Space, make_space
from sysid.intervals.uncertainty import PRIOR_SD, UNIDENTIFIABLE
from sysid.logs.log import Command
from sysid.logs.manoeuvre_library import Candidate, Limits, as_trial, library, placement
from sysid.replay.rollout import Measured, Plant, Replay, Simulated, make_batch, vehicle_plant
from whill_mjx.fields import Field, check_table
from whill_mjx.vehicle.config import VehicleConfig
from whill_mjx.vehicle.parameters import set_values
from whill_mjx.vehicle.specs import VehicleSpec

INFLATION = 13.7
"""Samples that count as one: an AR(1) residual of 0.9 at 20 Hz makes z-values 3.7 times too large."""
QUANTILE = 1.645  # of a 90 % interval
DEFAULT = Noise(DEFAULT_NOISE["ground_truth"] / 4, DEFAULT_NOISE["odometry"] / 4, "defaults")
Criterion = Literal["a", "d"]


@dataclass(frozen=True)
class Plan:
    """One candidate and what it would tell."""

    candidate: Candidate
    deviation: np.ndarray
    """(P,) standard deviations after the drive, in unit coordinates; those of the bounds where nothing tells."""
    trace: float
    """Sum of variances over the identifiable subspace, relative to that before the drive."""
    volume: float
    """Logarithm of the ratio of volumes after and before: -0.69 per halved standard deviation."""
    information: np.ndarray  # (P, P) in unit coordinates
    path: np.ndarray  # (T, 2) m, simulated, from the start pose
    start: tuple[float, float, float]
    """x, y [m] from a corner of the room and heading [rad] at which the path stays inside."""

    def score(self, criterion: Criterion) -> float:
        """The less the better."""
        return self.trace if criterion == "a" else self.volume


class Recorded(Replay):
    """A replay at one point with its derivatives, made once: nothing else is compiled or simulated."""

    def __init__(self, replay: Replay, values: np.ndarray):
        self.seen, self.slope = replay.jacobian(values[None])

    def simulate(self, values: np.ndarray, size: int | None = None) -> Simulated:
        return self.seen

    def jacobian(self, values: np.ndarray) -> tuple[Simulated, Simulated]:
        return self.seen, self.slope


def candidate_objective(
    plant: Plant, apply: Callable[[Any], Any], space: Space, candidates: Sequence[Candidate], noise: Noise = DEFAULT,
    channels: str = "both", at: np.ndarray | None = None,
) -> Objective:
    """Objective over candidates yet to be driven, at values `at` (P,), whose "measurements" are the replay there.

    Args:
        apply: values (P,) -> the plant's parameters.
        at: by default the space's initial values.
    """
    sigma = float(noise.pose[0]), float(noise.pose[2])
    trials = tuple(as_trial(candidate, channels=channels, sigma=sigma) for candidate in candidates)
    batch, blank = make_batch(trials, plant.dt)
    replay = Recorded(Replay(plant, batch, apply), np.asarray(space.initial if at is None else at))
    seen = replay.seen
    measured = Measured(np.asarray(seen.pose[0], float) * blank.pose_mask, blank.pose_mask,
                        np.asarray(seen.odometry[0], float) * blank.odometry_mask, blank.odometry_mask)
    return Objective(replay, space, trials, measured, noise)


def information(objective: Objective, values: np.ndarray) -> np.ndarray:
    """(B, P, P) information of each candidate in unit coordinates, with INFLATION taken off.

    Args:
        values: (P,) those of `candidate_objective`, which its slopes in unit coordinates belong to.
    """
    _, jacobian = objective.jacobian(objective.space.to_unit(values)[None])
    found: np.ndarray = np.einsum("bkp,bkq->bpq", jacobian[0], jacobian[0]) / INFLATION
    return found


def prior_information(space: Space, intervals: dict[str, tuple[float, float]] | None = None) -> np.ndarray:
    """(P, P) what is known before: 90 % intervals of single parameters where there are any, and the bounds."""
    diagonal = np.full(space.size, PRIOR_SD**-2.0)
    for name, (low, high) in (intervals or {}).items():
        if name in space.names:
            index = space.names.index(name)
            ends = [space.to_unit(np.where(np.arange(space.size) == index, end, space.initial))[index]
                    for end in (low, high)]
            diagonal[index] += (max(ends[1] - ends[0], 1e-4) / 2 / QUANTILE) ** -2.0
    return np.diag(diagonal)


def identifiable_subspace(total: np.ndarray) -> np.ndarray:
    """(P, S) directions that the information `total` (P, P) narrows well below the bounds."""
    values, directions = np.linalg.eigh(total)
    return directions[:, values * PRIOR_SD**2 > 1.0 / UNIDENTIFIABLE**2]


def rank(
    candidates: Sequence[Candidate], found: np.ndarray, prior: np.ndarray, paths: Sequence[np.ndarray],
    starts: Sequence[tuple[float, float, float]], criterion: Criterion = "a",
) -> list[Plan]:
    """Candidates by what they tell, best first.

    Args:
        found: (B, P, P) information of each.
        prior: (P, P) what is known before.
    """
    subspace = identifiable_subspace(prior + found.sum(axis=0))
    if not subspace.shape[1]:
        subspace = np.eye(len(prior))

    def covariance(total: np.ndarray) -> np.ndarray:
        return np.asarray(np.linalg.inv(subspace.T @ total @ subspace))

    before = covariance(prior)
    plans = []
    for index, candidate in enumerate(candidates):
        after = covariance(prior + found[index])
        volume = float(np.linalg.slogdet(after)[1] - np.linalg.slogdet(before)[1]) / 2
        deviation = np.sqrt(np.diag(np.linalg.inv(prior + found[index])))
        plans.append(Plan(candidate, deviation, float(np.trace(after) / np.trace(before)), volume, found[index],
                          paths[index], starts[index]))
    return sorted(plans, key=lambda plan: plan.score(criterion))


def propose(
    spec: VehicleSpec, params: Any, limits: Limits | None = None, noise: Noise = DEFAULT, channels: str = "both",
    intervals: dict[str, tuple[float, float]] | None = None, criterion: Criterion = "a", count: int = 1,
    names: Sequence[str] | None = None, candidates: Sequence[Candidate] | None = None, plant: Plant | None = None,
) -> tuple[list[Plan], list[Plan], Space, np.ndarray]:
    """The next manoeuvres of a vehicle.

    Args:
        intervals: what is known, by parameter name.
        count: how many manoeuvres, chosen one after the other.
        names: parameters of interest; by default all that a log can tell.

    Returns:
        The chosen ones, all plans for the first choice (best first), the space, and the deviations (P,) before.
    """
    limits = limits or Limits(max(spec.v_min, -1.0), min(spec.v_max, 1.0), min(spec.omega_max, 1.0))
    space = make_space(params, spec, names)
    plant = plant or vehicle_plant(spec, VehicleConfig(physics_dt=0.01))
    candidates = tuple(candidates or library(limits))
    objective = candidate_objective(plant, lambda values: set_values(params, space.names, values), space, candidates,
                                    noise, channels)
    paths = driven_paths(objective)
    starts = [placement(path, limits) for path in paths]
    inside = [k for k, start in enumerate(starts) if start is not None]
    if not inside:
        raise ValueError(f"the vehicle leaves {limits.room[0]:g} x {limits.room[1]:g} m in every manoeuvre. Give a "
                         "larger --space, or lower --v-max.")
    found = information(objective, space.initial)[inside]
    prior = prior_information(space, intervals)
    before = np.sqrt(np.diag(np.linalg.inv(prior)))
    ready = [candidates[k] for k in inside], [paths[k] for k in inside], [starts[k] for k in inside]
    chosen: list[Plan] = []
    first: list[Plan] = []
    for _ in range(count):
        plans = rank(ready[0], found, prior, ready[1], [one for one in ready[2] if one is not None], criterion)
        first = first or plans
        chosen.append(plans[0])
        prior = prior + plans[0].information
    return chosen, first, space, before


def driven_paths(objective: Objective) -> list[np.ndarray]:
    """Simulated path (T, 2) [m] of each candidate, from its start; the odometry's where no outside pose is planned."""
    paths = []
    for k, trial in enumerate(objective.trials):
        outside = trial.ground_truth is not None
        table = objective.measured.pose if outside else objective.measured.odometry
        stream = trial.ground_truth if outside else trial.odometry
        assert stream is not None
        paths.append(table[k, : len(stream.t), :2])
    return paths


def separation(signature_a: np.ndarray, signature_b: np.ndarray, jacobian: np.ndarray) -> float:
    """z-value of effect a where base parameters and effect b may explain what they can.

    Args:
        signature_a, signature_b: (K,) whitened change that each effect makes.
        jacobian: (K, P) whitened derivatives by the base parameters.

    Returns:
        Length of what is left of a, in standard deviations of autocorrelated noise (INFLATION).
    """
    known = np.column_stack([jacobian, signature_b])
    scale = np.linalg.norm(known, axis=0)
    known = known[:, scale > 1e-9] / scale[scale > 1e-9]
    basis, size, _ = np.linalg.svd(known, full_matrices=False)
    basis = basis[:, size > 1e-8 * max(float(size.max(initial=0.0)), 1e-30)]
    left = signature_a - basis @ (basis.T @ signature_a)
    return float(np.linalg.norm(left) / np.sqrt(INFLATION))


def best_splitting_manoeuvre(
    spec: VehicleSpec, params: Any, base_space: Space, effect_a_params: Any, effect_b_params: Any,
    candidates: Sequence[Candidate], noise: Noise = DEFAULT, channels: str = "both", plant: Plant | None = None,
    apply: Callable[[Any], Any] | None = None,
) -> tuple[str, Command, float]:
    """The manoeuvre that best tells effect a from effect b.

    Args:
        params: the base vehicle.
        base_space: base parameters that a fit would adapt; its initial values are those of `params`.
        effect_a_params, effect_b_params: the base vehicle with one effect each, at a size worth knowing.
        candidates: from `sysid.logs.manoeuvre_library.library`.
        plant: by default the simulator's vehicle of `spec`.
        apply: values (P,) of the base space -> the plant's parameters; by default they are set in `params`.

    Returns:
        Name, command and z-value: the less of both directions, a beside b and b beside a. Below about 3 no candidate
        tells them apart, and another sensor is needed.
    """
    scores = splitting_scores(spec, params, base_space, effect_a_params, effect_b_params, candidates, noise, channels,
                              plant, apply)
    best = int(np.argmax(scores))
    return candidates[best].name, candidates[best].command, float(scores[best])


def splitting_scores(
    spec: VehicleSpec, params: Any, base_space: Space, effect_a_params: Any, effect_b_params: Any,
    candidates: Sequence[Candidate], noise: Noise = DEFAULT, channels: str = "both", plant: Plant | None = None,
    apply: Callable[[Any], Any] | None = None,
) -> np.ndarray:
    """z-value (B,) of each candidate; arguments of `best_splitting_manoeuvre`."""
    plant = plant or vehicle_plant(spec, VehicleConfig(physics_dt=0.01))
    if apply is None:
        def apply(values: Any) -> Any:
            return set_values(params, base_space.names, values)

    objective = candidate_objective(plant, apply, base_space, candidates, noise, channels)
    u = base_space.to_unit(base_space.initial)[None]
    _, jacobian = (one[0] for one in objective.jacobian(u))  # (B, K, P)
    batch, _ = make_batch(objective.trials, plant.dt)
    signatures = []
    for changed in (effect_a_params, effect_b_params):
        replay = Replay(plant, batch, _always(changed))
        signatures.append(replace(objective, replay=replay).residuals(u)[0])  # (B, K)
    return np.array([min(separation(a, b, slope), separation(b, a, slope))
                     for a, b, slope in zip(*signatures, jacobian, strict=True)])


def _always(params: Any) -> Callable[[Any], Any]:
    return lambda _: params


@dataclass(frozen=True)
class DesignConfig:
    """Options of the command."""

    vehicle: str
    """Built-in vehicle, vehicle file, or the folder of a fit."""
    out: Path = Path("runs/command.csv")
    """Command file to write: t [s], v [m/s], omega [rad/s]. Beside it a page with the reasons."""
    space: tuple[float, float] = (8.0, 8.0)
    """Length and width [m] of the free floor."""
    margin: float | None = None
    """How far the drive-axle centre stays from its edges [m]; by default the reach of the body."""
    v_max: float | None = None
    """Greatest speed [m/s]; by default the vehicle's, 1 at most."""
    v_min: float | None = None
    """Least speed [m/s]; 0 forbids reversing."""
    omega_max: float | None = None
    """Greatest yaw rate [rad/s]."""
    seconds: float = 20.0
    """Time in motion at most [s]."""
    criterion: Criterion = "a"
    """a: sum of variances, ruled by the largest uncertainty; d: volume."""
    channels: Literal["both", "odometry", "ground_truth"] = "both"
    """What will be measured."""
    parameters: tuple[str, ...] = ()
    """Parameters of interest; by default all that a log can tell."""
    count: int = 1
    """Manoeuvres to propose, one after the other; further ones are written as NAME_2.csv, ..."""


def main(config: DesignConfig) -> list[Path]:
    """Propose, write the command files and the page, and print the reasons."""
    from sysid.pages.design_page import text, write_page
    from whill_mjx.logs.dataset import COMMAND_HEADER, write_csv

    spec, params, intervals, noise = load_subject(config.vehicle)
    limits = Limits(
        max(spec.v_min, -1.0) if config.v_min is None else config.v_min,
        min(spec.v_max, 1.0) if config.v_max is None else config.v_max,
        min(spec.omega_max, 1.0) if config.omega_max is None else config.omega_max, config.space,
        float(np.hypot(spec.body_length, spec.body_width)) / 2 if config.margin is None else config.margin,
        config.seconds)
    chosen, plans, space, before = propose(spec, params, limits, noise, config.channels, intervals, config.criterion,
                                           config.count, config.parameters or None)
    paths = []
    for number, plan in enumerate(chosen, start=1):
        path = config.out if number == 1 else config.out.with_name(f"{config.out.stem}_{number}{config.out.suffix}")
        command = plan.candidate.command
        write_csv(path, COMMAND_HEADER, np.column_stack([command.t, command.v, command.omega]))
        paths.append(path)
    print(text(chosen, plans, space, before, config.criterion))
    paths.append(write_page(config.out.with_suffix(".html"), chosen, plans, space, before, limits, config))
    for path in paths:
        print(f"wrote {path}")
    return paths


def load_subject(name: str) -> tuple[VehicleSpec, Any, dict[str, tuple[float, float]], Noise]:
    """Spec, parameters, known intervals and noise of a built-in vehicle, a vehicle file, or the folder of a fit."""
    from whill_mjx.drive import find_vehicle
    from whill_mjx.vehicle.vehicle_file import load_intervals

    if not Path(name).is_dir():
        spec, params = find_vehicle(name)
        return spec, params, load_intervals(name) if name.endswith(".toml") else {}, DEFAULT
    from sysid.report import read_report

    report = read_report(Path(name))
    file = str(Path(name) / "vehicle.toml")
    spec, params = find_vehicle(file)
    outside, own = (tuple(f"{channel}.{key}" for key in keys) for channel, keys in (
        ("ground_truth", ("x", "y", "yaw")), ("odometry", ("x", "y", "yaw", "v", "omega"))))
    fields = [Field(key, "SI", 1e-12, 1e6, remedy="Fit the log again.") for key in (*outside, *own)]
    found = report["noise"].get("scale")
    scale = check_table(str(Path(name) / "report.json"), fields, found, "noise.scale", others=True)
    noise = Noise(np.array([scale[key] for key in outside]), np.array([scale[key] for key in own]), "fit")
    return spec, params, load_intervals(file), noise


def cli() -> None:
    """Command line."""
    command_line.run(DesignConfig, main, __doc__)


if __name__ == "__main__":
    cli()

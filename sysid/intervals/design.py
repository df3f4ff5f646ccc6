"""Which manoeuvre shrinks the uncertainty of the parameters most."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np

from sysid.errors.pose_objective import DEFAULT_NOISE, Noise, Objective
from sysid.errors.space import Space, make_space
from sysid.intervals.uncertainty import PRIOR_SD, UNIDENTIFIABLE
from sysid.logs.manoeuvre_library import Candidate, Limits, as_trial, library, placement
from sysid.replay.records import Measured, Plant, Simulated
from sysid.replay.rollout import Replay, make_batch, vehicle_plant
from sysid.search.thin import drives_from
from whill_mjx.effects.pose_mount import PoseMount
from whill_mjx.vehicle.config import VehicleConfig
from whill_mjx.vehicle.parameters import set_values
from whill_mjx.vehicle.specs import VehicleSpec
from whill_mjx.vehicle.types import parameters_of

INFLATION = 13.7  # samples that count as one: an AR(1) residual of 0.9 at 20 Hz makes z-values 3.7 times too large
QUANTILE = 1.645  # of a 90 % interval
DEFAULT = Noise(DEFAULT_NOISE["ground_truth"] / 4, DEFAULT_NOISE["odometry"] / 4, "defaults")
Criterion = Literal["a", "d"]


@dataclass(frozen=True)
class Plan:
    """One candidate and its information."""

    candidate: Candidate
    deviation: np.ndarray  # (P,) standard deviations after the drive, in unit coordinates; those of the bounds at most
    trace: float  # sum of variances over the identifiable subspace, relative to that before the drive
    volume: float  # logarithm of the ratio of volumes after and before: -0.69 per halved standard deviation
    information: np.ndarray  # (P, P) in unit coordinates
    path: np.ndarray  # (T, 2) m, simulated, from the start pose
    start: tuple[float, float, float]  # x, y [m] from a corner of the room and heading [rad]

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
    channels: str = "both",
) -> Objective:
    """Objective over candidates yet to be driven, whose "measurements" are the replay at the space's initial values.

    `apply`: values (P,) -> the plant's parameters.
    """
    sigma = float(noise.pose[0]), float(noise.pose[2])
    trials = tuple(as_trial(candidate, channels=channels, sigma=sigma) for candidate in candidates)
    batch, blank = make_batch(trials, plant.dt)
    replay = Recorded(Replay(plant, batch, apply), np.asarray(space.initial))
    seen = replay.seen
    measured = Measured(np.asarray(seen.pose[0], float) * blank.pose_mask, blank.pose_mask,
                        np.asarray(seen.odometry[0], float) * blank.odometry_mask, blank.odometry_mask)
    return Objective(replay, space, trials, measured, noise)


def information(objective: Objective, values: np.ndarray) -> np.ndarray:
    """(B, P, P) information of each candidate in unit coordinates at values (P,), with INFLATION taken off."""
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
    """Candidates by their information `found` (B, P, P), beside what is known before (`prior`, (P, P)), best first."""
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


@dataclass(frozen=True)
class Subject:
    """What is known of the vehicle that will drive."""

    spec: VehicleSpec
    params: Any
    intervals: dict[str, tuple[float, float]] = field(default_factory=dict)  # 90 % intervals by parameter name
    noise: Noise = DEFAULT


@dataclass(frozen=True)
class Proposal:
    """Manoeuvres to drive next, and why."""

    chosen: list[Plan]
    plans: list[Plan]  # all plans for the first choice, best first
    space: Space
    before: np.ndarray  # (P,) deviations before the drives, in unit coordinates


def propose(
    subject: Subject, limits: Limits | None = None, *, channels: str = "both", criterion: Criterion = "a",
    count: int = 1, names: Sequence[str] | None = None,
) -> Proposal:
    """The next `count` manoeuvres of a vehicle, chosen one after the other.

    `channels`: what will be measured; `names`: parameters of interest, by default all that a log can determine.
    """
    spec, params = subject.spec, tracked_at_axle(subject.params)
    limits = limits or Limits(max(spec.v_min, -1.0), min(spec.v_max, 1.0), min(spec.omega_max, 1.0),
                              least=drives_from(spec))
    space = make_space(params, spec, names)
    plant = vehicle_plant(spec, VehicleConfig(physics_dt=0.01))
    candidates = tuple(library(limits))
    objective = candidate_objective(plant, lambda values: set_values(params, space.names, values), space, candidates,
                                    subject.noise, channels)
    paths = driven_paths(objective)
    starts = [placement(path, limits) for path in paths]
    inside = [k for k, start in enumerate(starts) if start is not None]
    if not inside:
        raise ValueError(f"the vehicle leaves {limits.room[0]:g} x {limits.room[1]:g} m in every manoeuvre. Give a "
                         "larger --space, or lower --v-max.")
    found = information(objective, space.initial)[inside]
    prior = prior_information(space, subject.intervals)
    before = np.sqrt(np.diag(np.linalg.inv(prior)))
    ready = [candidates[k] for k in inside], [paths[k] for k in inside], [starts[k] for k in inside]
    chosen: list[Plan] = []
    first: list[Plan] = []
    for _ in range(count):
        plans = rank(ready[0], found, prior, ready[1], [one for one in ready[2] if one is not None], criterion)
        first = first or plans
        chosen.append(plans[0])
        prior = prior + plans[0].information
    return Proposal(chosen, first, space, before)


def tracked_at_axle(params: Any) -> Any:
    """The vehicle as if its outside pose followed the drive-axle centre: that is what is put at the start, with the
    vehicle's own heading, and must stay in the room."""
    mounts = [effect for effect in getattr(params, "effects", ()) if effect.name == PoseMount.name]
    names = [f"{PoseMount.name}.{field}" for one in mounts for field in parameters_of(one)]
    return set_values(params, names, jnp.zeros(len(names))) if names else params


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

"""How far each effect seems to wander from day to day on reference drives in which nothing is missing.

A day differs from the next in more than the base parameters: what the model gets wrong changes with them, and an effect
of the catalogue fits a part of it. Estimated on every reference day by itself, the coordinates of each hypothesis show
how large that part is. Drives in question must show more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sysid.errors.noise import scatter
from sysid.missing.catalogue import Hypothesis
from sysid.missing.days import ASSUMED_DAYS, EXCESS, Reference, Wander, no_wander
from sysid.missing.drives import Drives
from sysid.missing.evidence import Columns, Evidence, Solver, column_layout
from sysid.missing.signatures import gather
from sysid.missing.unexplained import best_gain
from sysid.search.result import Progress
from whill_mjx.vehicle.specs import VehicleSpec
from whill_mjx.vehicle.types import VehicleParams

ASSUMED = 0.3  # standard deviation of a coordinate from day to day where reference days do not determine it


def estimate(
    drives: Drives, reference: Reference, hypotheses: Sequence[Hypothesis], full: VehicleParams, spec: VehicleSpec,
    progress: Progress | None = None,
) -> Wander:
    """Wander on the reference days.

    Args:
        drives: all training trials of all reference days, in the order of `reference.leftovers`.
        full: the vehicle with the catalogue; `drives` free all its parameters.
    """
    day = np.array([one.day for one in reference.leftovers])
    count = int(day.max()) + 1
    if not reference.known or count < 2:
        return no_wander(column_layout(hypotheses, reference.space.size), ASSUMED if reference.known else 0.0)
    evidence, _ = gather(drives, reference, hypotheses, full, progress, pools=False)
    white = reference.whitener
    series = np.stack([one.series - reference.expected_on_others(one) for one in reference.leftovers])
    left = white.apply(series, drives.mask).reshape(len(day), -1)
    moved = evidence.design[..., : evidence.base_size] @ reference.days.T  # (B, n, D)
    residual = left + np.take_along_axis(moved, day[:, None, None], axis=-1)[..., 0]
    evidence = replace(evidence, residual=residual, moments=np.einsum("bni,bn->bi", evidence.design, residual))
    measured = (drives.mask > 0).reshape(len(day), -1)
    excess = [np.square(left[day == number]).sum() / measured[day == number].sum() - 1 for number in range(count)]
    usual = [best_gain([one.trial for one in reference.leftovers if one.day == number], spec, left[day == number],
                       reference.width, reference.channels)
             / float((day == number).sum()) for number in range(count)]
    repeats = drives.repeats
    apart = [scatter(left[day == number], repeats[day == number]) for number in range(count)]
    apart = [one for one in apart if np.isfinite(one)]
    estimates = [coordinates(evidence, np.flatnonzero(day == number)) for number in range(count)]
    return replace(_pooled(evidence.columns, estimates), excess=_spread(np.array(excess)),
                   usual=float(np.mean(usual)),
                   usual_size=float(np.sqrt(np.square(usual).mean() * (1 + 1 / count))),
                   scatter=float(np.mean(apart)) if apart else 0.0)


def _spread(excess: np.ndarray) -> float:
    """Standard deviation of a new day's excess, drawn towards the assumed one."""
    count = len(excess)
    variance = (np.square(excess).sum() + ASSUMED_DAYS * EXCESS**2) / (count + ASSUMED_DAYS)
    return float(np.sqrt(variance * (1 + 1 / count)))


def coordinates(evidence: Evidence, trials: Sequence[int] | np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Coordinates (k,) and their information (k, k) beside the base, for each of the evidence's columns."""
    solver = Solver(evidence, list(trials))
    found = []
    for columns in evidence.columns:
        information = solver.information(columns.index)
        found.append((np.linalg.solve(information, solver.score(columns.index)), information))
    return found


def _pooled(columns: Sequence[Columns], days: Sequence[list[tuple[np.ndarray, np.ndarray]]]) -> Wander:
    """Covariances beyond the noise, each drawn towards what all hypotheses have in common; days count by their
    information on an effect."""
    ratios = [float(q @ information @ q) / len(q) for day in days for q, information in day]
    common = max(float(np.median(ratios)) / 0.455, 1.0)  # 0.455: median of chi squared with one degree of freedom
    covariance, shapes = [], []
    for position in range(len(columns)):
        each = np.stack([day[position][0] for day in days])  # (D, k)
        noises = np.stack([np.linalg.inv(day[position][1]) for day in days])  # (D, k, k)
        weight = _weights(noises)
        count = 1 / np.square(weight).sum()  # as many days as these weights amount to
        noise = np.einsum("d,dij->ij", weight, noises)
        mean = np.einsum("d,di,dj->ij", weight, each, each)
        seen = (count * mean + ASSUMED_DAYS * common * noise) / (count + ASSUMED_DAYS)
        value, vector = np.linalg.eigh(seen - noise)
        covariance.append((vector * np.maximum(value, 0.0)) @ vector.T)
        total = np.sqrt(np.maximum(np.diag(mean), 1e-30))
        shapes.append(each * np.sqrt(len(days) * weight)[:, None] / total)
    return Wander(tuple(covariance), tuple(shapes), len(days) + ASSUMED_DAYS)


def _weights(noises: np.ndarray) -> np.ndarray:
    """(D,) weights of days, of sum 1, from the covariances (D, k, k) of their estimates: as the variance of a squared
    estimate asks where an effect wanders by as much as the noise of a middling day."""
    size = np.einsum("dii->di", noises)
    weight = 1 / np.square(1 + size / np.median(size, 0)).mean(1)
    return weight / weight.sum()

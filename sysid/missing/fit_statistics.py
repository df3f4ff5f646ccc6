"""What a fit knows beside its values, kept in the vehicle file: how sure they are, and what the model leaves of drives.

The closed loop takes it for its reference where a vehicle file stands in for reference drives. One fit shows one day:
how far parameters and apparent effects wander from day to day is assumed then, and the report says so.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sysid.errors.features import CHANNELS, GYRO, Features, bin_width, channel_names, make_features
from sysid.errors.noise import ROUGH, Whitener, courses_of, fit_roughness, fit_whitener, roughness, scatter
from sysid.logs.records import Prediction, Trial
from sysid.replay.records import Measured
from sysid.replay.rollout import padded
from whill_mjx.io.fields import shown
from whill_mjx.vehicle.specs import VehicleSpec
from whill_mjx.vehicle.vehicle_file import load_statistics, load_vehicle

DIGITS = 5  # of numbers in the file


@dataclass(frozen=True)
class Leftovers:
    """Statistics of what a model leaves of drives, in bins of motion."""

    drives: int
    width: float  # of the bins [s]
    measured: tuple[str, ...]  # channels that the drives had
    whitener: Whitener
    factors: np.ndarray  # (4, C) noise of rough bins beside smooth ones
    shared: float  # share of a drive's white leftover that its replicates have as well


@dataclass(frozen=True)
class FitStatistics:
    """Standard errors of fitted parameters with their correlations, and the leftovers of the drives of the fit."""

    names: tuple[str, ...]
    error: np.ndarray  # (P,) in the parameters' own units
    correlation: np.ndarray  # (P, P)
    leftovers: Leftovers

    def covariance(self, names: Sequence[str], slope: np.ndarray) -> np.ndarray:
        """(Q, Q) of the unit coordinates of some parameters, with the values' derivatives (Q,) by these; 0 for those
        that were not fitted."""
        index = [self.names.index(name) if name in self.names else -1 for name in names]
        known = np.array(index) >= 0
        error = np.where(known, self.error[index], 0.0) / np.maximum(slope, 1e-12)
        return np.asarray(self.correlation[np.ix_(index, index)] * np.outer(error, error))

    def as_table(self) -> dict[str, Any]:
        """The section of the vehicle file; matrices row by row."""
        left = self.leftovers
        return {"schema": 1, "drives": left.drives, "bin": left.width, "channels": list(left.measured),
                "shared": _round(left.shared), "scale": _list(left.whitener.scale),
                "memory": _list(left.whitener.coefficients), "inverse": _list(left.whitener.inverse),
                "factors": _list(left.factors), "parameters": list(self.names), "standard_error": _list(self.error),
                "correlation": _list(self.correlation)}


@dataclass(frozen=True)
class FittedVehicle:
    """A vehicle and what its fit knows; None where the file was written without."""

    params: Any
    statistics: FitStatistics | None = None
    kept: bool = True  # false where a fit only starts at it


def load_fitted(path: Path) -> tuple[VehicleSpec, FittedVehicle]:
    """The spec of a vehicle file or built-in vehicle, and the vehicle with what a fit knows beside it; ValueError where
    the vehicle is unknown, or the statistics in its file do not fit it."""
    spec, params, _ = load_vehicle(path)
    table = load_statistics(path) if path.is_file() else None
    return spec, FittedVehicle(params, None if table is None else _from_table(path, table))


def statistics_of(
    trials: Sequence[Trial], seen: Sequence[Prediction], track: float, names: Sequence[str], error: np.ndarray,
    covariance: np.ndarray,
) -> FitStatistics:
    """Those of a fit of the parameters `names`: `seen` are the trials as the fitted vehicle replays them, `error` (P,)
    standard errors in their own units, `covariance` (P, P) in unit coordinates."""
    features, size = make_features(tuple(trials), bin_width(trials)), np.sqrt(np.maximum(np.diag(covariance), 1e-30))
    target, at = (features.of(_table(each)) for each in (trials, seen))
    return FitStatistics(tuple(names), error, np.clip(covariance / np.outer(size, size), -1.0, 1.0),
                         leftovers_of(tuple(trials), target, at, features, track))


def leftovers_of(
    trials: tuple[Trial, ...], target: np.ndarray, at: np.ndarray, features: Features, track: float
) -> Leftovers:
    """What replays of trials, as features `at` (B, K, C), leave of the measured ones, `target`."""
    level = roughness(at, features.width, track)
    factors = fit_roughness(target - at, features.mask, level)
    return leftovers_in_bins(trials, target - at, features.mask / factors[level], features.width, factors)


def leftovers_in_bins(
    trials: tuple[Trial, ...], series: np.ndarray, mask: np.ndarray, width: float, factors: np.ndarray
) -> Leftovers:
    """Statistics of leftovers (B, K, C) with weights of bins (B, K, C) and noise factors (4, C)."""
    whitener = fit_whitener(series, mask)
    white = whitener.flat(series, mask)
    apart = scatter(white, courses_of(trials))
    measured = tuple(name for c, name in enumerate(channel_names(mask.shape[-1])) if (mask[..., c] > 0).any())
    return Leftovers(len(trials), width, measured, whitener, factors,
                     float(np.clip(-apart, 0.0, 1.0)) if np.isfinite(apart) else 0.0)


def drawn(left: Leftovers, mask: np.ndarray, courses: Sequence[int], rng: np.random.Generator) -> np.ndarray:
    """Series (B, K, C) of drives with such leftovers and weights of bins `mask` (B, K, C); drives of one course (B,)
    share as much as replicates do."""
    count = len(courses)
    own, common = (rng.standard_normal((size, *mask.shape[1:])) for size in (count, max(courses) + 1))
    white = np.sqrt(1 - left.shared) * own + np.sqrt(left.shared) * common[list(courses)]
    out = np.einsum("ij,bkj->bki", np.linalg.inv(left.whitener.inverse), white)
    for k in range(out.shape[1]):
        for lag, matrix in enumerate(left.whitener.coefficients[:k], start=1):
            out[:, k] += out[:, k - lag] @ matrix.T
    return np.where(mask > 0, out * left.whitener.scale / np.where(mask > 0, mask, 1.0), 0.0)


def _table(motions: Sequence[Any]) -> Measured:
    """Poses and odometry of trials or predictions in padded tables."""
    pose, odometry = (padded([getattr(one, name) for one in motions], width)[1:]
                      for name, width in (("ground_truth", 3), ("odometry", 5)))
    if all(one.gyro is None for one in motions):
        return Measured(*pose, *odometry)
    return Measured(*pose, *odometry, *padded([one.gyro for one in motions], 1)[1:])


def _from_table(path: Path, table: Mapping[str, Any]) -> FitStatistics:
    """The checked section of a file; ValueError names the field whose length is wrong."""
    known = channel_names(len(CHANNELS) + (GYRO in table["channels"]))
    channels, names = len(known), tuple(table["parameters"])
    shapes = {"scale": (channels,), "memory": (-1, channels, channels), "inverse": (channels, channels),
              "factors": (len(ROUGH) + 1, channels), "standard_error": (len(names),),
              "correlation": (len(names), len(names))}
    arrays = {}
    for name, shape in shapes.items():
        values = np.array(table[name], float)
        step = int(np.prod([one for one in shape if one > 0]))
        if values.size % max(step, 1) or (-1 not in shape and values.size != step):
            raise ValueError(f"{path}: statistics.{name} has {values.size} numbers; {step} are needed for {channels} "
                             f"channels and {len(names)} parameters. Fit the vehicle again.")
        arrays[name] = values.reshape(shape)
    unknown = [name for name in table["channels"] if name not in known]
    if unknown:
        raise ValueError(f"{path}: statistics.channels has {shown(unknown[0])} (known: "
                         f"{', '.join((*CHANNELS, GYRO))}). Fit the vehicle again.")
    if abs(np.linalg.det(arrays["inverse"])) < 1e-12:
        raise ValueError(f"{path}: statistics.inverse is a singular matrix. Fit the vehicle again.")
    whitener = Whitener(arrays["scale"], arrays["memory"], arrays["inverse"])
    left = Leftovers(table["drives"], table["bin"], tuple(table["channels"]), whitener, arrays["factors"],
                     table["shared"])
    return FitStatistics(names, arrays["standard_error"], arrays["correlation"], left)


def _round(value: float) -> float:
    return float(f"{value:.{DIGITS}g}")


def _list(values: np.ndarray) -> list[float]:
    return [_round(float(value)) for value in values.ravel()]

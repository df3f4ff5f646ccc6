"""Effects beside other forms of each other.

No vehicle follows the catalogue's laws exactly. What such a law leaves is again the effect's own signature, only larger
or smaller with speed, turning, time or manoeuvre, or earlier or later. Every effect may therefore have another form,
whose columns have a prior of `Thresholds.form` times its size (Kennedy and O'Hagan 2001). What these explain, no
further effect is needed for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sysid.missing.joint_fit import Refit
from sysid.missing.refit import Refitter, without_each
from sysid.verdict.agreement import log_densities, solved

MOST = 2.0  # largest size of a modulation: it is 1 at the 90 % quantile of the speed
QUANTITIES = (("speed", "m/s"), ("yaw rate", "rad/s"), ("time in the drive", "s"))  # that forms may depend on
POINTS = 41  # points of a curve over one of them
CONFIDENCE = 1.96  # standard deviations to the ends of a 95 % band


@dataclass(frozen=True)
class Motion:
    """What drives cover of each of `QUANTITIES`."""

    ends: np.ndarray  # (3, 2)
    scale: np.ndarray  # (3,)
    middle: np.ndarray  # (3,) where it counts as 0


@dataclass(frozen=True)
class Deviation:
    """How much larger than by its law an effect is, over one quantity."""

    quantity: str
    unit: str
    at: np.ndarray  # (G,)
    share: np.ndarray  # (G,) of the size of the effect
    error: np.ndarray  # (G,) standard deviations

    def report(self) -> dict[str, Any]:
        """The curve for report.json, with its 95 % band."""
        low, high = self.share - CONFIDENCE * self.error, self.share + CONFIDENCE * self.error
        return {"quantity": self.quantity, "unit": self.unit, "at": self.at.tolist(), "share": self.share.tolist(),
                "low": low.tolist(), "high": high.tolist()}


@dataclass(frozen=True)
class Forms:
    """A joint fit of M effects whose forms may be others. Base parameters and sizes move linearly around the fit."""

    target: np.ndarray  # (n,) white residual, and what base parameters moved by
    base: np.ndarray  # (n, P) columns of the base parameters
    sizes: tuple[np.ndarray, ...]  # per effect (n, k): columns of its coordinates
    changes: tuple[np.ndarray, ...]  # per effect (n,): what it changes altogether
    bent: tuple[np.ndarray, ...]  # per effect (n, m): the same in other forms, together as large as it is
    precision: np.ndarray  # (P, P) of the base parameters
    shape: tuple[int, ...]  # (B, n / B) of the residual
    units: tuple[float, ...]  # per effect: factor on its modulations that makes them together as large as it is
    centres: tuple[np.ndarray, ...]  # per effect (7,): means of the modulations by `QUANTITIES`, where it acts
    motion: Motion

    def left(self, form: float) -> np.ndarray:
        """(B, n / B) what is left where all effects may have other forms, of size `form` beside what each changes."""
        columns = [self.base, *self.sizes]
        solution, design = self._solved(columns, self.bent, form, self.target)
        return (self.target - design @ solution).reshape(self.shape)

    def gain(
        self, form: float, number: int, groups: Sequence[Sequence[int]], noise: float = 1.0
    ) -> tuple[float, np.ndarray]:
        """By how much one of the effects, in the form of its law, lowers the cost beside other forms of the others; and
        by how much it raises the log density of each manoeuvre (G,), as all others predict it. `noise`: variance of the
        white residual. The effect is taken away whole: columns around its size say little of a dead zone without it."""
        target = self.target + self.changes[number]
        others = [one for i, one in enumerate(self.sizes) if i != number]
        bent = [one for i, one in enumerate(self.bent) if i != number]
        costs, densities = [], []
        for mine in ([], [self.changes[number][:, None]]):
            columns = [self.base, *others, *mine]
            solution, design = self._solved(columns, bent, form, target)
            costs.append(float(target @ target - target @ design @ solution))
            densities.append(log_densities(design, self._prior(columns, bent, form), target.reshape(self.shape), groups,
                                           noise))
        return max(costs[0] - costs[1], 0.0), densities[1] - densities[0]

    def deviations(self, form: float, number: int, noise: float = 1.0) -> list[Deviation]:
        """How far one of the effects is off the catalogue's law over speed, yaw rate and time, of its mean size;
        `noise`: variance of the white residual."""
        columns, before = [self.base, *self.sizes], sum(one.shape[1] for one in self.bent[:number])
        solution, design = self._solved(columns, self.bent, form, self.target)
        covariance = solved(design.T @ design + self._prior(columns, self.bent, form), np.eye(design.shape[1])) * noise
        start = first = sum(one.shape[1] for one in columns) + before
        out = []
        for (name, unit), (low, high), scale, middle in zip(
                QUANTITIES, self.motion.ends, self.motion.scale, self.motion.middle, strict=True):
            at = np.linspace(low, high, POINTS)
            basis = shapes((at - middle) / scale, name)
            index = slice(first, first + basis.shape[-1])
            basis = self.units[number] * (basis - self.centres[number][first - start : index.stop - start])
            error = np.sqrt(np.einsum("ij,jk,ik->i", basis, covariance[index, index], basis))
            out.append(Deviation(name, unit, at, basis @ solution[index], error))
            first = index.stop
        return out

    def _prior(self, plain: Sequence[np.ndarray], bent: Sequence[np.ndarray], form: float) -> np.ndarray:
        """(F, F) precision of the columns."""
        sizes = [sum(one.shape[1] for one in each) for each in (plain, bent)]
        prior = np.diag(np.repeat([0.0, form**-2], sizes))
        prior[: len(self.precision), : len(self.precision)] = self.precision
        return prior

    def _solved(self, plain: Sequence[np.ndarray], bent: Sequence[np.ndarray], form: float, target: np.ndarray
                ) -> tuple[np.ndarray, np.ndarray]:
        """Coefficients (F,) of least cost, and the columns (n, F)."""
        design = np.concatenate([*plain, *bent], axis=1)
        return solved(design.T @ design + self._prior(plain, bent, form), design.T @ target), design


def forms_of(refitter: Refitter, fit: Refit, groups: Sequence[Sequence[int]]) -> Forms:
    """Other forms of the effects of a joint fit; `groups` has the trials of each manoeuvre."""
    whole, *less = refitter.drives.simulate(np.stack([fit.values, *without_each(fit, refitter)]))
    motion = motion_of(whole, refitter.drives.features.width)
    changes = [refitter.white(whole - one) for one in less]
    bent = [refitter.white(modulated(whole - one, whole, groups)) for one in less]
    units = [float((np.square(change).sum() / max(np.square(one).sum(), 1e-12)) ** 0.5)
             for one, change in zip(bent, changes, strict=True)]
    energy = [np.square(change).reshape(whole.shape).sum(-1) for change in changes]  # (B, K)
    centres = [np.einsum("bk,bkm->m", one, factors_of(whole)) / max(float(one.sum()), 1e-12) for one in energy]
    size, count = len(fit.u), fit.residual.size
    columns = fit.jacobian.reshape(count, -1)
    target = fit.residual.reshape(-1) + columns[:, :size] @ (fit.u - refitter.reference.u)
    return Forms(target, columns[:, :size], tuple(columns[:, size + one.start : size + one.stop] for one in fit.parts),
                 tuple(one.reshape(-1) for one in changes),
                 tuple(unit * one.reshape(count, -1) for unit, one in zip(units, bent, strict=True)),
                 refitter.precision, fit.residual.shape, tuple(units), tuple(centres), motion)


def motion_of(features: np.ndarray, width: float = 1.0) -> Motion:
    """Ranges of the features (B, K, C) of drives, in bins of `width` [s]."""
    speeds = features[..., :2].reshape(-1, 2)
    scale = np.maximum(np.quantile(np.abs(speeds), 0.9, axis=0), 1e-6)
    end = features.shape[1] * width
    ends = np.concatenate([np.quantile(speeds, [0.01, 0.99], axis=0).T, [[0.0, end]]])
    return Motion(ends, np.append(scale, end / 2), np.array([0.0, 0.0, end / 2]))


def shapes(x: np.ndarray, quantity: str) -> np.ndarray:
    """(..., m) functions of a scaled quantity (...) by which an effect may be larger or smaller than its law says."""
    parts = (x,) if quantity == "time in the drive" else (x, np.abs(x), x**2)
    return np.stack([np.clip(one, -MOST, MOST) for one in parts], -1)


def factors_of(features: np.ndarray) -> np.ndarray:
    """(B, K, 7) functions of `QUANTITIES` in drives with these features (B, K, C)."""
    v, omega = np.moveaxis(features[..., :2] / motion_of(features).scale[:2], -1, 0)
    time = np.broadcast_to(np.linspace(-1.0, 1.0, v.shape[1]), v.shape)
    return np.concatenate([shapes(one, name) for one, (name, _) in zip((v, omega, time), QUANTITIES, strict=True)], -1)


def modulated(change: np.ndarray, features: np.ndarray, groups: Sequence[Sequence[int]]) -> np.ndarray:
    """What an effect changes, `change` (B, K, C), in other forms (B, K, C, m): in proportion to functions of `features`
    (B, K, C) and of time, of a size of its own in each manoeuvre, and shifted in time."""
    manoeuvres = [np.isin(np.arange(len(change)), group)[:, None, None] * np.ones((*change.shape[:2], 1))
                  for group in groups]
    early, late = np.zeros_like(change), np.zeros_like(change)
    early[:, :-1], late[:, 1:] = change[:, 1:], change[:, :-1]
    shifted = np.stack([(early - late) / 2, early + late - 2 * change], -1)
    factors = np.concatenate([factors_of(features), *manoeuvres], -1)[:, :, None]
    return np.concatenate([change[..., None] * factors, shifted], -1)

"""Groups of sizes that keep their stated values, since drives that are held back are predicted as well so.

The method is in docs/fit_method.md, section 7. Source: Stone (1974), cross-validatory choice.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from sysid.errors.pose_objective import DriveResiduals, Objective
from sysid.errors.prior import expected_sd
from sysid.errors.space import Space, robust_loss
from sysid.intervals.independence import Information
from sysid.intervals.uncertainty import PIECES, Uncertainty
from sysid.search import least_squares
from sysid.search.gauss_newton import BoxStep
from sysid.search.slopes import AT_ONCE
from whill_mjx.io.steps import step

GROUPS = {
    "wheel radii": ("wheel_radius_difference.common", "wheel_radius_difference.difference", "wheels.radius",
                    "wheels.difference"),
    "track": ("track_width.error", "wheels.track"),
    "scales of the odometry": ("odometry_scale.linear", "odometry_scale.angular"),
    "tracked point": ("pose_mount.x", "pose_mount.y", "pose_mount.yaw"),
}  # fmt: skip
"""What is measured in one way, and so known or unknown together."""
DAMPING = 1e-3
ITERATIONS = 15
LARGEST = 1e30  # error of a replay that diverged


@dataclass(frozen=True)
class Choice:
    """Groups that keep their stated sizes, and where that leads."""

    names: tuple[str, ...]  # of `GROUPS`
    u: np.ndarray  # (P,)
    cost: float


def chosen_sizes(
    objective: DriveResiduals, poses: Objective, known: Uncertainty, cost: float, kept: Sequence[str] = (),
    robust: bool = True,
) -> Choice:
    """The point (P,) at which only those groups differ from what was stated that the drives need.

    The search ended on `objective`, at `cost`; `known` has errors and information of each drive there, `poses` the
    errors of their whole poses. A person chose to fit what is `kept`.
    """
    space, evidence, u = objective.space, known.evidence, known.evidence.u
    free = set(kept) | contradicted(known, space)
    groups = {group: some for group, names in GROUPS.items()
              if (some := set(names) & set(space.names)) and not some & free}
    options = [tuple(one) for count in range(len(groups), -1, -1) for one in combinations(groups, count)]
    held = np.array([[any(name in groups[group] for group in one) for name in space.names] for one in options])
    follow = _Follow(objective, evidence, space.to_unit(space.initial))
    left = _held_back(follow, poses, held, robust) if groups else np.zeros((1, 1))
    left = np.where(np.isfinite(left), left, LARGEST)  # a replay that diverged
    best = simplest(np.log(np.clip(left, 1e-300, LARGEST)), held.sum(1))  # noise of a manoeuvre has a size of its own
    if not held[best].any():
        return Choice((), u, cost)
    names = tuple(name for name, one in zip(space.names, held[best], strict=True) if one)
    begin = follow(held[best], np.ones(evidence.scores.shape[:2], bool))
    found = least_squares.fit(objective, starts=begin[None], stop=least_squares.Stopping(ITERATIONS), robust=robust,
                              frozen=names)
    return Choice(options[best], found.u, found.cost)


def contradicted(known: Uncertainty, space: Space) -> set[str]:
    """Parameters that are more likely free than as stated, by posterior over prior density there (Savage and Dickey;
    Dickey, 1971); the prior is as wide as data sheets are usually off."""
    away = np.square((known.evidence.u - space.to_unit(space.initial)) / known.deviation)
    wider = np.square(expected_sd(space) / known.deviation)  # the prior, beside the errors
    free = away * wider / (1 + wider) > np.log(1 + wider)
    return {name for name, one in zip(space.names, free, strict=True) if one}


def simplest(errors: np.ndarray, held: np.ndarray) -> int:
    """The option that holds most and whose mean error is within a standard error of the least (Breiman et al., 1984).

    From errors (G, O) of G manoeuvres and O options that hold `held` (O,) parameters. The variance of gains by the best
    option is twice the mean square of those below 0: what a right size gains in a single manoeuvre is no noise.
    """
    mean = errors.mean(0)
    gains = errors - errors[:, [mean.argmin()]]
    noise = np.sqrt(2 * np.square(np.minimum(gains, 0.0)).mean(0) / len(gains))
    near = gains.mean(0) <= noise
    return int(np.lexsort((mean, -held, ~near))[0])


@dataclass(frozen=True)
class _Follow:
    """Where the minimum lies when some drives are left out and some parameters keep their stated value."""

    objective: DriveResiduals
    evidence: Information
    stated: np.ndarray  # (P,)

    def __call__(self, held: np.ndarray, fitted: np.ndarray) -> np.ndarray:
        """The point (P,) with `held` (P,) parameters as stated, by the `fitted` (B, PIECES) pieces of drives."""
        one, prior = self.evidence, self.objective.prior
        hessian = (one.blocks * fitted[..., None, None]).sum((0, 1)) + one.precision
        gradient = (one.scores * fitted[..., None]).sum((0, 1))
        if prior is not None:
            gradient = gradient + one.precision @ (one.u - prior.mean)
        base = np.where(held, self.stated, one.u)
        gradient = gradient + hessian @ (base - one.u)
        box = BoxStep(free=~held, move=self.objective.space.moved, reach=1.0)
        return box.points(base[None], gradient, hessian, DAMPING)[0]


def _folds(evidence: Information) -> np.ndarray:
    """(B, PIECES) number of the part that each piece is held back with: a manoeuvre, a drive, or half of one."""
    drives = len(evidence.groups)
    numbers = evidence.groups if len(np.unique(evidence.groups)) > 1 else np.arange(drives)
    if drives > 1:
        return np.repeat(numbers[:, None], PIECES, axis=1)
    return np.arange(PIECES)[None] * 2 // PIECES


def _held_back(follow: _Follow, poses: Objective, held: np.ndarray, robust: bool) -> np.ndarray:
    """(G, O) squared errors of whole poses in each part of the drives that is held back, of options `held` (O, P)."""
    folds = _folds(follow.evidence)
    numbers = np.unique(folds)
    points = np.stack([[follow(one, folds != number) for one in held] for number in numbers])  # (G, O, P)
    poses = replace(poses, prior=None)

    def compute() -> list[np.ndarray]:
        return [_errors(poses, points.reshape(-1, held.shape[1]), robust)]

    (errors,) = step("held back", compute, points)
    errors = errors.reshape(*points.shape[:2], *folds.shape)
    return np.stack([(errors[k] * (folds == number)).sum((1, 2)) for k, number in enumerate(numbers)])


def _errors(poses: Objective, points: np.ndarray, robust: bool) -> np.ndarray:
    """(N, B, PIECES) squared errors of whole poses in pieces of drives, at points (N, P)."""
    samples = poses.measured.pose[..., 0].size * 3 + poses.measured.odometry[..., 0].size * 5
    piece, found, together = poses.pieces(PIECES), [], max(AT_ONCE // max(samples, 1), 1)
    for first in range(0, len(points), together):
        residual = poses.residuals(points[first : first + together])
        label = np.pad(piece, (0, residual.shape[2] - len(piece)))  # errors of the start belong to the first piece
        loss = robust_loss(residual, robust)
        found.append(np.stack([loss[:, :, label == k].sum(-1) for k in range(PIECES)], axis=-1))
    return np.concatenate(found)

"""Sizes that a log does not contradict stay as stated.

A fit frees what a first calibration finds: sizes of the wheels, scales of the odometry, the tracked point. Where their
estimates lie within their own errors of what data sheet and rulers say, those errors are all that they would add, and
every other parameter bends to fit them. So a group of them that does not differ from what was stated, by a Wald test
with the covariance of the fit as wide as its intervals, goes back to it, and the others follow.
"""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2

from sysid.errors.pose_objective import Told
from sysid.errors.prior import QUANTILE
from sysid.intervals.uncertainty import Uncertainty
from sysid.search import least_squares

GROUPS = (
    ("wheel_radius_difference.common", "wheel_radius_difference.difference", "track_width.error", "wheels.radius",
     "wheels.difference", "wheels.track"),
    ("odometry_scale.linear", "odometry_scale.angular"),
    ("pose_mount.x", "pose_mount.y", "pose_mount.yaw"),
)  # fmt: skip
"""What is measured in one way, and so known or unknown together."""
LEVEL = 0.05
"""Significance at which a group differs from what was stated."""
ITERATIONS = 10


def not_different(known: Uncertainty, names: tuple[str, ...], u: np.ndarray, stated: np.ndarray) -> list[int]:
    """Places of the parameters of all groups that do not differ from what was stated, alone and together.

    Args:
        known: uncertainty at the fitted point, for its covariance in unit coordinates.
        names: of all parameters (P,).
        u, stated: (P,) fitted and stated unit coordinates.
    """

    wide = known.quantile * known.deviation / QUANTILE  # as the intervals are: few drives know their own errors badly
    scale = wide / np.sqrt(np.maximum(np.diag(known.covariance), 1e-300))

    def share(places: list[int]) -> float:
        """Chance of so large a difference, or a larger one, where there is none."""
        away = (u - stated)[places] / scale[places]
        covariance = known.covariance[np.ix_(places, places)]
        return float(chi2.sf(away @ np.linalg.lstsq(covariance, away, rcond=None)[0], len(places)))

    groups = [[names.index(name) for name in group if name in names] for group in GROUPS]
    found: list[int] = []
    for places in sorted((one for one in groups if one), key=share, reverse=True):
        if share([*found, *places]) > LEVEL:
            found = [*found, *places]
    return found


def as_stated(
    objective: Told, u: np.ndarray, known: Uncertainty, kept: tuple[str, ...], robust: bool
) -> tuple[np.ndarray, tuple[str, ...]]:
    """The fitted point (P,) with what does not differ from its stated size in that place, and the names of that.

    Args:
        objective: what the search ended on.
        u: (P,) where it ended.
        known: its uncertainty there.
        kept: parameters that a person chose to fit.
        robust: whether large residuals count linearly.
    """
    space = objective.space
    stated = space.to_unit(space.initial)
    names = tuple("" if name in kept else name for name in space.names)
    places = not_different(known, names, u, stated)
    if not places:
        return u, ()
    away = (stated - u)[places]
    covariance = known.covariance
    moved = covariance[:, places] @ np.linalg.lstsq(covariance[np.ix_(places, places)], away, rcond=None)[0]
    begin = np.clip(u + moved, 0.0, 1.0)
    begin[places] = stated[places]
    held = tuple(space.names[place] for place in places)
    found = least_squares.fit(
        objective, space, starts=begin[None], iterations=ITERATIONS, robust=robust, frozen=held
    ).u  # fmt: skip
    return found, held

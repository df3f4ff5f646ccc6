"""What is known of a vehicle before its log is fitted: the bounds of its parameters, or a vehicle file.

A normal distribution as wide as the bounds keeps a parameter of which a log says next to nothing from drifting.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from flax import struct

from sysid.errors.space import Space

SPREAD = 0.05  # assumed day-to-day standard deviation of a parameter, as a share of its value; printed with the fit
LEAST = 0.003  # of the range: what no parameter is known better than
UNKNOWN = 0.29  # of the range: standard deviation of a parameter of which only its bounds are known (uniform)
EXPECTED = {
    "wheel_radius_difference.common": 0.03, "wheel_radius_difference.difference": 0.02, "track_width.error": 0.05,
    "wheels.difference": 0.02, "odometry_scale.linear": 0.03, "odometry_scale.angular": 0.05,
    "pose_mount.x": 0.2, "pose_mount.y": 0.2, "pose_mount.yaw": 0.2, "gyro_bias.bias": 0.02, "gyro_bias.scale": 0.02,
}
"""How far data sheets, rulers and hand-drawn markers are usually off (standard deviations), if bounds say less."""
RELATIVE = {"wheels.radius": 0.03, "wheels.track": 0.05}  # the same as shares of what a robot file says
QUANTILE = 1.645  # of the normal distribution, of the 90 % intervals in vehicle files


@struct.dataclass
class Prior:
    """Normal distribution of the unit coordinates."""

    mean: np.ndarray  # (P,)
    sd: np.ndarray  # (P,)
    share: float = 1.0  # factor on its precision: autocorrelated residuals count more often than their information

    def residual(self, u: np.ndarray) -> np.ndarray:
        """(N, P) of unit coordinates (N, P), to be squared."""
        return (u - self.mean) * self.slope

    @property
    def slope(self) -> np.ndarray:
        """(P,) derivative of the residual."""
        return self.share**0.5 / self.sd

    @property
    def precision(self) -> np.ndarray:
        """(P, P), as it is weighed."""
        return np.diag(self.slope**2)


def bounds_alone(space: Space) -> Prior:
    """Nothing but the bounds is known: as wide as a uniform distribution within them; or as `EXPECTED` has it."""
    sd = expected_sd(space)
    return Prior(np.where(sd < UNKNOWN, space.to_unit(space.initial), 0.5), sd)


def expected_sd(space: Space) -> np.ndarray:
    """(P,) standard deviations in unit coordinates of what is known of parameters before any drive."""
    width = space.high - space.low
    sizes = np.array([EXPECTED.get(name, np.inf) for name in space.names])
    for i, name in enumerate(space.names):
        sizes[i] = RELATIVE[name] * abs(space.initial[i]) if name in RELATIVE else sizes[i]
    return np.minimum(sizes / width, UNKNOWN)


def make_prior(space: Space, intervals: Mapping[str, tuple[float, float]], spread: float = SPREAD) -> Prior:
    """Prior around the space's initial values: a parameter with an interval is known that well, and may differ by
    `spread` of its value on another day; of the others only the bounds are known."""
    mean = space.to_unit(space.initial)
    slope = np.maximum(space.slope(mean), 1e-12)
    sd = expected_sd(space)
    for i, name in enumerate(space.names):
        if name in intervals:
            low, high = intervals[name]
            known = (high - low) / (2 * QUANTILE) / slope[i]
            size = abs(space.initial[i]) if space.initial[i] else space.high[i] - space.low[i]
            sd[i] = np.clip(np.hypot(known, spread * size / slope[i]), LEAST, UNKNOWN)
    return Prior(mean, sd)


def moved(prior: Prior, space: Space, u: np.ndarray) -> list[dict[str, Any]]:
    """How far each parameter went from where it was, in standard deviations, and whether that is within 90 %."""
    before, after, distance = space.to_values(prior.mean), space.to_values(u), (u - prior.mean) / prior.sd
    return [{"name": name, "before": float(before[i]), "after": float(after[i]), "deviations": float(distance[i]),
             "within": bool(abs(distance[i]) <= QUANTILE)} for i, name in enumerate(space.names)]

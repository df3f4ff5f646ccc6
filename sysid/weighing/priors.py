"""Prior beliefs of the verdict, frozen before the logs that judge it were looked at."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

Weighted = tuple[tuple[float, float], ...]
"""Values and their prior weights."""


@dataclass(frozen=True)
class Priors:
    """What is believed before a log is seen. Sizes are in standard deviations of the reference noise."""

    freedom: float = 6.0
    """Degrees of freedom of the common noise variance."""
    noise_range: tuple[float, float] = (0.3, 8.0)
    """Noise of a channel over that of the reference."""
    colour: Weighted = ((0.0, 0.6), (0.1, 0.25), (0.4, 0.1), (1.5, 0.04), (6.0, 0.01))
    """Variance of correlated noise over that of white noise."""
    colour_time: float = 1.0
    """Correlation time of that noise [s]."""
    calm: float = 0.1
    """Most of it that may go with a named set: more is something unexplained."""
    day: Weighted = ((0.0, 0.5), (0.15, 0.35), (0.5, 0.15))
    """Amplitude of what a day adds to all drives of a manoeuvre."""
    day_bumps: int = 10
    """Smooth functions of time for it."""
    wander: Weighted = ((0.0, 0.3), (0.3, 0.4), (1.0, 0.3))
    """Factor on the day-to-day covariance of apparent effects."""
    wander_most: float = 25.0
    """Largest variance of a combination."""
    size: float = 3.0
    """Scale of an effect's coordinates."""
    reach: float = 0.3
    """How far sizes may be from where a set was linearised, as a share of them."""
    dependent: float = 1.5
    """The same of coordinates that only shape an effect."""
    form: Weighted = ((0.1, 0.5), (0.3, 0.5))
    """Standard deviation of the error of an effect's form, as a share of its response."""
    kernel: Weighted = ((0.3, 0.34), (1.0, 0.33), (4.0, 0.33))
    """Amplitude of a smooth unknown."""

    def settings(self, calm: bool) -> list[Setting]:
        """All combinations of noise colour, day and wander."""

        colours = [one for one in self.colour if not calm or one[0] <= self.calm]
        return [Setting(colour, day, wander, float(np.log(a * b * c)))
                for (colour, a), (day, b), (wander, c) in product(colours, self.day, self.wander)]


DEFAULT = Priors()


@dataclass(frozen=True)
class Setting:
    """Hyperparameters of the noise and of the day, and the log of their prior weight."""

    colour: float
    day: float
    wander: float
    weight: float

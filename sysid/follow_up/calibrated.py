"""What a p-value of the search comes to where nothing is missing.

It assumes that drives differ from the reference days as these do from each other. Real days do so only roughly: small
values come too often, and those that a refit takes back end at 1. On logs of an independent plant with nothing in them
they follow a Beta distribution (`python -m benchmarks.undeclared --calibrate` fits it), whose distribution function
makes them uniform there. It decides nothing: verdicts go by the p-values of the search.
"""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

from scipy import stats

FILE = Path(__file__).parents[1] / "data/null_p.json"
"""The shape of the distribution, and the logs that it rests on."""


def calibrated(p: float) -> float:
    """Share of days with nothing missing on which the search has a p-value as small as this one."""
    return float(stats.beta.cdf(p, *shape()))


@cache
def shape() -> tuple[float, float]:
    """a and b of the Beta distribution that p-values follow where nothing is missing; 1 and 1 would be uniform."""
    content = json.loads(FILE.read_text())
    return float(content["a"]), float(content["b"])

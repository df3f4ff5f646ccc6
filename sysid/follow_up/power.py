"""What these very drives can show, on simulated days: false alarms, power, and what a p-value of the search comes to.

Linear, like the scan: `--refit-nulls` measures the false alarms of the whole procedure. Real days differ only roughly
as the reference days do, so small p-values come too often. On logs of an independent plant with nothing in them they
follow a Beta distribution (`benchmarks.undeclared --calibrate`), which `calibrated` takes off. It decides nothing.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from scipy import stats

from sysid.intervals.statistics import upper_rate
from sysid.missing.catalogue import Hypothesis
from sysid.missing.days import Wander
from sysid.missing.evidence import Columns, Evidence, Solver
from sysid.verdict.scan import NullDays, worth_on
from sysid.verdict.search_record import Scan, family, tails

DRAWS = 200
SEED = 3  # beside that of the scan's nulls
POWER = 0.8
REACH, HALVINGS = 8.0, 7  # range of factors around a first guess, and how often it is halved
FACTORS = (0.25, 0.5, 1.0, 2.0)  # sizes of a named effect, over the fitted one, whose power is reported


Effect = tuple[Columns, np.ndarray]  # columns of a hypothesis and its coordinates (k,)


@dataclass(frozen=True)
class Days:
    """Simulated days on which nothing is missing, seen through the columns of the scan."""

    evidence: Evidence
    hypotheses: Sequence[Hypothesis]
    wander: Wander
    scan: Scan  # that was run on this evidence
    nulls: NullDays

    def p(self, effects: Sequence[Effect] = ()) -> np.ndarray:
        """(E, N) p-values of "nothing is missing", with one of the effects in every day; (1, N) of the days alone."""
        products, draws = self.evidence.products.sum(0), len(self.nulls.moments)
        added = np.stack([products[:, list(columns.index)] @ q for columns, q in effects]) if effects else np.zeros(
            (1, len(products)))
        moments = (added[:, None] + self.nulls.moments).reshape(-1, len(products))
        days = NullDays(moments, np.tile(self.nulls.share, (len(added), 1)))
        worth = worth_on(days, Solver(self.evidence), self.hypotheses, self.wander)
        smallest = tails(self.scan.null, worth).min(1)
        return family(self.scan.smallest, smallest).reshape(-1, draws)

    def noticed(self, alpha: float, effects: Sequence[Effect]) -> list[float]:
        """Of each effect the share of days on which something counts as missing."""
        return [float(np.mean(p < alpha)) for p in self.p(effects)] if effects else []

    def nearest(self, hypothesis: int, size: float) -> Columns:
        """The columns of a hypothesis that were simulated nearest to a size."""
        mine = [one for one in self.evidence.columns if one.hypothesis == hypothesis]
        return min(mine, key=lambda one: abs(one.level - size))


def false_alarms(days: Days, alpha: float) -> dict[str, float]:
    """`count` of days, `alarms` among them, their `rate` and its `upper` 95 % bound."""
    [p] = days.p()
    alarms = int((p < alpha).sum())
    return {"count": len(p), "alarms": alarms, "rate": alarms / len(p), "upper": upper_rate(alarms, len(p))}


def power_curve(days: Days, hypothesis: int, q: np.ndarray, alpha: float) -> list[dict[str, float]]:
    """`noticed`: share of days on which an effect would be missed from the model, at each `factor` on its size."""
    columns = days.nearest(hypothesis, float(np.abs(q).max()))
    noticed = days.noticed(alpha, [(columns, factor * q) for factor in FACTORS])
    return [{"factor": factor, "noticed": share} for factor, share in zip(FACTORS, noticed, strict=True)]


def smallest(days: Days, alpha: float, effects: Sequence[Effect]) -> list[tuple[float, float]]:
    """Of each effect the factor on its size (within `REACH`) at which it is noticed with 80 % power, and its power."""
    low, high = np.full(len(effects), 1 / REACH), np.full(len(effects), REACH)
    power = np.ones(len(effects))
    for number in range(HALVINGS + 1):
        factor = high if number == HALVINGS else np.sqrt(low * high)
        sized = [(columns, k * q) for k, (columns, q) in zip(factor, effects, strict=True)]
        power = np.array(days.noticed(alpha, sized))
        if number < HALVINGS:
            low, high = np.where(power < POWER, factor, low), np.where(power < POWER, high, factor)
    return [(float(factor), float(share)) for factor, share in zip(high, power, strict=True)]


FILE = Path(__file__).parents[1] / "data/null_p.json"  # the shape of the distribution, and the logs that it rests on


def calibrated(p: float) -> float:
    """Share of days with nothing missing on which the search has a p-value as small as this one."""
    return float(stats.beta.cdf(p, *shape()))


@cache
def shape() -> tuple[float, float]:
    """a and b of the Beta distribution that p-values follow where nothing is missing; 1 and 1 would be uniform."""
    content = json.loads(FILE.read_text())
    return float(content["a"]), float(content["b"])

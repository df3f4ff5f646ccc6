"""What a loop's drives could show: false alarms, power and smallest sizes, on simulated days."""

from __future__ import annotations

from typing import Any

import numpy as np

from sysid.follow_up.power import DRAWS, POWER, SEED, Days, false_alarms, power_curve, smallest
from sysid.missing.catalogue import base_values
from sysid.missing.evidence import Evidence, Solver, at_fit
from sysid.verdict.found import EFFORT
from sysid.verdict.result import Result
from sysid.verdict.scan import null_days
from whill_mjx.effects import about_of


def new_days(result: Result) -> Days:
    """Days on which nothing is missing, simulated anew for these drives."""
    evidence, wander = scanned(result), result.prepared.wander
    nulls = null_days(evidence, result.reference.spread, wander, DRAWS,
                      np.random.default_rng((result.config.seed, SEED)))
    return Days(evidence, result.hypotheses, wander, result.search.scan, nulls)


def scanned(result: Result) -> Evidence:
    """The evidence that the scan was run on: around the base model refitted to these drives."""
    base = result.search.base
    return at_fit(result.evidence, base.residual, base.jacobian[..., : len(base.u)], base.u - result.reference.u)


def operating(result: Result, days: Days) -> dict[str, Any]:
    """False alarms and power of these very drives, on simulated days."""
    found, alpha = result.search, result.config.thresholds.alpha
    power = []
    if found.verdict == "named":
        kept = {one.hypothesis.key for one in found.accepted}
        for one, q in zip(found.final.hypotheses, found.final.split, strict=True):
            if one.key in kept:
                number = result.hypotheses.index(one)
                power.append({"effect": one.effect, "sizes": power_curve(days, number, q, alpha)})
    return {"alpha": alpha, "decisions": EFFORT.rounds + 2, "days": "simulated, linear",
            "false_alarms": false_alarms(days, alpha), "power": power}


def detectable(result: Result, days: Days) -> list[dict[str, Any]]:
    """Smallest size of each effect that these drives would show with 80 % power, in its parameters' units, and the
    share of simulated days on which the scan notices it there. The verdict asks for more where days differ by more."""
    found, priors = result.search, result.config.thresholds
    least = 0.0 if found.findings is None else found.findings.least_gain(priors)
    limit = float(np.quantile(found.scan.null.max(1), 1 - priors.alpha))
    solver = Solver(result.evidence)
    base = base_values(result.full)
    done, tried, enough = set(), [], []
    for columns, wander in zip(result.evidence.columns, result.prepared.wander.covariance, strict=True):
        one = result.hypotheses[columns.hypothesis]
        for position, (axis, index) in enumerate(zip(one.axes, columns.index, strict=True)):
            information = float(solver.information((index,))[0, 0])
            q = (np.sqrt(limit) + 0.84) * np.sqrt(1 / information + wander[position, position])
            q = max(q, (np.sqrt(least) + 0.84) / np.sqrt(information))
            usable = axis.signed or q <= 1.6 * columns.level or columns.level >= 8.0
            if (one.key, axis.parameter) in done or not usable:
                continue
            done.add((one.key, axis.parameter))
            if axis.dependent:
                continue
            tried.append((one, axis, columns, np.array([q if other is axis else 0.0 for other in one.axes])))
            enough.append((np.sqrt(least) + 0.84) / np.sqrt(information) / q)
    shares = smallest(days, priors.alpha, [(columns, q) for _, _, columns, q in tried])
    out = []
    for (one, axis, _, q), (factor, power), weighed in zip(tried, shares, enough, strict=True):
        factor = max(factor, weighed)
        value, reach = one.values(factor * q, base)[axis.parameter], factor * q.max() <= axis.limit and power >= POWER
        out.append({"effect": one.effect, "parameter": axis.parameter, "value": value if reach else None,
                    "change": value - base[axis.parameter] if np.isfinite(base[axis.parameter]) and reach else None,
                    "unit": about_of(axis.parameter).unit, "power": power})
    return out

"""Tables of a loop's report: errors of its trials, evidence for the named effects, and what its drives could show."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from sysid.follow_up.power import DRAWS, POWER, SEED, Days, false_alarms, power_curve, smallest
from sysid.logs.metrics import METRICS, own_floor
from sysid.logs.records import Prediction, Trial
from sysid.missing.catalogue import base_values
from sysid.missing.evidence import Evidence, Solver, at_fit
from sysid.missing.joint_fit import Refit
from sysid.missing.signatures import group_names
from sysid.replay.rollout import predictions
from sysid.verdict.falsifiers import as_report as predictions_of
from sysid.verdict.forms import forms_of
from sysid.verdict.result import Result, Support
from sysid.verdict.scan import null_days
from sysid.verdict.search_record import ROUNDS
from sysid.verdict.vehicles import drives_of, fitted_after, fitted_before, refitter_of
from whill_mjx.effects import about_of
from whill_mjx.vehicle.parameters import describe, get_values

RESAMPLES = 2000


def replay(result: Result, vehicle: Any, trials: tuple[Trial, ...]) -> list[Prediction]:
    drives, values = drives_of(result, trials, vehicle)
    return predictions(trials, drives.replay(values[None]), 0)


def table(rows: list[dict[str, Any]], trials: tuple[Trial, ...], which: str) -> dict[str, Any]:
    """part -> channel -> metric -> mean RMSE, with the noise floor of the same trials."""
    out: dict[str, Any] = {"training": {}, "held_out": {}}
    floors = {part: own_floor(trials, part == "held_out") for part in out}
    for part, channel, mine in _parts(rows):
        means = {metric: [row["metrics"][metric][which] for row in mine if metric in row["metrics"]]
                 for metric in METRICS}
        out[part][channel] = {metric: float(np.mean(values)) for metric, values in means.items() if values}
        if floors[part] and mine:
            out[part][channel]["noise_floor"] = floors[part].get(channel)
    return out


def _parts(rows: list[dict[str, Any]]) -> Iterator[tuple[str, str, list[dict[str, Any]]]]:
    """Part, channel and their rows."""
    for part in ("training", "held_out"):
        for channel in dict.fromkeys(row["channel"] for row in rows):
            yield part, channel, [row for row in rows
                                  if row["channel"] == channel and row["held_out"] is (part == "held_out")]


def change(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Mean change of each RMSE, its interval from trials drawn anew, and the share of trials that got worse."""
    rng = np.random.default_rng(0)
    out: dict[str, Any] = {"training": {}, "held_out": {}}
    for part, channel, mine in _parts(rows):
        for metric in METRICS:
            pairs = np.array([[row["metrics"][metric]["initial"], row["metrics"][metric]["fitted"]]
                              for row in mine if metric in row["metrics"]])
            if len(pairs):
                difference = pairs[:, 1] - pairs[:, 0]
                draws = difference[rng.integers(0, len(pairs), (RESAMPLES, len(pairs)))].mean(1)
                out[part].setdefault(channel, {})[metric] = {
                    "mean": float(difference.mean()), "interval": np.quantile(draws, [0.025, 0.975]).tolist(),
                    "relative": float(difference.mean() / max(pairs[:, 0].mean(), 1e-12)),
                    "worse": int((difference > 0).sum()), "trials": len(pairs)}
    return out


def in_range(parameter: str, value: float, ends: Sequence[float]) -> dict[str, Any]:
    """An interval within a parameter's physical range, and which of its ends the drives leave `open`, as they allow
    values beyond that range. A value beyond it has an interval of its own."""
    about = about_of(parameter)
    known = [one for one in (about.low, about.high, about.neutral, value) if np.isfinite(one)]
    low, high = sorted(ends)
    least = low if value < about.low and np.isfinite(low) else min(known)
    most = high if value > about.high and np.isfinite(high) else max(known)
    return {"interval": [max(low, least), min(high, most)], "open": [low < least, high > most]}


def evidence_for(result: Result, part: slice, effect: str) -> dict[str, Any]:
    """What manoeuvres say of an effect by themselves, whether it predicts those left out, and its falsifiers."""
    one = next((one for one in result.stood if one.effect == effect), None) or Support.of(
        result.search.final, part, result.evidence.groups, result.evidence.precision, effect)
    agreement, names = one.agreement, group_names(result.log.training, result.evidence.groups)
    each = zip(names, one.sizes, one.errors, agreement.asked, strict=True)
    return {"left_out_gain": dict(zip(names, one.foretold.tolist(), strict=True)),
            "left_out_total": float(one.foretold.sum()), "left_out_interval": list(one.interval),
            "by_manoeuvre": [{"manoeuvre": name, "factor": float(size), "standard_error": float(error),
                              "asked": bool(asked)} for name, size, error, asked in each],
            "heterogeneity": {"q": agreement.q, "manoeuvres": int(agreement.asked.sum()), "p_value": agreement.p,
                              "scatter": agreement.scatter, "power": agreement.power, "outcome": agreement.outcome},
            "falsifiers": predictions_of(one.falsifiers)}


def form_curves(result: Result) -> dict[str, list[dict[str, Any]]]:
    """Effect -> curves of how far it is off its law (`forms.Deviation`). What its forms leave counts as noise."""
    found, form = result.search, result.config.thresholds.form
    if found.verdict != "named" or found.findings is None:
        return {}
    final, variants = found.final, tuple(one.key for one in found.final.hypotheses)
    left = min(one.bent.excess for one in found.findings.sets if one.variants == variants)
    forms = forms_of(refitter_of(result), final, result.evidence.groups)
    return {one.effect: [each.report() for each in forms.deviations(form, number, 1 + max(left, 0.0))]
            for number, one in enumerate(final.hypotheses)}


def base_table(result: Result) -> list[dict[str, Any]]:
    """Base parameters on these drives beside the reference; `away` is `shown_move` in day-to-day spreads."""
    space, reference = result.reference.space, result.reference
    spread = np.sqrt(np.diag(reference.spread))
    before, after = (np.asarray(get_values(one, list(space.names)), float)
                     for one in (fitted_before(result), fitted_after(result)))
    fit = result.search.final if result.search.verdict == "named" else result.search.base
    away = shown_move(fit, result.evidence.precision, space.to_unit(after) - reference.u) / spread
    slope = space.slope(reference.u)
    return [{"name": name, "unit": unit, "reference": float(space.to_values(reference.u)[i]),
             "spread": float(spread[i] * slope[i]), "value": float(space.to_values(result.search.final.u)[i]),
             "before": float(before[i]), "after": float(after[i]), "away": float(away[i])}
            for i, (name, unit) in enumerate((name, describe(result.reference.params)[name].unit)
                                             for name in space.names)]


def shown_move(fit: Refit, precision: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """The part (P,) of a move (P,) of base parameters, in unit coordinates, that drives show beside a fit's effects.

    A fit to whole poses is free where drives determine nothing, as without an outside pose. Of all moves that explain
    the drives as well, the one counts that is most likely from day to day (`precision` (P, P)).
    """
    flat = fit.jacobian.reshape(-1, fit.jacobian.shape[-1])
    base, effects = flat[:, :len(moved)], flat[:, len(moved):]
    alone = base - effects @ (np.linalg.pinv(effects) @ base)  # what the effects cannot do instead
    shown = alone.T @ alone
    return np.asarray(np.linalg.solve(shown + precision, shown @ moved))


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
    return {"alpha": alpha, "decisions": ROUNDS + 2, "days": "simulated, linear",
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

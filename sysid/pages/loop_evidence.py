"""What speaks for the effects that a loop names, and the base parameters beside them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sysid.missing.signatures import group_names
from sysid.verdict.agreement import foretold, heterogeneity, interval_of_sum, sizes_apart
from sysid.verdict.falsifiers import as_report as predictions_of
from sysid.verdict.forms import forms_of
from sysid.verdict.result import Result
from sysid.verdict.vehicles import fitted_after, fitted_before, refitter_of
from whill_mjx.effects import about_of
from whill_mjx.vehicle.parameters import describe, get_values


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
    one = next((one for one in result.stood if one.effect == effect), None)
    final, groups, precision = result.search.final, result.evidence.groups, result.evidence.precision
    sizes, errors = (one.sizes, one.errors) if one else sizes_apart(final, part, groups, precision)
    left_out = one.foretold if one else foretold(final, part, groups, precision)
    agreement = heterogeneity(sizes, errors)
    names = group_names(result.log.training, groups)
    return {"left_out_gain": dict(zip(names, left_out.tolist(), strict=True)), "left_out_total": float(left_out.sum()),
            "left_out_interval": list(interval_of_sum(left_out)),
            "by_manoeuvre": [{"manoeuvre": name, "factor": float(size), "standard_error": float(error),
                              "asked": bool(asked)}
                             for name, size, error, asked in zip(names, sizes, errors, agreement.asked, strict=True)],
            "heterogeneity": {"q": agreement.q, "manoeuvres": int(agreement.asked.sum()), "p_value": agreement.p,
                              "scatter": agreement.scatter, "power": agreement.power, "outcome": agreement.outcome},
            "falsifiers": predictions_of(one.falsifiers) if one else []}


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
    """Base parameters on these drives beside the reference."""
    space, reference = result.reference.space, result.reference
    spread = np.sqrt(np.diag(reference.spread))
    before, after = (np.asarray(get_values(one, list(space.names)), float)
                     for one in (fitted_before(result), fitted_after(result)))
    away = (space.to_unit(after) - reference.u) / spread
    slope = space.slope(reference.u)
    return [{"name": name, "unit": unit, "reference": float(space.to_values(reference.u)[i]),
             "spread": float(spread[i] * slope[i]), "value": float(space.to_values(result.search.final.u)[i]),
             "before": float(before[i]), "after": float(after[i]), "away": float(away[i])}
            for i, (name, unit) in enumerate((name, describe(result.reference.params)[name].unit)
                                             for name in space.names)]

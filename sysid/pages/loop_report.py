"""What a closed loop writes: `report.json` (entries: docs/formats.md), the page, the vehicle file with the effect."""

from __future__ import annotations

import hashlib
import json
import textwrap
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import jax
import numpy as np

from sysid.errors.noise import said
from sysid.follow_up import trust
from sysid.follow_up.changes import by_manoeuvre, worse
from sysid.follow_up.next_manoeuvre import next_manoeuvre, write_next_command
from sysid.follow_up.power import DRAWS, POWER, SEED, Days, calibrated, false_alarms, power_curve, smallest
from sysid.follow_up.unnamed import as_report, find_unnamed, replay_unnamed, vehicle_of
from sysid.logs.coverage import doubts
from sysid.logs.metrics import METRICS, own_floor
from sysid.logs.records import Prediction, Trial
from sysid.missing.catalogue import Hypothesis, base_values, falsifiers
from sysid.missing.days import Reference
from sysid.missing.evidence import Evidence, Solver, at_fit
from sysid.missing.unexplained import held_back_gains
from sysid.pages.before_after import replayed_paths, shown_drive
from sysid.pages.loop_words import FAR, describe_unnamed, lead, not_determined, sentence, title
from sysid.pages.report import code_hashes, error_rows
from sysid.pages.verdict_picture import account
from sysid.replay.rollout import predictions
from sysid.verdict.agreement import foretold, heterogeneity, interval_of_sum, sizes_apart
from sysid.verdict.falsifiers import as_report as predictions_of
from sysid.verdict.forms import forms_of
from sysid.verdict.found import EFFORT
from sysid.verdict.result import LoopConfig, Result
from sysid.verdict.scan import null_days
from sysid.verdict.vehicles import drives_of, fitted_after, fitted_alone, fitted_before, refitter_of
from whill_mjx.effects import EFFECTS, equation
from whill_mjx.vehicle.parameters import describe, get_values
from whill_mjx.vehicle.types import Parameter, parameters_of

WRITING = "fitting the vehicle to whole poses, without and with what was found, and writing the report"
"""What `write_result` does, for who waits for it."""
SCHEMA = 1
KIND = "sysid-close-loop"
RESAMPLES = 2000


def make_report(result: Result) -> dict[str, Any]:
    """The report; this is where the held-out trials are opened."""
    found = result.search
    settings = manifest(result.config, result.hypotheses, result.reference)
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True, default=str).encode()).hexdigest()
    trials = (*result.log.training, *result.log.held_out)
    wrench = find_unnamed(result)
    before = replay(result, result.reference.params, trials)
    refitted = replay(result, fitted_before(result), trials)
    after = replay(result, fitted_after(result), trials) if wrench is None or not wrench.kept else replay_unnamed(
        result, wrench, trials)
    rows = error_rows(trials, before, after)
    refitted_rows = error_rows(trials, before, refitted)
    days = new_days(result)
    about = [one.name for one in result.references]
    vehicle = f"the vehicle of {', '.join(about)}" if about else "the vehicle file"
    asked = (f"what has changed or is missing against {vehicle}"
             if result.reference.known else "what the model family lacks")
    noise = {} if result.noise is None else result.noise.report()
    base = base_table(result)
    same = found.verdict == "none" and not shifts(base) and not (result.floor and result.floor.named)
    return {
        "schema": SCHEMA, "kind": KIND, "verdict": found.verdict, "reason": found.reason,
        "noise": noise, "noise_sentence": said(noise, same) or None,
        "warnings": trust.warnings(result),
        "advice": trust.advice(result, predicts_well(trials, rows)), "known": result.reference.known, "question": asked,
        "remark": result.reference.remark,
        "dataset": {"name": result.log.name, "sha256": result.log.sha256, "vehicle": result.log.spec.name,
                    "training": [t.name for t in result.log.training],
                    "held_out": [t.name for t in result.log.held_out]},
        "references": [{"name": one.name, "sha256": one.sha256} for one in result.references],
        "effects": effects(result) if found.verdict == "named" else [],
        "before": table(rows, trials, "initial"), "refitted": table(refitted_rows, trials, "fitted"),
        "after": table(rows, trials, "fitted"),
        "shown": shown_drive(replayed_paths(trials, {"before": before, "refitted": refitted, "after": after})),
        "alone": alone(result, trials, before), "change": change(rows),
        "by_manoeuvre": by_manoeuvre(trials, before, after),
        "worse": worse(by_manoeuvre(trials, refitted, after)), "operating": operating(result, days),
        "log_doubts": doubts(result.log), "contradicted": trust.contradicted(result), "pairs": pairs_of(result),
        "missing": missing(result),
        "weights": found.weights, "steps": steps(result),
        "forms": form_curves(result), "decision": (
            None if found.findings is None else account(found.findings, result.config.thresholds)),
        "candidates": [[{"effect": one.hypothesis.effect, "variant": one.hypothesis.variant, "gain": one.gain,
                         "p_value": one.p, "explained": one.share,
                         "coordinates": one.refit.q[-len(one.hypothesis.axes):].tolist()} for one in each]
                       for each in found.rounds],
        "detectable": detectable(result, days),
        "lives_in": where_it_lives(result) if found.verdict == "unexplained" else [],
        "unnamed": None if wrench is None else as_report(wrench),
        "floor": None if result.floor is None else {**result.floor.report(), "sentence": result.floor.said()},
        "next_manoeuvre": next_manoeuvre(result), "base": base, "seconds": result.seconds,
        "errors": rows, "manifest": {**settings, "sha256": digest}, "code": code_hashes(),
    }


def new_days(result: Result) -> Days:
    """Days on which nothing is missing, simulated anew for these drives."""
    evidence, wander = scanned(result), result.prepared.wander
    nulls = null_days(evidence, result.reference.spread, wander, DRAWS,
                      np.random.default_rng((result.config.seed, SEED)))
    return Days(evidence, result.hypotheses, wander, result.search.scan, nulls)


def replay(result: Result, vehicle: Any, trials: tuple[Trial, ...]) -> list[Prediction]:
    """Replays of trials by a vehicle."""

    drives, values = drives_of(result, trials, vehicle)
    simulated = drives.replay(values[None])
    return predictions(trials, jax.tree.map(lambda leaf: leaf[0], simulated))


def predicts_well(trials: tuple[Trial, ...], rows: list[dict[str, Any]]) -> bool:
    """Whether drives that were not fitted are predicted, with what was found, to within what repeats differ by."""
    held = any(trial.held_out for trial in trials)
    mine = [row for row in rows if row["held_out"] is held and "trajectory" in row["metrics"]]
    channel = "ground_truth" if any(row["channel"] == "ground_truth" for row in mine) else "odometry"
    errors = np.array([row["metrics"]["trajectory"]["fitted"] for row in mine if row["channel"] == channel])
    return trust.as_good_as_repeats(errors, (own_floor(trials, held).get(channel) or {}).get("trajectory"))


def alone(result: Result, trials: tuple[Trial, ...], before: list[Prediction]) -> dict[str, Any] | None:
    """`after` where only what was named has moved."""
    if result.search.verdict != "named":
        return None
    return table(error_rows(trials, before, replay(result, fitted_alone(result), trials)), trials, "fitted")


def table(rows: list[dict[str, Any]], trials: tuple[Trial, ...], which: str) -> dict[str, Any]:
    """part -> channel -> metric -> mean RMSE, with the noise floor of the same trials."""
    out: dict[str, Any] = {}
    for part, held in (("training", False), ("held_out", True)):
        floor = own_floor(trials, held)
        out[part] = {}
        for channel in dict.fromkeys(row["channel"] for row in rows):
            mine = [row for row in rows if row["channel"] == channel and row["held_out"] is held]
            means = {metric: [row["metrics"][metric][which] for row in mine if metric in row["metrics"]]
                     for metric in METRICS}
            out[part][channel] = {metric: float(np.mean(values)) for metric, values in means.items() if values}
            if floor and mine:
                out[part][channel]["noise_floor"] = floor.get(channel)
    return out


def change(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Mean change of each RMSE, its interval from trials drawn anew, and the share of trials that got worse."""
    rng = np.random.default_rng(0)
    out: dict[str, Any] = {}
    for part, held in (("training", False), ("held_out", True)):
        out[part] = {}
        for channel in dict.fromkeys(row["channel"] for row in rows):
            mine = [row for row in rows if row["channel"] == channel and row["held_out"] is held]
            for metric in METRICS:
                pairs = np.array([[row["metrics"][metric]["initial"], row["metrics"][metric]["fitted"]]
                                  for row in mine if metric in row["metrics"]])
                if len(pairs) == 0:
                    continue
                difference = pairs[:, 1] - pairs[:, 0]
                draws = difference[rng.integers(0, len(pairs), (RESAMPLES, len(pairs)))].mean(1)
                out[part].setdefault(channel, {})[metric] = {
                    "mean": float(difference.mean()), "interval": np.quantile(draws, [0.025, 0.975]).tolist(),
                    "relative": float(difference.mean() / max(pairs[:, 0].mean(), 1e-12)),
                    "worse": int((difference > 0).sum()), "trials": len(pairs)}
    return out


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


def missing(result: Result) -> dict[str, Any]:
    """p-values of "nothing is missing", and what exceeds the noise."""
    found, nulls = result.search, result.null_refits
    return {"p_value": calibrated(found.p_value) if result.reference.known else found.p_value,
            "p_search": found.p_value, "p_pairs": None if found.pairs is None else found.pairs.p_family,
            "excess_before": found.excess[0], "excess_after": found.excess[1], "explained": found.share,
            "null_refits": None if nulls is None else {
                "count": len(nulls.p), "p_value": nulls.p_of(found.p_value), "false_alarms": nulls.alarms,
                "upper": nulls.upper}}


def steps(result: Result) -> list[dict[str, Any]]:
    """The sets of effects that were weighed: what they gain, and what they leave though it could be predicted."""
    findings, priors = result.search.findings, result.config.thresholds
    if findings is None:
        return []
    return [{"effects": list(one.variants), "gain": one.gain, "own": list(one.own), "p": list(one.p),
             "left": findings.predictable(one.left, priors.form**2, priors.alpha),
             "share": findings.named(one, priors)} for one in findings.sets]


def pairs_of(result: Result, most: int = 5) -> list[dict[str, Any]]:
    """The pairs of effects with the largest gain in the scan."""
    pairs = result.search.pairs
    if pairs is None:
        return []
    out: dict[frozenset[str], dict[str, Any]] = {}
    for m in np.argsort(-pairs.gain):
        names = [result.hypotheses[h].effect for h in pairs.members[m]]
        out.setdefault(frozenset(names), {"effects": names, "gain": float(pairs.gain[m]), "p_value": float(pairs.p[m])})
        if len(out) == most:
            break
    return list(out.values())


def effects(result: Result) -> list[dict[str, Any]]:
    """The named effects with values (of the joint refit that decided), intervals and evidence."""
    final, found = result.search.final, result.search
    ends_of = np.stack([trust.intervals(one, result) for one in (final, *trust.beside_still_base(result))])
    low, high = ends_of[:, 0].min(0), ends_of[:, 1].max(0)
    values = dict(zip(result.names, final.values.tolist(), strict=True))
    base, was = base_values(result.full), base_values(result.reference.params)
    for index, name in enumerate(result.reference.space.names):
        base[name] = float(result.reference.space.to_values(final.u)[index])
    kept = {one.hypothesis.key for one in found.accepted}
    out, start = [], 0
    for one in final.hypotheses:
        stop = start + len(one.axes)
        ends = [one.values(np.clip(edge, [-a.limit if a.signed else 0.0 for a in one.axes], None), base)
                for edge in (low[start:stop], high[start:stop])]
        if one.key in kept:
            index = [c.hypothesis.key for c in found.accepted].index(one.key)
            out.append({
                "name": one.effect, "kind": one.kind, "variant": one.variant, "class": found.classes[index],
                "parameters": {axis.parameter: {
                    "value": values[axis.parameter],
                    **in_range(axis.parameter, values[axis.parameter], [end[axis.parameter] for end in ends]),
                    "confidence": trust.CONFIDENCE, "unit": about_of(axis.parameter).unit,
                    "was": was.get(axis.parameter), "neutral": about_of(axis.parameter).neutral,
                    "description": about_of(axis.parameter).description} for axis in one.axes},
                "p_value": found.accepted[index].p,
                "equation": equation(EFFECTS[one.effect]) if one.effect in EFFECTS else "",
                "evidence": evidence_for(result, slice(start, stop), one.effect)})
        start = stop
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


def about_of(parameter: str) -> Parameter:
    """What is known of a dotted parameter before any data."""
    effect, _, name = parameter.partition(".")
    return parameters_of(EFFECTS[effect])[name]


def evidence_for(result: Result, part: slice, effect: str) -> dict[str, Any]:
    """What manoeuvres say of an effect by themselves, whether it predicts those left out, and its falsifiers."""
    one = next((one for one in result.stood if one.effect == effect), None)
    final, groups, precision = result.search.final, result.evidence.groups, result.evidence.precision
    sizes, errors = (one.sizes, one.errors) if one else sizes_apart(final, part, groups, precision)
    left_out = one.foretold if one else foretold(final, part, groups, precision)
    agreement = heterogeneity(sizes, errors)
    names = [result.log.training[group[0]].manoeuvre for group in groups]
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


def shifts(rows: list[dict[str, Any]], least: float = FAR) -> list[str]:
    """Base parameters that the last refit moved by more than so many day-to-day spreads, in words, furthest first."""
    far = sorted((row for row in rows if abs(row["away"]) > least), key=lambda row: -abs(row["away"]))
    return [f"{row['name']} {row['reference']:.4g} -> {row['after']:.4g} {row['unit']} ({row['away']:+.1f} spreads)"
            for row in far]


def summary(report: dict[str, Any], width: int = 100) -> str:
    """What a person reads first, in lines of at most `width` characters."""
    lines = [title(report), *lead(report), *report["log_doubts"], *report["advice"]]
    if report["noise_sentence"] is not None:
        lines.append(f"noise: {report['noise_sentence']}")
    lines += ["", f"verdict: {report['verdict']} - {report['reason']}",
              f"asked: {report['question']}; {report['remark']}"]
    for one in report["effects"]:
        lines += [f"  {name} = {p['value']:.4g} [{p['interval'][0]:.4g}, {p['interval'][1]:.4g}] {p['unit']}"
                  for name, p in one["parameters"].items()]
        lines += [f"  {text}" for text in not_determined(one["parameters"])]
    if report["floor"] is not None and report["floor"]["sentence"]:
        lines.append(f"  changed: {report['floor']['sentence']}")
    moved = shifts(report["base"])
    if moved:
        lines += ["  base parameters further than from day to day:", *(f"    {one}" for one in moved)]
    if report["next_manoeuvre"] is not None:
        lines.append(f"  next drive: {sentence(report['next_manoeuvre'])}")
    for one in report["lives_in"][:4]:
        lines.append(f"  lives in {one['quantity']}: {one['share']:.0%} of what is left")
    if report["unnamed"] is not None:
        lines.append(f"  {describe_unnamed(report['unnamed'])}")
    return "\n".join(wrapped(line, width) for line in lines)


def wrapped(line: str, width: int) -> str:
    """A line folded at `width`; what follows is indented by two more."""
    indent = " " * (len(line) - len(line.lstrip()))
    return textwrap.fill(line.strip(), width, initial_indent=indent, subsequent_indent=f"{indent}  ",
                         break_long_words=False, break_on_hyphens=False) if line.strip() else ""


def write_run(out: Path, result: Result, report: dict[str, Any]) -> None:
    """Write report.json, both pages, vehicle.toml and, where one is proposed, next_command.csv into a folder."""
    from sysid.pages.loop_page import write_method, write_page
    from sysid.pages.report import write_report
    from sysid.verdict.posterior import write as write_evidence
    from whill_mjx.vehicle.vehicle_file import save_vehicle

    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    unnamed = report["unnamed"]
    kept = unnamed is not None and unnamed["kept"]
    vehicle = vehicle_of(result, unnamed["parameters"]) if kept else fitted_after(result)
    known = describe(vehicle)
    bounds = {name: tuple(p["interval"]) for one in report["effects"] for name, p in one["parameters"].items()
              if name in known and np.isfinite(p["interval"]).all() and not any(p["open"])}
    save_vehicle(out / "vehicle.toml", result.log.spec, vehicle, bounds,
                 {"made_by": "sysid.close_loop", "dataset": result.log.name, "dataset_sha256": result.log.sha256,
                  "verdict": report["verdict"], "manifest_sha256": report["manifest"]["sha256"],
                  "effects_added": [one["name"] for one in report["effects"]] + ["unnamed"] * kept})
    write_next_command(out, report["next_manoeuvre"])
    if result.search.findings is not None:
        write_evidence(out / "evidence.json", result.search.findings)
    write_report(out / "report.json", report)
    write_page(out, report)
    write_method(out, report)


def manifest(config: LoopConfig, found: Sequence[Hypothesis], reference: Reference) -> dict[str, Any]:
    """Everything that was fixed before the drives were looked at."""
    space = reference.space
    return {
        "settings": {key: value for key, value in asdict(config).items() if key != "thresholds"},
        "thresholds": asdict(config.thresholds),
        "catalogue": [{"effect": one.effect, "variant": one.variant, "kind": one.kind,
                       "axes": [asdict(axis) for axis in one.axes], "constants": dict(one.constants)}
                      for one in found],
        "falsifiers": {name: [asdict(one) for one in each] for name, each in falsifiers().items()},
        "bounds": {name: [float(space.low[i]), float(space.high[i])] for i, name in enumerate(space.names)},
    }


def where_it_lives(result: Result) -> list[dict[str, Any]]:
    """Quantities by the share of the systematic residual that they predict on other drives, where any; best first."""
    residual, excess = result.search.final.residual, result.search.excess[1]
    beyond = max(excess / (1 + excess) * float(np.square(residual).sum()), 1.0)
    gains = held_back_gains(result.log.training, result.log.spec, residual, result.reference.width,
                            result.reference.channels)
    out = [{"quantity": name, "share": float(np.clip(gain / beyond, 0.0, 1.0))} for name, gain in gains.items()
           if gain > 0]
    return sorted(out, key=lambda one: -one["share"])


def write_result(out: Path, result: Result) -> dict[str, Any]:
    """Open the held-out trials, write the folder `out`, print the verdict, and return the report."""
    report = make_report(result)
    write_run(out, result, report)
    print(summary(report))
    print(f"wrote report.json, report.html, method.html and vehicle.toml into {out}")
    return report

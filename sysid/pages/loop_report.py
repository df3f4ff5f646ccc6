"""What a closed loop writes: `report.json` (entries: docs/formats.md), the page, the vehicle file with the effect."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import norm

from sysid.errors.noise import said
from sysid.follow_up import trust
from sysid.follow_up.changes import by_manoeuvre, worse
from sysid.follow_up.next_manoeuvre import next_manoeuvre, write_next_command
from sysid.follow_up.power import calibrated
from sysid.follow_up.unnamed import as_report, find_unnamed, replay_unnamed, vehicle_of
from sysid.intervals.independence import CONFIDENCE
from sysid.logs.coverage import doubts
from sysid.logs.metrics import own_floor
from sysid.logs.records import Prediction, Trial
from sysid.missing.catalogue import Hypothesis, base_values, falsifiers
from sysid.missing.days import Reference
from sysid.missing.unexplained import held_back_gains
from sysid.pages.before_after import shown_drive
from sysid.pages.loop_page import write_method, write_page
from sysid.pages.loop_tables import (
    base_table,
    change,
    detectable,
    evidence_for,
    form_curves,
    in_range,
    new_days,
    operating,
    replay,
    table,
)
from sysid.pages.loop_words import shifts, summary
from sysid.pages.report import code_hashes, error_rows, write_report
from sysid.pages.series import replayed
from sysid.pages.verdict_picture import account
from sysid.verdict import agreement
from sysid.verdict.posterior import write as write_evidence
from sysid.verdict.result import LoopConfig, Result
from sysid.verdict.vehicles import fitted_after, fitted_alone, fitted_before
from whill_mjx.effects import EFFECTS, about_of, equation
from whill_mjx.vehicle.parameters import describe
from whill_mjx.vehicle.vehicle_file import save_vehicle

WRITING = "fitting the vehicle to whole poses, without and with what was found, and writing the report"
"""What `write_result` does, for who waits for it."""
SCHEMA = 1
KIND = "sysid-close-loop"


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
        "shown": shown_drive(replayed(trials, {"before": before, "refitted": refitted, "after": after})),
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


def effects(result: Result) -> list[dict[str, Any]]:
    """The named effects with values (of the joint refit that decided), intervals and evidence."""
    final, found = result.search.final, result.search
    ends_of = np.stack([trust.intervals(one, result) for one in (final, *trust.beside_still_base(result))])
    low, high = ends_of[:, 0].min(0), ends_of[:, 1].max(0)
    values = dict(zip(result.names, final.values.tolist(), strict=True))
    base, was = base_values(result.full), base_values(result.reference.params)
    for index, name in enumerate(result.reference.space.names):
        base[name] = float(result.reference.space.to_values(final.u)[index])
    kept = {one.hypothesis.key: (one, alike) for one, alike in zip(found.accepted, found.classes, strict=True)}
    out = []
    for one, part in zip(final.hypotheses, final.parts, strict=True):
        ends = [one.values(np.clip(edge[part], [-a.limit if a.signed else 0.0 for a in one.axes], None), base)
                for edge in (low, high)]
        if one.key in kept:
            named, alike = kept[one.key]
            out.append({
                "name": one.effect, "kind": one.kind, "variant": one.variant, "class": alike,
                "parameters": {axis.parameter: {
                    "value": values[axis.parameter],
                    **in_range(axis.parameter, values[axis.parameter], [end[axis.parameter] for end in ends]),
                    "confidence": agreement.CONFIDENCE, "unit": about_of(axis.parameter).unit,
                    "was": was.get(axis.parameter), "neutral": about_of(axis.parameter).neutral,
                    "description": about_of(axis.parameter).description} for axis in one.axes},
                "p_value": named.p,
                "equation": equation(EFFECTS[one.effect]) if one.effect in EFFECTS else "",
                "evidence": evidence_for(result, part, one.effect)})
    return out


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


def write_run(out: Path, result: Result, report: dict[str, Any]) -> None:
    """Write report.json, both pages, vehicle.toml and, where one is proposed, next_command.csv into a folder."""
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    unnamed = report["unnamed"]
    kept = unnamed is not None and unnamed["kept"]
    vehicle = vehicle_of(result, unnamed["parameters"]) if kept else fitted_after(result)
    known = describe(vehicle)
    bounds = {name: narrower(p["interval"], p["value"]) for one in report["effects"]
              for name, p in one["parameters"].items()
              if name in known and np.isfinite(p["interval"]).all() and not any(p["open"])}
    save_vehicle(out / "vehicle.toml", result.log.spec, vehicle, bounds,
                 {"made_by": "sysid.close_loop", "interval_confidence": CONFIDENCE,
                  "dataset": result.log.name, "dataset_sha256": result.log.sha256,
                  "verdict": report["verdict"], "manifest_sha256": report["manifest"]["sha256"],
                  "effects_added": [one["name"] for one in report["effects"]] + ["unnamed"] * kept})
    write_next_command(out, report["next_manoeuvre"])
    if result.search.findings is not None:
        write_evidence(out / "evidence.json", result.search.findings)
    write_report(out / "report.json", report)
    write_page(out, report)
    write_method(out, report)


def narrower(interval: Sequence[float], value: float) -> tuple[float, float]:
    """The interval of a vehicle file, all of which are read as of CONFIDENCE, of an interval of the report."""
    share = norm.ppf((1 + CONFIDENCE) / 2) / norm.ppf((1 + agreement.CONFIDENCE) / 2)
    low, high = (value + share * (end - value) for end in interval)
    return float(low), float(high)


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

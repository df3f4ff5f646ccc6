"""What the verdicts of the closed loop on logs of the contact plant come to."""

from __future__ import annotations

import hashlib
import inspect
import json
import math
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.harness import device_name, figure, provenance, record
from benchmarks.plant.effects import EFFECTS
from benchmarks.undeclared_plant import RECORDED, power_sizes
from benchmarks.undeclared_reference import USUAL, Driven
from sysid.follow_up.power import FILE, calibrated
from sysid.intervals.statistics import upper_rate
from sysid.pages.report import write_report
from sysid.verdict import posterior as decision
from sysid.verdict.posterior import Thresholds, from_json, posterior
from whill_mjx.evaluation.intervals import wilson_interval

LEAST = 30
"""Logs with nothing in them on which p-values are calibrated at least."""
OF_ALL_SIZES = ("mean_class_size", "out_of_catalogue", "class_accuracy", "wrong_name")
"""Figures of logs with one effect that are also taken over all its sizes together."""
CLASSES = Path(__file__).parents[1] / "sysid/data/classes.json"
SAME = {  # effects that the plant and the catalogue write alike: parameter, its value without and per unit of size
    "command_scale": ("command_scale.linear", 1.0, 1.0),
    "drive_gain_difference": ("drive_gain_difference.difference", 0.0, 1.0),
    "wheel_radius_difference": ("wheel_radius_difference.difference", 0.0, 1.0),
    "track_width": ("track_width.error", 0.0, 1.0),
    "payload_shift": ("payload_shift.mass", 0.0, 1.0),
    "quadratic_drag": ("quadratic_drag.coefficient", 0.0, 1.0),
    "side_force": ("side_force.sideways", 0.0, 1.0),
    "slope": ("slope.along_x", 0.0, 1.0),
    "sensor_delay": ("sensor_delay.delay", 0.0, 1.0),
}


def figures(work: Path, driven: Driven = USUAL) -> None:
    """Write into benchmarks/results/undeclared.json what the verdicts in the work folder say; the rest is kept.

    Fresh draws are counted together with recorded ones of the same stages that this decision judged.
    """
    recorded = json.loads(RECORDED.read_text()) if RECORDED.exists() else {}
    own = [(truth, one) for truth, one in read_cases(work) if bool(one.get("draw", 0)) == bool(driven.draw)]
    kept, earlier = _recorded_rows(recorded.get("confusion", []), own, driven)
    cases = [*own, *map(_case_of, earlier)]
    noisy = [(truth, one) for truth, one in cases if one["stage"] == "noisy"]
    cases = [(truth, one) for truth, one in cases if one["stage"] != "noisy"]
    found = {**of_nulls([one for truth, one in cases if not truth]), **of_noisy(noisy)}
    singles = [(next(iter(truth)), one) for truth, one in cases if one["stage"] == "scaled"]
    for scale in sorted({one["scale"] for _, one in singles}):
        found.update(of_singles([(name, one) for name, one in singles if one["scale"] == scale], f"_{scale:g}x"))
    found.update({name: one for name, one in of_singles(singles, "").items() if name in OF_ALL_SIZES})
    pairs, least = [(truth, one) for truth, one in cases if one["stage"] == "pair"], power_sizes(work, driven)
    found.update(of_pairs(pairs))
    large = [(truth, one) for truth, one in pairs if all(truth[name] >= 2 * least.get(name, 0.0) for name in truth)]
    found.update({f"{name}_2x": one for name, one in of_pairs(large).items()})
    found.update(of_left_out([(next(iter(truth)), one) for truth, one in cases if one["stage"] == "left_out"],
                             own_classes(work)))
    found.update(of_parameters([(truth, one) for truth, one in cases if one["stage"] != "left_out"]))
    ratios = [one["heldout_ratio"] for _, one in cases if "heldout_ratio" in one]
    if ratios:
        found["heldout_ratio"] = figure(ratios, "held-out trajectory RMSE over the replicates' spread")
    timed = [one for _, one in cases if one["stage"] in ("scaled", "pair") and "device" in one]
    if timed:
        found["seconds_per_log"] = figure([one["seconds"] for one in timed], "s on one core, reference fit apart",
                                          timed[0]["device"])
    found.update({} if driven.draw else of_speed(work))
    found.update(of_decision([one["findings"] for _, one in [*cases, *noisy] if one.get("findings")]))
    found = {name + driven.tag: one for name, one in found.items()}
    sizes = {name: {"value": size, "unit": EFFECTS[name].unit, "base": EFFECTS[name].base}
             for name, size in power_sizes(work).items()} if driven == USUAL else recorded.get("sizes", {})
    path = record("undeclared", "Undeclared effects in logs of an independent contact plant", found)
    content = {**json.loads(path.read_text()), "sizes": sizes}
    # Others may have been judged in another folder.
    content["confusion"] = [*kept, *earlier, *(_row_of(truth, one, driven) for truth, one in own)]
    write_report(path, content)


def _recorded_rows(rows: Sequence[Any], own: Sequence[Case], driven: Driven) -> tuple[list[Any], list[Any]]:
    """Recorded rows that stay as they are, and those of other fresh draws that count beside the `own` logs."""
    judged, draws = {_kind(truth, one["stage"]) for truth, one in own}, {one.get("draw", 0) for _, one in own}
    stay, count = [], []
    for row in rows:
        same = driven_of(row).tag == driven.tag and _kind(row["truth"], row["stage"]) in judged
        if not same:
            stay.append(row)
        elif row.get("draw", 0) not in draws | {0} and row.get("decision", decision_now()) == decision_now():
            count.append(row)
    return stay, count


def decision_now() -> str:
    """The beginning of the checksum of the source that decides."""
    return hashlib.sha256(inspect.getsource(decision).encode()).hexdigest()[:12]


def _row_of(truth: Mapping[str, float], one: Mapping[str, Any], driven: Driven) -> dict[str, Any]:
    """What is recorded of a log."""
    row = {"truth": truth, "stage": one["stage"], "scale": one["scale"], "noise": driven.noise,
           "vehicle": driven.vehicle, "draw": one.get("draw", 0), "verdict": one["verdict"],
           "named": [e["name"] for e in one["effects"]], "classes": [e["class"] for e in one["effects"]],
           "explained": one["share"], "sensor_noise": one.get("noise", 1.0)}
    if not driven.draw:
        return row
    sizes = {e["name"]: e["parameters"] for e in one["effects"] if e["name"] in truth and e["name"] in SAME}
    levels = {"noise_levels": one["noise_levels"]} if one["stage"] == "noisy" and not truth else {}
    return {**row, "decision": decision_now(), "reference": one.get("reference", 0), "p_value": one["p_value"],
            "warned": warned(one), "parameters": sizes, **levels}


def _case_of(row: Mapping[str, Any]) -> Case:
    """A row as the verdict that it is of; the first rows lack warning, p-value and parameters."""
    sizes = row.get("parameters", {})
    effects = [{"name": name, "class": members, "parameters": sizes.get(name)}
               for name, members in zip(row["named"], row["classes"], strict=True)]
    return row["truth"], {**row, "noise": row["sensor_noise"], "share": row["explained"], "effects": effects}


def driven_of(row: Mapping[str, Any]) -> Driven:
    """What a recorded row is of; older rows, from before there were other vehicles and noise levels, do not say."""
    return Driven(row.get("noise", 1.0), row.get("vehicle", "chair"), row.get("draw", 0))


def _kind(truth: Mapping[str, float], stage: str) -> tuple[str, ...]:
    """What is judged in one folder: all logs of a stage, or all with which the size of one effect is looked for."""
    return (stage, *truth) if stage == "base" else (stage,)


Case = tuple[dict[str, float], dict[str, Any]]
"""What was in a log, and what was said of it."""


def read_cases(work: Path) -> Iterable[Case]:
    """All logs that have a verdict."""
    for path in sorted((work / "verdicts").glob("*.json")):
        yield json.loads((work / "truth" / path.name).read_text()), json.loads(path.read_text())


def share(hits: Sequence[bool], unit: str) -> dict[str, Any]:
    """A share with its 95 % interval (`low`, `high`) and number `n`."""
    low, high = wilson_interval(int(sum(hits)), len(hits))
    return {**figure([float(np.mean(hits))], unit), "low": max(low, 0.0), "high": high, "n": len(hits)}


def of_nulls(nulls: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """False alarms and whether p-values are uniform."""
    from scipy import stats

    if not nulls:
        return {}
    false = sum(one["verdict"] != "none" for one in nulls)
    found = {
        "false_alarms": {**figure([float(false)], f"of {len(nulls)} logs with nothing in them"), "n": len(nulls),
                         "sets": sets_of(nulls)},
        "false_alarm_upper": figure([upper_rate(false, len(nulls))], "share")}
    apart = [one for one in nulls if "p_value" in one and not calibrates(one)]
    for name, p_of in (("null_ks_p", calibrated), ("null_ks_p_uncalibrated", float)):
        if apart:
            p_values = [p_of(one["p_value"]) for one in apart]
            found[name] = figure([float(stats.kstest(p_values, "uniform").pvalue)],
                                 f"of {len(apart)} logs over {sets_of(apart)} sets of reference days")
    return found


def of_noisy(cases: Sequence[Case]) -> dict[str, Any]:
    """False alarms, factors inside their intervals, and names, of logs noisier or quieter than the reference days."""
    found = of_noisy_nulls([one for truth, one in cases if not truth], "_noise", "0.5 to 4 times the noise")
    for level in sorted({one["noise"] for _, one in cases}):
        mine, tag = [(truth, one) for truth, one in cases if one["noise"] == level], f"_sensor_noise_{level:g}"
        found.update(of_noisy_nulls([one for truth, one in mine if not truth], tag, f"{level:g} times the noise"))
        found.update(of_singles([(next(iter(truth)), one) for truth, one in mine if len(truth) == 1], f"_4x{tag}"))
        pairs = of_pairs([(truth, one) for truth, one in mine if len(truth) == 2])
        found.update({name + tag: one for name, one in pairs.items()})
    return found


def of_noisy_nulls(nulls: Sequence[dict[str, Any]], tag: str, level: str) -> dict[str, Any]:
    """The same of logs with nothing in them."""
    if not nulls:
        return {}
    false, about = sum(one["verdict"] != "none" for one in nulls), (
        f"logs with nothing in them at {level} of the reference days")
    inside = [each["interval"][0] <= one["noise"] <= each["interval"][1]
              for one in nulls for each in one.get("noise_levels", {}).values()]
    return {f"false_alarms{tag}": {**figure([float(false)], f"of {len(nulls)} {about}"), "n": len(nulls),
                                   "sets": sets_of(nulls)},
            f"false_alarm_upper{tag}": figure([upper_rate(false, len(nulls))], f"share of {about}"),
            f"noise_factor_coverage{tag}": share(
                inside, f"share of {len(inside)} 95 % intervals of {len(nulls)} logs")}


def sets_of(nulls: Sequence[dict[str, Any]]) -> int:
    """How many sets of reference days these logs are judged against."""
    return len({(one.get("draw", 0), one.get("reference", 0)) for one in nulls})


def calibrates(null: dict[str, Any]) -> bool:
    """Whether a log with nothing in it is for calibrating p-values; the others show whether they are uniform."""
    return not null.get("draw", 0) and null.get("reference", 0) % 2 == 0


def calibrate(work: Path) -> None:
    """Fit the distribution of p-values where nothing is missing, on half of the sets of reference days."""
    from scipy import stats

    nulls = [one for truth, one in read_cases(work) if not truth and one.get("stage", "null") == "null" and
             calibrates(one)]
    if len(nulls) < LEAST:
        raise SystemExit(f"{work}: {len(nulls)} logs with nothing in them, judged against sets 0, 2, 4 ... of "
                         f"reference days; {LEAST} are needed. Drive more with --nulls and --reference-sets.")
    values = np.clip([one["p_value"] for one in nulls], 1e-4, 1 - 1e-3)  # smaller values say more of tails
    a, b, _, _ = stats.beta.fit(values, floc=0, fscale=1)
    sets = sets_of(nulls)
    content = {"a": float(a), "b": float(b), "logs": len(nulls), "sets": sets, **provenance()}
    write_report(FILE, content)
    print(f"Beta({a:.3f}, {b:.3f}) from {len(nulls)} logs over {sets} sets")


def said(truth: str, one: dict[str, Any]) -> bool:
    """Whether a verdict names an effect or a class with it."""
    return any((EFFECTS[truth].covered or truth) in effect["class"] for effect in one["effects"])


def of_singles(inside: Sequence[tuple[str, dict[str, Any]]], tag: str) -> dict[str, Any]:
    """Right and wrong names of logs with one effect each."""
    known = [(name, one) for name, one in inside if EFFECTS[name].can_be_named]
    beyond = [one for name, one in inside if not EFFECTS[name].can_be_named]
    found = {}
    if known:
        about = f"share of {len(known)} logs"
        right = [said(name, one) for name, one in known]
        wrong = [one["verdict"] == "named" and not ok for (_, one), ok in zip(known, right, strict=True)]
        found[f"class_accuracy{tag}"] = share(right, about)
        right_ones = [one for (_, one), ok in zip(known, right, strict=True) if ok]
        if certain := [warned(one) for one in right_ones if knows_warnings(one)]:
            found[f"warned_right{tag}"] = share(certain,
                                                f"share of {len(certain)} right names that come with a warning")
        if right_ones:
            found[f"further_name{tag}"] = share([len(one["effects"]) > 1 for one in right_ones],
                                                f"share of {len(right_ones)} right names with a further effect")
        found[f"wrong_name{tag}"] = share(wrong, about)
        found[f"noticed{tag}"] = share([one["verdict"] != "none" for _, one in known], about)
        sizes = [len(effect["class"]) for _, one in known for effect in one["effects"]]
        if sizes:
            found[f"mean_class_size{tag}"] = figure([float(np.mean(sizes))], "effects")
    if beyond:
        found[f"out_of_catalogue{tag}"] = share(
            [one["verdict"] == "unexplained" for one in beyond],
            f"share of {len(beyond)} logs that are said to be unexplained")
    return found


def of_pairs(pairs: Sequence[Case]) -> dict[str, Any]:
    """Both named, and no wrong one, of logs with two effects.

    Their `_2x`: where both are at least twice as large as what 80 % of all logs would notice. Some are not, since the
    chair would no longer drive.
    """
    if not pairs:
        return {}
    both = [all(said(name, one) for name in truth) for truth, one in pairs]
    clean = [all(set(effect["class"]) & set(truth) for effect in one["effects"]) for truth, one in pairs]
    return {"pair_both": share(both, f"share of {len(pairs)} logs"),
            "pair_wrong": share([not one for one in clean], f"share of {len(pairs)} logs with a wrong name")}


def warned(one: Mapping[str, Any]) -> bool:
    """Whether a name comes with a warning (`sysid.follow_up.trust.warnings`); one is that more is left than days differ
    by; older verdicts contain that too."""
    if "warned" in one:
        return bool(one["warned"])
    return one["verdict"] == "named" and (bool(one.get("warnings")) or one["excess"][1] > one["excess_limit"])


def knows_warnings(one: Mapping[str, Any]) -> bool:
    """Whether a verdict, or what is recorded of one, says if its name came with a warning."""
    return "warned" in one or "excess" in one


def own_classes(work: Path) -> dict[str, set[str]]:
    """Effect -> what its log at four times the size is named as where the catalogue has it, judged here or recorded."""
    rows = json.loads(RECORDED.read_text()).get("confusion", []) if RECORDED.exists() else []
    rows += [{"truth": truth, **one, "classes": [e["class"] for e in one["effects"]]}
             for truth, one in read_cases(work)]
    return {name: {member for members in row["classes"] for member in members} for row in rows
            for name in row["truth"]
            if (row["stage"], row["scale"], driven_of(row)) == ("scaled", 4.0, USUAL)}


def of_left_out(inside: Sequence[tuple[str, dict[str, Any]]], own: Mapping[str, set[str]]) -> dict[str, Any]:
    """What is said of an effect that the catalogue lacks: wrong where it is named after one outside its class, without
    a warning. Its class is that of the file, and that with which the same log is named by the whole catalogue (`own`).
    """
    if not inside:
        return {}
    [*_, alike] = json.loads(CLASSES.read_text())["sensors"].values()
    outside = [one["verdict"] == "named" and not any(
        ({*alike["classes"][name]} | own.get(name, set())) & set(effect["class"]) for effect in one["effects"])
        for name, one in inside]
    wrong = [bad and not warned(one) for bad, (_, one) in zip(outside, inside, strict=True) if knows_warnings(one)]
    about = f"share of {len(inside)} logs whose effect was taken out of the catalogue"
    certain = f"share of {len(wrong)} logs whose effect was taken out of the catalogue"
    return {**({"left_out_wrong": share(wrong, certain)} if wrong else {}),
            "left_out_outside_class": share(outside, about),
            "left_out_unexplained": share([one["verdict"] == "unexplained" for _, one in inside], about)}


def of_parameters(cases: Sequence[Case]) -> dict[str, Any]:
    """Intervals that cover the size driven, relative errors, and how wide the intervals are, where plant and catalogue
    write an effect alike. The ideal intervals are as these, but longer or shorter by one factor, so that they hold 95 %
    of the sizes."""
    errors, reach = [], []
    for truth, one in cases:
        for effect in one["effects"]:
            if effect["name"] in truth and effect["name"] in SAME and effect["parameters"]:
                parameter, neutral, unit = SAME[effect["name"]]
                driven, seen = neutral + unit * truth[effect["name"]], effect["parameters"][parameter]
                away = driven - seen["value"]
                errors.append(abs(away) / abs(driven - neutral))
                end = seen["interval"][int(away > 0)]
                reach.append(away / (end - seen["value"]) if end != seen["value"] else math.inf if away else 0.0)
    if not reach:
        return {}
    inside = [one <= 1 for one in reach]
    held = float(np.quantile(reach, 0.95, method="inverted_cdf"))
    return {"interval_coverage": share(inside, f"share of {len(inside)} 95 % intervals"),
            "interval_width_ratio": figure([1 / held if held > 0 else math.inf],
                                           f"width over that with which {len(inside)} such intervals hold 95 %"),
            "parameter_error": figure(errors, "of the size")}


def of_decision(kept: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """How much decides, and how long a verdict from kept evidence takes."""
    if not kept:
        return {}
    seconds = []
    for one in kept:
        began = time.perf_counter()
        posterior(from_json(one), Thresholds())
        seconds.append(time.perf_counter() - began)
    return {"verdict_s": figure(seconds, "s from kept evidence, one core"),
            "decision_thresholds": figure([float(len(fields(Thresholds)))], "thresholds"),
            "decision_lines": figure([float(len(inspect.getsource(decision).splitlines()))],
                                     "lines of sysid/verdict/posterior.py, all between kept evidence and verdict")}


def of_speed(work: Path) -> dict[str, Any]:
    """Seconds of the whole command, with linear nulls only and with refitted ones."""
    found = {}
    for path in work.glob("speed_*.json"):
        one = json.loads(path.read_text())
        nulls, device = one["nulls"], one.get("device", device_name())
        about = "linear nulls" if nulls is None else f"{nulls['count']} refitted nulls"
        name = f"{'cpu' if device.startswith('cpu') else 'gpu'}{'_quick' if nulls is None else ''}_seconds"
        new = {name: figure([one["seconds"]], f"s, the whole command with {about}, compilations included", device)}
        if nulls is not None:
            new["refitted_null_alarms"] = figure([float(nulls["false_alarms"])],
                                                 f"of {nulls['count']} simulated days of one log", device)
        report = path.with_suffix("") / "report.json"  # of a machine that may have had other versions than this one
        if report.exists():
            code = json.loads(report.read_text())["code"]
            versions = {key: value for key, value in code.items() if "SHA" not in key}
            new = {key: {**value, "versions": versions} for key, value in new.items()}
        found.update(new)
    return found

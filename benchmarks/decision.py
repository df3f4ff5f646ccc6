"""The posterior's verdicts on saved evidence, beside those that the search gave on the same logs.

    export OMP_NUM_THREADS=1                                      one process for each core
    python -m benchmarks.decision --stage tuning --calibrate      null scores into sysid/data/null_scores.json
    python -m benchmarks.decision --stage test --record           figures into benchmarks/results/decision.json

The evidence is that of `benchmarks.evidence`; posteriors are kept in WORK/posterior, so that verdicts cost nothing.
What the search said of a log is its row in benchmarks/results/undeclared.json: same seed, same effect, same size.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from benchmarks.evidence import Stage
from benchmarks.harness import RESULTS, figure, provenance, record
from benchmarks.plant.effects import EFFECTS
from benchmarks.undeclared_figures import upper_rate
from sysid.errors.features import CHANNELS
from sysid.pages.report import write_report
from sysid.weighing.posterior import Posterior, Weighed, posterior
from sysid.weighing.saved_evidence import load
from sysid.weighing.verdict import Rules, Verdict, calibration_scores, decide
from whill_mjx.io.command_line import COUNT, run

SCORES = Path("sysid/data/null_scores.json")
MISSING = RESULTS.parents[1] / "sysid" / "missing"
REACHED = ("saved_evidence", "priors", "linear_model", "smooth_unknown", "posterior", "verdict")
"""Modules between a file of evidence and a verdict."""


@dataclass(frozen=True)
class Benchmark:
    """What to judge."""

    stage: Stage = "tuning"
    only: tuple[str, ...] = ()
    """Labels that begin with one of these."""
    calibrate: bool = False
    """Keep the scores of the logs with nothing in them."""
    record: bool = False
    """Write the figures."""
    verbose: bool = False
    """Print every log."""
    processes: Annotated[int, COUNT] = 1
    work: Path = Path("runs/evidence")


@dataclass(frozen=True)
class Case:
    """One log: what is in it, and what the posterior says."""

    label: str
    truth: Mapping[str, Any]
    verdict: Verdict
    found: Posterior
    seconds: float

    @property
    def effects(self) -> dict[str, float]:
        """What is in it."""
        return dict(self.truth["effects"])

    @property
    def kind(self) -> str:
        """null, scaled, noisy or pair."""
        return str(self.truth["kind"])


def main(settings: Benchmark) -> None:
    """Judge all logs of a stage."""
    judged = judge(settings)
    if settings.calibrate:
        scores = sorted(found.score for _, truth, found, _ in judged if not truth["effects"])
        write_report(SCORES, {"scores": scores, "logs": len(scores), **provenance()})
    nulls = calibration_scores(SCORES)
    cases = [Case(label, truth, decide(found, CHANNELS, nulls), found, seconds)
             for label, truth, found, seconds in judged]
    if settings.verbose:
        for case in cases:
            print(line(case))
    found = figures(cases) | (of_search(cases) if settings.stage == "test" else {})
    for name, one in found.items():
        print(f"{name:40s} {one['value']:.3f}  {one['unit']}")
    if settings.record:
        record("decision", "Verdicts by posterior weight, beside those of the search on the same logs", found)


Judged = tuple[str, dict[str, Any], Posterior, float]


def judge(settings: Benchmark) -> list[Judged]:
    """Label, truth, posterior and seconds of each log; what was weighed before is read."""
    paths = sorted((settings.work / settings.stage).glob("*.npz.xz"))
    paths = [path for path in paths if not settings.only or path.name.startswith(settings.only)]
    if settings.processes > 1:
        with ProcessPoolExecutor(settings.processes) as pool:
            return list(pool.map(_judge, paths))
    return [_judge(path) for path in paths]


def _judge(path: Path) -> Judged:
    label, work, stage = path.name.removesuffix(".npz.xz"), path.parent.parent, path.parent.name
    truth = json.loads((work / "truth" / stage / f"{label}.json").read_text())
    kept = work / "posterior" / stage / f"{label}.json"
    if not kept.exists():
        evidence = load(path)
        began = time.process_time()
        found = posterior(evidence)
        kept.parent.mkdir(parents=True, exist_ok=True)
        write_report(kept, {**asdict(found), "seconds": time.process_time() - began})
    content = json.loads(kept.read_text())
    seconds = content.pop("seconds")
    sets = tuple(Weighed(tuple(one["keys"]), one["log_evidence"], np.array(one["q"]), np.array(one["deviation"]),
                         tuple(one["parts"]), one["refitted"]) for one in content.pop("sets"))
    content |= {name: np.array(content[name]) for name in ("noise", "noise_low", "noise_high")}
    return label, truth, Posterior(sets=sets, **content), seconds


def line(case: Case) -> str:
    """One log in one line."""
    said = [f"{one.name} ({', '.join(one.members[1:])})" if one.members[1:] else one.name
            for one in case.verdict.effects]
    best = case.found.sets[0] if case.found.sets else None
    mark = "ok " if right(case) else "   "
    return (f"{mark}{case.label:34s} {case.verdict.verdict:11s} score {case.found.score:8.1f} "
            f"unknown {case.found.unknown - case.found.none:8.1f} best "
            f"{'+'.join(best.keys) if best else ''} {best.log_evidence - case.found.none if best else 0:8.1f} {said}")


def named(truth: str, classes: Sequence[Sequence[str]]) -> bool:
    """Whether an effect, or the one of the catalogue that covers it, is in a named class."""
    return any((EFFECTS[truth].covered or truth) in members for members in classes)


def right_of(effects: Sequence[str], verdict: str, classes: Sequence[Sequence[str]]) -> bool:
    """Whether a verdict is right: all that can be named is named, and nothing else."""
    if not effects:
        return verdict == "none"
    if not all(EFFECTS[name].can_be_named for name in effects):
        return verdict == "unexplained"
    return verdict == "named" and all(named(name, classes) for name in effects)


def classes_of(case: Case) -> list[tuple[str, ...]]:
    """Classes of the named effects."""
    return [one.members for one in case.verdict.effects]


def right(case: Case) -> bool:
    """Whether the posterior's verdict is right."""
    return right_of(list(case.effects), case.verdict.verdict, classes_of(case))


def figures(cases: Sequence[Case]) -> dict[str, dict[str, Any]]:
    """Of the posterior."""
    out: dict[str, dict[str, Any]] = {}
    for noise in sorted({case.truth["noise"] for case in cases if case.kind == "null"}):
        mine = [case for case in cases if case.kind == "null" and case.truth["noise"] == noise]
        false = sum(case.verdict.verdict != "none" for case in mine)
        about = f"of {len(mine)} logs with nothing in them, at {noise:g} times the noise of the reference days"
        out[f"false_alarms_noise_{noise:g}"] = figure([float(false)], about)
        out[f"false_alarm_upper_noise_{noise:g}"] = figure([upper_rate(false, len(mine))], f"share, {about}")
        inside = [low <= noise <= high for case in mine for _, low, high in case.verdict.noise.values()]
        out[f"noise_factor_coverage_{noise:g}"] = figure(
            [float(np.mean(inside))], f"share of {len(inside)} 95 % intervals, {len(mine)} logs")
    for kind, scale, tag in (("scaled", 2.0, "2x"), ("scaled", 4.0, "4x"), ("noisy", 4.0, "4x_noisy")):
        inside_of = [case for case in cases if case.kind == kind and case.truth["scale"] == scale]
        out |= of_singles([(next(iter(case.effects)), case.verdict.verdict, classes_of(case)) for case in inside_of],
                          tag)
    out |= of_pairs([(list(case.effects), case.verdict.verdict, classes_of(case))
                     for case in cases if case.kind == "pair"], "")
    if cases:
        out["decision_lines"] = figure([float(sum(len((MISSING / f"{name}.py").read_text().splitlines())
                                                  for name in REACHED))], "lines reached between evidence and verdict")
        out["decision_thresholds"] = figure([float(len(fields(Rules)))], "thresholds")
        out["verdict_s"] = figure([case.seconds for case in cases], f"s of one core, median of {len(cases)} logs")
    return out


Row = tuple[str, str, Sequence[Sequence[str]]]


def of_singles(rows: Sequence[Row], tag: str) -> dict[str, dict[str, Any]]:
    """Right and wrong names of logs with one effect each."""
    known = [row for row in rows if EFFECTS[row[0]].can_be_named]
    beyond = [row for row in rows if not EFFECTS[row[0]].can_be_named]
    out = {}
    if known:
        good = [named(name, classes) for name, _, classes in known]
        wrong = [verdict == "named" and not ok for (_, verdict, _), ok in zip(known, good, strict=True)]
        about = f"share of {len(known)} logs"
        out[f"class_accuracy_{tag}"] = figure([float(np.mean(good))], about)
        out[f"wrong_name_{tag}"] = figure([float(np.mean(wrong))], about)
        sizes = [len(members) for _, _, classes in known for members in classes]
        if sizes:
            out[f"mean_class_size_{tag}"] = figure([float(np.mean(sizes))], "effects")
    if beyond:
        out[f"out_of_catalogue_{tag}"] = figure([float(np.mean([row[1] == "unexplained" for row in beyond]))],
                                                f"share of {len(beyond)} logs that are said to be unexplained")
        out[f"out_of_catalogue_named_{tag}"] = figure([float(np.mean([row[1] == "named" for row in beyond]))],
                                                      f"share of {len(beyond)} logs")
    return out


def of_pairs(rows: Sequence[tuple[Sequence[str], str, Sequence[Sequence[str]]]], tag: str) -> dict[str, dict[str, Any]]:
    """Both named, and no wrong one, of logs with two effects."""
    if not rows:
        return {}
    both = [all(named(name, classes) for name in truth) for truth, _, classes in rows]
    wrong = [not all(set(members) & set(truth) for members in classes) for truth, _, classes in rows]
    about = f"share of {len(rows)} logs"
    return {f"pair_both{tag}": figure([float(np.mean(both))], about),
            f"pair_wrong{tag}": figure([float(np.mean(wrong))], f"{about} with a wrong name")}


def of_search(cases: Sequence[Case]) -> dict[str, dict[str, Any]]:
    """What the search said of the same logs, and on how many of them each of the two is right alone."""
    rows = [row for row in json.loads((RESULTS / "undeclared.json").read_text())["confusion"]
            if (row.get("noise", 1.0), row.get("vehicle", "chair")) == (1.0, "chair")]
    by_label: dict[str, dict[str, Any]] = {}
    seen: dict[str, int] = {}
    for row in rows:
        if row["stage"] in ("scaled", "pair"):
            alone = "" if row["stage"] == "pair" else f"{next(iter(row['truth']))}_x{row['scale']:g}_"
            number = seen[alone] = seen.get(alone, -1) + 1
            by_label[f"{alone}{number}" if alone else f"pair_{number:02d}"] = row
    both = [(case, by_label[case.label]) for case in cases
            if case.label in by_label and _same(case.effects, by_label[case.label]["truth"])]
    out: dict[str, dict[str, Any]] = {}
    for scale, tag in ((2.0, "2x"), (4.0, "4x")):
        out |= of_singles([(next(iter(case.effects)), row["verdict"], row["classes"]) for case, row in both
                           if case.kind == "scaled" and row["scale"] == scale], f"{tag}_search")
    out |= of_pairs([(list(case.effects), row["verdict"], row["classes"]) for case, row in both
                     if case.kind == "pair"], "_search")
    if both:
        other = [right_of(list(case.effects), row["verdict"], row["classes"]) for case, row in both]
        mine = [right(case) for case, _ in both]
        about = f"of {len(both)} logs that both judged"
        for name, value in (("right", sum(mine)), ("right_search", sum(other)),
                            ("right_alone", sum(a and not b for a, b in zip(mine, other, strict=True))),
                            ("right_alone_search", sum(b and not a for a, b in zip(mine, other, strict=True)))):
            out[name] = figure([float(value)], about)
    return out


def _same(mine: Mapping[str, float], theirs: Mapping[str, float]) -> bool:
    return set(mine) == set(theirs) and all(np.isclose(mine[name], theirs[name], rtol=1e-3) for name in mine)


if __name__ == "__main__":
    run(Benchmark, main, __doc__, positional=False)

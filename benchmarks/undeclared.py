"""Effects that nobody declared: what the closed loop says of logs whose contents it is not told.

    python -m benchmarks.undeclared --shared            the sets of ../shared/data/undeclared against plant/plain*
    python -m benchmarks.undeclared --nulls 20 --effects --scales 1 2 --seeds 1

The second form drives logs with the contact plant (`benchmarks/plant`): reference days, days with nothing in them, each
catalogue effect at multiples of its base size, and effects that the catalogue does not have. What a log contains goes
into a file beside it that the loop never reads. Verdicts are kept in `runs/undeclared` and a run that was stopped goes
on where it was; the figures are written at the end from all verdicts there.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.harness import RESULTS, device_name, figure, provenance, record
from sysid.close_loop import LoopConfig, Result, close_loop, prepare
from sysid.log import Log, load_log
from sysid.loop.reference import Reference, make_reference
from sysid.loop.report import effects as named_effects
from sysid.loop.report import make_report, write_run
from sysid.rollout import vehicle_plant
from whill_mjx.config import VehicleConfig
from whill_mjx.presets import preset_params

REFERENCES = ("plain", "plain_2", "plain_3", "plain_4", "plain_5", "plain_6")
SETS = ("a", "b", "c", "d", "e", "f", "g", "h")


@dataclass(frozen=True)
class Benchmark:
    """What to run."""

    shared: bool = False
    """The undeclared sets, with the plain drives as reference."""
    sets: tuple[str, ...] = SETS
    """Which of them."""
    data: Path = Path("../shared/data")
    """Folder with `plant` and `undeclared`."""
    nulls: int = 0
    """Logs of the contact plant with nothing in them."""
    effects: bool = False
    """Logs of the contact plant with one effect each, of the catalogue and beyond it."""
    only: tuple[str, ...] = ()
    """Only these effects."""
    scales: tuple[float, ...] = (1.0,)
    """Multiples of each effect's base size."""
    seeds: int = 1
    """Logs of each effect and size."""
    classes: bool = False
    """Which effects look alike, per set of sensors, into sysid/data/classes.json."""
    collect: bool = False
    """Only write the figures from the verdicts that are there."""
    work: Path = Path("runs/undeclared")
    """Folder for logs and verdicts."""
    part: str = "1/1"
    """I/N: only every N-th log from the I-th on, for several processes."""


def main(settings: Benchmark) -> None:
    """Run what was asked for."""
    if settings.shared:
        shared(settings)
    if settings.nulls or settings.effects:
        plant(settings)
    if settings.classes:
        look_alikes(settings)
    if settings.collect:
        figures(settings.work / "plant")


def shared(settings: Benchmark) -> None:
    """One command, the same settings for all sets."""
    references = [load_log(settings.data / "plant" / name) for name in REFERENCES]
    config = LoopConfig()
    ready = prepare(reference_of(references, config), references[0].spec, config)
    path = RESULTS / "undeclared_shared.json"
    content = json.loads(path.read_text()) if path.exists() else {"sets": {}}
    content.update(claim="Verdicts on logs with at most one undeclared effect each", device=device_name(),
                   **provenance())
    for name in settings.sets:
        began = time.perf_counter()
        log = load_log(settings.data / "undeclared" / name)
        result = replace(close_loop(log, (), config, reference=ready), references=tuple(references))
        report = make_report(result)
        write_run(settings.work / "shared" / name, result, report)
        content["sets"][name] = {
            "verdict": report["verdict"], "reason": report["reason"],
            "effects": [{key: one[key] for key in ("name", "kind", "class", "parameters", "p_value")}
                        for one in report["effects"]],
            "lives_in": report["lives_in"][:3], "before": report["before"], "after": report["after"],
            "seconds": time.perf_counter() - began}
        print(name, report["verdict"], [one["name"] for one in report["effects"]], report["reason"], flush=True)
        write_json(path, content)


def reference_of(logs: Sequence[Log], config: LoopConfig) -> Reference:
    """The reference, made once for all logs of one vehicle."""
    plant = vehicle_plant(logs[0].spec, VehicleConfig(physics_dt=config.physics_dt))
    return make_reference(plant, preset_params(logs[0].spec, config.preset), logs, True, config.iterations,
                          progress=lambda _, remark: print(remark, flush=True))


def plant(settings: Benchmark) -> None:
    """Logs of the contact plant."""
    from benchmarks.plant.effects import EFFECTS
    from benchmarks.plant.make import make_log

    work = settings.work / "plant"
    days = reference_days(work)
    jobs: list[tuple[str, dict[str, float], int]] = [(f"null_{n:03d}", {}, 2000 + n) for n in range(settings.nulls)]
    if settings.effects:
        for index, (name, effect) in enumerate(sorted(EFFECTS.items())):
            if settings.only and name not in settings.only:
                continue
            for scale in settings.scales:
                for seed in range(settings.seeds):
                    jobs.append((f"{name}_x{scale:g}_{seed}", {name: scale * effect.base}, 3000 + 50 * index + seed))
    first, count = (int(one) for one in settings.part.split("/"))
    jobs = [job for number, job in enumerate(jobs) if number % count == first - 1]
    config = LoopConfig()
    ready = None
    for label, content, seed in jobs:
        verdict = work / "verdicts" / f"{label}.json"
        if verdict.exists():
            continue
        if ready is None:
            ready = prepare(reference_of(days, config), days[0].spec, config)
        folder = work / "logs" / label
        if not folder.exists():
            make_log(folder, effects=content, seed=seed)
        write_json(work / "truth" / f"{label}.json", content)
        began = time.perf_counter()
        result = close_loop(load_log(folder), (), config, reference=ready)
        write_json(verdict, {**brief(result), "seconds": time.perf_counter() - began})
        print(label, result.search.verdict, [one.hypothesis.key for one in result.search.accepted],
              f"{result.search.share:.2f}", flush=True)
    figures(work)


def reference_days(work: Path) -> list[Log]:
    """Six days of the contact plant with nothing in them: one with three replicates, five with one."""
    from benchmarks.plant.make import make_log

    days = []
    for number in range(6):
        path = work / "reference" / f"day_{number + 1}"
        if not path.exists():
            make_log(path, seed=1001 + number, replicates=3 if number == 0 else 1)
        days.append(load_log(path))
    return days


def look_alikes(settings: Benchmark) -> None:
    """Classes of effects on the nine manoeuvres, with and without an outside pose."""
    from sysid.loop.catalogue import base_values, hypotheses, with_catalogue
    from sysid.loop.classes import classes, imitation
    from sysid.loop.drives import make_drives
    from sysid.loop.evidence import gather

    days = reference_days(settings.work / "plant")
    content: dict[str, Any] = {"threshold": 0.9, "command": "python -m benchmarks.undeclared --classes", "sensors": {}}
    for sensors, keep in (("odometry", False), ("odometry and outside pose", True)):
        logs = [log if keep else replace(log, trials=tuple(replace(t, ground_truth=None) for t in log.trials))
                for log in days]
        reference = reference_of(logs, LoopConfig())
        found = hypotheses(logs[0].spec, reference.params)
        full = with_catalogue(reference.params, found)
        base = base_values(full)
        plant = vehicle_plant(logs[0].spec, VehicleConfig())
        drives = make_drives(plant, full, tuple(base), logs[0].training)
        at = drives.simulate(np.array([list(base.values())]))[0]
        evidence, _ = gather(drives.weighted(at, reference.factors, logs[0].spec.track), reference, found, full)
        members = classes(imitation(evidence, found), found)
        content["sensors"][sensors] = {"classes": members,
                                       "mean_size": float(np.mean([len(each) for each in members.values()]))}
    write_json(Path("sysid/data/classes.json"), content)


def brief(result: Result) -> dict[str, Any]:
    """A verdict without its report; held-out trials stay closed."""
    found = result.search
    return {"verdict": found.verdict, "share": found.share, "excess": list(found.excess),
            "p_value": found.p_value, "gain": float(found.scan.gain.max()),
            "effects": [{key: one[key] for key in ("name", "class", "parameters", "p_value")}
                        for one in named_effects(result)] if found.verdict == "named" else [],
            "candidates": [[[one.hypothesis.key, one.gain, one.share, one.refit.q.tolist()] for one in each]
                           for each in found.rounds]}


def figures(work: Path) -> None:
    """Write benchmarks/results/undeclared.json from all verdicts in the work folder."""
    from scipy import stats

    from benchmarks.plant.effects import EFFECTS

    cases = list(read_cases(work))
    nulls = [one for truth, one, _ in cases if not truth]
    found: dict[str, Any] = {}
    if nulls:
        false = sum(one["verdict"] != "none" for one in nulls)
        found["false_alarms"] = figure([float(false)], f"of {len(nulls)} logs with nothing in them")
        found["false_alarm_upper"] = figure([float(stats.beta.ppf(0.95, false + 1, len(nulls) - false))], "share")
        found["null_ks_p"] = figure([float(stats.kstest([one["p_value"] for one in nulls], "uniform").pvalue)], "-")
    for scale in sorted({scale for truth, _, scale in cases if truth}):
        inside = [(next(iter(truth)), one) for truth, one, s in cases if truth and s == scale]
        known = [(name, one) for name, one in inside if EFFECTS[name].known]
        beyond = [one for name, one in inside if not EFFECTS[name].known]
        tag = f"x{scale:g}_base"
        if known:
            right = [any(name == e["name"] or name in e["class"] for e in one["effects"]) for name, one in known]
            sizes = [len(e["class"]) for _, one in known for e in one["effects"]]
            found[f"class_accuracy_{tag}"] = figure([float(np.mean(right))], f"share of {len(known)} logs")
            wrong = [one["verdict"] == "named" and not ok for (_, one), ok in zip(known, right, strict=True)]
            found[f"wrong_name_{tag}"] = figure([float(np.mean(wrong))], f"share of {len(known)} logs")
            if sizes:
                found[f"mean_class_size_{tag}"] = figure([float(np.mean(sizes))], "effects")
        if beyond:
            found[f"out_of_catalogue_{tag}"] = figure(
                [float(np.mean([one["verdict"] == "unexplained" for one in beyond]))], f"share of {len(beyond)} logs")
    seconds = [one["seconds"] for _, one, _ in cases]
    found["seconds_per_log"] = figure(seconds, "s, reference fit apart")
    path = record("undeclared", "Undeclared effects in logs of an independent contact plant", found)
    content = json.loads(path.read_text())
    content["confusion"] = [{"truth": truth, "verdict": one["verdict"], "named": [e["name"] for e in one["effects"]],
                             "classes": [e["class"] for e in one["effects"]], "explained": one["share"]}
                            for truth, one, _ in cases]
    write_json(path, content)


def read_cases(work: Path) -> Iterable[tuple[dict[str, float], dict[str, Any], float]]:
    """Truth, verdict and scale of every log that has a verdict."""
    from benchmarks.plant.effects import EFFECTS

    for path in sorted((work / "verdicts").glob("*.json")):
        truth = json.loads((work / "truth" / path.name).read_text())
        scale = 0.0
        for name, size in truth.items():
            scale = round(size / EFFECTS[name].base, 6)
        yield truth, json.loads(path.read_text()), scale


def write_json(path: Path, content: Any) -> None:
    """Write whole or not at all."""
    from sysid.report import write_report

    path.parent.mkdir(parents=True, exist_ok=True)
    write_report(path, content)


if __name__ == "__main__":
    import tyro

    main(tyro.cli(Benchmark, description=__doc__))

"""Verdicts of the closed loop on logs of the contact plant: which logs are driven, and what is kept of them.

First every effect is driven at its base size and then at others, until it stands out about as far as what is noticed
with 80 % power. Logs at 2 and 4 times that size (or the largest with which the chair still drives its manoeuvres), and
with pairs of effects, follow. What a log contains is written into a file beside it that the loop never reads.
`benchmarks/undeclared_figures.py` counts.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.harness import RESULTS, device_name
from benchmarks.plant.chair import VEHICLES
from benchmarks.plant.effects import EFFECTS, in_proportion
from benchmarks.plant.make import Experiment, make_log
from benchmarks.undeclared_reference import USUAL, Driven, reference_days
from sysid.follow_up.trust import warnings
from sysid.logs.log import load_log
from sysid.pages.loop_report import effects as named_effects
from sysid.pages.loop_report import make_report, write_run
from sysid.pages.report import write_report
from sysid.verdict.pipeline import find_missing
from sysid.verdict.posterior import Thresholds, as_json, from_json, posterior
from sysid.verdict.result import LoopConfig, Prepared, Result
from sysid.verdict.search_record import LARGEST

RECORDED = RESULTS / "undeclared.json"
POWER = 0.84
"""Standard deviations between the limit and the mean of what is noticed in 80 % of all cases."""
NEAR, FAR = (0.3, 3.0), (0.1, 10.0)
"""How far an effect may stand out, of what 80 % power needs, where its size is taken for found, and at all used."""
PROBES = 10
"""Logs with which the size of an effect is looked for at most."""
BESIDE = 2.0
"""Factor on a size within which a second log must have been driven, before what one log showed there is believed."""
ALIKE = 10.0
"""Factor by which such logs may differ, beyond the square of their sizes, where an effect does not strike at random."""
SURE = 4
"""Logs at up to `BESIDE`^2 times a size that must all have stood out where it does."""
BRACKET = 1.3
"""Factor between a size that does not stand out enough and one that does at which they are close enough."""
OWN_SET, OWN_SEED = 100, 25000
"""Number of the first set of reference days that one log alone is judged against, and the seed of that log."""
REACH = 100.0
"""Factor on the base size, up or down, beyond which no size is tried."""


@dataclass(frozen=True)
class Job:
    """One log to drive and to judge."""

    label: str
    effects: Mapping[str, float]
    seed: int
    scale: float = 0.0
    """Multiple of the 80 %-power size; 0 at base size and where there is nothing."""
    stage: str = "null"
    """null, base, scaled, pair, left_out or noisy."""
    log: str = ""
    """Label of the log, where another job drives it."""
    without: tuple[str, ...] = ()
    """Effects that the catalogue does not have."""
    reference: int = 0
    """Set of reference days that it is judged against."""
    noise: float = 1.0
    """Factor on its noise beside that of the reference days."""


def mine(number: int, part: str) -> bool:
    """Whether the process I of N, `part` "I/N", has this log or effect."""
    first, count = (int(one) for one in part.split("/"))
    return number % count == first - 1


def claimed(work: Path, label: str) -> bool:
    """Whether this process is the first of all that share the folder to take a log."""
    (work / "claims").mkdir(parents=True, exist_ok=True)
    try:
        os.close(os.open(work / "claims" / label, os.O_CREAT | os.O_EXCL))
    except FileExistsError:
        return False
    return True


def null_jobs(nulls: int, part: str, sets: int = 1) -> list[Job]:
    """Logs with nothing in them, dealt over sets of reference days."""
    return [Job(f"null_{n:03d}", {}, 20000 + n, reference=n % sets) for n in range(nulls)
            if mine(_dealt(n, sets, part), part)]


def _dealt(null: int, sets: int, part: str) -> int:
    """Number by which a null goes to a process, such that each needs as few sets of reference days as can be."""
    [_, count] = part.split("/")
    number = null % sets
    sharing = len(range(number, int(count), sets))  # processes that can have this set for their only one
    return number + sets * (null // sets % sharing) if sharing else number


def own_set_jobs(count: int, part: str) -> list[Job]:
    """Logs with nothing in them, each against a set of reference days that no other log is judged against."""
    return [Job(f"null_own_{n:03d}", {}, OWN_SEED + n, reference=OWN_SET + n) for n in range(count) if mine(n, part)]


def noisy_jobs(usual: Sequence[Job], levels: Sequence[float], nulls: int, part: str, sets: int = 1) -> list[Job]:
    """Logs noisier or quieter than the reference days: with nothing in them, dealt over sets of these days, and those
    of other jobs (`scaled_jobs`, `pair_jobs`) driven anew. They are mixed, so that a part of them is a fair part."""
    listed = [(n / nulls, Job(f"noise_{level:g}_{n:03d}", {}, 20000 + n + round(1000 * (level - 1)), stage="noisy",
                              noise=level, reference=n % sets))
              for n in range(nulls) for level in levels]
    listed += [(n / len(usual), replace(job, label=f"{job.label}_noise_{level:g}", seed=job.seed + 4000,
                                        stage="noisy", noise=level))
               for level in levels for n, job in enumerate(usual)]
    return [job for n, (_, job) in enumerate(sorted(listed, key=lambda one: one[0])) if mine(n, part)]


def probe_jobs(work: Path, part: str, only: Sequence[str] = ()) -> list[Job]:
    """The next log of each effect (of those in `only`, if any) that brings its size nearer to where it would be noticed
    with 80 % power."""
    out = []
    for i, name in enumerate(sorted(EFFECTS)):
        points = seen_at(work, name)
        size = next_size(EFFECTS[name].base, points) if mine(i, part) and name in (only or EFFECTS) else None
        if size is not None:
            label = f"{name}_probe_{len(points)}" if points else f"{name}_base"
            out.append(Job(label, {name: size}, 30000 + 50 * i + 40 + len(points), stage="base"))
    return out


def scaled_jobs(
    work: Path, scales: Sequence[float], seeds: int, part: str, driven: Driven = USUAL, only: Sequence[str] = ()
) -> list[Job]:
    """Logs with one effect each (of `only`, if any), at multiples of that size, as far as the chair still drives."""
    sizes = power_sizes(work, driven)
    return [Job(f"{name}_x{scale:g}_{seed}", {name: capped(name, scale * sizes[name], driven)},
                30001 + 50 * i + 10 * j + seed, scale, "scaled")
            for i, name in enumerate(sorted(EFFECTS)) if name in sizes and mine(i, part) and name in (only or sizes)
            for j, scale in enumerate(scales) for seed in range(seeds)]


def left_out_jobs(work: Path, part: str) -> list[Job]:
    """The logs with one effect of the catalogue at four times that size, for a catalogue without that effect."""
    return [replace(job, label=f"{job.label}_left_out", log=job.label, stage="left_out", without=tuple(job.effects))
            for job in scaled_jobs(work, (4.0,), 1, part) if all(EFFECTS[name].known for name in job.effects)]


def pair_jobs(work: Path, pairs: int, part: str, driven: Driven = USUAL) -> list[Job]:
    """Logs with two effects each, at four times that size; the sizes of all effects must be there."""
    sizes = power_sizes(work, driven)
    known = [name for name in sorted(EFFECTS) if EFFECTS[name].known and name in sizes]
    random, out = np.random.default_rng([7, driven.draw] if driven.draw else 7), []
    for n in range(pairs if len(known) > 1 else 0):
        first, second = random.choice(known, 2, replace=False)
        effects = {str(name): capped(name, 4 * sizes[name], driven) for name in (first, second)}
        out.append(Job(f"pair_{n:02d}", effects, 60000 + n, 4.0, "pair"))
    return [job for n, job in enumerate(out) if mine(n, part)]


def capped(name: str, size: float, driven: Driven = USUAL) -> float:
    """A size with which the vehicle still drives."""
    return min(size, in_proportion(name, EFFECTS[name].most, VEHICLES[driven.vehicle]))


Point = tuple[float, float]
"""Size of an effect, and how far it stood out there: 1 where 80 % would be noticed."""


def seen_at(work: Path, name: str) -> list[Point]:
    """The sizes at which an effect was driven to find its size, smallest first."""
    points = []
    for path in (work / "verdicts").glob(f"{name}_*.json"):
        one = json.loads(path.read_text())
        if one["stage"] == "base":
            [size] = json.loads((work / "truth" / path.name).read_text()).values()
            found = max(one["worth"] / one["worth_limit"], one["excess"][0] / one["excess_limit"], 0.01)
            points.append((size, found / (1 + POWER / np.sqrt(one["worth_limit"])) ** 2))
    return sorted(points)


def rising(points: Sequence[Point]) -> list[Point]:
    """The same sizes, each with how far the effect stood out at least there and at every larger size.

    What strikes at random may stand out at a small size by luck: it must not have been missed at a larger one.
    """
    points = sorted(points)
    least = np.minimum.accumulate([found for _, found in reversed(points)])[::-1]
    return [(size, float(found)) for (size, _), found in zip(points, least, strict=True)]


def next_size(base: float, points: Sequence[Point]) -> float | None:
    """Where to drive an effect next; None where a size is close enough and the logs around it agree, or none is in
    reach."""
    if not points:
        return base
    if len(points) >= PROBES:
        return None
    steady = rising(points)
    near = min(steady, key=lambda point: abs(np.log(point[1])))
    below = [size for size, found in steady if found < 1]
    above = [size for size, found in steady if found >= 1]
    if NEAR[0] < near[1] < NEAR[1] or (below and above and min(above) < BRACKET * max(below)):
        return _check_at(crossing(steady), points)
    if below and above:
        return float(np.sqrt(max(below) * min(above)))
    size, found = max(steady) if below else min(steady)
    size *= float(np.clip(found**-0.5, 1 / 8, 3.0))  # what stands out grows with the square of the size
    return size if abs(np.log(size / base)) < np.log(REACH) else None


def _check_at(size: float | None, points: Sequence[Point]) -> float | None:
    """Where to drive once more to believe in a size; None where that is not needed."""
    if size is None:
        return None
    beside = [found / one**2 for one, found in points if 1 / BESIDE <= one / size <= BESIDE]
    if len(beside) < 2:
        return size
    if max(beside) <= ALIKE * min(beside) or sum(size <= one <= BESIDE**2 * size for one, _ in points) >= SURE:
        return None
    return size * float(np.sqrt(BESIDE))


def power_sizes(work: Path, driven: Driven = USUAL) -> dict[str, float]:
    """Size of each effect that would be noticed with 80 % power; without those for which no such size was found.

    Of an effect that was not driven to find its size, it is the recorded one of the chair, times the noise and in
    proportion to the vehicle.
    """
    seen = {name: seen_at(work, name) for name in EFFECTS}
    recorded = json.loads(RECORDED.read_text())["sizes"] if RECORDED.exists() else {}
    found = {name: size_between(EFFECTS[name].base, points) if points
             else driven.noise * in_proportion(name, recorded[name]["value"], VEHICLES[driven.vehicle])
             if name in recorded else None for name, points in seen.items()}
    return {name: size for name, size in found.items() if size is not None}


def size_between(base: float, points: Sequence[Point]) -> float | None:
    """The size at which an effect stands out by 1, once the search for it is over."""
    if not points or next_size(base, points) is not None:
        return None
    return crossing(rising(points))


def crossing(points: Sequence[Point]) -> float | None:
    """Where rising points pass 1, or would; None where they are too far from it."""
    above = min((point for point in points if point[1] >= 1), default=None)
    below = max((point for point in points if point[1] < 1), default=None)
    if above and below:
        rate = np.log(above[1] / below[1]) / np.log(above[0] / below[0])
        return float(below[0] * below[1] ** (-1 / rate))
    size, found = above or below or points[0]
    return float(size * found**-0.5) if FAR[0] < found < FAR[1] else None


def judge(
    job: Job, ready: Prepared, work: Path, config: LoopConfig, full: bool, driven: Driven = USUAL
) -> dict[str, Any]:
    """Drive a log, close the loop on it, and keep the verdict; `full` also opens its held-out trials."""
    verdict = work / "verdicts" / f"{job.label}.json"
    if verdict.exists():
        return json.loads(verdict.read_text())
    folder = work / "logs" / (job.log or job.label)
    if not folder.exists():
        make_log(folder, Experiment(effects=job.effects, seed=driven.seed(job.seed), noise=driven.noise * job.noise,
                 vehicle=driven.vehicle))
    began = time.perf_counter()
    config = replace(config, without=job.without)
    result = find_missing(load_log(folder), (), config, reference=ready)
    content = {"stage": job.stage, "scale": job.scale, "reference": job.reference, "draw": driven.draw,
               "noise": job.noise, **brief(result),
               "seconds": time.perf_counter() - began, "device": device_name()}
    if full and result.search.verdict == "named":
        report = make_report(result)
        write_run(work / "reports" / job.label, result, report)
        after = report["after"]["held_out"]["ground_truth"]
        content["heldout_ratio"] = after["trajectory"] / after["noise_floor"]["trajectory"]
        before = report["refitted"]["held_out"]["ground_truth"]  # a fair peer: it may move base parameters too
        content["heldout_ratio_before"] = before["trajectory"] / before["noise_floor"]["trajectory"]
        content["full_seconds"] = time.perf_counter() - began
    verdict.parent.mkdir(parents=True, exist_ok=True)
    (work / "truth").mkdir(parents=True, exist_ok=True)
    write_report(work / "truth" / f"{job.label}.json", dict(job.effects))
    write_report(verdict, content)
    return content


def replay(work: Path) -> None:
    """Judge again what has a verdict, from the evidence in it, by the present decision. A set of effects that was not
    the chosen one before has no intervals, and is contradicted only where it was put to the test."""
    for path in sorted((work / "verdicts").glob("*.json")):
        content = json.loads(path.read_text())
        if content.get("findings") is None:
            continue
        findings = from_json(content["findings"])
        judged = posterior(findings, Thresholds())
        before = {one["name"]: one["parameters"] for one in content["effects"]}
        content.update(verdict=judged.verdict, share=judged.share, weights=judged.weights)
        chosen = None if judged.chosen is None else findings.sets[judged.chosen]
        if chosen is not None and set(before) != set(chosen.effects):
            before = {}
        content["excess"][1] = findings.excess if chosen is None else chosen.left.excess
        content["effects"] = [] if chosen is None or judged.verdict != "named" else [
            {"name": name, "class": members[:LARGEST], "parameters": before.get(name, {}),
             "p_value": p} for name, members, p in zip(chosen.effects, chosen.apart(), chosen.p, strict=True)]
        write_report(path, content)


def speed(work: Path, refit_nulls: int = 0) -> None:
    """Time the command line with its compilations, and keep what its simulated days said."""
    reference_days(work)
    log = work / "logs" / "speed"
    if not log.exists():
        make_log(log, Experiment(effects={"slope": EFFECTS["slope"].base}, seed=70000))
    days, out = sorted((work / "reference").glob("day_*")), work / f"speed_{refit_nulls}"
    command = [sys.executable, "-m", "sysid.close_loop", log, "--reference", *days, "--out", out, "--refit-nulls",
               refit_nulls]
    environment = {key: value for key, value in os.environ.items() if key != "JAX_COMPILATION_CACHE_DIR"}
    began = time.perf_counter()
    subprocess.run([str(part) for part in command], check=True, env=environment)
    nulls = json.loads((out / "report.json").read_text())["missing"]["null_refits"]
    seconds = time.perf_counter() - began
    write_report(work / f"speed_{refit_nulls}.json", {"seconds": seconds, "nulls": nulls, "device": device_name()})


def brief(result: Result) -> dict[str, Any]:
    """A verdict without its report; held-out trials stay closed."""
    found, alpha = result.search, result.config.thresholds.alpha
    wander = result.prepared.wander
    return {"verdict": found.verdict, "share": found.share, "excess": list(found.excess), "p_value": found.p_value,
            "scan_p": found.scan.p_family, "worth": float(found.scan.worth.max()),
            "worth_limit": float(np.quantile(found.scan.null.max(1), 1 - alpha)),
            "excess_limit": wander.excess_limit(alpha), "warnings": warnings(result),
            "noise_levels": {} if result.noise is None else result.noise.report(),
            "effects": [{key: one[key] for key in ("name", "class", "parameters", "p_value")}
                        for one in named_effects(result)] if found.verdict == "named" else [],
            "stood": [{"effect": one.effect, "manoeuvres": one.agreement.outcome, "scatter": one.agreement.scatter,
                       "scatter_least": one.agreement.least,
                       "predictions": [[each.falsifier.by, each.outcome, each.power] for each in one.falsifiers]}
                      for one in result.stood],
            "weights": found.weights, "findings": None if found.findings is None else as_json(found.findings),
            "candidates": [[[one.hypothesis.key, one.gain, one.share, one.p, one.refit.q.tolist()] for one in each]
                           for each in found.rounds]}

"""Effects that nobody declared: what the closed loop finds in logs whose effects are hidden from it.

    python -m benchmarks.undeclared --shared            the sets of ../shared/data/undeclared against plant/plain*
    python -m benchmarks.undeclared --nulls 200 --base --scales 2 4 --pairs 10

    for i in $(seq 44); do python -m benchmarks.undeclared --nulls 200 --reference-sets 44 --part $i/44 & done; wait
    for i in $(seq 28); do python -m benchmarks.undeclared --scales 2 4 --seeds 4 --pairs 90 --share & done; wait
    for i in $(seq 16); do python -m benchmarks.undeclared --sensor-noise 0.5 2 4 --share & done; wait
    python -m benchmarks.undeclared --collect
    python -m benchmarks.undeclared --draw 1 --nulls 8 --scales 2 4 --pairs 8

The second form drives logs with the contact plant (`benchmarks/undeclared_plant.py`), the others do so in processes
that share a folder, each with a part of its own or with whatever is left. Verdicts are kept in `runs/undeclared` and a
run that was stopped goes on where it was; the figures are written at the end from all verdicts there. The last form
drives logs that no record has used.
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from benchmarks import undeclared_figures
from benchmarks import undeclared_plant as contact
from benchmarks.harness import RESULTS, device_name, provenance
from benchmarks.undeclared_reference import Driven, prepared, reference_days, reference_of
from sysid.logs.log import load_log
from sysid.missing.catalogue import Hypothesis
from sysid.pages.loop_report import make_report, write_run
from sysid.replay.rollout import vehicle_plant
from sysid.verdict.pipeline import find_missing
from sysid.verdict.preparation import prepare
from sysid.verdict.result import LoopConfig, Prepared
from whill_mjx.io.command_line import COUNT, NOT_NEGATIVE, run
from whill_mjx.vehicle.config import VehicleConfig

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
    nulls: Annotated[int, NOT_NEGATIVE] = 0
    """Logs of the contact plant with nothing in them."""
    reference_sets: Annotated[int, COUNT] = 1
    """Sets of reference days that these and `noisy_nulls` are judged against in turn; all else is judged against the
    first. With as many sets as there are processes (`part`), each makes one."""
    own_sets: Annotated[int, NOT_NEGATIVE] = 0
    """Further logs with nothing in them, each judged against a set of its own: their p-values are independent."""
    base: bool = False
    """Logs of the contact plant with one effect each, from its base size to the one that is noticed with 80 % power."""
    scales: tuple[float, ...] = ()
    """The same at multiples of that size."""
    seeds: Annotated[int, COUNT] = 1
    """Logs of each effect and multiple."""
    noise: Annotated[float, NOT_NEGATIVE] = 1.0
    """Factor on all disturbances and sensor noise, of the reference days too; each needs a `work` of its own."""
    sensor_noise: tuple[float, ...] = ()
    """Factors on the disturbances and the sensor noise of further logs alone, whose reference days keep the usual ones:
    `noisy_nulls` with nothing in them, `seeds` of each effect and `noisy_pairs` of two at four times that size."""
    noisy_nulls: Annotated[int, NOT_NEGATIVE] = 40
    noisy_pairs: Annotated[int, NOT_NEGATIVE] = 0
    vehicle: Literal["chair", "scooter", "robot"] = "chair"
    """What is driven, of `benchmarks.plant.chair.VEHICLES`; each needs a `work` of its own. `speed` and `classes`
    are of the chair."""
    draw: Annotated[int, NOT_NEGATIVE] = 0
    """Another draw of all that is driven: other seeds, reference days and pairs. The names of its days, logs and
    verdicts have its number, so several draws may share a `work`. Their figures are taken together, without draw 0,
    and end in `_fresh`: the weights of the decision were chosen with draw 0 in view."""
    pairs: Annotated[int, NOT_NEGATIVE] = 0
    """Logs with two effects of 4 times that size; after the sizes of all effects are there."""
    left_out: bool = False
    """The logs of 4 times that size against a catalogue that lacks the effect; after those logs are driven."""
    only: tuple[str, ...] = ()
    """Only logs with these effects, of those from `base` and `scales`."""
    labels: tuple[str, ...] = ()
    """Only logs of these names (without the number of a draw), in this order, of all that the other options ask for."""
    full: Annotated[int, COUNT] = 4
    """Every how many-th named log also has its held-out trials opened."""
    speed: bool = False
    """How long the whole command takes, from start to report, on a log of 27 trials with six reference days."""
    refit_nulls: Annotated[int, NOT_NEGATIVE] = 0
    """Simulated days that are refitted meanwhile."""
    classes: bool = False
    """Which effects look alike, per set of sensors, into sysid/data/classes.json."""
    calibrate: bool = False
    """Fit what p-values come to where nothing is missing, on half of the sets, into sysid/data/null_p.json."""
    replay: bool = False
    """Judge all logs that have a verdict again, from the evidence in it."""
    collect: bool = False
    """Only write the figures from the verdicts that are there."""
    work: Path = Path("runs/undeclared")
    """Folder for logs and verdicts."""
    share: bool = False
    """Judge what no other process has taken yet; any number of them may run. What a killed one had taken stays in
    WORK/plant/claims and is left out until it is removed there."""
    part: str = "1/1"
    """I/N: only every N-th log or effect from the I-th on, for several processes; `collect` then writes the figures."""

    @property
    def driven(self) -> Driven:
        """What drives the logs."""
        return Driven(self.noise, self.vehicle, self.draw)


def main(settings: Benchmark) -> None:
    """Run what was asked for."""
    if settings.shared:
        shared(settings)
    if (settings.nulls or settings.own_sets or settings.base or settings.scales or settings.pairs or settings.left_out
            or settings.sensor_noise):
        plant(settings)
    if settings.speed:
        contact.speed(settings.work / "plant", settings.refit_nulls)
    if settings.classes:
        look_alikes(settings)
    if settings.calibrate:
        undeclared_figures.calibrate(settings.work / "plant")
    if settings.replay:
        contact.replay(settings.work / "plant")
    if settings.collect:
        undeclared_figures.figures(settings.work / "plant", settings.driven)


def shared(settings: Benchmark) -> None:
    """One command, the same settings for all sets."""
    references = [load_log(settings.data / "plant" / name) for name in REFERENCES]
    config = LoopConfig()
    ready = prepare(reference_of(references, config), references[0].spec, config)
    path = RESULTS / "undeclared_shared.json"
    for name in settings.sets:
        began = time.perf_counter()
        log = load_log(settings.data / "undeclared" / name)
        result = replace(find_missing(log, (), config, reference=ready), references=tuple(references))
        report = make_report(result)
        write_run(settings.work / "shared" / name, result, report)
        content = json.loads(path.read_text()) if path.exists() else {"sets": {}}  # other processes have other sets
        content.update(claim="Verdicts on logs with at most one undeclared effect each", device=device_name(),
                       **provenance())
        content["sets"][name] = {
            "verdict": report["verdict"], "reason": report["reason"],
            "effects": [{key: one[key] for key in ("name", "kind", "class", "parameters", "p_value")}
                        for one in report["effects"]],
            "lives_in": report["lives_in"][:3], "as_it_was": report["before"], "before": report["refitted"],
            "after": report["after"],
            "seconds": time.perf_counter() - began}
        print(name, report["verdict"], [one["name"] for one in report["effects"]], report["reason"], flush=True)
        write_json(path, content)


def plant(settings: Benchmark) -> None:
    """Logs of the contact plant."""
    work, config, part, driven = settings.work / "plant", LoopConfig(), settings.part, settings.driven
    ready: dict[int, Prepared] = {}

    def judge(listed: Sequence[contact.Job]) -> None:
        for number, job in enumerate(listed):
            if (work / "verdicts" / f"{job.label}.json").exists() or (
                    settings.share and not contact.claimed(work, job.label)):
                continue
            if job.reference not in ready:
                ready.clear()  # one at a time: each has its compiled replay
                ready[job.reference] = prepared(work, job.reference, driven, config)
            full = job.stage in ("scaled", "pair") and bool(job.effects) and number % settings.full == 0
            one = contact.judge(job, ready[job.reference], work, config, full, driven)
            print(job.label, one["verdict"], [effect["class"] for effect in one["effects"]], f"{one['share']:.2f}",
                  f"p {one['p_value']:.2g}", f"{one['seconds']:.0f} s", flush=True)

    while settings.base and (listed := contact.probe_jobs(work, part, settings.only)):
        judge(listed)
    judge(wanted(settings))
    if part == "1/1" and not settings.share:
        undeclared_figures.figures(work, driven)


def wanted(settings: Benchmark) -> list[contact.Job]:
    """The logs that were asked for, in the order in which they are judged."""
    work, part, driven = settings.work / "plant", settings.part, settings.driven
    nulls = contact.null_jobs(settings.nulls, part, settings.reference_sets)
    listed = sorted(nulls, key=lambda job: job.reference) + contact.own_set_jobs(settings.own_sets, part)
    if settings.scales:
        listed += contact.scaled_jobs(work, settings.scales, settings.seeds, part, driven, settings.only)
    if settings.sensor_noise:
        usual = contact.scaled_jobs(work, (4.0,), settings.seeds, "1/1", driven, settings.only)
        usual += contact.pair_jobs(work, settings.noisy_pairs, "1/1", driven)
        listed += contact.noisy_jobs(usual, settings.sensor_noise, settings.noisy_nulls, part,
                                     settings.reference_sets)
    if settings.left_out:
        listed += contact.left_out_jobs(work, part)
    listed += contact.pair_jobs(work, settings.pairs, part, driven)
    by_name = {job.label: job for job in listed}
    chosen = [by_name[label] for label in settings.labels if label in by_name] if settings.labels else listed
    return [replace(job, label=driven.label(job.label), log=driven.label(job.log)) for job in chosen]


def look_alikes(settings: Benchmark) -> None:
    """Classes of effects on the nine manoeuvres, with and without an outside pose."""
    from sysid.missing.catalogue import base_values, hypotheses, with_catalogue
    from sysid.missing.drives import make_drives
    from sysid.missing.signatures import gather
    from sysid.replay.records import FreeVehicle
    from sysid.verdict.scan import imitation

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
        drives = make_drives(FreeVehicle(plant, full, tuple(base)), logs[0].training)
        at = drives.simulate(np.array([list(base.values())]))[0]
        evidence, _ = gather(drives.weighted(at, reference.factors, logs[0].spec.track), reference, found, full)
        members = classes(imitation(evidence, found), found)
        content["sensors"][sensors] = {"classes": members,
                                       "mean_size": float(np.mean([len(each) for each in members.values()]))}
    write_json(undeclared_figures.CLASSES, content)


def classes(
    alike: np.ndarray, hypotheses: Sequence[Hypothesis], threshold: float = 0.9, largest: int = 4
) -> dict[str, list[str]]:
    """Effect -> itself and the effects that imitate it, nearest first."""
    out: dict[str, list[str]] = {}
    for effect in dict.fromkeys(one.effect for one in hypotheses):
        mine = [i for i, one in enumerate(hypotheses) if one.effect == effect]
        nearest: dict[str, float] = {}
        for i in mine:
            for j, other in enumerate(hypotheses):
                if other.effect != effect and alike[i, j] > threshold:
                    nearest[other.effect] = max(nearest.get(other.effect, 0.0), float(alike[i, j]))
        out[effect] = [effect, *sorted(nearest, key=lambda name: -nearest[name])][:largest]
    return out


def write_json(path: Path, content: Any) -> None:
    """Write whole or not at all."""
    from sysid.pages.report import write_report

    path.parent.mkdir(parents=True, exist_ok=True)
    write_report(path, content)


if __name__ == "__main__":
    run(Benchmark, main, __doc__, positional=False)

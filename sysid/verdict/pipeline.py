"""From drives to a verdict: reference, evidence, search, and what the verdict must stand."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from sysid import command_line
from sysid.errors.features import bin_width, check_length
from sysid.errors.noise import NoiseLevels
from sysid.logs.log import check_same_vehicle
from sysid.logs.odd_trials import content_of
from sysid.logs.records import Log, Trial
from sysid.missing.catalogue import PARAMETER
from sysid.missing.days import Reference, Wander
from sysid.missing.evidence import Evidence
from sysid.missing.refit import Refitter
from sysid.missing.signatures import gather
from sysid.missing.unexplained import best_gain
from sysid.search.result import Progress
from sysid.verdict.alone import search_alone, stands_alone
from sysid.verdict.falsification import put_to_test
from sysid.verdict.late_pose import told_late
from sysid.verdict.null_refits import checked
from sysid.verdict.null_refits import run as run_null_refits
from sysid.verdict.posterior import Thresholds, contradicted
from sysid.verdict.preparation import as_shown, days_of, expected_steps, prepare, reference_for
from sysid.verdict.result import LoopConfig, Prepared, Result, Support
from sysid.verdict.rounds import Asked, begin
from sysid.verdict.search import pairs_of, settle
from sysid.verdict.search_record import PairScan, Search
from sysid.verdict.surroundings import floor_change, noise_change, with_noise


def find_missing(
    log: Log, references: Sequence[Log] = (), config: LoopConfig | None = None, vehicle: Any = None,
    progress: Progress | None = None, reference: Reference | Prepared | None = None,
) -> Result:
    """Verdict on the training trials of a log; its held-out trials are not looked at.

    Args:
        log: the drives in question.
        references: drives of the same vehicle on other days.
        vehicle: `VehicleParams` fitted before, kept as the reference; or `FittedVehicle`, with what its fit knows, or
            from which the fit of the base model starts.
        reference: a reference made before, for many logs of one vehicle; `prepare` also saves compiling again.
    """
    config = config or LoopConfig()
    check_logs(log, references)
    if log.fields.get("pose_stamps") == "receipt":
        config = replace(config, pose_delay=True)
    began = time.perf_counter()
    if reference is None:
        reference = reference_for(log, references, config, vehicle, progress)
    ready = reference if isinstance(reference, Prepared) else prepare(reference, log.spec, config, progress)
    log, ready = as_shown(log, ready)
    fitted = time.perf_counter()
    seen = _look(log, ready.without(config.without), config, progress)
    gathered = time.perf_counter()
    reference = seen.ready.reference
    anything = partial(best_gain, log.training, log.spec, width=reference.width, channels=reference.channels)
    asked = begin(seen.evidence, seen.ready, seen.refitter, config, anything, progress)
    alone = stands_alone(log.training, reference.known)
    judge: Callable[[Asked, PairScan | None], Search] = settle
    if alone:
        judge = partial(search_alone, wheels=any(trial.odometry is not None for trial in log.training))
    pairs = None if alone else pairs_of(asked, config.seed)
    outcome = judge(asked, pairs)
    if outcome.findings is not None and seen.noise is not None:
        other = tuple(name for name, one in seen.noise.report().items() if one["changed"])
        outcome = outcome.judged(replace(outcome.findings, noise=other), config.thresholds)
    searched, nulls = time.perf_counter(), None
    if config.refit_nulls:
        usual = replace(asked, wander=seen.usual)
        nulls = run_null_refits(usual, judge, pairs, config.refit_nulls, config.seed, progress)
        outcome = checked(outcome, nulls, seen.ready.wander, config.thresholds)
    # Drives that stand alone do not show the noise, so nothing that is left in them contradicts an effect.
    p_excess = (lambda _: 1.0) if alone else seen.usual.p_excess
    stood: dict[tuple[str, ...], tuple[Support, ...]] = {}  # of each set of effects that was put to the test
    while outcome.verdict == "named" and outcome.effects not in stood:
        found = stand(outcome, seen.refitter, log.training, seen.evidence.groups, log.spec.track, p_excess)
        stood[outcome.effects] = tuple(found)
        outcome = guarded(outcome, found, config.thresholds)
        if nulls is not None:
            outcome = checked(outcome, nulls, seen.ready.wander, config.thresholds)
    seconds = {"reference": fitted - began, "signatures": gathered - fitted, "search": searched - gathered,
               "null_refits": time.perf_counter() - searched}
    floor = floor_change(reference, log.training, config.thresholds.alpha)
    result = Result(log, tuple(references), config, seen.ready, outcome, seen.evidence, seconds, nulls,
                    stood.get(outcome.effects, ()), seen.noise, floor)
    if alone and config.pose_delay and PARAMETER not in (*reference.space.names, *config.held):
        result = told_late(result, config.thresholds.alpha)
    return result


@dataclass(frozen=True)
class Seen:
    """What some drives show, before anything is searched for in them."""

    ready: Prepared  # where their noise is another one, with that noise
    usual: Wander  # at the noise of the reference days
    noise: NoiseLevels | None
    evidence: Evidence
    refitter: Refitter


def _look(log: Log, ready: Prepared, config: LoopConfig, progress: Progress | None) -> Seen:
    """Noise and signatures of the training trials."""
    drives, at = ready.drives(log.training, log.spec.track)
    noise = noise_change(drives, at, ready.reference, config.thresholds.alpha)
    usual, ready = ready.wander, with_noise(ready, noise)
    evidence, slopes = gather(drives, ready.reference, ready.hypotheses, ready.full, progress)
    return Seen(ready, usual, noise, evidence, Refitter(drives, ready.reference, ready.values, slopes))


def watched(log: Log, references: Sequence[Log], config: LoopConfig, vehicle: Any = None) -> Result:
    """`find_missing` with a progress bar. With references, `vehicle` is where the fit to them starts."""
    if vehicle is not None:
        vehicle = replace(vehicle, kept=not references)
    kept = vehicle is not None and vehicle.kept
    steps = expected_steps(config, len(days_of(references)), kept)
    with command_line.progress_bar(steps, "close the loop") as progress:
        progress(0, "reference vehicle")
        return find_missing(log, references, config, vehicle, progress)


def check_logs(log: Log, references: Sequence[Log] = ()) -> None:
    """Raise ValueError for logs in which nothing can be found."""
    for one in (log, *references):
        if one.fields.get("input") == "wheels":
            raise ValueError(f"log {one.name!r}: its input is measured wheel speeds; what a vehicle lacks shows after "
                             "commands only. Record them, or fit the wheels with python -m sysid.fit.")
    if not log.training:
        raise ValueError(f"log {log.name!r} has no training trial. Take some out of held_out in its dataset.toml.")
    if all(trial.odometry is None for trial in log.training) and all(t.ground_truth is None for t in log.training):
        raise ValueError(f"log {log.name!r} has neither odometry nor an outside pose. Record one of them.")
    width = bin_width([trial for one in references or (log,) for trial in one.training])
    for one in (log, *references):
        if one.training:
            check_length(one.name, one.training, width)
    seen = {content_of(trial): "the drives in question" for trial in log.trials if trial.command.table[:, 1:].any()}
    for number, other in enumerate(references):
        mine = {content_of(trial): trial.name for trial in other.training if trial.command.table[:, 1:].any()}
        if again := [(name, seen[content]) for content, name in mine.items() if content in seen]:
            name, place = again[0]
            raise ValueError(f"reference {other.name!r} has {name!r}, which is among {place} already. Give drives of "
                             "other days, each once.")
        seen |= dict.fromkeys(mine, f"those of reference {number + 1}, {other.name!r},")
        if not other.training:
            raise ValueError(f"reference {other.name!r} has no training trial. Leave it out, or take some out of "
                             "held_out.")
        check_same_vehicle(log, other.spec, f"reference {other.name!r}", "A reference must be a drive of the same "
                                                                         "vehicle")


def stand(
    found: Search, refitter: Refitter, trials: Sequence[Trial], groups: Sequence[Sequence[int]], track: float,
    p_excess: Callable[[float], float],
) -> list[Support]:
    """The evidence for each effect of the final fit, in its order."""
    fit = found.final
    tested = put_to_test(fit, refitter, trials, groups, track, p_excess)
    return [Support.of(fit, part, groups, refitter.precision, one.effect, tuple(mine))
            for one, part, mine in zip(fit.hypotheses, fit.parts, tested, strict=True)]


def guarded(found: Search, stood: Sequence[Support], thresholds: Thresholds) -> Search:
    """The search without a name where one of its effects is contradicted, or with that of the next set of effects."""
    named = {one.hypothesis.effect for one in found.accepted}
    against = [each for one in stood if one.effect in named for each in one.against(thresholds)]
    if found.findings is not None:
        return found.judged(found.findings.put_to_test(found.effects, against), thresholds)
    if against:
        found.verdict, found.reason = "unexplained", contradicted(named, found.share, against)
    return found

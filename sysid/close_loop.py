"""From the residual to the missing effect: `python -m sysid.close_loop DATASET --reference DATASET ... --out RUN`.

The base model is fitted to the reference drives. The drives in question are then asked what has changed or is missing
against that vehicle: every effect of the catalogue is tried, the best are refitted together with the base parameters
within their day-to-day spread, and the verdict is one of

    named        these effects, each with the class of effects that these drives cannot tell from it
    none         nothing is missing at this noise level
    unexplained  something is missing and the catalogue does not have it

Without a reference the question is what the model family lacks; effects that base parameters imitate (mass, track,
scrub, friction, drag, traction) cannot be seen then. Held-out trials are opened after the verdict only.

Writes RUN/report.json (`sysid.loop.report`), RUN/report.html and RUN/vehicle.toml with the effect in it.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from itertools import compress
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from sysid import command_line
from sysid.log import Log, Trial
from sysid.loop.alone import judged, stands_alone
from sysid.loop.catalogue import Axis, Hypothesis, base_values, hypotheses, with_catalogue
from sysid.loop.drives import Drives, make_drives, rows_of_call
from sysid.loop.evidence import PARTS, Evidence, column_layout, gather
from sysid.loop.falsifiers import FALSIFIERS
from sysid.loop.found import Search, Thresholds
from sysid.loop.guards import Stood, guarded, stand
from sysid.loop.late_pose import PARAMETER, told_late
from sysid.loop.null_refits import NullRefits, checked
from sysid.loop.null_refits import run as run_null_refits
from sysid.loop.reference import Reference, make_reference
from sysid.loop.refit import Refitter
from sysid.loop.search import search
from sysid.loop.unexplained import best_gain
from sysid.loop.wander import Wander, estimate
from sysid.models import measured_effects, with_effects
from sysid.result import Progress
from sysid.rollout import PathReplay, Plant, vehicle_plant
from sysid.space import FIXED, make_space, searched
from whill_mjx.config import VehicleConfig
from whill_mjx.parameters import describe, get_values, set_values
from whill_mjx.presets import preset_params
from whill_mjx.specs import VehicleSpec


@dataclass(frozen=True)
class LoopConfig:
    """How the loop is closed."""

    preset: Literal["paper", "physical"] = "physical"
    """Base model."""
    iterations: int = 15
    """Iterations of the base fit."""
    draws: int = 1000
    """Simulated nulls that the decision is calibrated on."""
    seed: int = 0
    """Of the simulated nulls."""
    refit_nulls: int = 0
    """Simulated days with nothing missing that are refitted as the drives are; from 100 they decide too."""
    quick: bool = False
    """Fewer iterations, nulls and candidates."""
    physics_dt: float = 0.005
    """Physics step [s]."""
    with_effects: tuple[str, ...] = ()
    """Effects of the catalogue that the base model has as well, fitted like its own."""
    held: tuple[str, ...] = ()
    """Base parameters that keep their value; an effect that is one of them is then looked for, not fitted before;
    `pose_delay.delay` is what it is."""
    pose_delay: bool = False
    """Look for a late outside pose too: where its stamps are those of receipt. Logs whose loader says so
    (`fields["pose_stamps"]`) are always asked."""
    poses: bool = True
    """After the verdict, refit the vehicle to whole poses."""
    without: tuple[str, ...] = ()
    """Effects of the catalogue that are not looked for."""
    thresholds: Thresholds = field(default_factory=Thresholds)
    """When something counts as found."""


@dataclass(frozen=True)
class Prepared:
    """All of a vehicle that does not depend on the drives in question; its compiled replay serves many logs."""

    reference: Reference
    plant: Plant
    hypotheses: tuple[Hypothesis, ...]
    full: Any
    """The vehicle with the whole catalogue at neutral."""
    names: tuple[str, ...]
    paths: PathReplay
    wander: Wander
    others: dict[Any, PathReplay] = field(default_factory=dict)
    """Compiled replays of vehicles with effects that the catalogue does not have, by plant and structure."""

    def without(self, effects: Sequence[str]) -> Prepared:
        """The same without some effects of the catalogue; nothing is compiled or simulated again."""
        known = {one.effect for one in self.hypotheses}
        if unknown := sorted(set(effects) - known):
            raise ValueError(f"without: there is no effect {unknown[0]!r} (known: {', '.join(sorted(known))}).")
        kept = [one.effect not in effects for one in self.hypotheses]
        columns = column_layout(self.hypotheses, self.reference.space.size)
        return replace(self, hypotheses=tuple(compress(self.hypotheses, kept)),
                       wander=self.wander.of([kept[one.hypothesis] for one in columns]))


@dataclass(frozen=True)
class Result:
    """A closed loop before the held-out trials are opened."""

    log: Log
    references: tuple[Log, ...]
    config: LoopConfig
    prepared: Prepared
    search: Search
    evidence: Evidence
    seconds: dict[str, float]
    null_refits: NullRefits | None = None
    stood: tuple[Stood, ...] = ()
    """What speaks for and against each effect of the final fit; empty where nothing was about to be named."""

    @property
    def reference(self) -> Reference:
        """The vehicle as it was."""
        return self.prepared.reference

    @property
    def plant(self) -> Plant:
        """What replays it."""
        return self.prepared.plant

    @property
    def hypotheses(self) -> tuple[Hypothesis, ...]:
        """What was tried."""
        return self.prepared.hypotheses

    @property
    def full(self) -> Any:
        """The vehicle with the whole catalogue at neutral."""
        return self.prepared.full

    @property
    def names(self) -> tuple[str, ...]:
        """Its parameters."""
        return self.prepared.names

    @cached_property
    def before(self) -> Any:
        """The base model fitted to these drives."""
        return refit_poses(self, vehicle_before(self)) if self.config.poses else vehicle_before(self)

    @cached_property
    def after(self) -> Any:
        """The vehicle with the accepted effects, fitted to these drives."""
        if self.search.verdict != "named":
            return self.before
        return refit_poses(self, vehicle_after(self)) if self.config.poses else vehicle_after(self)


def close_loop(
    log: Log, references: Sequence[Log] = (), config: LoopConfig | None = None, vehicle: Any = None,
    progress: Progress | None = None, reference: Reference | Prepared | None = None, start: Any = None,
) -> Result:
    """Verdict on the training trials of a log; its held-out trials are not looked at.

    Args:
        log: the drives in question.
        references: drives of the same vehicle on other days.
        vehicle: `VehicleParams` fitted before, kept as the reference.
        start: `VehicleParams` where the fit of the base model starts, instead of the preset.
        reference: a reference made before, for many logs of one vehicle; `prepare` also saves compiling again.
    """
    config = config or LoopConfig()
    _check(log, references)
    if log.fields.get("pose_stamps") == "receipt":
        config = replace(config, pose_delay=True)
    began = time.perf_counter()
    if reference is None:
        reference = reference_for(log, references, config, vehicle, progress, start)
    ready = reference if isinstance(reference, Prepared) else prepare(reference, log.spec, config, progress)
    ready = ready.without(config.without)
    reference, found, full, names = ready.reference, ready.hypotheses, ready.full, ready.names
    fitted = time.perf_counter()
    base = base_values(full)
    drives = make_drives(ready.plant, full, names, log.training, reference.width, ready.paths)
    at = drives.simulate(np.array([base[name] for name in names])[None])[0]
    drives = drives.weighted(at, reference.factors, log.spec.track)
    evidence, slopes = gather(drives, reference, found, full, progress)
    gathered = time.perf_counter()
    refitter = Refitter(drives, reference, np.array([base[name] for name in names]), slopes)
    draws = min(config.draws, 300) if config.quick else config.draws

    def anything(residual: np.ndarray) -> float:
        return best_gain(log.training, log.spec, residual, reference.width)

    outcome = search(evidence, found, refitter, ready.wander, config.thresholds, anything, draws, config.seed, progress)
    searched, nulls = time.perf_counter(), None
    if config.refit_nulls:
        nulls = run_null_refits(evidence, found, refitter, ready.wander, outcome.scan, config.thresholds,
                                config.refit_nulls, config.seed, progress, outcome.pairs)
        outcome = checked(outcome, nulls, ready.wander, config.thresholds)
    alone = stands_alone(log.training, reference.known)
    if alone:
        wheels = any(trial.odometry is not None for trial in log.training)
        outcome = judged(outcome, evidence.groups, refitter.precision, config.thresholds, wheels)
    stood: tuple[Stood, ...] = ()
    if outcome.verdict == "named":
        stood = tuple(stand(outcome, refitter, log.training, evidence.groups, log.spec.track, ready.wander.p_excess))
        outcome = guarded(outcome, stood, config.thresholds)
    seconds = {"reference": fitted - began, "signatures": gathered - fitted, "search": searched - gathered,
               "null_refits": time.perf_counter() - searched}
    result = Result(log, tuple(references), config, ready, outcome, evidence, seconds, nulls, stood)
    if alone and config.pose_delay and PARAMETER not in (*reference.space.names, *config.held):
        result = told_late(result, config.thresholds.alpha)
    return result


def reference_for(log: Log, references: Sequence[Log], config: LoopConfig, vehicle: Any = None,
                  progress: Progress | None = None, start: Any = None) -> Reference:
    """The vehicle as its reference drives show it; of the log itself where there are none."""
    known = bool(references) or vehicle is not None
    start = preset_params(log.spec, config.preset) if start is None else start
    start = with_effects(start, config.with_effects) if vehicle is None else vehicle
    free = _free(start, config)
    iterations = max(config.iterations // 2, 4) if config.quick else config.iterations
    return make_reference(_plant(log.spec, config), start, tuple(references) or (log,), known, iterations, free,
                          progress, vehicle is not None)


def prepare(
    reference: Reference, spec: VehicleSpec, config: LoopConfig | None = None, progress: Progress | None = None
) -> Prepared:
    """A vehicle with the catalogue, ready for `close_loop` on one log after the other."""
    config = config or LoopConfig()
    plant = _plant(spec, config)
    found = hypotheses(spec, reference.params)
    if config.pose_delay and PARAMETER not in config.held:
        fitted = PARAMETER in reference.space.names
        found += (Hypothesis("pose_delay", (Axis(PARAMETER, 0.05, signed=fitted, limit=20.0),),
                             kind="parameter_shift" if fitted else "effect"),)
    full = with_catalogue(reference.params, found)
    base = base_values(full)
    paths = PathReplay(plant, lambda values: set_values(full, tuple(base), values), rows_of_call())
    drives = make_drives(plant, full, tuple(base), tuple(one.trial for one in reference.leftovers), reference.width,
                         paths)
    drives = replace(drives, weight=np.stack([one.mask for one in reference.leftovers]))
    wander = estimate(drives, reference, found, full, spec, progress)
    return Prepared(reference, plant, found, full, tuple(base), paths, wander)


def _free(vehicle: Any, config: LoopConfig) -> list[str]:
    """Parameters of the base model that are fitted: limits that are not there stay away."""
    names = [name for name in describe(vehicle) if name not in FIXED and name not in config.held]
    return [name for name, value in zip(names, get_values(vehicle, names), strict=True) if np.isfinite(float(value))]


def _plant(spec: VehicleSpec, config: LoopConfig) -> Plant:
    return vehicle_plant(spec, VehicleConfig(physics_dt=config.physics_dt))


def vehicle_before(result: Result) -> Any:
    """The base model with its parameters refitted within their spread."""
    base = result.search.base
    names = result.reference.space.names
    return set_values(result.reference.params, names,
                      jnp.asarray(result.reference.space.to_values(base.u), jnp.result_type(float)))


def vehicle_after(result: Result) -> Any:
    """The vehicle with the accepted effects in it, and only these."""
    if result.search.verdict != "named":
        return vehicle_before(result)
    final = result.search.final
    moved = set_values(result.full, result.names, jnp.asarray(final.values, jnp.result_type(float)))
    kept = {effect.name for effect in result.reference.params.effects}
    for one in final.hypotheses:
        kept |= {axis.parameter.partition(".")[0] for axis in one.axes}
    return type(moved)(moved.body, tuple(effect for effect in moved.effects if effect.name in kept))


def refit_poses(result: Result, vehicle: Any, iterations: int = 12) -> Any:
    """A vehicle refitted to whole poses and speeds, as `sysid.fit` does, from where the search left it.

    The search weighs short motions, which tell effects apart; what adds up over a whole drive is told by its poses. The
    refit may move base parameters and the accepted effects' own, and against a reference what every fit to poses has
    besides (`measured_effects`, without the losses, which may be what is asked for): the search takes their part for
    the wander of days. Drives without one would only be fitted closer by them: on a measured robot the errors of drives
    left out grew by 3 %.
    """
    from sysid.loop.poses import fit_poses

    known, trials = result.reference.known, result.log.training
    extra = measured_effects(vehicle, result.log.spec, trials, losses=False) if known else ()
    vehicle = with_effects(vehicle, extra)
    have = describe(vehicle)
    names = list(result.reference.space.names)
    names += [name for name in searched(vehicle) if name not in names and name not in result.config.held
              and (name.partition(".")[0] in extra or extra and name == "body.com_z")]
    if result.search.verdict == "named":
        moved = [axis.parameter for one in result.search.final.hypotheses for axis in one.axes]
        names += [name for name in dict.fromkeys(moved) if name in have and name not in names
                  and np.isfinite(float(get_values(vehicle, [name])[0])) and name not in result.config.held]
    space = make_space(vehicle, result.log.spec, names)
    spread = np.zeros((space.size, space.size))
    told = result.reference.space.size
    spread[:told, :told] = result.reference.spread
    drives, held = drives_of(result, trials, vehicle)
    u = fit_poses(drives, trials, space, held, spread, iterations)
    return vehicle if u is None else set_values(
        vehicle, space.names, jnp.asarray(space.to_values(u), jnp.result_type(float)))


def drives_of(result: Result, trials: tuple[Trial, ...], vehicle: Any) -> tuple[Drives, np.ndarray]:
    """Trials as a vehicle replays them, and the values (all,) of its parameters there.

    They go through what was compiled for the search, where the catalogue has all effects of the vehicle; those that the
    vehicle does not have are neutral.
    """
    ready, width, values = result.prepared, result.reference.width, base_values(vehicle)
    if set(values) <= set(ready.names):
        values = {**base_values(ready.full), **values}
        drives = make_drives(ready.plant, ready.full, ready.names, trials, width, ready.paths)
        return drives, np.array([values[name] for name in ready.names])
    kind = ready.plant, jax.tree.structure(vehicle)
    drives = make_drives(ready.plant, vehicle, tuple(values), trials, width, ready.others.get(kind))
    ready.others[kind] = drives.paths
    return drives, np.array(list(values.values()))


def _check(log: Log, references: Sequence[Log]) -> None:
    if not log.training:
        raise ValueError(f"log {log.name!r} has no training trial. Take some out of held_out in its dataset.toml.")
    if all(trial.odometry is None for trial in log.training) and all(t.ground_truth is None for t in log.training):
        raise ValueError(f"log {log.name!r} has neither odometry nor an outside pose. Record one of them.")
    for other in references:
        if not other.training:
            raise ValueError(f"reference {other.name!r} has no training trial. Leave it out, or take some out of "
                             "held_out.")
        for name in ("wheel_radius", "track", "wheelbase", "drive"):
            mine, theirs = getattr(log.spec, name), getattr(other.spec, name)
            if mine != theirs:
                raise ValueError(f"reference {other.name!r}: {name} is {theirs}, but {mine} in {log.name!r}. A "
                                 "reference must be a drive of the same vehicle; correct dataset.toml or leave it out.")


def expected_steps(config: LoopConfig, days: int, fitted: bool = False) -> int:
    """How far the progress bar goes at most, with so many reference days."""
    iterations = max(config.iterations // 2, 4) if config.quick else config.iterations
    base = 0 if fitted else iterations + max(iterations // 2, 3)
    return base + 6 * days + 2 * PARTS + 4 + 3 * (config.thresholds.rounds + 1) + config.refit_nulls


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Command line of `python -m sysid.close_loop`."""

    dataset: Path
    """Folder with the drives in question."""
    reference: tuple[Path, ...] = ()
    """Folders with drives of the same vehicle on other days."""
    vehicle: Path | None = None
    """Vehicle file fitted before, taken as the reference instead of drives."""
    out: Path = Path("runs/close_loop")
    """Folder for the report and the vehicle file."""
    quick: bool = False
    """Fewer iterations, nulls and candidates."""
    seed: int = 0
    """Seed of the simulated nulls."""
    refit_nulls: int = 0
    """Simulated days with nothing missing that are refitted as the drives are (a few seconds each)."""
    iterations: int = 15
    """Iterations of the base fit."""
    without: tuple[str, ...] = ()
    """Effects of the catalogue that are not looked for, because the vehicle cannot have them."""
    decision: Literal["search", "posterior"] = "search"
    """What decides: the search, or posterior weights (writes posterior.json instead of the report)."""


def main(arguments: Arguments) -> dict[str, Any]:
    """Load, close the loop, open the held-out trials, write and print the verdict."""
    from sysid.measured import load_any

    log = load_any(arguments.dataset)
    references = [load_any(path) for path in arguments.reference]
    vehicle = None
    if arguments.vehicle is not None:
        from whill_mjx.vehicle_file import load_vehicle

        if references:
            raise ValueError("--reference and --vehicle are both given. Give the drives, or the vehicle fitted to "
                             "them.")
        _, vehicle, _ = load_vehicle(arguments.vehicle)
    config = LoopConfig(quick=arguments.quick, seed=arguments.seed, iterations=arguments.iterations,
                        without=arguments.without, refit_nulls=arguments.refit_nulls)
    if arguments.decision == "posterior":
        from sysid.missing.decision import run as weigh

        return weigh(log, references, arguments.out, config, vehicle)
    return run(log, references, arguments.out, config, vehicle)


def run(log: Log, references: Sequence[Log], out: Path, config: LoopConfig, vehicle: Any = None) -> dict[str, Any]:
    """Close the loop with a progress bar, open the held-out trials, write the folder `out` and print the verdict."""
    from sysid.loop.report import make_report, summary, write_run

    progress, close = command_line.progress_bar(
        expected_steps(config, len(references), vehicle is not None), "close the loop", "step")
    try:
        result = close_loop(log, references, config, vehicle, progress)
    finally:
        close()
    report = make_report(result)
    write_run(out, result, report)
    print(summary(report))
    print(f"wrote report.json, report.html and vehicle.toml into {out}")
    return report


def manifest(config: LoopConfig, found: Sequence[Hypothesis], reference: Reference) -> dict[str, Any]:
    """Everything that was fixed before the drives were looked at."""
    space = reference.space
    return {
        "settings": {key: value for key, value in asdict(config).items() if key != "thresholds"},
        "thresholds": asdict(config.thresholds),
        "catalogue": [{"effect": one.effect, "variant": one.variant, "kind": one.kind,
                       "axes": [asdict(axis) for axis in one.axes], "constants": dict(one.constants)}
                      for one in found],
        "falsifiers": {name: [asdict(one) for one in each] for name, each in FALSIFIERS.items()},
        "bounds": {name: [float(space.low[i]), float(space.high[i])] for i, name in enumerate(space.names)},
    }


def cli() -> None:
    """Command line."""
    command_line.run(Arguments, main, __doc__)


if __name__ == "__main__":
    cli()

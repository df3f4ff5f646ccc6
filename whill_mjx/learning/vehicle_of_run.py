"""The vehicle of a training: the given one, that of the run so far, or one fitted to a driving log."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax

from dreamer.training import checkpoint
from whill_mjx.io.command_line import OptionError
from whill_mjx.io.folders import RUN_FILE, Claim, FolderRefused, write_whole
from whill_mjx.io.heartbeat import say
from whill_mjx.io.own_process import on_processor_apart
from whill_mjx.learning.identity import identity_of, vehicle_label
from whill_mjx.learning.options import TrainOptions
from whill_mjx.learning.setup import Preset
from whill_mjx.learning.trainings import Stage
from whill_mjx.logs.dataset import plain
from whill_mjx.vehicle.specs import VehicleSpec
from whill_mjx.vehicle.types import VehicleParams
from whill_mjx.vehicle.vehicle_file import load_intervals, load_vehicle, save_vehicle

SHIPPED_LOG = "chair"
Vehicle = tuple[VehicleSpec, VehicleParams, dict[str, Any]]
"""Spec, parameters and provenance."""


def given_vehicle(options: TrainOptions) -> Vehicle | None:
    """The vehicle that the options name; None if they name none. A bad file is refused before anything is written."""
    return None if options.vehicle is None else load_vehicle(options.vehicle)


def prepare_vehicle(
    options: TrainOptions, preset: Preset, claim: Claim, given: Vehicle | None = None, stage: Stage = say
) -> None:
    """Settle what RUN is and write RUN/vehicle.toml: the given vehicle, that of the run so far, or one fitted to a log.

    Raises:
        FolderRefused: RUN holds a training that differs in anything that changes its result.
    """
    target, known = options.out / "vehicle.toml", claim.identity
    if absent := sorted({"vehicle", "data"} - set({"vehicle": "", "data": ""} if known is None else known)):
        raise FolderRefused(f"--out {options.out}: {options.out / RUN_FILE} does not say which run this is: it has no "
                            f"{absent[0]}. Choose another --out.")
    here = load_vehicle(target) if target.exists() else None
    begun = bool(checkpoint.complete(options.out / "checkpoints")) or _has_lines(options.out / "metrics.jsonl")
    vehicle, data, fitted = given or here, known["data"] if known else None, None
    if given is not None and not (known and known["vehicle"] == vehicle_label(*given[:2])):
        data = None
    elif given is None and (options.log or not known):
        log = options.log or _shipped_log()
        data = _hash_of(log)
        if not known or (not begun and known["data"] != data):
            fitted = _fitted(log, options.out / "fit", stage)
            vehicle = load_vehicle(fitted)
    if vehicle is None:
        raise OptionError(f"--out {options.out}: its vehicle.toml is missing. Give the vehicle by --vehicle.")
    identity = identity_of(preset, options.learner, options.seed, vehicle_label(*vehicle[:2]), data)
    claim.settle(identity, begun, command=plain(options), preset=plain(preset))
    if here is not None and vehicle_label(*here[:2]) == identity["vehicle"]:
        return
    if here is not None and begun:
        raise OptionError(f"{target}: holds {vehicle_label(*here[:2])}, but the run was begun with "
                          f"{identity['vehicle']}. Put the old file back or choose another --out.")
    if fitted is not None:
        write_whole(target, fitted.read_text())
    else:
        source = options.vehicle if given is not None else None
        known_intervals = load_intervals(source) if source is not None and source.is_file() else None
        save_vehicle(target, *vehicle[:2], known_intervals, provenance=vehicle[2])


def spec_of_log(log: Path) -> VehicleSpec:
    """What a driving log says of its vehicle; ValueError as of `sysid.load_any`."""
    from sysid import load_any

    return load_any(log).spec


def _shipped_log() -> Path:
    import sysid

    return Path(sysid.__file__).parent / "data" / SHIPPED_LOG


def _hash_of(log: Path) -> str:
    from sysid.logs.log import hash_files

    return hash_files(log)


def _has_lines(path: Path) -> bool:
    return path.exists() and path.stat().st_size > 0


def _fitted(log: Path, out: Path, stage: Stage) -> Path:
    """Vehicle file fitted to a driving log. The fit runs on the processor, since an accelerator takes longer to compile
    its programs than two cores take to finish it."""
    stage(f"vehicle: fitting to the driving log {log.name}, usually 1 to 3 minutes")
    if jax.default_backend() == "cpu":
        fit_quickly(log, out)
    else:
        on_processor_apart(fit_quickly, log, out)
    return out / "vehicle.toml"


def fit_quickly(log: Path, out: Path) -> None:
    """Fit a vehicle, and say its result in a few lines."""
    from sysid import FitConfig, fit_dataset
    from sysid.command_line import progress_bar
    from sysid.pages.fit_page import in_words
    from sysid.search.fitting import expected_steps

    config = FitConfig(quick=True)
    with progress_bar(expected_steps(config)) as progress:
        report = fit_dataset(log, out, config=config, progress=progress)
    for line in in_words(report):
        say(f"  {line}")
    say(f"  report of the fit: {out / 'report.html'}")

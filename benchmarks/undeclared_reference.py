"""The reference days that undeclared effects are looked for against: sets of drives with nothing in them.

Verdicts against one set share its luck, so their p-values are not independent. Nulls are therefore dealt over several
sets; set 0 is the one that everything else is judged against. The fit to a set is kept beside its drives, under the
hash of the code that made it, for processes that come later.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks import kept
from benchmarks.plant.make import Experiment, make_log
from sysid.errors.space import make_space
from sysid.logs.log import load_log
from sysid.logs.records import Log
from sysid.missing.days import Reference
from sysid.missing.reference import make_reference
from sysid.pages.report import code_hashes
from sysid.replay.records import FreeVehicle
from sysid.replay.rollout import vehicle_plant
from sysid.verdict.preparation import prepare
from sysid.verdict.result import LoopConfig, Prepared
from whill_mjx.vehicle.config import VehicleConfig
from whill_mjx.vehicle.presets import preset_params


@dataclass(frozen=True)
class Driven:
    """What drives the logs; each vehicle and each noise needs a folder of its own."""

    noise: float = 1.0
    """Factor on all disturbances and sensor noise."""
    vehicle: str = "chair"
    """Of `benchmarks.plant.chair.VEHICLES`."""
    draw: int = 0
    """Number of the draw of all logs and reference days: each has seeds and pairs of its own."""

    def seed(self, seed: int) -> int:
        """A seed of the first draw, as it is in this one."""
        return seed + PER_DRAW * self.draw

    def label(self, label: str) -> str:
        """A log of the first draw, as it is named in this one."""
        return f"{label}_draw_{self.draw}" if self.draw and label else label

    @property
    def tag(self) -> str:
        """What the names of its figures end in. Draws that the weights were not chosen with have them in common."""
        noise = "" if self.noise == 1.0 else f"_noise_{self.noise:g}"
        vehicle = "" if self.vehicle == "chair" else f"_{self.vehicle}"
        return f"{noise}{vehicle}{'_fresh' if self.draw else ''}"


PER_DRAW = 10_000_000
"""How far the seeds of a draw are from those of the one before."""
USUAL = Driven()
DAYS = 6
FIRST_SEED, SEEDS = 11001, 10
"""Seed of the first day of set 0, and how far the next set's first is from it; nulls start at 20000."""
SETS = 800
"""More sets would use the seeds of other logs."""


def folder_of(work: Path, number: int, driven: Driven = USUAL) -> Path:
    """Where the days of a set are."""
    return work / driven.label("reference" if number == 0 else f"reference_{number}")


def reference_days(work: Path, driven: Driven = USUAL, number: int = 0) -> list[Log]:
    """Days of the contact plant with nothing in them: one with three replicates, the others with one.

    Args:
        number: of the set, from 0.

    Raises:
        ValueError: if there is no such set.
    """
    if not 0 <= number < SETS:
        raise ValueError(f"set of reference days {number}: must be 0 to {SETS - 1}. Ask for fewer sets.")
    days = []
    for day in range(DAYS):
        path = folder_of(work, number, driven) / f"day_{day + 1}"
        if not path.exists():
            try:
                make_log(path, Experiment(seed=driven.seed(FIRST_SEED + SEEDS * number + day), noise=driven.noise,
                         replicates=3 if day == 0 else 1, vehicle=driven.vehicle))
            except OSError:
                if not path.exists():  # else another part was quicker
                    raise
        days.append(load_log(path))
    return days


def reference_of(logs: Sequence[Log], config: LoopConfig) -> Reference:
    """The reference, made once for all logs of one vehicle."""
    plant = vehicle_plant(logs[0].spec, VehicleConfig(physics_dt=config.physics_dt))
    params = preset_params(logs[0].spec, config.preset)
    return make_reference(FreeVehicle(plant, params, make_space(params, logs[0].spec).names), logs, True,
                          config.iterations, lambda _, remark: print(remark, flush=True))


def prepared(work: Path, number: int, driven: Driven, config: LoopConfig) -> Prepared:
    """A set ready for `find_missing`; its days are driven, and fitted, where that was not done before."""
    days = reference_days(work, driven, number)
    path = folder_of(work, number, driven) / f"fitted_{key_of(days, config)}.pickle"
    reference = None
    if path.exists():
        try:
            reference = kept.loads(path.read_bytes())
        except kept.KeptError as error:
            print(f"{path}: {error}; the set is fitted again", flush=True)
    if reference is None:
        reference = reference_of(days, config)
        _write(path, kept.dumps(reference))
    return prepare(reference, days[0].spec, config)


def key_of(days: Sequence[Log], config: LoopConfig, *more: str) -> str:
    """Hash of everything that a fit depends on: code, versions, data, settings, and what else there is."""
    settings = repr((sorted(code_hashes().items()), [day.sha256 for day in days], config, *more))
    return hashlib.sha256(settings.encode()).hexdigest()[:16]


def _write(path: Path, content: bytes) -> None:
    temporary = path.with_name(f"{path.name}.{os.getpid()}")
    temporary.write_bytes(content)
    os.replace(temporary, path)

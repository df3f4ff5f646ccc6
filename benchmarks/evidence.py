"""Evidence of many logs of the contact plant, made once and kept.

    for i in 1 2; do python -m benchmarks.evidence --stages tuning & done; wait
    python -m benchmarks.evidence --all-cores --seconds 420 --pack out

Each log is driven, linearised, refitted where something stands out, and kept as one file WORK/STAGE/LABEL.npz.xz. What
is in it is kept in WORK/truth. Any number of processes share the folder, and a run that was stopped goes on where it
was. `test` holds the logs that the search was judged on (`benchmarks.undeclared`), with the same seeds, and logs of
other noise; `tuning` holds logs of other seeds. What is decided from them is in `benchmarks.decision`.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import numpy as np

from benchmarks import kept
from benchmarks.plant.effects import EFFECTS
from benchmarks.plant.make import make_log
from benchmarks.undeclared_plant import capped, power_sizes
from benchmarks.undeclared_reference import USUAL, prepared, reference_days
from sysid.logs.log import load_log
from sysid.missing.catalogue import base_values, hypotheses, with_catalogue
from sysid.missing.drives import rows_of_call
from sysid.pages.report import write_report
from sysid.replay.rollout import PathReplay, vehicle_plant
from sysid.verdict.result import LoopConfig, Prepared
from sysid.weighing.make_evidence import Maker
from sysid.weighing.saved_evidence import save
from whill_mjx.io.command_line import COUNT, NOT_NEGATIVE, run
from whill_mjx.vehicle.config import VehicleConfig
from whill_mjx.vehicle.parameters import set_values

Stage = Literal["tuning", "test"]
NOISES = (0.5, 1.0, 2.0, 4.0)
PAIRS, TUNED_PAIRS = 90, 34
FILES, LARGEST = 8, 16 * 2**20 - 2**16
"""Archives, and bytes of each."""
RESERVE = 45.0
"""Seconds that a log begun last may still take."""


@dataclass(frozen=True)
class Log:
    """One log to drive: label, effects and their sizes, seed, noise and what it is for."""

    label: str
    kind: str
    """null, scaled, noisy or pair."""
    effects: Mapping[str, float]
    seed: int
    noise: float = 1.0
    scale: float = 0.0


@dataclass(frozen=True)
class Benchmark:
    """What to make."""

    stages: tuple[Stage, ...] = ("tuning", "test")
    kinds: tuple[str, ...] = ("null", "scaled", "noisy", "pair")
    nulls: Annotated[int, COUNT] = 40
    """Logs with nothing in them, for each noise level."""
    only: tuple[str, ...] = ()
    """Labels that begin with one of these."""
    seconds: Annotated[float, NOT_NEGATIVE] = 1e9
    """After which no further log is begun."""
    work: Path = Path("runs/evidence")
    reference: Annotated[int, NOT_NEGATIVE] = 0
    """Set of reference days."""
    all_cores: bool = False
    """One process for each core; this one only waits for them."""
    pack: Path | None = None
    """Folder for what was made, as at most `FILES` archives."""


def main(settings: Benchmark) -> None:
    """Make what no other process has taken."""
    if settings.all_cores:
        spread(settings)
    else:
        make_all(settings)
    if settings.pack is not None:
        pack(settings.work, settings.pack)


def make_all(settings: Benchmark) -> None:
    """Make logs one after the other."""
    began = time.perf_counter()
    ready = ready_vehicle(settings.work, settings.reference)
    parts = [[(stage, log) for log in logs(settings.work, stage, settings.nulls)] for stage in settings.stages]
    for stage, log in mixed(parts):
        if log.kind not in settings.kinds or settings.only and not log.label.startswith(settings.only):
            continue
        if time.perf_counter() - began > settings.seconds:
            break
        started = time.perf_counter()
        if make(log, stage, settings.work, ready):
            print(stage, log.label, f"{time.perf_counter() - started:.0f} s", flush=True)


def spread(settings: Benchmark) -> None:
    """The same in one process for each core, which are stopped when time is up."""
    began = time.perf_counter()
    ready_vehicle(settings.work, settings.reference)
    command = [sys.executable, "-m", "benchmarks.evidence", "--work", settings.work, "--seconds",
               settings.seconds - (time.perf_counter() - began) - RESERVE,
               "--nulls", settings.nulls, "--stages", *settings.stages, "--kinds", *settings.kinds]
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    running = []
    for core in sorted(os.sched_getaffinity(0)):
        running.append(subprocess.Popen([str(part) for part in command], env=environment))
        os.sched_setaffinity(running[-1].pid, {core})
    for one in running:
        try:
            one.wait(max(settings.seconds - (time.perf_counter() - began), 0.1))
        except subprocess.TimeoutExpired:
            one.kill()


def ready_vehicle(work: Path, reference: int) -> Prepared:
    """The vehicle and its wander on the reference days, fitted where that was not done before."""
    path = work / f"vehicle_{reference}.pickle"
    if not path.exists():
        ready = prepared(work, reference, USUAL, LoopConfig())
        temporary = path.with_name(f"{path.name}.{os.getpid()}")
        params = jax.tree.map(np.asarray, ready.reference.params)  # arrays that any version reads
        temporary.write_bytes(kept.dumps((replace(ready.reference, params=params), ready.wander)))
        os.replace(temporary, path)
    fitted, wander = kept.loads(path.read_bytes())
    spec = reference_days(work, USUAL, reference)[0].spec
    found = hypotheses(spec, fitted.params)
    full = with_catalogue(fitted.params, found)
    names = tuple(base_values(full))
    plant = vehicle_plant(spec, VehicleConfig())
    paths = PathReplay(plant, lambda values: set_values(full, names, values), rows_of_call())
    return Prepared(fitted, plant, found, full, names, paths, wander)


def pack(work: Path, out: Path) -> None:
    """Archives of all evidence and of what is in it, each below `LARGEST`."""
    out.mkdir(parents=True, exist_ok=True)
    files = sorted((path for stage in ("tuning", "test") for path in (work / stage).glob("*.npz.xz")),
                   key=lambda path: path.stat().st_mtime)
    number, size = 0, 0
    archive = tarfile.open(out / f"evidence_{number}.tar", "w")
    for path in files:
        more = path.stat().st_size + 4096
        if size + more > LARGEST:
            archive.close()
            number, size = number + 1, 0
            if number == FILES:
                print(f"{len(files)} files are more than {FILES} archives hold: the last ones are left out", flush=True)
                return
            archive = tarfile.open(out / f"evidence_{number}.tar", "w")
        truth = work / "truth" / path.parent.name / f"{path.name.removesuffix('.npz.xz')}.json"
        for one in (path, truth):
            archive.add(one, one.relative_to(work))
        size += more
    archive.close()


def mixed(parts: Sequence[Sequence[Any]]) -> list[Any]:
    """Items of several lists, such that each is done by the same share at any time."""
    order = [(place / len(part), number, item) for number, part in enumerate(parts) for place, item in enumerate(part)]
    return [item for _, _, item in sorted(order, key=lambda one: one[:2])]


def logs(work: Path, stage: Stage, nulls: int) -> list[Log]:
    """All logs of a stage, those first that decide most; kinds are mixed, so that a part of them is a fair part."""
    test = stage == "test"
    sizes = power_sizes(work)
    names = sorted(EFFECTS)
    parts: list[list[Log]] = [
        [Log(f"null_{noise:g}_{n:03d}", "null", {}, (20000 if test else 80000) + n + round(1000 * (noise - 1)), noise)
         for n in range(nulls) for noise in NOISES]]
    scaled = []
    for seed in range(2 if test else 1):
        for j, scale in enumerate((2.0, 4.0)):
            for i, name in enumerate(names):
                first = 30001 + 50 * i + 10 * j if test else 82001 + 50 * i + 10 * j
                scaled.append(Log(f"{name}_x{scale:g}_{seed}", "scaled", {name: capped(name, scale * sizes[name])},
                                  first + seed, scale=scale))
    parts.append(scaled)
    parts.append([Log(f"{name}_noise_2", "noisy", {name: capped(name, 4 * sizes[name])},
                      (35001 if test else 85001) + i, 2.0, 4.0) for i, name in enumerate(names)])
    known = [name for name in names if EFFECTS[name].known and name in sizes]
    random, pairs = np.random.default_rng(7 if test else 8), []
    for n in range(PAIRS if test else TUNED_PAIRS):
        first, second = random.choice(known, 2, replace=False)
        inside = {str(name): capped(name, 4 * sizes[name]) for name in (first, second)}
        pairs.append(Log(f"pair_{n:02d}", "pair", inside, (60000 if test else 86000) + n, scale=4.0))
    parts.append(pairs)
    return mixed(parts)


def make(log: Log, stage: Stage, work: Path, ready: Prepared) -> bool:
    """Drive a log and keep its evidence; False where it is there or another process has it."""
    path = work / stage / f"{log.label}.npz.xz"
    if path.exists() or not _claimed(work / "claims" / f"{stage}_{log.label}"):
        return False
    folder = Path(tempfile.mkdtemp(prefix="evidence_"))
    try:
        make_log(folder / "log", effects=log.effects, seed=log.seed, noise=log.noise)
        loaded = load_log(folder / "log")
        maker = Maker(ready, loaded.training, loaded.spec, log.label)
        maker.refine_all()
        truth = {"effects": dict(log.effects), "kind": log.kind, "noise": log.noise, "scale": log.scale}
        (work / "truth" / stage).mkdir(parents=True, exist_ok=True)
        write_report(work / "truth" / stage / f"{log.label}.json", truth)
        save(path, maker.evidence)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        (work / "claims" / f"{stage}_{log.label}").unlink(missing_ok=True)
    return True


def _claimed(path: Path) -> bool:
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.close(os.open(path, os.O_CREAT | os.O_EXCL))
    except FileExistsError:
        return False
    return True


def truth_of(work: Path, stage: Stage, labels: Sequence[str]) -> list[dict[str, object]]:
    """What is in logs."""
    return [json.loads((work / "truth" / stage / f"{label}.json").read_text()) for label in labels]


if __name__ == "__main__":
    run(Benchmark, main, __doc__, positional=False)

"""Find the physical effect that a model lacks: `python -m sysid.close_loop DATASET --reference DATASET ... --out RUN`.

The base model is fitted to the reference drives. The drives in question are then asked what has changed or is missing
against that vehicle: every effect of the catalogue is tried, the best are refitted together with the base parameters
within their day-to-day spread, and the verdict is one of

    named        these effects, each with the class of effects that these drives cannot separate from it
    none         nothing is missing at this noise level
    unexplained  something is missing and the catalogue does not have it

Without a reference the question is what the model family lacks; effects that base parameters imitate (mass, track,
scrub, friction, drag, traction) cannot be seen then. Held-out trials are opened after the verdict only.

Writes RUN/report.json (docs/formats.md), RUN/report.html, RUN/method.html and, with the effect in it,
RUN/vehicle.toml. A loop that was stopped goes on where it was when the same command is given again.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from whill_mjx.io.command_line import SEED, Range, With, check_known, listen, refusing, starts
from whill_mjx.io.heartbeat import say_loading

if starts(__name__):
    listen()
    say_loading()

from sysid import command_line
from sysid.logs.log import of_file
from sysid.logs.records import Log
from sysid.logs.sources import refuse_recording
from sysid.missing.catalogue import hypotheses, outside_hypotheses
from sysid.run_folder import file_label, run_folder, settings_of
from sysid.verdict.pipeline import check_logs, watched
from sysid.verdict.result import LoopConfig

KIND = "sysid.close_loop"
OUTPUTS = ("next_command.csv", "method.html", "evidence.json", "steps")


@dataclass(frozen=True, kw_only=True)
class Arguments:
    dataset: Path
    """Folder with the drives in question."""
    reference: tuple[Path, ...] = ()
    """Folders with drives of the same vehicle on other days."""
    train: tuple[str, ...] = ()
    """Trials in question of a measured set: RUN, GROUP or RUN:FROM-TO, e.g. warthog_gravel or robot1:0-0.667."""
    held_out: tuple[str, ...] = ()
    """Trials of a measured set that are opened after the verdict, in the same form."""
    reference_train: Annotated[tuple[str, ...], With("reference")] = ()
    """Trials of a reference that is a measured set, in the same form."""
    chained: bool = False
    """DRIVE: 6 s steps, chained from 2 s windows, instead of the windows."""
    vehicle: Path | None = None
    """Vehicle file fitted before, kept as it is. With a reference too, the fit to these drives starts at it."""
    out: Path = Path("runs/close_loop")
    """Folder for the report and the vehicle file."""
    quick: bool = False
    """Fewer iterations, nulls and candidates."""
    seed: Annotated[int, SEED] = 0
    """Seed of the simulated nulls."""
    refit_nulls: Annotated[int, Range(0, 1_000_000)] = 0
    """Simulated days with nothing missing that are refitted as the drives are (a few seconds each)."""
    iterations: Annotated[int, Range(1, 10_000)] = 15
    """Iterations of the base fit."""
    without: tuple[str, ...] = ()
    """Effects of the catalogue that are not looked for, because the vehicle cannot have them."""


def main(arguments: Arguments) -> dict[str, Any]:
    """Load, close the loop, open the held-out trials, write and print the verdict."""
    from sysid.pages.loop_report import WRITING, write_result

    with refusing():
        log, references, vehicle = load(arguments)
        config = LoopConfig(quick=arguments.quick, seed=arguments.seed, iterations=arguments.iterations,
                            without=arguments.without, refit_nulls=arguments.refit_nulls)
    chosen = {"data": log.sha256, "references": [one.sha256 for one in references],
              "train": [one.name for one in log.training], "held_out": [one.name for one in log.held_out],
              "reference_train": arguments.reference_train, "vehicle": file_label(arguments.vehicle),
              **settings_of(config, ("thresholds",))}
    with run_folder(arguments.out, KIND, OUTPUTS, chosen):
        found = watched(log, references, config, vehicle)
        command_line.stage(WRITING)
        return write_result(arguments.out, found)


def load(arguments: Arguments) -> tuple[Log, list[Log], Any]:
    """The drives, the reference drives and the vehicle, checked; ValueError or FileNotFoundError says what is wrong."""
    from sysid.logs.loaders import load_any
    from sysid.missing.fit_statistics import load_fitted
    from whill_mjx.vehicle.presets import preset_params

    log = load_any(arguments.dataset, "auto", arguments.train, arguments.held_out, arguments.chained)
    references = [load_any(path, "auto", arguments.reference_train, (), arguments.chained)
                  for path in arguments.reference]
    check_logs(log, references)
    vehicle = None
    if arguments.vehicle is not None:
        refuse_recording(arguments.vehicle, "a vehicle file. Drives of other days are given with --reference.")
        spec, vehicle = load_fitted(arguments.vehicle)
        log, *references = (of_file(one, spec, str(arguments.vehicle)) for one in (log, *references))
    base = preset_params(log.spec, LoopConfig.preset) if vehicle is None else vehicle.params
    known = {one.effect for one in (*hypotheses(log.spec, base), *outside_hypotheses(log.spec, base, ()))}
    for name in arguments.without:
        check_known("--without", name, sorted(known))
    return log, references, vehicle


def cli() -> None:
    command_line.run(Arguments, main, __doc__, stopped=command_line.STOPPED)


if __name__ == "__main__":
    cli()

"""From the residual to the missing effect: `python -m sysid.close_loop DATASET --reference DATASET ... --out RUN`.

The base model is fitted to the reference drives. The drives in question are then asked what has changed or is missing
against that vehicle: every effect of the catalogue is tried, the best are refitted together with the base parameters
within their day-to-day spread, and the verdict is one of

    named        these effects, each with the class of effects that these drives cannot separate from it
    none         nothing is missing at this noise level
    unexplained  something is missing and the catalogue does not have it

Without a reference the question is what the model family lacks; effects that base parameters imitate (mass, track,
scrub, friction, drag, traction) cannot be seen then. Held-out trials are opened after the verdict only.

Writes RUN/report.json (`sysid.pages.loop_report`), RUN/report.html and RUN/vehicle.toml with the effect in it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from sysid import command_line
from sysid.logs.sources import refuse_recording
from sysid.verdict.pipeline import watched
from sysid.verdict.result import LoopConfig


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
    """What decides: the search, or, as a trial, posterior weights (writes posterior.json instead of the report)."""


def main(arguments: Arguments) -> dict[str, Any]:
    """Load, close the loop, open the held-out trials, write and print the verdict."""
    from sysid.logs.measured import load_any
    from sysid.pages.loop_report import write_result

    log = load_any(arguments.dataset)
    references = [load_any(path) for path in arguments.reference]
    vehicle = None
    if arguments.vehicle is not None:
        from sysid.missing.fit_statistics import load_fitted

        if references:
            raise ValueError("--reference and --vehicle are both given. Give the drives, or the vehicle fitted to "
                             "them.")
        refuse_recording(arguments.vehicle, "a vehicle file. Drives of other days are given with --reference.")
        vehicle = load_fitted(arguments.vehicle)
    config = LoopConfig(quick=arguments.quick, seed=arguments.seed, iterations=arguments.iterations,
                        without=arguments.without, refit_nulls=arguments.refit_nulls)
    if arguments.decision == "posterior":
        from sysid.weighing.decision import run as weigh

        return weigh(log, references, arguments.out, config, vehicle)
    return write_result(arguments.out, watched(log, references, config, vehicle))


def cli() -> None:
    """Command line."""
    command_line.run(Arguments, main, __doc__)


if __name__ == "__main__":
    cli()

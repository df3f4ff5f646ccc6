"""Fit a vehicle to a driving log: `python -m sysid.fit DATASET --out RUN`.

Only training trials are fitted; held-out ones are predicted once, at the end, by the initial and the fitted vehicle.
Writes RUN/report.json (entries: docs/formats.md), RUN/report.html, RUN/series.npz, RUN/*.png and RUN/vehicle.toml. A
fit that was stopped goes on where it was when the same command is given again.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from whill_mjx.io.command_line import listen, starts
from whill_mjx.io.heartbeat import say_loading

if starts(__name__):
    listen()
    say_loading()

from sysid import command_line
from sysid.logs.coverage import doubts
from sysid.logs.loaders import Form, load_any
from sysid.logs.log import of_file
from sysid.logs.records import Log
from sysid.pages.fit_page import warning
from sysid.pages.fit_report import Loaded, fit_dataset
from sysid.pages.report import parameter_table, table
from sysid.replay.models import Model
from sysid.run_folder import run_folder, settings_of
from sysid.search.fitting import check_settings, expected_steps
from sysid.search.settings import GLOBAL, FitConfig
from sysid.search.studies import open_storage, without_secrets
from whill_mjx.io.command_line import refusing

KIND = "sysid.fit"
OUTPUTS = ("series.npz", "model.toml", "model.xml", "trajectories.png", "yaw.png", "errors.png", "close_loop", "steps")


@dataclass(frozen=True, kw_only=True)
class Arguments(command_line.OwnModels, FitConfig):
    dataset: Path
    """Folder with the driving log."""

    out: Path = Path("runs/fit")
    """Folder for report.json, plots and vehicle.toml."""
    format: Form = "auto"
    """Form of the data; found out by default."""
    train: tuple[str, ...] = ()
    """Trials to fit in a measured set: RUN, GROUP or RUN:FROM-TO, e.g. warthog_asphalt_a:0-0.667 or robot1."""
    held_out: tuple[str, ...] = ()
    """Trials to predict in a measured set, in the same form."""
    chained: bool = False
    """DRIVE: 6 s steps, chained from 2 s windows, instead of the windows."""
    close_loop: bool = False
    """Then ask what the model lacks, into OUT/close_loop (`sysid.close_loop`)."""
    reference: tuple[Path, ...] = ()
    """For that: drives of the same vehicle on other days."""


def main(arguments: Arguments) -> None:
    """Load, fit, write and print the summary."""
    with refusing():
        if arguments.close_loop and arguments.model:
            raise ValueError(f"--close-loop asks what the simulator's vehicle lacks, and {arguments.model} is another "
                             "model. Leave one of the two out.")
        if arguments.reference and not arguments.close_loop:
            raise ValueError("--reference: only --close-loop asks for drives of other days. Add it or leave this out.")
        if arguments.wheels and not arguments.model:
            raise ValueError("--wheels: only a --model has joints or actuators to name. Add it or leave this out.")
        settings = FitConfig(**{name: getattr(arguments, name) for name in FitConfig.__dataclass_fields__})
        log = load_any(arguments.dataset, arguments.format, arguments.train, arguments.held_out, arguments.chained)
        log = replace(log, notes=(*log.notes, *doubts(log)))
        check_storage(settings)
        model = check_settings(log, settings)
        references = [load_any(path) for path in arguments.reference]
        if arguments.close_loop:
            from sysid.missing.fit_statistics import load_fitted
            from sysid.verdict.pipeline import check_logs

            check_logs(log, references)
            asked, vehicle = log, None
            if settings.vehicle is not None:
                spec, vehicle = load_fitted(settings.vehicle)
                asked, *references = (of_file(one, spec, str(settings.vehicle)) for one in (log, *references))
    chosen = {"data": log.sha256, "train": arguments.train, "held_out": arguments.held_out,
              "chained": arguments.chained, **settings_of(settings, model=model)}
    with run_folder(arguments.out, KIND, OUTPUTS, chosen, {"references": [one.sha256 for one in references]}):
        fit(arguments, settings, log, model)
        if arguments.close_loop:
            from sysid.pages.loop_report import WRITING, write_result
            from sysid.verdict.pipeline import watched
            from sysid.verdict.result import LoopConfig

            if settings.preset != "physical":
                print("the loop starts from the physical base model")
            config = LoopConfig(quick=settings.quick, seed=settings.seed, with_effects=settings.effects)
            found = watched(asked, references, config, vehicle)
            command_line.stage(WRITING)
            write_result(arguments.out / "close_loop", found)


def check_storage(settings: FitConfig) -> None:
    """Raise ValueError for a study's storage that cannot be opened, or that no search would use."""
    if settings.storage and settings.method not in (*GLOBAL, "both"):
        raise ValueError(f"--storage {without_secrets(settings.storage)}: --method {settings.method} has no global "
                         "search to keep. Use --method tpe, cmaes or both, or leave it out.")
    open_storage(settings.storage)


def fit(arguments: Arguments, settings: FitConfig, log: Log, model: Model | None) -> None:
    for note in log.notes:
        print(note)
    data = Loaded(log, arguments.dataset, {"train": arguments.train, "held_out_selection": arguments.held_out})
    with command_line.progress_bar(expected_steps(settings)) as progress:
        report = fit_dataset(data, arguments.out, config=settings, progress=progress, model=model)
    for note in (*filter(None, [warning(report)]), *report["dataset"]["notes"][len(log.notes):]):
        print(note)
    print(parameter_table(report))
    if report["prior"] is not None:
        print(f"Against {settings.vehicle}, assuming {settings.spread:.0%} from day to day:")
        for one in report["prior"]["moved"]:
            if not one["within"]:
                print(f"  {one['name']}: {one['before']:.4g} -> {one['after']:.4g}, {one['deviations']:+.1f} standard "
                      "deviations")
        print(f"  {sum(one['within'] for one in report['prior']['moved'])} parameters stayed within 90 %")
    print(table(report))
    fitted = ", ".join(name for name in ("model.toml", "model.xml", "vehicle.toml") if (arguments.out / name).exists())
    print(f"wrote {arguments.out / 'report.html'}, report.json, {fitted} and the plots")


def cli() -> None:
    command_line.run(Arguments, main, __doc__, stopped=command_line.STOPPED)


if __name__ == "__main__":
    cli()

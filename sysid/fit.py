"""Fit a vehicle to a driving log: `python -m sysid.fit DATASET --out RUN`.

Only training trials are fitted; held-out ones are predicted once, at the end, by the initial and the fitted vehicle.
Writes RUN/report.json and RUN/report.html (`sysid.report`), RUN/series.npz, RUN/*.png and RUN/vehicle.toml.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from sysid import command_line
from sysid.logs import odometry_frames
from sysid.logs.log import Log
from sysid.logs.measured import load_any
from sysid.pages.fit_report import make_report, provenance
from sysid.pages.report import error_rows, parameter_table, table, write_html, write_report
from sysid.pages.series import collect, save
from sysid.replay.models import (
    Model,
    save_model,
)
from sysid.search.fitting import expected_steps, fit_log, predict
from sysid.search.result import Progress
from sysid.search.settings import (
    FitConfig,
)


def fit_dataset(
    path: str | Path, out: str | Path, quick: bool = False, config: FitConfig | None = None, log: Log | None = None,
    progress: Progress | None = None, source: dict[str, Any] | None = None, model: Model | None = None,
) -> dict[str, Any]:
    """Fit a dataset and write report.json, report.html, plots and vehicle.toml into the folder `out`.

    Of another model than the simulator's vehicle, model.toml is written instead of vehicle.toml, and model.xml where
    it came from an MJCF or URDF file.

    Args:
        path: dataset folder; only named in the report when `log` is given.
        quick: overrides `config.quick` where true.
        log: an already loaded log.
        source: more to note in the report's `dataset`.
        model: as of `fit_log`.

    Returns:
        The report.
    """
    from sysid.pages.plots import write_plots
    from whill_mjx.vehicle.vehicle_file import save_vehicle

    config = config or FitConfig()
    config = replace(config, quick=quick or config.quick)
    log = load_any(path) if log is None else log
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    fit = fit_log(log, config, progress, model=model)
    if fit.frame is not None:
        log = replace(log, trials=odometry_frames.at_frames(log.trials, fit.frame),
                      notes=(*log.notes, odometry_frames.note(fit.frame)))
    trials = (*log.training, *log.held_out)
    initial, fitted = predict(fit, trials)
    rows = error_rows(trials, initial, fitted)
    report = make_report(log, config, fit, rows, str(path), source)
    write_report(out / "report.json", report)
    write_plots(out, trials, initial, fitted, rows)
    series = collect(trials, initial, fitted)
    save(out, series)
    write_html(out, series)
    intervals = {one.name: (one.low, one.high) for one in fit.uncertainty.estimates if one.identifiable}
    if fit.model is None:
        save_vehicle(out / "vehicle.toml", log.spec, fit.params, intervals, provenance(report))
    else:
        save_model(out, fit.model, fit.params, intervals, provenance(report))
    return report


@dataclass(frozen=True, kw_only=True)
class Arguments(FitConfig):
    """Command line of `python -m sysid.fit`."""

    dataset: Path
    """Folder with the driving log."""

    out: Path = Path("runs/fit")
    """Folder for report.json, plots and vehicle.toml."""
    format: Literal["auto", "dataset", "drive_norlab", "mrclam"] = "auto"
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
    dataset = arguments.dataset
    if arguments.close_loop and arguments.model:
        raise ValueError(f"--close-loop asks what the simulator's vehicle lacks, and {arguments.model} is another "
                         "model. Leave one of the two out.")
    settings = FitConfig(**{name: getattr(arguments, name) for name in FitConfig.__dataclass_fields__})
    log = load_any(dataset, arguments.format, arguments.train, arguments.held_out, arguments.chained)
    for note in log.notes:
        print(note)
    progress, close = command_line.progress_bar(expected_steps(settings))
    try:
        report = fit_dataset(dataset, arguments.out, config=settings, log=log, progress=progress,
                             source={"train": arguments.train, "held_out_selection": arguments.held_out})
    finally:
        close()
    for note in report["dataset"]["notes"][len(log.notes):]:
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
    fitted = "vehicle.toml" if not settings.model else "model.toml"
    print(f"wrote {arguments.out / 'report.html'}, report.json, {fitted} and the plots")
    if arguments.close_loop:
        from sysid.pages.loop_report import write_result
        from sysid.verdict.pipeline import watched
        from sysid.verdict.result import LoopConfig

        references = [load_any(path) for path in arguments.reference]
        if settings.preset != "physical":
            print("the loop starts from the physical base model")
        config = LoopConfig(quick=settings.quick, seed=settings.seed)
        write_result(arguments.out / "close_loop", watched(log, references, config))


def cli() -> None:
    """Command line."""
    command_line.run(Arguments, main, __doc__)


if __name__ == "__main__":
    cli()

"""Fits to two published sets of measured robots, the parts drive and mrclam of `benchmarks.fit`."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from benchmarks.fit_scores import evaluate, gains, show, show_parameters
from benchmarks.harness import figure, record
from sysid.logs.loaders import split
from sysid.logs.published.drive_norlab import load_drive
from sysid.logs.published.mrclam import load_mrclam
from sysid.logs.records import Log, Trial
from sysid.logs.unusable import lost, without_lost
from sysid.search.fitting import fit_log
from sysid.search.settings import FitConfig

if TYPE_CHECKING:
    from benchmarks.fit_settings import Benchmark

CLAIM = "A fitted vehicle predicts real robots better than an ideal one"
DRIVE_TRAIN = {"asphalt": ("warthog_asphalt_a:0-0.667",), "sand": ("warthog_sand_1",)}
DRIVE_HELD_OUT = {"asphalt": ("warthog_asphalt_a:0.667-1",), "sand": ("warthog_sand_2",)}
DRIVE_RUNS = ("warthog_asphalt_a", "warthog_sand_1", "warthog_sand_2")


def thin(log: Log, count: int) -> Log:
    """The log with at most `count` training trials, spread evenly over each group; held-out ones are kept."""
    groups: dict[str, list[Trial]] = {}
    for trial in log.training:
        groups.setdefault(trial.group, []).append(trial)
    each = max(count // len(groups), 1)
    kept = {group[i].name for group in groups.values()
            for i in np.linspace(0, len(group) - 1, min(each, len(group))).round().astype(int)}
    return log.select(lambda trial: trial.held_out or trial.name in kept)


def measured_config(settings: Benchmark, preset: Literal["paper", "physical"]) -> FitConfig:
    # The paper's drive has no wheel-spin state: its odometry is its body's motion, so it can only fit the pose.
    # Every window is a course of its own: looking elsewhere would take half an hour.
    return FitConfig(preset=preset, elsewhere=False, iterations=settings.iterations, physics_dt=settings.physics_dt,
                     channels="both" if preset == "physical" else "ground_truth")


def drive(settings: Benchmark) -> None:
    """DRIVE: one fit per terrain and one pooled, to steps of 6 s, since those are foretold; the same vehicles on native
    windows of 2 s, and on the steps whose outside pose was not lost (`sysid.logs.unusable`)."""
    folder = settings.shared / "data" / "measured" / "drive_norlab"
    native, chained = (load_drive(folder, DRIVE_RUNS, chained=chained) for chained in (False, True))
    everything = (tuple(sum(DRIVE_TRAIN.values(), ())), tuple(sum(DRIVE_HELD_OUT.values(), ())))
    choices = {name: (DRIVE_TRAIN[name], DRIVE_HELD_OUT[name]) for name in DRIVE_TRAIN} | {"pooled": everything}
    for preset in settings.presets:
        for name in settings.terrains:
            train, held_out = choices[name]
            log = without_lost(split(chained, train, held_out))
            fit = fit_log(thin(log, settings.windows), measured_config(settings, preset))
            stem = f"drive_{name}_{preset}"
            result = evaluate(fit, log.held_out)
            figures = gains(result["summary"]["held_out"], f"{stem}_chained_6s")
            gone = set(lost(log))
            followed = tuple(trial for trial in log.held_out if trial.name not in gone)
            figures |= gains(evaluate(fit, followed)["summary"]["held_out"], f"{stem}_chained_6s_not_lost")
            figures[f"lost_{stem}"] = figure([1 - len(followed) / len(log.held_out)], "share of held-out steps")
            windows = evaluate(fit, split(native, train, held_out).held_out)
            figures |= gains(windows["summary"]["held_out"], stem)
            for group, parts in (result["groups"] if name == "pooled" else {}).items():
                figures |= gains(parts["held_out"], f"{stem}_on_{group}")
            figures[f"seconds_{stem}"] = figure([fit.seconds], "s")
            if preset == "physical" and name != "pooled":
                figures[f"drive_gain_over_ideal_{name}"] = figures[f"gain_{stem}_chained_6s"]
            record("measured", CLAIM, figures)
            show(figures)
            show_parameters(fit)
    for note in chained.notes:
        print(note)


def mrclam(settings: Benchmark) -> None:
    """MRCLAM: robots 1 to 3 fitted, 4 and 5 held out."""
    log = load_mrclam(settings.shared / "data" / "measured" / "mrclam")
    log = split(log, ("robot1", "robot2", "robot3"), ("robot4", "robot5"))
    for preset in settings.presets:
        # Within a bin, poses alone contain little on such slow robots: a short global search finds the better starts.
        config = replace(measured_config(settings, preset), method="both", trials=96, starts=3)
        fit = fit_log(thin(log, settings.windows // 2), config)
        figures = gains(evaluate(fit, log.held_out)["summary"]["held_out"], f"mrclam_{preset}")
        figures[f"seconds_mrclam_{preset}"] = figure([fit.seconds], "s")
        record("measured", CLAIM, figures)
        show(figures)
        show_parameters(fit)

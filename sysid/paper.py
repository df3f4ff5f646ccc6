"""Repeat the reference paper's experiment on a driving log: `python -m sysid.paper DATASET --out RUN`.

Its 13 parameters from its initial values, its objective J (sum over manoeuvres of the position RMSE), TPE with 500
trials; straight, turn, circle and S-curve are fitted, the figure-eight is held out. The table has its four errors per
manoeuvre, mean and SD over replicate drives, before and after. Significance is tested over replicate drives (paired
sign flips, Holm's correction over the whole table): re-runs of a simulator against one recording would only test the
simulator's jitter.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from whill_mjx.io.command_line import listen, refusing, starts

if starts(__name__):
    listen()

import numpy as np

from sysid import command_line
from sysid.logs.loaders import load_any
from sysid.logs.records import Log
from sysid.pages.paper_page import HELD_OUT, PARAMETERS, PaperConfig, caution, compare, markdown, write
from sysid.pages.report import code_hashes, error_rows
from sysid.pages.series import collect
from sysid.run_folder import run_folder, settings_of
from sysid.search.fitting import fit_log, predict
from sysid.search.result import Progress
from sysid.search.settings import FitConfig
from whill_mjx.logs.manoeuvres import PAPER_MANOEUVRES
from whill_mjx.vehicle.parameters import describe, get_values
from whill_mjx.vehicle.presets import preset_params

KIND = "sysid.paper"
OUTPUTS = ("paper.json", "paper.md", "paper.html", "paper_trajectories.png", "paper_yaw.png", "series.npz", "steps")


def select(log: Log, channel: str = "odometry") -> Log:
    """The five manoeuvres' drives, the figure-eight alone held out; ValueError where one or the channel is missing."""
    absent = [name for name in PAPER_MANOEUVRES if not any(trial.manoeuvre == name for trial in log.trials)]
    if absent:
        raise ValueError(f"log {log.name!r} has no trial of {absent[0]} (its manoeuvres: "
                         f"{', '.join(sorted({trial.manoeuvre for trial in log.trials}))}). The experiment needs all "
                         f"of {', '.join(PAPER_MANOEUVRES)}; name trials like circle_1.")
    trials = tuple(replace(trial, held_out=trial.manoeuvre == HELD_OUT) for trial in log.trials
                   if trial.manoeuvre in PAPER_MANOEUVRES)
    for trial in trials:
        stream = getattr(trial, channel)
        if stream is None or stream.x is None:
            raise ValueError(f"trial {trial.name} of {log.name!r} has no position in {channel}. Use --channel "
                             f"{'ground_truth' if channel == 'odometry' else 'odometry'}.")
    order = {name: k for k, name in enumerate(PAPER_MANOEUVRES)}
    return replace(log, trials=tuple(sorted(trials, key=lambda trial: (order[trial.manoeuvre], trial.name))))


def run(log: Log, config: PaperConfig, progress: Progress | None = None) -> tuple[dict[str, Any], Any]:
    """The experiment: the content of paper.json, and the fit."""
    log = select(log, config.channel)
    settings = FitConfig(preset="paper", method="tpe", trials=config.trials, seed=config.seed, starts=1,
                         channels=config.channel, parameters=PARAMETERS, physics_dt=config.physics_dt)
    fit = fit_log(log, settings, progress)
    trials = (*log.training, *log.held_out)
    pairs = [predict(fit, part) for part in (log.training, log.held_out)]
    initial, fitted = ([*pairs[0][k], *pairs[1][k]] for k in (0, 1))
    rows = error_rows(trials, initial, fitted)
    about = describe(fit.params)
    published = np.asarray(get_values(preset_params(log.spec, "paper_optimised"), PARAMETERS))
    values = [np.asarray(get_values(one, PARAMETERS)) for one in (fit.initial_params, fit.params)]
    content = {
        "schema": 1, "kind": "sysid-paper", "code": code_hashes(),
        "dataset": {"name": log.name, "sha256": log.sha256, "vehicle": log.spec.name,
                    "drives": {name: sum(trial.manoeuvre == name for trial in trials) for name in PAPER_MANOEUVRES}},
        "settings": {"trials": config.trials, "seed": config.seed, "channel": config.channel,
                     "physics_dt": config.physics_dt},
        "parameters": [{"name": name, "unit": about[name].unit, "initial": float(values[0][k]),
                        "optimised": float(values[1][k]), "published": float(published[k])}
                       for k, name in enumerate(PARAMETERS)],
        "search": {"J_initial": fit.initial_cost, "J": fit.cost, "seconds": fit.seconds,
                   "evaluations": fit.scan.evaluations if fit.scan is not None else None,
                   "history": fit.scan.history if fit.scan is not None else []},
        "errors": rows,
        "table": {channel: compare(rows, channel) for channel in ("odometry", "ground_truth")
                  if any(row["channel"] == channel for row in rows)},
    }
    return content, (fit, collect(trials, initial, fitted))


def main(config: PaperConfig) -> dict[str, Any]:
    """Load, fit, write and print the table."""
    with refusing():
        log = load_any(config.dataset)
        select(log, config.channel)
    with run_folder(config.out, KIND, OUTPUTS, {"data": log.sha256, **settings_of(config, ("dataset", "out"))}):
        with command_line.progress_bar(config.trials) as progress:
            content, (fit, series) = run(log, config, progress)
        write(config.out, content, fit, series, log)
    print(markdown(content))
    print(caution(content))
    print(f"wrote {config.out / 'paper.html'}, paper.md, paper.json and the figures")
    return content


def cli() -> None:
    command_line.run(PaperConfig, main, __doc__, stopped=command_line.STOPPED)


if __name__ == "__main__":
    cli()

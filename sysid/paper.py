"""The reference paper's experiment on a driving log: `python -m sysid.paper DATASET --out RUN`.

Its 13 parameters from its initial values, its objective J (sum over manoeuvres of the position RMSE), TPE with 500
trials; straight, turn, circle and S-curve are fitted, the figure-eight is held out. The table has its four errors per
manoeuvre, mean and SD over replicate drives, before and after. Significance is tested over replicate drives (paired
sign flips, Holm's correction over the whole table): re-runs of a simulator against one recording would only test the
simulator's jitter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from sysid import command_line
from sysid.fit import FitConfig, fit_log, predict
from sysid.intervals.statistics import holm, mean_sd, sign_flip_p, smallest_p
from sysid.logs.log import Log
from sysid.logs.measured import load_any
from sysid.logs.metrics import METRICS, UNITS
from sysid.pages.html import Cell, Section, charts, html_page, legend, paragraph, png, table
from sysid.pages.series import TrialSeries, collect, save
from sysid.pages.svg import COLOURS, line_chart, replay_line
from sysid.report import code_hashes, error_rows, write_report
from sysid.search.result import Progress
from whill_mjx.logs.dataset import write_text
from whill_mjx.logs.manoeuvres import PAPER_MANOEUVRES
from whill_mjx.vehicle.parameters import describe, get_values
from whill_mjx.vehicle.presets import preset_params

PARAMETERS = (
    "lateral_damping.c_rear", "lateral_damping.c_front", "forward_slip.eta", "pid_drive.kp", "pid_drive.ki",
    "pid_drive.kd", "pid_drive.integral_limit", "air_drag.c_d", "rolling_resistance.mu_r", "air_drag.area",
    "body.com_x", "body.com_y", "body.com_z",
)  # fmt: skip
HELD_OUT = "figure_eight"
TRAJECTORY_FIGURES, YAW_FIGURES = ("s_curve", "figure_eight"), ("turn", "circle")
SIGNIFICANT = 0.05
WORSE = 1.001  # times as much counts as more than before


@dataclass(frozen=True)
class PaperConfig:
    """Options of the command."""

    dataset: Path
    """Driving log with the five manoeuvres, as many replicate drives of each as there are."""
    out: Path = Path("runs/paper")
    """Folder for paper.json, paper.md, paper.html, the figures and vehicle.toml."""
    trials: int = 500
    """Parameter sets that TPE tries."""
    seed: int = 0
    """Of TPE."""
    channel: Literal["odometry", "ground_truth"] = "odometry"
    """Positions that J compares: the paper's are wheel odometry."""
    physics_dt: float = 0.005
    """Physics step [s]."""


def select(log: Log, channel: str = "odometry") -> Log:
    """The five manoeuvres' drives, with the figure-eight, and nothing else, held out.

    Raises:
        ValueError: a manoeuvre or the channel is missing.
    """
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


def compare(rows: Sequence[dict[str, Any]], channel: str) -> list[dict[str, Any]]:
    """Errors of one channel by manoeuvre and metric over replicate drives, with tests.

    Args:
        rows: from `sysid.report.error_rows`.

    Returns:
        One entry per manoeuvre and metric: drives, initial and optimised (mean, SD), p, p_holm (None with one drive).
    """
    found: list[dict[str, Any]] = []
    for manoeuvre in PAPER_MANOEUVRES:
        mine = [row for row in rows if row["manoeuvre"] == manoeuvre and row["channel"] == channel]
        for metric in METRICS:
            pairs = [(row["metrics"][metric]["initial"], row["metrics"][metric]["fitted"]) for row in mine
                     if metric in row["metrics"]]
            if not pairs:
                continue
            before, after = np.array(pairs).T
            found.append({"manoeuvre": manoeuvre, "metric": metric, "unit": UNITS[metric], "drives": len(pairs),
                          "held_out": manoeuvre == HELD_OUT, "initial": mean_sd(before), "optimised": mean_sd(after),
                          "p": sign_flip_p(after - before) if len(pairs) > 1 else None, "p_holm": None})
    tested = [one for one in found if one["p"] is not None]
    for one, adjusted in zip(tested, holm([one["p"] for one in tested]), strict=True):
        one["p_holm"] = float(adjusted)
    return found


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


def markdown(content: dict[str, Any]) -> str:
    """The paper's table as Markdown: one table per channel."""
    parts = []
    for channel, entries in content["table"].items():
        metrics = [metric for metric in METRICS if any(one["metric"] == metric for one in entries)]
        heads = "".join(f" {metric.replace('_', ' ')} [{UNITS[metric]}] |" for metric in metrics)
        parts += [f"{channel.replace('_', ' ')}: mean +- SD over drives (p, Holm)", "",
                  f"| manoeuvre | parameters |{heads}", "|---|---|" + "---|" * len(metrics)]
        for manoeuvre in PAPER_MANOEUVRES:
            mine = {one["metric"]: one for one in entries if one["manoeuvre"] == manoeuvre}
            if not mine:
                continue
            label = manoeuvre + (" (held out)" if manoeuvre == HELD_OUT else "")
            drives = next(iter(mine.values()))["drives"]
            first = " | ".join(_spread(mine[metric]["initial"]) for metric in metrics)
            second = " | ".join(f"{_spread(mine[metric]['optimised'])} ({_p(mine[metric]['p_holm'])})"
                                for metric in metrics)
            parts += [f"| {label}, {drives} drives | initial | {first} |", f"| | optimised | {second} |"]
        parts.append("")
    return "\n".join(parts)


def caution(content: dict[str, Any]) -> str:
    """What the number of drives allows to say."""
    drives = min(content["dataset"]["drives"].values())
    tests = max(len(entries) for entries in content["table"].values())
    least = min(1.0, smallest_p(drives) * tests) if drives > 1 else 1.0
    text = (f"{drives} drives per manoeuvre at least: with {tests} tests no Holm-corrected p-value can be below "
            f"{least:.3g}.")
    if least > SIGNIFICANT:
        needed = next((n for n in range(2, 13) if smallest_p(n) * tests <= SIGNIFICANT), 13)
        text += f" Nothing can be significant; {needed} drives of each manoeuvre could be."
    return text


def write(folder: Path, content: dict[str, Any], fit: Any, series: Sequence[TrialSeries], log: Log) -> None:
    """Write paper.json, paper.md, figures, paper.html, series.npz and vehicle.toml."""
    from sysid.pages.plots import write_paper_figures
    from whill_mjx.vehicle.vehicle_file import save_vehicle

    folder.mkdir(parents=True, exist_ok=True)
    write_report(folder / "paper.json", content)
    write_text(folder / "paper.md", markdown(content) + "\n" + caution(content) + "\n")
    figures = write_paper_figures(folder, series, TRAJECTORY_FIGURES, YAW_FIGURES)
    save(folder, series)
    save_vehicle(folder / "vehicle.toml", log.spec, fit.params, provenance={
        "made_by": "sysid.paper", "dataset": log.name, "dataset_sha256": log.sha256, "J": fit.cost})
    write_text(folder / "paper.html", html_page(
        f"The paper's experiment on {log.name}", sections(content, series, figures),
        f"TPE, {content['settings']['trials']} trials, seed {content['settings']['seed']}; J over "
        f"{content['settings']['channel'].replace('_', ' ')}; data SHA-256 {log.sha256[:16]}"))


def sections(content: dict[str, Any], series: Sequence[TrialSeries], figures: Sequence[Path] = ()) -> list[Section]:
    """Sections of paper.html, for other pages as well."""
    search = content["search"]
    parts = [paragraph(f"J, the sum of position RMSE over the drives fitted: {search['J_initial']:.3f} m before, "
                       f"{search['J']:.3f} m after {search['evaluations']} evaluations in {search['seconds']:.0f} s.",
                       "lead"), paragraph(caution(content))]
    for channel, entries in content["table"].items():
        parts.append(_html_table(channel, entries))
    values = table(["parameter", "unit", "initial", "optimised here", "optimised in the paper"], [
        [one["name"], one["unit"], one["initial"], one["optimised"], one["published"]]
        for one in content["parameters"]])
    drawn = [trial for trial in series if trial.name.rsplit("_", 1)[-1] == "1"] or list(series)[:6]
    paths, yaws = [], []
    for trial in drawn:
        channel_of = trial.channels.get(content["settings"]["channel"])
        if channel_of is None:
            continue
        replays = {name: channel_of.values[name] for name in ("measured", "initial", "fitted")}
        title = trial.name + (" (held out)" if trial.held_out else "")
        paths.append(line_chart([replay_line(one[:, 0], one[:, 1], name) for name, one in replays.items()], "x [m]",
                                "y [m]", title, equal=True, smallest=0.3))
        yaws.append(line_chart([replay_line(channel_of.t, one[:, 2], name) for name, one in replays.items()], "t [s]",
                               "yaw [rad]", title, smallest=0.05))
    key = legend([(name, COLOURS[name]) for name in ("measured", "initial", "fitted")])
    return [Section("Table", "".join(parts)), Section("Parameters", values + paragraph(
        "The paper's values are of another vehicle; they stand here for orientation.", "dim")),
        Section("Trajectories", key + charts(paths)), Section("Yaw over time", key + charts(yaws)),
        Section("Figures for print", "".join(png(path) for path in figures)),
        Section("Data and code", table(["", ""], [["dataset SHA-256", content["dataset"]["sha256"]],
                                                  *([name, value] for name, value in content["code"].items())]))]


def _html_table(channel: str, entries: Sequence[dict[str, Any]]) -> str:
    rows: list[list[Any]] = []
    for one in entries:
        better = one["optimised"][0] < WORSE * one["initial"][0]
        rows.append([one["manoeuvre"] + (" (held out)" if one["held_out"] else ""),
                     f"{one['metric'].replace('_', ' ')} [{one['unit']}]", one["drives"], _spread(one["initial"]),
                     Cell(_spread(one["optimised"]), "good" if better else "bad"), one["p"], one["p_holm"]])
    return table(["manoeuvre", "RMSE", "drives", "initial", "optimised", "p", "p (Holm)"], rows,
                 f"{channel.replace('_', ' ')}: mean ± SD over replicate drives; red: more than before")


def _spread(pair: Sequence[float]) -> str:
    mean, deviation = pair
    return f"{mean:.3f}" + (f" ± {deviation:.3f}" if deviation is not None and np.isfinite(deviation) else "")


def _p(value: float | None) -> str:
    return "p –" if value is None else "p < .001" if value < 0.001 else f"p = {value:.3f}"


def main(config: PaperConfig) -> dict[str, Any]:
    """Load, fit, write and print the table."""
    log = load_any(config.dataset)
    progress, close = command_line.progress_bar(config.trials)
    try:
        content, (fit, series) = run(log, config, progress)
    finally:
        close()
    write(config.out, content, fit, series, log)
    print(markdown(content))
    print(caution(content))
    print(f"wrote {config.out / 'paper.html'}, paper.md, paper.json and the figures")
    return content


def cli() -> None:
    """Command line."""
    command_line.run(PaperConfig, main, __doc__)


if __name__ == "__main__":
    cli()

"""The tables, figures and page of the reference paper's experiment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from sysid.intervals.statistics import holm, mean_sd, sign_flip_p, smallest_p
from sysid.logs.metrics import METRICS, UNITS
from sysid.logs.records import Log
from sysid.pages.fit_page import WORSE, path_chart, replay_legend, yaw_chart
from sysid.pages.plots import write_paper_figures
from sysid.pages.report import write_report
from sysid.pages.series import TrialSeries, save
from whill_mjx.io.command_line import PHYSICS_DT, SEED, Range
from whill_mjx.io.html import Cell, Section, charts, html_page, paragraph, png, table
from whill_mjx.logs.dataset import write_text
from whill_mjx.logs.manoeuvres import PAPER_MANOEUVRES
from whill_mjx.vehicle.vehicle_file import save_vehicle

PARAMETERS = (
    "lateral_damping.c_rear", "lateral_damping.c_front", "forward_slip.eta", "pid_drive.kp", "pid_drive.ki",
    "pid_drive.kd", "pid_drive.integral_limit", "air_drag.c_d", "rolling_resistance.mu_r", "air_drag.area",
    "body.com_x", "body.com_y", "body.com_z",
)  # fmt: skip
HELD_OUT = "figure_eight"
TRAJECTORY_FIGURES, YAW_FIGURES = ("s_curve", "figure_eight"), ("turn", "circle")
SIGNIFICANT = 0.05
REPLAYS = ("measured", "initial", "fitted")


@dataclass(frozen=True)
class PaperConfig:
    """Options of the command."""

    dataset: Path
    """Driving log with the five manoeuvres, as many replicate drives of each as there are."""
    out: Path = Path("runs/paper")
    """Folder for paper.json, paper.md, paper.html, the figures and vehicle.toml."""
    trials: Annotated[int, Range(1, 1_000_000)] = 500
    """Parameter sets that TPE tries."""
    seed: Annotated[int, SEED] = 0
    """Random seed of TPE."""
    channel: Literal["odometry", "ground_truth"] = "odometry"
    """Positions that J compares: the paper's are wheel odometry."""
    physics_dt: Annotated[float, PHYSICS_DT] = 0.005
    """Physics step [s]."""


def compare(rows: Sequence[dict[str, Any]], channel: str) -> list[dict[str, Any]]:
    """Errors of one channel by manoeuvre and metric over replicate drives, with tests, from `error_rows`.

    One entry each: drives, initial and optimised (mean, SD), p, p_holm (None with one drive).
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
        f"{content['settings']['channel'].replace('_', ' ')}; data SHA-256 {log.sha256[:16]}",
        kind="The paper's experiment", lead=headline(content)))


def headline(content: dict[str, Any]) -> str:
    """One sentence: what the search made of the paper's objective."""
    search = content["search"]
    return (f"J, the sum of position RMSE over the drives fitted: {search['J_initial']:.3f} m before, "
            f"{search['J']:.3f} m after {search['evaluations']} evaluations in {search['seconds']:.0f} s.")


def sections(content: dict[str, Any], series: Sequence[TrialSeries], figures: Sequence[Path] = ()) -> list[Section]:
    """Sections of paper.html, for other pages as well."""
    parts = [paragraph(caution(content))]
    for channel, entries in content["table"].items():
        parts.append(_html_table(channel, entries))
    values = table(["parameter", "unit", "initial", "optimised here", "optimised in the paper"], [
        [one["name"], one["unit"], one["initial"], one["optimised"], one["published"]]
        for one in content["parameters"]])
    drawn = [trial for trial in series if trial.name.rsplit("_", 1)[-1] == "1"] or list(series)[:6]
    shown = [(one, trial.label, REPLAYS) for trial in drawn
             if (one := trial.channels.get(content["settings"]["channel"])) is not None]
    key = replay_legend(REPLAYS)
    return [Section("Table", "".join(parts)), Section("Parameters", values + paragraph(
        "The paper's values are of another vehicle; they stand here for orientation.", "dim")),
        Section("Trajectories", key + charts([path_chart(*one) for one in shown])),
        Section("Yaw over time", key + charts([yaw_chart(*one) for one in shown])),
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

"""Plots of a fit: trajectories and yaw, measured against simulated, and errors per trial."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sysid.pages.series import REPLAYED, Channel, TrialSeries
from sysid.search.result import Trace
from whill_mjx.io.png import pyplot, save_figure
from whill_mjx.io.svg import COLOURS

SMALLEST_PANEL = 0.2  # m; a turn on the spot would fill the panel with its noise
STYLES = {"measured": "-", "ideal": ":", "initial": "--", "fitted": "-"}


def write_plots(folder: Path, series: Sequence[TrialSeries], rows: list[dict[str, Any]]) -> list[Path]:
    """Write trajectories.png, yaw.png and errors.png of some trials; returns their paths."""
    panels = [(trial.channels.get("ground_truth") or trial.channels["odometry"], trial.label) for trial in series]
    names = {name: name for name in REPLAYED}
    paths = [_write_panels(folder / f"{kind}.png", kind, panels, names, 110) for kind in ("trajectories", "yaw")]
    return [*paths, _error_bars(folder / "errors.png", rows, {trial.name for trial in series})]


def write_paper_figures(
    folder: Path, series: Sequence[TrialSeries], trajectories: Sequence[str], yaws: Sequence[str]
) -> list[Path]:
    """Write paper_trajectories.png and paper_yaw.png of such manoeuvres: one panel each, of its first drive."""
    paths, names = [], {"measured": "measured", "initial": "initial", "fitted": "optimised"}
    for kind, manoeuvres in (("trajectories", trajectories), ("yaw", yaws)):
        firsts = [(name, next((one for one in series if one.name.startswith(f"{name}_")), None)) for name in manoeuvres]
        panels = [(trial.channels.get("odometry") or trial.channels["ground_truth"],
                   name.replace("_", " ") + (" (held out)" if trial.held_out else ""))
                  for name, trial in firsts if trial is not None]
        paths.append(_write_panels(folder / f"paper_{kind}.png", kind, panels, names, 150))
    return paths


def _write_panels(
    path: Path, kind: str, panels: Sequence[tuple[Channel, str]], names: Mapping[str, str], dpi: int
) -> Path:
    """Write a panel of trajectories, whose axes have one scale, or of yaw for each channel, with its title. `names`:
    what is drawn, and what it is called."""
    columns = min(4, max(len(panels), 1))
    lines = max(-(-len(panels) // columns), 1)
    figure, axes = pyplot().subplots(lines, columns, figsize=(3.6 * columns, 3.2 * lines), squeeze=False,
                                     layout="constrained")
    for axis in axes.flat[len(panels) :]:
        axis.set_visible(False)
    for axis, (channel, title) in zip(axes.flat, panels, strict=False):
        for name, label in names.items():
            table = channel.values[name]
            across, up = (table[:, 0], table[:, 1]) if kind == "trajectories" else (channel.t, table[:, 2])
            if np.isfinite(up).any():
                axis.plot(across, up, STYLES[name], color=COLOURS[name], label=label,
                          linewidth=2.2 if name == "measured" else 1.3, marker="." if len(channel.t) < 60 else None,
                          markersize=3)
        axis.set_title(title, fontsize=9)
        axis.set_xlabel("x [m]" if kind == "trajectories" else "t [s]", fontsize=8)
        axis.set_ylabel("y [m]" if kind == "trajectories" else "yaw [rad]", fontsize=8)
        axis.tick_params(labelsize=7)
        axis.grid(alpha=0.3)
        if kind == "trajectories":
            axis.axis("equal")
            reach, start = np.array([-0.5, 0.5]) * SMALLEST_PANEL, channel.values["fitted"][0, :2]
            axis.plot(start[0] + reach, start[1] + reach, alpha=0.0)
    axes.flat[0].legend(fontsize=7)
    return save_figure(figure, path, dpi)


def _error_bars(path: Path, rows: list[dict[str, Any]], names: set[str]) -> Path:
    """Trajectory and yaw error of the chosen trials for each replay."""
    mine = [row for row in rows if row["trial"] in names and "trajectory" in row["metrics"]]
    channel = "ground_truth" if any(row["channel"] == "ground_truth" for row in mine) else "odometry"
    mine = [row for row in mine if row["channel"] == channel]
    figure, axes = pyplot().subplots(2, 1, figsize=(max(6.0, 0.8 * len(mine)), 6.5), sharex=True, layout="constrained")
    for axis, metric, unit in zip(axes, ("trajectory", "yaw"), ("m", "rad"), strict=True):
        for k, replay in enumerate(("ideal", "initial", "fitted")):
            axis.bar(np.arange(len(mine)) + 0.27 * (k - 1), [row["metrics"][metric][replay] for row in mine], 0.27,
                     color=COLOURS[replay], label=replay)
        axis.set_ylabel(f"{metric} RMSE [{unit}]")
        axis.set_yscale("log")
        axis.grid(axis="y", alpha=0.3)
    axes[0].legend()
    axes[0].set_title(f"Error per trial, {channel.replace('_', ' ')} (* held out)")
    axes[1].set_xticks(range(len(mine)), [row["trial"] + ("*" if row["held_out"] else "") for row in mine],
                       rotation=60, ha="right", fontsize=8)
    return save_figure(figure, path, 110)


def write_search_plot(path: Path, traces: Sequence[Trace]) -> Path:
    """Write the best cost and held-out error so far of searches against evaluations and against seconds."""
    from matplotlib import ticker

    held_out = any(np.isfinite(one.held_out).any() for one in traces)
    errors = [("cost", "mean squared residual, training")]
    errors += [("held_out", "position RMSE, held out [m]")] if held_out else []
    figure, axes = pyplot().subplots(len(errors), 2, figsize=(10.5, 3.6 * len(errors)), squeeze=False,
                                     layout="constrained")
    methods = list(dict.fromkeys(one.method for one in traces))
    for row, (error, label) in zip(axes, errors, strict=True):
        for axis, (effort, unit) in zip(row, (("evaluations", "simulator evaluations"), ("seconds", "seconds")),
                                        strict=True):
            for k, method in enumerate(methods):
                mine = [one for one in traces if one.method == method]
                for one in mine:
                    axis.step(getattr(one, effort), getattr(one, error), where="post", color=f"C{k}", alpha=0.3,
                              linewidth=0.9)
                grid, middle = _median_step([(getattr(one, effort), getattr(one, error)) for one in mine])
                axis.step(grid, middle, where="post", color=f"C{k}", linewidth=2.2, label=method)
            axis.set_xscale("log")
            axis.set_yscale("log")
            axis.xaxis.set_minor_formatter(ticker.NullFormatter())  # it would print labels over one another
            axis.set_xlabel(unit)
            axis.set_ylabel(label)
            axis.grid(alpha=0.3, which="both")
    axes[0, 1].legend(fontsize=8)
    return save_figure(figure, path, 120)


def _median_step(steps: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Median of step functions (x, y), from where all have begun; each keeps its last value."""
    grid = np.unique(np.concatenate([x for x, _ in steps]))
    grid = grid[grid >= max(x[0] for x, _ in steps)]
    return grid, np.median([y[np.searchsorted(x, grid, side="right") - 1] for x, y in steps], axis=0)

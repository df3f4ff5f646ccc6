"""Plots of a fit: trajectories and yaw, measured against simulated, and errors per trial."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sysid.logs.metrics import ideal_replay
from sysid.logs.records import OdometryStream, PoseStream, Prediction, Trial
from sysid.pages.series import TrialSeries
from sysid.search.result import Trace
from whill_mjx.io.folders import whole_file

MAX_PANELS = 12

SMALLEST_PANEL = 0.2  # m; a turn on the spot would fill the panel with its noise
COLOURS = {"measured": "black", "ideal": "tab:gray", "initial": "tab:orange", "fitted": "tab:blue"}
STYLES = {"measured": "-", "ideal": ":", "initial": "--", "fitted": "-"}


def write_plots(
    folder: Path, trials: tuple[Trial, ...], initial: list[Prediction], fitted: list[Prediction],
    rows: list[dict[str, Any]],
) -> list[Path]:
    """Write trajectories.png, yaw.png and errors.png; returns their paths. Held-out trials come first."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    chosen = choose(trials)
    columns = min(4, len(chosen))
    lines = -(-len(chosen) // columns)
    paths = []
    for name in ("trajectories", "yaw"):
        figure, axes = pyplot.subplots(lines, columns, figsize=(3.6 * columns, 3.2 * lines), squeeze=False,
                                       layout="constrained")
        for axis in axes.flat[len(chosen) :]:
            axis.set_visible(False)
        for axis, index in zip(axes.flat, chosen, strict=False):
            trial = trials[index]
            streams = {"measured": _stream(trial), "ideal": _stream(ideal_replay(trial)),
                       "initial": _stream(initial[index]), "fitted": _stream(fitted[index])}
            sparse = len(streams["measured"].t) < 60
            for label, stream in streams.items():
                across, up = (stream.x, stream.y) if name == "trajectories" else (stream.t, stream.yaw)
                if across is None or up is None:
                    continue
                axis.plot(across, up, STYLES[label], color=COLOURS[label], label=label,
                          linewidth=2.2 if label == "measured" else 1.3,
                          marker="." if sparse else None, markersize=3)
            _label(axis, name, trial.name, trial.held_out)
            if name == "trajectories":
                reach = np.array([-0.5, 0.5]) * SMALLEST_PANEL
                axis.plot(trial.start.x + reach, trial.start.y + reach, alpha=0.0)
                axis.axis("equal")
        axes.flat[0].legend(fontsize=7)
        paths.append(folder / f"{name}.png")
        _save(figure, paths[-1], 110)
    paths.append(folder / "errors.png")
    _error_bars(pyplot, paths[-1], rows, {trials[index].name for index in chosen})
    return paths


def write_paper_figures(
    folder: Path, series: Sequence[TrialSeries], trajectories: Sequence[str], yaws: Sequence[str]
) -> list[Path]:
    """Write paper_trajectories.png and paper_yaw.png of such manoeuvres: one panel each, of its first drive."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    paths = []
    for kind, manoeuvres in (("trajectories", trajectories), ("yaw", yaws)):
        figure, axes = pyplot.subplots(1, len(manoeuvres), figsize=(3.6 * len(manoeuvres), 3.0), squeeze=False,
                                       layout="constrained")
        for axis, manoeuvre in zip(axes.flat, manoeuvres, strict=True):
            trial = next((one for one in series if one.name.startswith(f"{manoeuvre}_")), None)
            if trial is None:
                axis.set_visible(False)
                continue
            channel = trial.channels.get("odometry") or trial.channels["ground_truth"]
            for label, name in (("measured", "measured"), ("initial", "initial"), ("optimised", "fitted")):
                table = channel.values[name]
                across, up = (table[:, 0], table[:, 1]) if kind == "trajectories" else (channel.t, table[:, 2])
                axis.plot(across, up, STYLES[name], color=COLOURS[name], label=label,
                          linewidth=2.2 if name == "measured" else 1.3)
            _label(axis, kind, manoeuvre.replace("_", " "), trial.held_out)
            if kind == "trajectories":
                axis.axis("equal")
        axes.flat[0].legend(fontsize=7)
        paths.append(folder / f"paper_{kind}.png")
        _save(figure, paths[-1], 150)
    return paths


def _label(axis: Any, kind: str, title: str, held_out: bool) -> None:
    """Title and axes of a panel of trajectories or of yaw."""
    axis.set_title(title + (" (held out)" if held_out else ""), fontsize=9)
    axis.set_xlabel("x [m]" if kind == "trajectories" else "t [s]", fontsize=8)
    axis.set_ylabel("y [m]" if kind == "trajectories" else "yaw [rad]", fontsize=8)
    axis.tick_params(labelsize=7)
    axis.grid(alpha=0.3)


def choose(trials: tuple[Trial, ...]) -> list[int]:
    """At most MAX_PANELS trials: held-out ones first, spread evenly, at least a third of the panels for training."""
    held_out = [i for i, trial in enumerate(trials) if trial.held_out]
    training = [i for i, trial in enumerate(trials) if not trial.held_out]
    room = max(MAX_PANELS - len(training), 2 * MAX_PANELS // 3)
    first = _spread(held_out, room)
    return first + _spread(training, MAX_PANELS - len(first))


def _spread(items: list[int], count: int) -> list[int]:
    if len(items) <= count:
        return items
    return [items[i] for i in np.linspace(0, len(items) - 1, count).round().astype(int)]


def _stream(source: Trial | Prediction) -> PoseStream | OdometryStream:
    stream = source.ground_truth if source.ground_truth is not None else source.odometry
    assert stream is not None
    return stream


def _error_bars(pyplot: Any, path: Path, rows: list[dict[str, Any]], names: set[str]) -> None:
    """Trajectory and yaw error of the chosen trials for each replay."""
    mine = [row for row in rows if row["trial"] in names and "trajectory" in row["metrics"]]
    channel = "ground_truth" if any(row["channel"] == "ground_truth" for row in mine) else "odometry"
    mine = [row for row in mine if row["channel"] == channel]
    figure, axes = pyplot.subplots(2, 1, figsize=(max(6.0, 0.8 * len(mine)), 6.5), sharex=True, layout="constrained")
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
    _save(figure, path, 110)


def write_search_plot(path: Path, traces: Sequence[Trace]) -> Path:
    """Write the best cost and held-out error so far of searches against evaluations and against seconds."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot, ticker

    held_out = any(np.isfinite(one.held_out).any() for one in traces)
    errors = [("cost", "mean squared residual, training")]
    errors += [("held_out", "position RMSE, held out [m]")] if held_out else []
    figure, axes = pyplot.subplots(len(errors), 2, figsize=(10.5, 3.6 * len(errors)), squeeze=False,
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
    _save(figure, path, 120)
    return path


def _save(figure: Any, path: Path, dpi: int) -> None:
    """Write a figure, whole or not at all, and close it."""
    from matplotlib import pyplot

    try:
        with whole_file(path) as temporary:
            figure.savefig(temporary, dpi=dpi)
    finally:
        pyplot.close(figure)


def _median_step(steps: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Median of step functions (x, y), from where all have begun; each keeps its last value."""
    grid = np.unique(np.concatenate([x for x, _ in steps]))
    grid = grid[grid >= max(x[0] for x, _ in steps)]
    return grid, np.median([y[np.searchsorted(x, grid, side="right") - 1] for x, y in steps], axis=0)

"""The page of an inspected log (inspect.html, self-contained), and its picture: sampling, excitation, replicates."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sysid.logs.records import Log
from sysid.logs.stream_quality import speeds
from whill_mjx.io.folders import write_whole
from whill_mjx.io.html import Cell, Section, bullets, html_page, paragraph, png, table
from whill_mjx.io.png import pyplot, save_figure

MAX_ROWS = 60  # trials listed one by one
STREAMS = {"command": "commands", "odometry": "odometry", "ground_truth": "outside pose"}


def write_page(path: Path, found: dict[str, Any], picture: Path) -> Path:
    """Write the page of what `sysid.logs.inspection.inspect` found, with its picture inside."""
    log = found["log"]
    sections = [Section("Is anything odd?", odd(found)), Section("What this log cannot determine", blind(found))]
    if found.get("next_drives"):
        sections.append(Section("Next drives", next_drives(found["next_drives"])))
    sections += [Section("Pictures", png(picture, "Sampling, excitation, the liveliest trial, and the spread between "
                                                  "replicates")),
                 Section("Streams", streams(found)), Section("Trials", trials(found))]
    write_whole(path, html_page(f"Log {log['name']}", sections, f"data SHA-256 {log['sha256'][:16]}", kind="Log",
                                lead=meaning(found)))
    return path


def meaning(found: dict[str, Any]) -> str:
    """One sentence: how much there is, and what stands between it and a fit."""
    log, wrong, hidden = found["log"], len(found["sanity"] or ()), len(found["blind_spots"])
    about = f"{log['trials']} trials of {log['vehicle']}, {log['seconds']:.0f} s"
    looks = ("nothing looks wrong" if not wrong else "one thing looks wrong" if wrong == 1 else
             f"{wrong} things look wrong")
    lacks = ("a fit can determine all it needs" if not hidden else
             "one property of the vehicle stays hidden" if hidden == 1 else
             f"{hidden} properties of the vehicle stay hidden")
    return f"{about}: {looks}, and {lacks}."


def odd(found: dict[str, Any]) -> str:
    """What contradicts the commands, and the notes of the loader."""
    text = (bullets(found["sanity"]) if found["sanity"] else
            paragraph("No: measured speeds, yaw rates and path lengths agree with the commands."))
    notes = found["log"]["notes"]
    return text + (paragraph("Notes of the reader:") + bullets(notes) if notes else "")


def blind(found: dict[str, Any]) -> str:
    """What the log cannot determine, why, and the remedy."""
    rows = [[one["hidden"], one["cause"], one["remedy"]] for one in found["blind_spots"]]
    header = ["not determined", "because", "remedy"]
    return table(header, rows) if rows else paragraph("A fit can determine all that it looks for.")


def next_drives(drives: list[dict[str, Any]]) -> str:
    """The proposed drives and their files."""
    rows = [[one["file"], one["manoeuvre"].replace("_", " "), one["why"], one["seconds"], one["v"], one["omega"]]
            for one in drives]
    header = ["file", "manoeuvre", "why", "time [s]", "to v [m/s]", "to omega [rad/s]"]
    return table(header, rows) + paragraph("The drives go up to this speed and yaw rate. Commands are ramped and "
                                           "stay within the room; inspect.txt says where to start. Keep a hand on the "
                                           "stop.", "dim")


def streams(found: dict[str, Any]) -> str:
    """How regularly each stream was sampled, and how the clocks differ."""
    rows = [[STREAMS.get(name, name), one["samples"], one["rate"], round(1e3 * one["jitter"], 2),
             round(1e3 * one["longest"], 1), Cell(one["gaps"], "warn" if one["gaps"] else ""), f"{one['missing']:.1%}",
             "–" if not np.isfinite(one["held"]) else f"{one['held']:.1%}"] for name, one in found["streams"].items()]
    late = [[name.replace("ground_truth", "outside pose"), channel, 1e3 * one["delay"],
             1e3 * one["error"] if one["trials"] > 1 else None, one["gain"], one["trials"]]
            for name, channels in found["clocks"].items() for channel, one in channels.items()]
    parts = [table(["stream", "samples", "rate [Hz]", "jitter [ms]", "longest interval [ms]", "gaps", "missing",
                    "repeated"], rows)]
    if late:
        parts.append(table(["what is late", "channel", "delay [ms]", "standard error [ms]", "gain", "trials"], late,
                           "Delay: clock offset plus transport delay. Gain: what is late over what it follows. Medians "
                           "over trials."))
    return "".join(parts)


def trials(found: dict[str, Any]) -> str:
    """What each trial excites."""
    rows = []
    for one in found["trials"][:MAX_ROWS]:
        drive = one["excitation"]
        rows.append([one["trial"], "held out" if one["held_out"] else "training", one["seconds"],
                     f"{drive['v'][0]:+.2f} to {drive['v'][1]:+.2f}",
                     f"{drive['omega'][0]:+.2f} to {drive['omega'][1]:+.2f}",
                     drive["reversals"], drive["distance"], drive["turn"]])
    hidden = len(found["trials"]) - MAX_ROWS
    return table(["trial", "part", "time [s]", "v [m/s]", "omega [rad/s]", "reversals", "path [m]", "turn [rad]"], rows,
                 f"the first {MAX_ROWS} of {len(found['trials'])}; all are in inspect.json" if hidden > 0 else "")


COLOURS = {"command": "tab:gray", "odometry": "tab:blue", "ground_truth": "tab:red"}
LABELS = {"command": "command", "odometry": "odometry", "ground_truth": "outside pose"}

UNITS = {"m": ("x", "y"), "rad": ("yaw",), "m/s": ("v",), "rad/s": ("omega",)}  # quantities of each unit
MARKS = ("o", "x")  # marks of the quantities of one unit


def write_plot(path: Path, log: Log, found: dict[str, Any]) -> Path:
    """Write the picture (PNG) of a log and what `sysid.logs.inspection.inspect` found on it."""
    rows = max(len(found["replicates"]), 3)
    figure = pyplot().figure(figsize=(12.0, 8.5 + 0.25 * rows), layout="constrained")
    parts: Any = figure.subfigures(3, 1, height_ratios=(4.2, 3.3, 1.0 + 0.25 * rows))
    upper, middle, lower = parts
    left, right = upper.subplots(1, 2)
    _intervals(left, log)
    _velocities(right, log)
    _liveliest(middle.subplots(), log)
    lower.suptitle("Standard deviation between replicates: no model can predict better", fontsize=11)
    _spread(lower.subplots(1, len(UNITS), sharey=True), found)
    figure.suptitle(f"{log.name}: {len(log.trials)} trials, {found['log']['seconds']:.0f} s")
    return save_figure(figure, path, 100)


def _label(axis: Any, title: str, across: str, up: str) -> None:
    axis.set(title=title, xlabel=across, ylabel=up)
    axis.legend(fontsize=8)
    axis.grid(alpha=0.3)


def _intervals(axis: Any, log: Log) -> None:
    """Distribution of the intervals between samples."""
    from matplotlib import ticker

    for name, style in zip(COLOURS, ("-", "-", "--"), strict=True):
        streams = [getattr(trial, name) for trial in log.trials]
        steps = [np.diff(stream.t) for stream in streams if stream is not None and len(stream.t) > 1]
        if steps:
            ordered = np.sort(np.concatenate(steps)) * 1e3
            axis.plot(ordered, np.linspace(0, 1, len(ordered)), style, color=COLOURS[name], label=LABELS[name])
    axis.set_xscale("log")
    low, high = axis.get_xlim()
    axis.set_xlim(low / 3, high * 3)
    _label(axis, "Sampling: an upright line is regular", "interval between samples [ms]", "share of intervals below")
    axis.xaxis.set_major_formatter("{x:g}")
    axis.xaxis.set_minor_locator(ticker.LogLocator(subs=(2.0, 5.0)))
    axis.xaxis.set_minor_formatter("{x:g}")


def _velocities(axis: Any, log: Log) -> None:
    """Which speeds and yaw rates were reached."""
    for trial in log.trials:
        channel = "odometry" if trial.odometry is not None else "ground_truth"
        rates = speeds(trial, channel)
        if rates is not None:
            axis.plot(rates[1][::5], rates[2][::5], ".", markersize=2, alpha=0.35, color=COLOURS[channel])
        axis.plot(trial.command.v[:: max(len(trial.command.v) // 200, 1)],
                  trial.command.omega[:: max(len(trial.command.v) // 200, 1)], "x", markersize=4, color="black",
                  alpha=0.5)
    axis.plot([], [], ".", color=COLOURS[channel], label=f"measured ({LABELS[channel]})")
    axis.plot([], [], "x", color="black", label="commanded")
    axis.axhline(0, color="black", linewidth=0.5)
    axis.axvline(0, color="black", linewidth=0.5)
    _label(axis, "Excitation: empty regions are extrapolated", "v [m/s]", "omega [rad/s]")


def _liveliest(axis: Any, log: Log) -> None:
    """Command against measured yaw rate, or speed, of the trial that changes most."""

    def changes(trial: Any) -> float:
        return float(np.abs(np.diff(trial.command.v)).sum() + np.abs(np.diff(trial.command.omega)).sum())

    trial = max(log.trials, key=changes)
    turning = trial.command.omega.std() > trial.command.v.std()
    column, label = (2, "omega [rad/s]") if turning else (1, "v [m/s]")
    for channel in ("ground_truth", "odometry"):
        rates = speeds(trial, channel)
        if rates is not None:
            axis.plot(rates[0], rates[column], color=COLOURS[channel], label=LABELS[channel], linewidth=1.2)
    t = np.arange(0.0, trial.duration, 0.01)
    axis.plot(t, trial.command.at(t)[int(turning)], color="black", linewidth=1.0, label="command")
    _label(axis, f"Command and motion: {trial.name}", "t [s]", label)


def _spread(panels: Sequence[Any], found: dict[str, Any]) -> None:
    """Spread between replicates: one panel a unit, one row a manoeuvre, one mark a channel."""
    groups = found["replicates"]
    names = list(dict.fromkeys(name for group in groups for name in group["spread"]))
    labels = [group["trials"][0].rsplit("_", 1)[0] for group in groups]
    for axis, (unit, quantities) in zip(panels, UNITS.items(), strict=True):
        mine = [name for name in names if name.partition(".")[2] in quantities]
        axis.set_title(f"{' and '.join(quantities)} [{unit}]", fontsize=9)
        if not mine:
            axis.text(0.5, 0.5, "no replicates" if not groups else "not measured", ha="center", va="center",
                      transform=axis.transAxes)
            axis.set_xticks([])
            continue
        for name in mine:
            channel, mark = name.partition(".")[0], MARKS[quantities.index(name.partition(".")[2])]
            axis.plot([group["spread"].get(name, np.nan) for group in groups], range(len(groups)), mark,
                      markersize=5, color=COLOURS.get(channel, "black"), alpha=0.8,
                      label=f"{name.partition('.')[2]}, {LABELS.get(channel, channel)}")
        axis.set_xlim(0.0, 1.1 * axis.get_xlim()[1])
        axis.set_ylim(len(groups) - 0.5, -0.5)
        axis.set_yticks(range(len(groups)), labels, fontsize=8)
        axis.tick_params(axis="x", labelsize=7)
        axis.legend(fontsize=7, loc="upper left", bbox_to_anchor=(0.0, -0.2), ncols=2, frameon=False)
        axis.grid(alpha=0.3)

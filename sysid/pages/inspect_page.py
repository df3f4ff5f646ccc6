"""The page of an inspected log: RUN/inspect.html, self-contained."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from whill_mjx.io.folders import write_whole
from whill_mjx.io.html import Cell, Section, bullets, html_page, paragraph, png, table

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

"""The report of a loop over ROS 2: what was found, before and after, and how long it took."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from whill_mjx.io.folders import write_whole
from whill_mjx.io.html import Cell, Section, html_page, links, paragraph, table

PAGES = (("fit/report.html", "the fitted vehicle"), ("loop/report.html", "the first verdict"),
         ("loop_again/report.html", "the second verdict"), ("train/index.html", "the training"))
LEAST_GAIN = 0.5
"""Share of the held-out error that the loop should remove."""


def write_page(out: Path, last_loop: Path, found: dict[str, Any]) -> Path:
    """Write report.html into the run's folder; return its path."""
    sections = [Section("What was driven", stages(found)), Section("What was found", verdicts(found))]
    report = last_loop / "report.json"
    if report.exists():
        sections.append(Section("Before and after", errors(json.loads(report.read_text()))))
    drive = out / "drive.json"
    if drive.exists():
        sections.append(Section("The policy on the plant", episodes(json.loads(drive.read_text())["episodes"])))
    there = [(name, text) for name, text in PAGES if (out / name).exists()]
    sections.append(Section("All reports", links(there) if there else paragraph("None was written yet.")))
    path = out / "report.html"
    write_whole(path, html_page("The loop over ROS 2", sections, str(out), kind="Loop over ROS 2", lead=meaning(found)))
    return path


def meaning(found: dict[str, Any]) -> str:
    """What came of the run, in one sentence."""
    last = found.get("loop_again") or found.get("loop")
    if last is None:
        return "The loop was not closed yet."
    names = " and ".join(effect["name"] for effect in last["effects"])
    said = f"The loop named {names}" if names else f"The verdict is {last['verdict']}"
    right = "which is what was built in" if last["named"] else "which is not what was built in"
    gain = last["held_out_removed"]
    removed = "" if gain is None else f"; it removed {100 * gain:.0f} % of the error on held-out drives"
    return f"{said}, {right}{removed}."


def stages(found: dict[str, Any]) -> str:
    """Table of the stages."""
    rows = [(name, one["what"], one["seconds"]) for name, one in found["stages"].items()]
    return table(("stage", "result", "seconds"), rows)


def verdicts(found: dict[str, Any]) -> str:
    """What the loop named, beside what was built in."""
    truth = ", ".join(f"{name}, size {size:.3g}" for name, size in found["truth"].items()) or "nothing"
    rows: list[tuple[str | Cell, ...]] = []
    for stage in ("loop", "loop_again"):
        one = found.get(stage)
        if one is None:
            continue
        names = "; ".join(f"{effect['name']} (class: {', '.join(effect['class'])})" for effect in one["effects"])
        mark = Cell("yes", "good") if one["named"] else Cell("no", "bad")
        rows.append((stage.replace("_", " "), one["verdict"], names or "none", mark))
    if not rows:
        return paragraph("The loop was not closed yet.")
    return paragraph(f"Built into the plant: {truth}. Nothing but this page has read that.") + table(
        ("after", "verdict", "effects", "built in is in the class"), rows)


def errors(report: dict[str, Any]) -> str:
    """Errors of held-out and training drives before and after the effect is in the vehicle."""
    rows: list[tuple[str | float | Cell | None, ...]] = []
    for part, words in (("held_out", "held out"), ("training", "training")):
        for channel, before in report["before"][part].items():
            after = report["after"][part][channel]
            gain = 1 - after["trajectory"] / before["trajectory"] if before["trajectory"] else 0.0
            floor = (before.get("noise_floor") or {}).get("trajectory")
            mark = "good" if gain >= LEAST_GAIN else "warn"
            rows.append((words, channel.replace("_", " "), before["trajectory"], after["trajectory"], floor,
                         Cell(f"{100 * gain:.0f} %", mark)))
    return table(("drives", "channel", "before [m]", "after [m]", "replicates differ by [m]", "removed"), rows,
                 "Mean root-mean-square distance of the predicted path.")


def episodes(driven: list[dict[str, Any]]) -> str:
    """Table of the policy's episodes."""
    rows = [(str(one["seed"]), "arrived" if one["reached_goal"] else "collided" if one["collided"] else "out of time",
             float(one["steps"]), one["ended"] - one["began"]) for one in driven]
    return table(("world", "outcome", "periods", "seconds"), rows)

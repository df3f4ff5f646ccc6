"""How a proposed manoeuvre reads: a text, and a page with its path, its commands and what the others would show."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sysid.errors.space import Space
from sysid.intervals.design import Criterion, Plan, Proposal
from sysid.intervals.uncertainty import PRIOR_SD, UNIDENTIFIABLE
from sysid.logs.manoeuvre_library import Limits
from sysid.logs.planar import turned_by
from sysid.pages.loop_words import MANOEUVRE_WORDS
from whill_mjx.io.html import Cell, Section, charts, explained, html_page, paragraph, table
from whill_mjx.io.svg import PALETTE, Axes, Line, line_chart
from whill_mjx.logs.dataset import write_text
from whill_mjx.vehicle.types import Parameter

SHOWN = 12  # candidates listed
CRITERIA: dict[Criterion, str] = {"a": "least sum of variances", "d": "least volume of the uncertainty"}


def text(found: Proposal, criterion: Criterion) -> str:
    """What was chosen, why, and what it changes."""
    chosen, plans, space, before = found.chosen, found.plans, found.space, found.before
    lines = []
    for number, plan in enumerate(chosen, start=1):
        x, y, yaw = plan.start
        lines.append(f"{number}. {plan.candidate.name}: {plan.candidate.command.t[-1]:.1f} s; start {x:.2f} m, "
                     f"{y:.2f} m from the corner, heading {np.rad2deg(yaw):.0f} degrees")
    index = int(np.argmax(before))
    after = chosen[-1].deviation
    lines.append(f"largest uncertainty: {space.names[index]}, +-{before[index]:.1%} of its range; after the drive "
                 f"+-{after[index]:.1%}")
    lines.append(f"{'manoeuvre':18} {'sum of variances':>17} {'volume (log)':>13}   ({CRITERIA[criterion]} first)")
    lines += [f"{plan.candidate.name:18} {plan.trace:17.4f} {plan.volume:13.2f}" for plan in plans[:SHOWN]]
    best = np.min([plan.deviation for plan in plans], axis=0)  # by any single candidate
    blind = [name for name, one in zip(space.names, best, strict=True) if one > UNIDENTIFIABLE * PRIOR_SD]
    if blind:
        lines.append("no candidate determines: " + ", ".join(blind))
    return "\n".join(lines)


def meaning(chosen: Sequence[Plan], space: Space, before: np.ndarray) -> str:
    """One sentence: what to drive, and what becomes of the parameter that is known worst."""
    index = int(np.argmax(before))
    drives = " and then ".join(in_words(plan.candidate.name) for plan in chosen)
    return (f"Drive {drives} next: the uncertainty of {space.names[index]}, the largest, shrinks from "
            f"{before[index]:.1%} to {chosen[-1].deviation[index]:.1%} of its range.")


def in_words(name: str) -> str:
    """A manoeuvre of the library in words, with its name; NAME_50 is the one of half size."""
    whole = name.removesuffix("_50")
    said = MANOEUVRE_WORDS.get(whole, f"the {whole.replace('_', ' ')}") + (" at half size" if whole != name else "")
    return f"{said} ({name})"


def write_page(path: Path, found: Proposal, limits: Limits, config: Any, about: dict[str, Parameter]) -> Path:
    """Write the page, whole or not at all; `about` has meaning and unit of each parameter."""
    chosen, plans, space, before = found.chosen, found.plans, found.space, found.before
    sections = []
    for plan in chosen:
        command = plan.candidate.command
        axes = Axes(smallest=0.1)
        items = [_room_chart(plan, limits),
                 line_chart([_held(command.t, command.v)], "t [s]", "v [m/s]", "speed", axes),
                 line_chart([_held(command.t, command.omega)], "t [s]", "omega [rad/s]", "yaw rate", axes)]
        x, y, yaw = plan.start
        sections.append(Section(in_words(plan.candidate.name).capitalize(), charts(items) + paragraph(
            f"Start {x:.2f} m, {y:.2f} m from the lower left corner, heading {np.rad2deg(yaw):.0f} degrees. The path "
            f"is simulated; the dashed frame keeps {limits.margin:.2f} m for the body.")))
    rows: list[list[str | float | Cell | None]] = [
        [explained(name, about[name].description), about[name].unit, float(space.initial[k]),
         float(before[k] / PRIOR_SD), float(chosen[-1].deviation[k] / PRIOR_SD)]
        for k, name in enumerate(space.names)]
    ranking: list[list[str | float | Cell | None]] = [
        [plan.candidate.name, float(plan.candidate.command.t[-1]), plan.trace, plan.volume]
        for plan in plans]
    sections += [
        Section("What it determines", paragraph("Uncertainty of each parameter before and after the drives: 1 is as "
                                                "much as its bounds allow, and above 0.5 counts as not determined.")
                + table(["parameter", "unit", "value", "before", "after"], rows)),
        Section("Other manoeuvres", paragraph(
            "How much uncertainty each manoeuvre would leave; less is better. Sum of variances: 1 is as now. Volume: "
            "logarithm of the volume of the uncertainty relative to now. NAME_50 is NAME at half size; prbs is a "
            "pseudo-random binary sequence.")
                + table(["manoeuvre", "seconds", "sum of variances", "volume (log)"], ranking))]
    page = html_page(f"Next manoeuvre for {config.vehicle if '/' not in config.vehicle else Path(config.vehicle).name}",
                     sections, f"{limits.room[0]:g} x {limits.room[1]:g} m, {limits.v_min:g} to {limits.v_max:g} m/s, "
                     f"{limits.omega_max:g} rad/s; chosen by the {CRITERIA[config.criterion]}", kind="Next drive",
                     lead=meaning(chosen, space, before))
    write_text(path, page)
    return path


def _room_chart(plan: Plan, limits: Limits) -> str:
    x0, y0, yaw = plan.start
    along, across = turned_by(plan.path[:, 0], plan.path[:, 1], yaw)
    x, y = x0 + along, y0 + across
    (length, width), margin = limits.room, limits.margin
    outer = Line(np.array([0, length, length, 0, 0.0]), np.array([0, 0, width, width, 0.0]), colour=PALETTE[6])
    inner = Line(np.array([margin, length - margin, length - margin, margin, margin]),
                 np.array([margin, margin, width - margin, width - margin, margin]), colour=PALETTE[7], dash="4 3")
    return line_chart([outer, inner, Line(x, y), Line(x[:1], y[:1], colour=PALETTE[3], markers=True)], "x [m]", "y [m]",
                      "path in the room (dot: start)", Axes(equal=True))


def _held(t: np.ndarray, values: np.ndarray) -> Line:
    """A command that holds until the next."""
    return Line(np.repeat(t, 2)[1:], np.repeat(values, 2)[:-1])

"""Write the figures of README.md and the page benchmarks/README.md from the result files in benchmarks/results.

    python -m benchmarks.tables          # write both pages
    python -m benchmarks.tables --check  # write nothing; fail where a page differs from the result files
"""

from __future__ import annotations

import argparse
import json
import os
import re
import sys
from pathlib import Path
from typing import Any

from benchmarks.claims import CLAIMS, HEADLINES, Claim
from benchmarks.harness import RESULTS
from bridge.nodes.options import Parser
from whill_mjx.io.command_line import guarded

HEAD = """# Benchmarks

Each table below supports one claim. `python -m benchmarks.tables` makes this page from `benchmarks/results/*.json`; do
not edit it. The result files also hold every repeat and seed, the full command, the versions and the commit.
Values are medians unless a heading says otherwise. "a to b" is the range over seeds or repeats.
The [glossary](../docs/glossary.md) explains the terms. All scripts run on a CPU too, in smaller sizes. Logs of measured
robots belong to others: scripts read them from the folder that `--shared` names.
"""
NOTES = RESULTS.parent / "notes"
"""Written by hand: NOTES/FILE.md goes below the last table of results/FILE.json."""
MARKS = ("<!-- figures -->", "<!-- /figures -->")
CELL = re.compile(r"\{(?:(?P<stem>\w+):)?(?P<name>[^{}|]+)(?:\|(?P<form>[^{}]+))?\}")
"""{figure}, {figure|form} or {file:figure|form}; `shown` lists the forms."""


class Figures:
    """Figures of the result files in a folder, and a record of those that were shown."""

    def __init__(self, results: Path) -> None:
        self.results = results
        self.files: dict[str, dict[str, Any]] = {}
        self.used: list[dict[str, Any]] = []

    def content(self, stem: str) -> dict[str, Any]:
        """A whole result file; empty where there is none."""
        if stem not in self.files:
            path = self.results / f"{stem}.json"
            self.files[stem] = json.loads(path.read_text()) if path.exists() else {}
        return self.files[stem]

    def entry(self, stem: str, name: str) -> dict[str, Any] | None:
        """One figure, or None where it was not measured."""
        found = self.content(stem).get("figures", {}).get(name)
        if found is not None:
            whole = self.content(stem)
            self.used.append({"date": whole.get("date"), "command": whole["command"], **found})
        return found

    def fill(self, text: str, stem: str, release: str | None = None) -> str | None:
        """`text` with its cells filled in; None where it has cells and none of them was measured.

        With `release`, * marks figures of other releases: the end of a text of which all are, else each of them.
        """
        cells = list(CELL.finditer(text))
        entries = [self.entry(cell["stem"] or stem, cell["name"]) for cell in cells]
        if cells and not any(entries):
            return None
        older = [release is not None and entry is not None and entry.get("release") != release for entry in entries]
        values = iter("-" if entry is None else shown(entry, cell["form"] or "") + "*" * (old and not all(older))
                      for cell, entry, old in zip(cells, entries, older, strict=True))
        return CELL.sub(lambda cell: next(values), text) + "*" * (all(older) and bool(cells))


def shown(entry: dict[str, Any], form: str) -> str:
    """A figure as text. Forms: % | a factor such as 1e-6 | range | n (repeats) | .KEY (another field of the entry).

    They can be joined: "range 100" and "range %" are the range of the repeats, times 100.
    """
    key = next((word[1:] for word in form.split() if word.startswith(".")), None)
    words = [word for word in form.split() if not word.startswith(".")]
    if "n" in words:
        return str(len(entry["repeats"]))
    percent = "%" in words
    factor = 100.0 if percent else next((float(word) for word in words if word not in ("%", "range")), 1.0)
    unit = " %" if percent else ""
    if "range" in words:
        low, high = (number(end(entry["repeats"]) * factor) + unit for end in (min, max))
        return low if low == high else f"{low} to {high}"
    value = entry["value"] if key is None else entry.get(key)  # files of earlier runs lack newer fields
    return number(value if value is None else value * factor) + unit


def number(value: float | None) -> str:
    """Three significant digits; thousands separated."""
    if value is None:
        return "-"
    if abs(value) >= 1000:
        return f"{value:,.0f}"
    return f"{value:.3g}"


def table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """Markdown table."""
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    return "\n".join([*lines, *(f"| {' | '.join(row)} |" for row in rows)])


def section(claim: Claim, figures: Figures) -> str | None:
    """Heading, text and table of one claim, and where its figures come from; None where nothing was measured."""
    figures.used.clear()
    content = figures.content(claim.stem)
    templates = claim.rows(content) if callable(claim.rows) else claim.rows
    rows = []
    for template in templates if content else ():
        cells = [figures.fill(text, claim.stem) for text in template]
        if any(CELL.search(text) and cell for text, cell in zip(template, cells, strict=True)) or callable(claim.rows):
            rows.append(tuple(cell or "-" for cell in cells))
    if not rows:
        return None
    head = tuple(figures.fill(text, claim.stem) or text for text in claim.head)
    return "\n".join([f"### {claim.title}", claim.text, "", table(head, rows), "", origin(figures.used, content)])


def origin(used: list[dict[str, Any]], content: dict[str, Any]) -> str:
    """Script, devices and days of the figures of a table."""
    of = used or [content]
    scripts = sorted({" ".join(one["command"].split()[:3]) for one in of})
    devices = sorted({short_device(one["device"]) for one in of if one.get("device")})
    days = sorted({one["date"] for one in of if one.get("date")})
    facts = [", ".join(f"`{script}`" for script in scripts), ", ".join(devices), " to ".join(days[:1] + days[1:][-1:])]
    return f"*{'; '.join(fact for fact in facts if fact)}.*\n"


def short_device(device: str) -> str:
    """The device without the model of its processor: "2 CPU cores"."""
    cores = re.match(r"cpu, (\d+) cores?", device)
    return f"{cores[1]} CPU core{'s' if cores[1] != '1' else ''}" if cores else device


def page(results: Path) -> str:
    """The whole page."""
    figures, parts, room, last = Figures(results), [HEAD], "", ""
    for claim in CLAIMS:
        text = section(claim, figures)
        if text is None:
            continue
        if claim.stem != last:
            parts += _note(last)
        if claim.room != room:
            parts.append(f"## {claim.room}\n")
        parts.append(text)
        parts += [f"![{name}](results/{name})\n" for name in claim.pictures if (results / name).exists()]
        room, last = claim.room, claim.stem
    return "\n".join([*parts, *_note(last)])


def _note(stem: str) -> list[str]:
    note = NOTES / f"{stem}.md"
    return [note.read_text()] if stem and note.exists() else []


def headlines(results: Path) -> str:
    """Markdown table of HEADLINES, and a sentence on its marks if there are any."""
    from whill_mjx import __version__

    figures = Figures(results)
    rows: list[tuple[str, ...]] = []
    for stem, what, value in HEADLINES:
        figures.used.clear()
        cell = figures.fill(value, stem, __version__)
        if cell is not None:
            rows.append((what, cell, short_device(figures.used[0]["device"])))
    marks = "\n\nFigures with * were measured before the present release." if any("*" in row[1] for row in rows) else ""
    return table(("what", "figure", "measured on"), rows) + marks


def put_between_marks(text: str, block: str) -> str:
    """`text` with what stands between MARKS replaced; ValueError if they are missing."""
    before, opening, rest = text.partition(MARKS[0])
    _, closing, after = rest.partition(MARKS[1])
    if not opening or not closing:
        raise ValueError(f"README.md: no {MARKS[0]} ... {MARKS[1]}; put both lines where the figures belong.")
    return f"{before}{opening}\n{block}\n{closing}{after}"


def write(path: Path, text: str) -> None:
    """Write a file, whole or not at all."""
    temporary = path.with_suffix(".tmp")
    temporary.write_text(text)
    os.replace(temporary, path)
    print(path)


def pages(results: Path = RESULTS) -> dict[Path, str]:
    """Both pages as they should be."""
    readme = RESULTS.parent.parent / "README.md"
    return {RESULTS.parent / "README.md": page(results),
            readme: put_between_marks(readme.read_text(), headlines(results))}


def main(arguments: list[str] | None = None) -> None:
    """Write or check both pages."""
    parser = Parser(prog="python -m benchmarks.tables", description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing; fail where a page is out of date")
    given = parser.parse_args(arguments)
    for path, text in pages().items():
        if not given.check:
            write(path, text)
        elif path.read_text() != text:
            sys.exit(f"{path}: differs from the result files. Run python -m benchmarks.tables.")


if __name__ == "__main__":
    with guarded():
        main()

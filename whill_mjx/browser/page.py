"""The page of one or several runs: curves, drives from above, videos, reports, and settings side by side."""

from __future__ import annotations

import base64
import html as escaping
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import quote

from whill_mjx.browser.read import Replay, Run, curve, differing, guarded, inside, read_drives, read_replays
from whill_mjx.io import html
from whill_mjx.io.reading import read_bytes
from whill_mjx.io.svg import COLOURS, PALETTE, Axes, Line, line_chart, replay_line

CURVES = (
    ("eval/success", "evaluations: success"), ("eval/return", "evaluations: return"),
    ("eval/collision", "evaluations: collision"), ("episode/return", "training episodes: return"),
    ("episode/success", "training episodes: success"), ("reward", "training: reward per step"),
    ("loss", "world model: loss"), ("kl", "world model: KL divergence [nat]"),
    ("loss_recon", "world model: error of the picture"), ("loss_policy", "policy: loss"), ("loss_value", "value: loss"),
    ("policy_entropy", "policy: entropy [nat]"), ("entropy", "policy: entropy [nat]"),
    ("env_steps_per_s", "environment steps per second"),
)  # fmt: skip
"""Quantities of metrics.jsonl that are drawn at once, and their titles; the others are folded away."""
MOST_OTHERS = 60
ENDINGS = {
    "success": ("arrived", PALETTE[2]), "collision": ("collision", PALETTE[3]), "timeout": ("time-out", PALETTE[1]),
    "diverged": ("diverged", PALETTE[6]), "": ("unknown", PALETTE[7]),
}  # fmt: skip
CAPTIONS = {
    "reward_curve": "reward and success during the training", "drives": "drives of the final evaluation, from above",
    "failures": "drives that failed, from above", "paths": "drives from above",
    "camera": "what the camera saw, and the view from above",
    "prediction": "what the camera saw (top), what the world model predicts, and the difference",
    "trajectories": "measured and fitted paths", "errors": "errors of each trial", "yaw": "measured and fitted yaw",
    "inspect": "sampling, excitation and replicates",
}  # fmt: skip
MEDIA = {".png": ("image/png", b"\x89PNG"), ".gif": ("image/gif", b"GIF8"), ".mp4": ("video/mp4", b"")}
"""Type and first bytes of what is shown."""
ENDS: dict[str, Callable[[bytes], bool]] = {
    ".png": lambda data: data.endswith(b"IEND\xaeB`\x82"), ".gif": lambda data: data.endswith(b";"),
    ".mp4": lambda data: data[4:8] == b"ftyp" and b"moov" in data,
}  # fmt: skip
"""How the bytes of a whole file are known."""
MEDIA_BYTES = 40_000_000
POLICY = ("default-src 'none'; img-src data:; media-src data:; style-src 'unsafe-inline'; base-uri 'none'; "
          "form-action 'none'")  # fmt: skip
"""What a browser may do with the page: show what is in it."""
Links = Callable[[Run, Path], str]
"""The address of a file of a run, as seen from the page."""


@dataclass
class Budget:
    """Bytes of pictures and videos that the page may still take in; what is larger is linked."""

    left: int


def runs_page(runs: Sequence[Run], links: Links, embed: int = MEDIA_BYTES, head: str = "") -> str:
    """The whole page.

    Args:
        runs: from `read_runs`.
        links: addresses of files.
        embed: bytes of pictures and videos that are put into the page.
        head: more for the head of the page; HTML.
    """
    problems: dict[str, list[str]] = {run.name: list(run.problems) for run in runs}
    budget = Budget(embed)
    sections = [html.Section("Overview", overview(runs, links))]
    if drawn := curves([run for run in runs if run.lines]):
        sections.append(html.Section("Curves", drawn))
    if rows := figures(runs, problems):
        sections.append(html.Section("Figures", rows))
    if drawn := drives(runs, problems):
        sections.append(html.Section("Drives from above", drawn))
    if shown := media(runs, (".mp4", ".gif"), budget, links, problems):
        sections.append(html.Section("Videos", shown))
    if shown := media(runs, (".png",), budget, links, problems):
        sections.append(html.Section("Pictures", shown))
    if found := [(name, text) for name, texts in problems.items() for text in texts]:
        rows_of = html.table(["run", "what could not be read, and why"], [[name, text] for name, text in found])
        sections.insert(1, html.Section("Damaged or unfinished", rows_of))
    sections.append(html.Section("Settings", settings(runs)))
    title = runs[0].name if len(runs) == 1 else f"{len(runs)} runs"
    policy = f'<meta http-equiv="Content-Security-Policy" content="{escaping.escape(POLICY)}">'
    page = html.html_page(title, sections, kind="Runs", lead=meaning(runs), head=head or policy)
    return page.encode("utf-8", "replace").decode()  # JSON has letters that no text file can hold


def meaning(runs: Sequence[Run]) -> str:
    """One sentence on all runs."""
    if len(runs) == 1:
        return runs[0].sentence
    counts = {state: sum(run.state == state for run in runs) for state in ("finished", "at work", "stopped", "damaged")}
    said = ", ".join(f"{count} {state}" for state, count in counts.items() if count)
    kinds = ", ".join(dict.fromkeys(run.kind for run in runs))
    drove = [(one["success"], run.name) for run in runs if run.kind == "training"
             if isinstance(one := run.result.get("policy"), dict) and isinstance(one.get("success"), float)]
    best = max(drove, default=None) if len(drove) > 1 else None
    more = f"; {best[1]} succeeds most often, in {best[0]:.1%} of its unseen episodes" if best else ""
    return f"{len(runs)} runs ({kinds}): {said}{more}."


def overview(runs: Sequence[Run], links: Links) -> str:
    """State and result of each run, with its report."""
    marks = {"finished": "good", "at work": "warn", "stopped": "warn", "damaged": "bad"}
    rows: list[list[Any]] = []
    for run in runs:
        report: Any = "–"
        if run.page is not None:
            address = escaping.escape(links(run, run.page))
            report = html.Cell(f'<a href="{address}">{escaping.escape(run.page.name)}</a>', html=True)
        rows.append([run.name, run.kind, html.Cell(run.state, marks.get(run.state, "")), run.sentence, report])
    return html.table(["run", "kind", "state", "what it means", "report"], rows)


def curves(runs: Sequence[Run]) -> str:
    """Logged quantities over environment steps; runs share a chart."""
    named = [name for name, _ in CURVES]
    others = dict.fromkeys(name for run in runs for line in run.lines for name in line)
    rest = [name for name in others if name not in (*named, "env_steps", "updates", "wall_s")][:MOST_OTHERS]
    first = [_chart(runs, name, title) for name, title in CURVES]
    more = [_chart(runs, name, name) for name in rest]
    if not any(first) and not any(more):
        return ""
    keys = html.legend([(run.name, _colour(k)) for k, run in enumerate(runs)])
    folded = (f"<details><summary>{len(rest)} other quantities</summary>{html.charts(more)}</details>" if any(more)
              else "")
    return keys + html.charts([one for one in first if one]) + folded


def _chart(runs: Sequence[Run], name: str, title: str) -> str:
    lines = []
    for k, run in enumerate(runs):
        x, y = curve(run.lines, name)
        if len(x):
            lines.append(Line(x, y, "", _colour(k), markers=len(x) < (40 if name.startswith("eval/") else 3)))
    share = (0.0, 1.0) if name.partition("/")[2] in ("success", "collision") else ()
    return line_chart(lines, "environment steps", "", title, Axes(340, 230, covers=share)) if lines else ""


def _colour(index: int) -> str:
    return PALETTE[index % len(PALETTE)]


def figures(runs: Sequence[Run], problems: dict[str, list[str]]) -> str:
    """What evaluations, fits and loops came to, side by side."""
    parts = []
    evaluated = [[run.name, *row] for run in runs for row in _each(run, problems, _drivers)]
    if evaluated:
        parts.append(html.table(["run", "driver", "episodes", "success", "95% interval", "collision", "time-out",
                                 "time to the goal [s]", "return"], evaluated, "evaluations"))
    named = [[run.name, *row] for run in runs for row in _each(run, problems, _effects)]
    if named:
        parts.append(html.table(["run", "effect", "parameter", "value", "95% from", "to", "unit"], named,
                                "effects that were named"))
    fitted = {run.name: dict(_each(run, problems, _parameters)) for run in runs if run.kind == "fit"}
    fitted = {name: values for name, values in fitted.items() if values}
    if fitted:
        names = dict.fromkeys(parameter for values in fitted.values() for parameter in values)
        rows = [[parameter, *(values.get(parameter, "–") for values in fitted.values())] for parameter in names]
        parts.append(html.table(["parameter", *fitted], rows, "fitted values and their intervals"))
    return "".join(parts)


def _each(run: Run, problems: dict[str, list[str]], rows: Callable[[Run], list[Any]]) -> list[Any]:
    return guarded(lambda: rows(run), problems[run.name], f"{run.path}: its result") or [] if run.result else []


def _drivers(run: Run) -> list[Any]:
    if run.kind not in ("training", "evaluation"):
        return []
    drivers = run.result.get("drivers", run.result)
    rows = []
    for name, one in drivers.items():
        if isinstance(one, dict) and "success_interval_95" in one:
            low, high = one["success_interval_95"]
            seconds = one["time_to_goal_s"]
            rows.append([str(name), int(one["episodes"]), f"{one['success']:.1%}", f"{low:.1%} to {high:.1%}",
                         f"{one['collision']:.1%}", f"{one['timeout']:.1%}",
                         None if seconds is None else float(seconds), float(one["return"])])
    return rows


def _effects(run: Run) -> list[Any]:
    if run.kind != "missing effect":
        return []
    return [[str(one["name"]), str(name), float(p["value"]), *map(float, p["interval"]), str(p["unit"])]
            for one in run.result["effects"] for name, p in one["parameters"].items()]


def _parameters(run: Run) -> list[Any]:
    rows = []
    for one in run.result["parameters"]:
        low, high = one["interval"]
        unit = "" if one["unit"] == "-" else f" {one['unit']}"
        known = f"({html.number(low)} to {html.number(high)})" if one["identifiable"] else "(not determined)"
        rows.append((str(one["name"]), f"{html.number(one['value'])}{unit} {known}"))
    return rows


def drives(runs: Sequence[Run], problems: dict[str, list[str]]) -> str:
    """Paths of trainings and fits from above."""
    parts = []
    for run in runs:
        if (path := run.path / "drives.npz").is_file():
            found = guarded(partial(read_drives, path), problems[run.name], str(path))
            if found is not None and found.paths:
                lines = [Line(one[:, 0], one[:, 1], "", ENDINGS[how][1], markers=False)
                         for one, how in zip(found.paths, found.endings, strict=True)]
                axes = Axes(equal=True, width=560, height=330)
                chart = line_chart(lines, "x [m]", "y [m]", f"{len(lines)} drives", axes)
                keys = html.legend([ENDINGS[how] for how in dict.fromkeys(found.endings)])
                parts += [html.heading(run.name), keys, html.charts([chart])]
        if (path := run.path / "series.npz").is_file():
            trials = guarded(partial(read_replays, path), problems[run.name], str(path))
            items = [_replayed(trial) for trial in trials or []]
            if items:
                keys = html.legend([(name, COLOURS[name]) for name in ("measured", "ideal", "initial", "fitted")])
                parts += [html.heading(run.name), keys, html.charts(items)]
    return "".join(parts)


def _replayed(trial: Replay) -> str:
    """A trial of a fit from above."""
    lines = [replay_line(one[:, 0], one[:, 1], name) for name, one in trial.paths.items()]
    title = trial.name + (" (held out)" if trial.held_out else "")
    return line_chart(lines, "x [m]", "y [m]", title, Axes(equal=True, smallest=0.3))


def media(
    runs: Sequence[Run], endings: Iterable[str], budget: Budget, links: Links, problems: dict[str, list[str]]
) -> str:
    """Pictures or videos of the runs; those beyond the budget are linked."""
    parts = []
    for run in runs:
        shown = []
        for path in sorted(one for folder in (run.path, run.path / "fit") if folder.is_dir()
                           for one in folder.iterdir() if one.suffix in endings and not one.name.startswith(".")):
            if not path.is_file() or not inside(run.path, path):
                continue
            item = guarded(partial(_embedded, path, run, budget, links), problems[run.name], str(path))
            if item:
                shown.append(item)
        if shown:
            parts += [html.heading(run.name), *shown]
    return "".join(parts)


def _embedded(path: Path, run: Run, budget: Budget, links: Links) -> str:
    """A picture or video inside the page, or a link to it."""
    kind, begins = MEDIA[path.suffix]
    caption = escaping.escape(_caption(path))
    if path.stat().st_size > budget.left:
        return f'<p><a href="{escaping.escape(links(run, path))}">{escaping.escape(path.name)}</a>: {caption}</p>'
    data = read_bytes(path, budget.left, "missing.")
    if not (data.startswith(begins) and ENDS[path.suffix](data)):
        raise ValueError(f"{path}: is no whole {path.suffix[1:].upper()} file. It is still being written, or damaged.")
    budget.left -= len(data)
    source = f"data:{kind};base64,{base64.b64encode(data).decode()}"
    item = (f'<video controls loop muted preload="metadata" src="{source}"></video>' if path.suffix == ".mp4" else
            f'<img alt="{caption}" src="{source}">')
    return f"<figure>{item}<figcaption>{caption}</figcaption></figure>"


def _caption(path: Path) -> str:
    return f"{path.name}: {CAPTIONS[path.stem]}" if path.stem in CAPTIONS else path.name


def settings(runs: Sequence[Run]) -> str:
    """Settings side by side; what differs comes first and is marked."""
    differs, equal = differing(runs)
    header = ["setting", *(run.name for run in runs)]

    def row(name: str, mark: str) -> list[Any]:
        return [html.Cell(name, mark), *(html.Cell(_shown(run.settings.get(name, "")), mark) for run in runs)]

    if len(runs) == 1:
        return html.table(header, [row(name, "") for name in equal]) if equal else html.paragraph("None are known.")
    parts = [html.table(header, [row(name, "differs") for name in differs], "what differs") if differs else
             html.paragraph("No setting differs.")]
    if equal:
        rows = [[name, _shown(runs[0].settings.get(name, ""))] for name in equal]
        parts.append(f"<details><summary>{len(equal)} settings are equal in all</summary>"
                     f"{html.table(['setting', 'value'], rows)}</details>")
    return "".join(parts)


def _shown(value: Any) -> str:
    text = "–" if value is None else value if isinstance(value, str) else str(value)
    return text if len(text) <= 300 else f"{text[:300]} ..."


def relative_links(out: Path) -> Links:
    """Addresses for a page at `out`: relative paths, so that folder and page can move together."""
    folder = out.absolute().parent

    def address(run: Run, path: Path) -> str:
        return "./" + quote(Path(os.path.relpath(path.absolute(), folder)).as_posix())

    return address

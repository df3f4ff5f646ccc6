"""Self-contained HTML pages of one look: no external style, script, font or picture.

A report is a list of sections; any module can make its own and hand them to `html_page`, which puts the header that all
reports share above them. Pages can be printed, and read on a telephone.
"""

from __future__ import annotations

import base64
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

from whill_mjx import __version__

STYLE = """
:root { color-scheme: light; }
body { font: 15px/1.5 system-ui, sans-serif; color: #1b1b1b; background: #fff; margin: 0 auto; max-width: 1160px;
       padding: 0 1.4rem 2rem; overflow-wrap: anywhere; }
header { border-top: .3rem solid #1f6fb4; padding: .7rem 0 .6rem; border-bottom: 1px solid #d5d5d5; }
header .kind { font-size: .8rem; letter-spacing: .04em; text-transform: uppercase; color: #1f5f9f; font-weight: 600;
               margin: 0 0 .3rem; max-width: none; }
header .kind span { float: right; color: #6a6a6a; font-weight: 400; }
footer { border-top: 1px solid #d5d5d5; margin-top: 3rem; padding-top: .5rem; font-size: .84rem; color: #6a6a6a; }
h1 { font-size: 1.6rem; line-height: 1.25; margin: 0 0 .2rem; } h2 { font-size: 1.2rem; margin: 2.2rem 0 .6rem;
     border-bottom: 1px solid #d5d5d5; padding-bottom: .2rem; } h3 { font-size: 1rem; margin: 1.2rem 0 .4rem; }
nav { font-size: .88rem; margin: .6rem 0 0; } nav a { margin-right: 1rem; color: #1f5f9f; display: inline-block; }
p { max-width: 62rem; margin: .5rem 0; } .lead { font-size: 1.1rem; margin: .4rem 0; } .dim { color: #6a6a6a; }
.scroll { overflow-x: auto; overflow-wrap: normal; }
table { border-collapse: collapse; font-size: .86rem; margin: .5rem 0; }
th, td { padding: .18rem .6rem; border-bottom: 1px solid #e6e6e6; text-align: left; vertical-align: middle; }
th { font-weight: 600; border-bottom: 1px solid #9a9a9a; }
td.n { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; } th.n { text-align: right; }
caption { text-align: left; color: #6a6a6a; padding-bottom: .2rem; max-width: min(62rem, calc(100vw - 1.7rem)); }
td.differs { background: #fff3d1; } td.differs:first-child { border-left: .25rem solid #e0a014; }
details { margin: .6rem 0; } summary { cursor: pointer; color: #1f5f9f; }
td:last-child:not(.n) { min-width: 10rem; }
td small { color: #6a6a6a; display: block; }
td.good { color: #176b32; } td.bad { color: #a31621; font-weight: 600; } td.warn { color: #8a5a00; }
.charts { display: flex; flex-wrap: wrap; gap: .4rem 1rem; } figure { margin: .4rem 0; }
figcaption { font-size: .84rem; color: #6a6a6a; max-width: 62rem; } img, video { max-width: 100%; }
video { max-height: 70vh; }
code { font-size: .84rem; overflow-wrap: anywhere; }
svg.chart { max-width: 100%; height: auto; background: #fff; } svg text { fill: #333; font-family: inherit; }
svg .title { font-size: 11.5px; font-weight: 600; } svg .label { font-size: 11px; } svg .tick { font-size: 10px; }
svg .grid { stroke: #e4e4e4; stroke-width: 1; } svg .band { fill: #1f6fb4; opacity: .13; }
.legend span { margin-right: 1.1rem; font-size: .84rem; display: inline-block; }
.legend i { display: inline-block; width: 1.1rem; height: .2rem; margin-right: .35rem; vertical-align: middle; }
@media (max-width: 640px) { body { font-size: 14px; padding: 0 .8rem 1.5rem; } h1 { font-size: 1.25rem; }
  h2 { font-size: 1.1rem; margin-top: 1.6rem; } .charts { display: block; } .charts svg { width: 100%; }
  nav a { padding: .25rem 0; } th, td { padding: .25rem .4rem; } figure { margin: .4rem 0; }
  ul { padding-left: 1.2rem; } td:not(.n) { min-width: 4.2rem; } td:first-child:not(.n) { min-width: 7rem; } }
@media print { @page { margin: 14mm; } body { font-size: 10pt; max-width: none; padding: 0; }
  nav, video { display: none; }
  h2, h3, caption { break-after: avoid; } figure, tr, svg, img { break-inside: avoid; } .scroll { overflow: visible; }
  table { font-size: 8pt; } a { color: inherit; text-decoration: none; }
  .legend { break-after: avoid; } }
"""


@dataclass(frozen=True)
class Section:
    """A part of a page with its own heading."""

    title: str
    body: str
    """HTML; made of the functions below, which escape what they are given."""


@dataclass(frozen=True)
class Cell:
    """A table cell with a mark ("good", "bad", "warn", "") or with ready HTML."""

    text: str | float | None
    mark: str = ""
    html: bool = False


def html_page(
    title: str, sections: Sequence[Section], subtitle: str = "", *, kind: str = "Report", lead: str = "",
    head: str = "",
) -> str:
    """A whole page: the header of all reports, links to the sections, sections.

    Args:
        title: what this page is about.
        sections: its parts.
        subtitle: where the content comes from.
        kind: of the report, such as "Fit"; stands above the title.
        lead: what the page means, in one sentence; empty where the first section begins with it.
        head: more for the head of the page; HTML.
    """
    anchors = _anchors([section.title for section in sections])
    links = "".join(f'<a href="#{anchor}">{escape(section.title)}</a>'
                    for anchor, section in zip(anchors, sections, strict=True))
    parts = "".join(f'<section id="{anchor}"><h2>{escape(section.title)}</h2>{section.body}</section>\n'
                    for anchor, section in zip(anchors, sections, strict=True))
    means = f'<p class="lead">{escape(lead)}</p>' if lead else ""
    below = f'<p class="dim">{escape(subtitle)}</p>' if subtitle else ""
    return (f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
            '<meta name="viewport" content="width=device-width, initial-scale=1">'
            f'{head}<style>{STYLE}</style></head><body><header><p class="kind"><span>whill-mjx</span>'
            f'{escape(kind)}</p><h1>{escape(title)}</h1>{means}{below}'
            f"<nav>{links}</nav></header>\n{parts}<footer>Made by whill-mjx {__version__}.</footer></body></html>\n")


def paragraph(text: str, style: str = "") -> str:
    """A paragraph of plain text; style "lead" or "dim"."""
    return f'<p class="{style}">{escape(text)}</p>' if style else f"<p>{escape(text)}</p>"


def heading(text: str) -> str:
    """A heading within a section."""
    return f"<h3>{escape(text)}</h3>"


def folded(summary: str, body: str) -> str:
    """HTML that is shown only after a click on `summary`."""
    return f"<details><summary>{escape(summary)}</summary>{body}</details>"


def explained(name: str, meaning: str) -> Cell:
    """A cell with a name, and below it what the name means."""
    return Cell(escape(name) + (f"<small>{escape(meaning)}</small>" if meaning else ""), html=True)


def bullets(items: Sequence[str]) -> str:
    """A list of plain texts."""
    return "<ul>" + "".join(f"<li>{escape(item)}</li>" for item in items) + "</ul>"


def table(header: Sequence[str], rows: Sequence[Sequence[str | float | None | Cell]], caption: str = "") -> str:
    """A table; numbers are set with four digits to the right, None as a dash."""
    body = []
    numeric = [False] * len(header)
    for row in rows:
        cells = []
        for k, one in enumerate(row):
            cell = one if isinstance(one, Cell) else Cell(one)
            is_number = cell.text is None or isinstance(cell.text, int | float)
            numeric[k] |= is_number and cell.text is not None
            shown = str(cell.text) if cell.html else escape(number(cell.text) if is_number else str(cell.text))
            classes = " ".join(filter(None, ["n" if is_number else "", cell.mark]))
            cells.append(f'<td class="{classes}">{shown}</td>' if classes else f"<td>{shown}</td>")
        body.append(f"<tr>{''.join(cells)}</tr>")
    head = "".join(f'<th class="n">{escape(name)}</th>' if numeric[k] else f"<th>{escape(name)}</th>"
                   for k, name in enumerate(header))
    title = f"<caption>{escape(caption)}</caption>" if caption else ""
    return (f'<div class="scroll"><table>{title}<thead><tr>{head}</tr></thead><tbody>{"".join(body)}</tbody></table>'
            "</div>")


def number(value: object) -> str:
    """Four significant digits, without an exponent where it can be avoided; a dash for None and nan."""
    if value is None or not isinstance(value, int | float) or not math.isfinite(value):
        return "–"
    if isinstance(value, int) and not isinstance(value, bool):
        return str(value)
    if value == 0:
        return "0"
    value = float(f"{value:.4g}")
    digits = max(3 - math.floor(math.log10(abs(value))), 0)
    return f"{value:.{min(digits, 6)}f}" if 1e-4 <= abs(value) < 1e6 else f"{value:.3e}"


def charts(items: Sequence[str], caption: str = "") -> str:
    """Charts side by side, wrapping."""
    note = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
    return f'<figure><div class="charts">{"".join(items)}</div>{note}</figure>'


def legend(entries: Sequence[tuple[str, str]]) -> str:
    """Names with their colours, for charts that share them."""
    return '<p class="legend">' + "".join(f'<span><i style="background:{escape(colour)}"></i>{escape(name)}</span>'
                                          for name, colour in entries) + "</p>"


def png(path: Path, caption: str = "") -> str:
    """A PNG file inside the page."""
    data = base64.b64encode(Path(path).read_bytes()).decode()
    note = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
    return f'<figure><img alt="{escape(caption)}" src="data:image/png;base64,{data}">{note}</figure>'


def image(source: str, caption: str = "") -> str:
    """A picture that lies beside the page, at a relative path."""
    return (f'<figure><a href="{escape(source)}"><img alt="{escape(caption)}" src="{escape(source)}"></a>'
            f"<figcaption>{escape(caption)}</figcaption></figure>")


def video(source: str, caption: str = "") -> str:
    """A video that lies beside the page, at a relative path."""
    return (f'<figure><video controls loop muted preload="auto" src="{escape(source)}"></video>'
            f"<figcaption>{escape(caption)}</figcaption></figure>")


def links(entries: Sequence[tuple[str, str]]) -> str:
    """A list of (relative path, what it is)."""
    return "<ul>" + "".join(f'<li><a href="{escape(path)}">{escape(path)}</a>: {escape(text)}</li>'
                            for path, text in entries) + "</ul>"


def _anchors(titles: Sequence[str]) -> list[str]:
    found: list[str] = []
    for title in titles:
        base = re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-") or "section"
        found.append(base if base not in found else f"{base}-{len(found)}")
    return found

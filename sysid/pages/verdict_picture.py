"""How a verdict was reached, in one picture: whether anything is missing, what explains it, and how sure that is."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from sysid.pages.loop_words import spoken
from sysid.verdict.posterior import MOST, Findings, Posterior, Thresholds, posterior

SHOWN = 6  # sets of effects in the picture: those that gain most
LEAST = 1e-12  # p-value at the end of the axis
WIDTH, ROW, LEFT, MIDDLE, RIGHT, WORDS = 830, 21, 280, 460, 600, 614
"""Size [px] of the picture and a row; where shares begin, where weights begin and end, and where remarks begin."""
BLUE, GREY, RED = "#1f6fb4", "#b4b4b4", "#b2182b"


def account(findings: Findings, priors: Thresholds) -> dict[str, Any]:
    """What `draw` shows of a verdict: part of report.json.

    `looks`: p-value of each look at the drives; `alpha` and `least_share`, what they are held against;
    `explanations`: `name`, `share` that it explains, posterior `weight` and `outcome` of each.
    """
    judged = posterior(findings, priors)
    looks = {"one effect stands out": findings.p_scan, "two effects stand out": findings.p_pairs,
             "more error than on other days": findings.p_excess(findings.excess)}
    order = sorted(range(len(findings.sets)), key=lambda i: (i != judged.chosen, -findings.sets[i].gain))
    best: dict[frozenset[str], int] = {}  # of several refits of the same effects the first in that order
    for i in order:
        best.setdefault(frozenset(findings.sets[i].effects), i)
    rows: list[dict[str, Any]] = []
    for i in list(best.values())[:SHOWN]:
        one = findings.sets[i]
        joined = (" and " if len(one.effects) < 3 else ", ").join(spoken(name) for name in one.effects)
        rows.append({"name": joined, "share": findings.named(one, priors),
                     "weight": next((weight for key, weight in judged.weights.items()
                                     if {*key.split(" + ")} == {*one.effects}), 0.0),
                     "outcome": _outcome(findings, priors, judged, i)})
    for key, name in (("none", "nothing"), ("noise", "nothing but other noise"), ("unknown", "something unknown")):
        if key in judged.weights:
            kept = f"keeps {priors.alpha:.1%} or more" if judged.verdict == "none" and key != "unknown" else ""
            rows.append({"name": name, "share": None, "weight": judged.weights[key], "outcome": kept})
    return {"verdict": judged.verdict, "reason": judged.reason, "alpha": priors.alpha, "least_share": priors.share,
            "looks": {name: p for name, p in looks.items() if p is not None}, "explanations": rows}


def _outcome(findings: Findings, priors: Thresholds, judged: Posterior, number: int) -> str:
    """Why a set of effects is the verdict, or is not."""
    one = findings.sets[number]
    if findings.contradictions(one):
        return "contradicted"
    if len(one.effects) > MOST:
        return "tried to check the others"
    if not findings.able(one, priors):
        if len(one.effects) == 1:
            return "adds too little"
        known = findings.borne_out(one, priors)
        return "may be another form of the other" if known else "is wrong about other manoeuvres"
    if judged.verdict == "none":
        return "no more than days differ by"
    if number != judged.chosen:
        return "explains less" if len(one.effects) == 1 else "weighs less"
    return "named" if judged.verdict == "named" else "weighs less than something unknown"


def draw(account: Mapping[str, Any]) -> str:
    """SVG of an `account`, 830 px wide."""
    looks, rows = account["looks"], account["explanations"]
    named = [one["name"] for one in rows if one["outcome"] == "named"]
    second = 62 + ROW * len(looks)
    height = second + 62 + ROW * len(rows)
    parts = [f'<rect width="{WIDTH}" height="{height}" fill="#fff"/>',
             *_looks(looks, account["alpha"]), *_explanations(rows, account["least_share"], second),
             _text(8, height - 12, f"3. Verdict: {', '.join([account['verdict'], *named])}", bold=True)]
    return (f'<svg xmlns="http://www.w3.org/2000/svg" class="chart" viewBox="0 0 {WIDTH} {height}" width="{WIDTH}" '
            f'height="{height}" role="img" font-family="system-ui, sans-serif">{"".join(parts)}</svg>')


def _looks(looks: Mapping[str, float], alpha: float) -> list[str]:
    """The first panel: p-values on a logarithmic axis, and where chance begins."""
    def across(p: float) -> float:
        return LEFT + (RIGHT - LEFT) * min(math.log10(max(p, LEAST)) / math.log10(LEAST), 1.0)

    limit, bottom = across(alpha), 34 + ROW * len(looks)
    parts = [_text(8, 18, "1. Is anything missing?", bold=True),
             f'<rect x="{LEFT}" y="26" width="{limit - LEFT:.1f}" height="{bottom - 26}" fill="#eee"/>',
             _text(LEFT, bottom + 12, "p = 1", size=10), _text(limit, bottom + 12, f"{alpha:g}", "middle", 10),
             _text(RIGHT, bottom + 12, f"{LEAST:g} or less", "end", 10)]
    for number, (name, p) in enumerate(looks.items()):
        y = 42 + ROW * number
        parts += [_text(LEFT - 10, y + 4, name, "end"), _line(LEFT, RIGHT, y, y, "#ccc"),
                  f'<circle cx="{across(p):.1f}" cy="{y}" r="5" fill="{RED if p < alpha else GREY}"/>',
                  _text(WORDS, y + 4, "beyond chance" if p < alpha else "chance")]
    return parts


def _explanations(rows: Sequence[Mapping[str, Any]], least: float, top: int) -> list[str]:
    """The second panel: what each explains, and its posterior weight."""
    long = MIDDLE - LEFT - 44
    limit = LEFT + long * least
    parts = [_text(8, top + 8, "2. What explains it?", bold=True), _text(LEFT, top + 8, "explains", size=10),
             _text(MIDDLE, top + 8, "posterior weight", size=10)]
    for number, one in enumerate(rows):
        y = top + 17 + ROW * number
        colour = BLUE if one["share"] is None or one["outcome"] == "named" else GREY
        parts += [_text(LEFT - 10, y + 12, one["name"], "end"), _text(WORDS, y + 12, one["outcome"])]
        if one["share"] is not None:
            parts += [_bar(LEFT, y, long * one["share"], colour, f"{one['share']:.0%}")]
        if one["weight"] > 0:
            parts += [_bar(MIDDLE, y, (RIGHT - MIDDLE - 36) * one["weight"], colour, f"{one['weight']:.0%}")]
    known = sum(one["share"] is not None for one in rows)
    if known:
        parts += [_line(limit, limit, top + 13, top + 15 + ROW * known, RED),
                  _text(limit, top + 8, f"least {least:.0%}", "middle", 10)]
    return parts


def _bar(x: float, y: float, length: float, colour: str, words: str) -> str:
    return (f'<rect x="{x:.1f}" y="{y}" width="{max(length, 1):.1f}" height="14" fill="{colour}"/>'
            + _text(x + max(length, 1) + 4, y + 11, words, size=10))


def _line(x1: float, x2: float, y1: float, y2: float, colour: str) -> str:
    return f'<line x1="{x1:.1f}" x2="{x2:.1f}" y1="{y1}" y2="{y2}" stroke="{colour}" stroke-dasharray="3 2"/>'


def _text(x: float, y: float, words: str, anchor: str = "start", size: int = 12, bold: bool = False) -> str:
    weight = ' font-weight="600"' if bold else ""
    return (f'<text x="{x:.1f}" y="{y}" text-anchor="{anchor}" font-size="{size}" fill="#333"{weight}>{escape(words)}'
            "</text>")

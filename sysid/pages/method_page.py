"""How a closed loop decided: RUN/method.html, with what was tried, thresholds, and what was fixed beforehand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sysid.pages.loop_words import title
from whill_mjx.io.html import Section, bullets, html_page, links, paragraph, table
from whill_mjx.logs.dataset import write_text


def write_method(out: Path, report: dict[str, Any]) -> Path:
    """Write the page into a folder."""
    sections = [Section("How the verdict was reached", verdict(report)),
                Section("What was tried", candidates(report) + pairs(report)),
                Section("What these drives can show", operating(report))]
    if report["noise"]:
        sections.append(Section("Noise of the sensors", noise(report)))
    sections += [Section("Base parameters", base(report)), Section("Thresholds and settings", fixed(report))]
    page = html_page(f"Method: {title(report)}", sections,
                     f"data SHA-256 {report['dataset']['sha256'][:16]}, manifest {report['manifest']['sha256'][:16]}",
                     kind="Missing effect", lead=f"{report['verdict'].capitalize()}: {report['reason']}.")
    write_text(out / "method.html", page)
    return out / "method.html"


def verdict(report: dict[str, Any]) -> str:
    """The decision in numbers."""
    missing = report["missing"]
    parts = [links([("report.html", "what was found")]),
             paragraph(f"{report['verdict'].capitalize()}: {report['reason']}."),
             paragraph(f"Asked: {report['question']}. {report['remark'][:1].upper()}{report['remark'][1:]}."),
             paragraph(f"The squared residual exceeds the noise by {missing['excess_before']:.0%} before and by "
                       f"{missing['excess_after']:.0%} after. p-value that nothing is missing: "
                       f"{missing['p_value']:.2g}.")]
    if nulls := missing["null_refits"]:
        parts.append(paragraph(f"Of {nulls['count']} simulated days with nothing missing, fitted in the same way, "
                               f"{nulls['false_alarms']} raise a false alarm (at most {nulls['upper']:.1%} of all, "
                               f"with 95% confidence). Calibrated p-value: {nulls['p_value']:.2g}."))
    if report["warnings"]:
        parts += [paragraph("Doubts about the names, also those that ask for nothing:"), bullets(report["warnings"])]
    return "".join(parts)


def operating(report: dict[str, Any]) -> str:
    """False alarms and power of these very drives."""
    one = report["operating"]
    alarms = one["false_alarms"]
    parts = [paragraph(f"On {alarms['alarms']} of {alarms['count']} simulated days with nothing missing, the scan "
                       f"raises a false alarm (at most {alarms['upper']:.1%} of all, with 95% confidence); each of up "
                       f"to {one['decisions']} decisions may err with probability {one['alpha']:.1%}.")]
    rows = [[each["effect"], f"{size['factor']:g}", f"{size['noticed']:.0%}"]
            for each in one["power"] for size in each["sizes"]]
    if rows:
        parts.append(table(["effect", "factor on its size", "days on which it is noticed"], rows))
    return "".join(parts)


def pairs(report: dict[str, Any]) -> str:
    """The pairs of effects that explain most in the scan."""
    rows = [[" and ".join(one["effects"]), one["gain"], one["p_value"]] for one in report["pairs"]]
    return table(["two effects", "gain", "p"], rows, "The pairs of effects that gain most in the scan") if rows else ""


def candidates(report: dict[str, Any]) -> str:
    """The refitted candidates of each round."""
    parts = []
    for number, each in enumerate(report["candidates"], start=1):
        parts.append(table(["effect", "gain", "explains", "p of the gain"],
                           [[f"{one['effect']} {one['variant']}".strip(), one["gain"], f"{one['explained']:.0%}",
                             one["p_value"]] for one in each],
                           f"Round {number}. Gain: fall of the squared error, in variances of the noise. Explains: "
                           "share of what can be explained. p: how often chance gains as much if nothing is missing."))
    left = ("common", "smooth", "any")
    rows = [[" and ".join(one["effects"]), one["gain"], *(one["left"].get(key, "") for key in left),
             f"{one['share']:.0%}"] for one in report["steps"]]
    if rows:
        parts.append(table(["effects", "gain", "left, shared by replicates", "left, predicted by smooth functions",
                            "left, perhaps at random", "share explained"], rows,
                           "Sets of effects: their gain, and the error that they leave though it could be predicted, "
                           "by what shows it. The share compares the gain with both together."))
    return "".join(parts) or paragraph("Nothing stood out, so nothing was refitted.")


def noise(report: dict[str, Any]) -> str:
    """Noise of each channel beside that of the reference days."""
    rows = [[name, one["factor"], *one["interval"], "yes" if one["changed"] else ""]
            for name, one in report["noise"].items()]
    return table(["channel", "noise over that of the reference days", "95% from", "to", "surely changed"], rows)


def base(report: dict[str, Any]) -> str:
    """Base parameters beside their day-to-day spread: what the last refits made of them."""
    return table(["parameter", "reference days", "day-to-day spread", "refitted before it is in", "and with it", "unit",
                  "with it, off by [spreads]"],
                 [[one["name"], one["reference"], one["spread"], one["before"], one["after"], one["unit"], one["away"]]
                  for one in report["base"]])


def fixed(report: dict[str, Any]) -> str:
    """The manifest in short."""
    manifest = report["manifest"]
    return table(["setting", "value"],
                 [[key, str(value)] for part in ("settings", "thresholds") for key, value in manifest[part].items()],
                 f"{len(manifest['catalogue'])} hypotheses; SHA-256 {manifest['sha256']}")

"""The page of a closed loop: RUN/report.html, self-contained."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from sysid.logs.log import Command, Start
from sysid.logs.manoeuvre_library import make_command
from sysid.logs.metrics import METRICS, UNITS, integrate
from sysid.pages.svg import PALETTE, Line, bar_chart, line_chart
from whill_mjx.io.html import Section, bullets, charts, html_page, paragraph, table
from whill_mjx.logs.dataset import write_text


def write_page(out: Path, report: dict[str, Any]) -> Path:
    """Write the page of a report into a folder."""
    sections = [Section("Verdict", verdict(report))]
    if report["next_manoeuvre"] is not None:
        sections.append(Section("Next drive", next_drive(report["next_manoeuvre"])))
    sections += [Section("Error before and after", errors(report)),
                 Section("Error of each manoeuvre", by_manoeuvre(report)),
                 Section("What was tried", candidates(report) + pairs(report)),
                 Section("What these drives can show", operating(report))]
    if report["lives_in"]:
        sections.append(Section("Where the unexplained residual lives", lives(report)))
    if report["unnamed"] is not None:
        sections.append(Section("A wrench without a name", wrench(report["unnamed"])))
    if report["verdict"] != "named":
        sections.append(Section("What these drives would have shown", detectable(report)))
    if report["noise"]:
        sections.append(Section("Noise of the sensors", noise(report)))
    sections += [Section("Base parameters", base(report)), Section("Fixed beforehand", fixed(report))]
    page = html_page(f"{report['dataset']['name']}: {report['verdict']}", sections,
                     f"data SHA-256 {report['dataset']['sha256'][:16]}, manifest {report['manifest']['sha256'][:16]}",
                     kind="Missing effect", lead=meaning(report))
    write_text(out / "report.html", page)
    return out / "report.html"


def meaning(report: dict[str, Any]) -> str:
    """One sentence: the verdict, the effects that were named, and why."""
    names = " and ".join(dict.fromkeys(one["name"] for one in report["effects"]))
    return f"{report['verdict'].capitalize()}{f' {names}' if names else ''}: {report['reason']}."


def verdict(report: dict[str, Any]) -> str:
    """The verdict in words, and the effects."""
    missing = report["missing"]
    parts = [paragraph(f"Asked: {report['question']}. {report['remark'][:1].upper()}{report['remark'][1:]}."),
             paragraph(f"The squared residual exceeds the noise by {missing['excess_before']:.0%} before and by "
                       f"{missing['excess_after']:.0%} after. p-value that nothing is missing: "
                       f"{missing['p_value']:.2g}.")]
    if text := report["noise_sentence"]:
        parts.append(paragraph(f"{text[0].upper()}{text[1:]}."))
    parts += [paragraph(f"Warning: {one}.") for one in report["warnings"]]
    if report["contradicted"]:
        parts += [paragraph("Contradicted, and so not named:"), bullets(report["contradicted"])]
    if nulls := missing["null_refits"]:
        parts.append(paragraph(f"Of {nulls['count']} simulated days with nothing missing, fitted in the same way, "
                               f"{nulls['false_alarms']} raise a false alarm (at most {nulls['upper']:.1%} of all, "
                               f"with 95 % confidence). Calibrated p-value: {nulls['p_value']:.2g}."))
    rows = []
    for one in report["effects"]:
        for name, p in one["parameters"].items():
            rows.append([one["name"], one["kind"], ", ".join(one["class"]), name, p["value"], p["interval"][0],
                         p["interval"][1], p["unit"]])
    if rows:
        parts.append(table(["effect", "kind", "or one of", "parameter", "value", "95 % from", "to", "unit"],
                           rows))
        if left_open := [text for one in report["effects"] for text in not_determined(one["parameters"])]:
            parts.append(bullets(left_open))
        parts.append(bullets([f"{one['name']}: {one['equation']}" for one in report["effects"] if one["equation"]]))
        for one in report["effects"]:
            evidence = one["evidence"]["by_manoeuvre"]
            parts.append(table(
                ["manoeuvre", "factor on the effect", "standard error", "gain when left out"],
                [[each["manoeuvre"], each["factor"], each["standard_error"],
                  one["evidence"]["left_out_gain"].get(each["manoeuvre"])] for each in evidence],
                f"{one['name']}: what each manoeuvre says by itself (1 agrees with the joint fit), and by how much the "
                "effect fitted to the others lowers the squared residual there"))
            parts += [paragraph(agreement(one)), predictions(one)]
    return "".join(parts)


def not_determined(parameters: dict[str, Any]) -> list[str]:
    """Which parameters of an effect the drives do not determine up to an end of their physical range, in words."""
    out = []
    for name, p in parameters.items():
        below, above = p["open"]
        if below or above:
            unit = "" if p["unit"] == "-" else f" {p['unit']}"
            least, most = (f"{end:.3g}{unit}" for end in p["interval"])
            where = "" if below and above else f" above {least}" if above else f" below {most}"
            out.append(f"the drives do not determine {name}{where}")
    return out


def agreement(effect: dict[str, Any]) -> str:
    """What manoeuvres say together, in words."""
    evidence = effect["evidence"]
    test, (low, high) = evidence["heterogeneity"], evidence["left_out_interval"]
    said = {"agree": "agree on its size", "differ": f"differ on its size by {test['scatter']:.0%} of it",
            "untold": "are too few, or see too little of it, to differ on its size"}[test["outcome"]]
    return (f"{test['manoeuvres']} manoeuvres excite {effect['name']}. They {said} (p = {test['p_value']:.2g}, power "
            f"{test['power']:.0%}). Left out, manoeuvres gain {evidence['left_out_total']:.0f} of squared residual "
            f"together (95 % interval {low:.0f} to {high:.0f}).")


def predictions(effect: dict[str, Any]) -> str:
    """What would have contradicted an effect."""
    rows = [[f"it {one['says']}", one["by"], ", ".join(f"{size:.2f}" for size in one["sizes"]), one["p_value"],
             f"{one['power']:.0%}", one["outcome"]] for one in effect["evidence"]["falsifiers"]]
    return table(["prediction", "tested by", "sizes, or share left", "p", "power", "outcome"], rows,
                 f"{effect['name']}: what would contradict it") if rows else ""


def next_drive(proposal: dict[str, Any]) -> str:
    """The drive that would separate the effects of a class."""
    text = sentence(proposal)
    parts = [paragraph(f"{text[0].upper()}{text[1:]}.")]
    if proposal["name"] is not None:
        command = command_of(proposal)
        x, y, yaw = integrate(command, Start(**{key: proposal["start"][name] for key, name in
                                                (("x", "x"), ("y", "y"), ("yaw", "heading"))}), command.t)
        held = np.repeat(command.t, 2)[1:]
        parts.append(charts([
            line_chart([Line(held, np.repeat(command.v, 2)[:-1], "v [m/s]"),
                        Line(held, np.repeat(command.omega, 2)[:-1], "omega [rad/s]", PALETTE[1])], "t [s]", "command"),
            line_chart([Line(x, y), Line(x[:1], y[:1], colour=PALETTE[3], markers=True)], "x [m]", "y [m]",
                       "ideal path in the room (dot: start)", equal=True)]))
    return "".join(parts)


def errors(report: dict[str, Any]) -> str:
    """Tables of mean errors, training and held out apart."""
    parts = []
    for part in ("held_out", "training"):
        rows = []
        for channel, metrics in report["before"][part].items():
            floor = metrics.get("noise_floor") or {}
            for metric in METRICS:
                if metric not in metrics:
                    continue
                moved = report["change"][part][channel][metric]
                only = None if report["alone"] is None else report["alone"][part][channel][metric]
                rows.append([f"{channel}, {metric} [{UNITS[metric]}]".replace("_", " "), metrics[metric], only,
                             report["after"][part][channel][metric], floor.get(metric), moved["interval"][0],
                             moved["interval"][1], f"{moved['worse']} of {moved['trials']}"])
        if rows:
            parts.append(table(
                ["RMSE", "before", "named alone", "after", "replicates", "change from", "to", "worse in"], rows,
                f"{part.replace('_', '-')} trials; for \"named alone\" nothing but what was named has moved, for "
                "\"after\" the base parameters as well; the change with its 95 % interval over trials"))
    return "".join(parts)


def by_manoeuvre(report: dict[str, Any]) -> str:
    """Errors of each manoeuvre, and which of them surely grew."""
    grown = [f"{row['part']} {row['manoeuvre']}, {row['channel']} {row['metric']}: ".replace("_", " ")
             + f"{row['before']:.4g} to {row['after']:.4g} {row['unit']}" for row in report["worse"]]
    parts = [paragraph("What got worse:"), bullets(grown)] if grown else [paragraph("Nothing surely got worse.")]
    for part in ("held_out", "training"):
        rows = [[f"{row['manoeuvre']}, {row['channel']} {row['metric']} [{row['unit']}]".replace("_", " "),
                 row["before"], row["after"], *row["interval"], row["trials"]]
                for row in report["by_manoeuvre"] if row["part"] == part]
        if rows:
            parts.append(table(["RMSE", "before", "after", "change from", "to", "trials"], rows,
                               f"{part.replace('_', '-')} trials; 95 % intervals of trials and blocks drawn in pairs"))
    return "".join(parts)


def operating(report: dict[str, Any]) -> str:
    """False alarms and power of these very drives."""
    one = report["operating"]
    alarms = one["false_alarms"]
    parts = [paragraph(f"Of {alarms['count']} simulated days with nothing missing the scan takes {alarms['alarms']} "
                       f"for more (at most {alarms['upper']:.1%} of all, with 95 % confidence); each of up to "
                       f"{one['decisions']} decisions may err in {one['alpha']:.1%}.")]
    rows = [[each["effect"], f"{size['factor']:g}", f"{size['noticed']:.0%}"]
            for each in one["power"] for size in each["sizes"]]
    if rows:
        parts.append(table(["effect", "factor on its size", "days on which it is noticed"], rows))
    return "".join(parts)


def pairs(report: dict[str, Any]) -> str:
    """The pairs of effects that explain most in the scan."""
    rows = [[" and ".join(one["effects"]), one["gain"], one["p_value"]] for one in report["pairs"]]
    return table(["two effects", "gain", "p"], rows, "pairs in the scan") if rows else ""


def candidates(report: dict[str, Any]) -> str:
    """The refitted candidates of each round."""
    parts = []
    for number, each in enumerate(report["candidates"], start=1):
        parts.append(table(["effect", "gain", "explains", "p of the gain"],
                           [[f"{one['effect']} {one['variant']}".strip(), one["gain"], f"{one['explained']:.0%}",
                             one["p_value"]] for one in each], f"round {number}"))
    return "".join(parts) or paragraph("Nothing stood out, so nothing was refitted.")


def lives(report: dict[str, Any]) -> str:
    """Shares of the residual by quantity."""
    rows = report["lives_in"][:10]
    chart = bar_chart([one["quantity"] for one in rows], {"share": [one["share"] for one in rows]},
                      "share predicted on other drives", log_y=False)
    return charts([chart])


def wrench(one: dict[str, Any]) -> str:
    """The fitted tables, what they predict, and what else was tried."""
    text = describe_unnamed(one)
    z, units = np.asarray(one["knots"]), one["units"]
    if one["periodic"]:
        z = np.append(z, 2 * np.pi)
    drawn = []
    for name, title in (("force", "force forward"), ("torque", "torque to the left")):
        values = np.asarray(one["values"][name])
        if z.ndim == 2:  # a map: a line over x for every row
            lines = [Line(z[z[:, 1] == y, 0], values[z[:, 1] == y], f"y = {y:.2f} m", markers=True)
                     for y in np.unique(z[:, 1])]
            drawn.append(line_chart(lines, "x in the room [m]", f"{name} [{units[name]}]",
                                    f"{title}{', times the direction of motion' if one['kind'] == 'brake' else ''}"))
            continue
        line = Line(z, np.append(values, values[0]) if one["periodic"] else values, markers=True)
        drawn.append(line_chart([line], f"{one['quantity']} [{units['quantity']}]", f"{name} [{units[name]}]",
                                f"{title}{', times the direction of motion' if one['kind'] == 'brake' else ''}"))
    gains = one["gain"]["by_manoeuvre"]
    drawn.append(bar_chart(list(gains), {"gain": list(gains.values())}, "squared residual less, held back",
                           log_y=False))
    return "".join([
        paragraph(f"{text[0].upper()}{text[1:]}."),
        paragraph(f"Replayed, the squared residual of the training trials falls from {one['cost']['before']:.3f} to "
                  f"{one['cost']['after']:.3f} of the noise."),
        charts(drawn),
        table(["quantity", "kind", "share of the excess, held back"],
              [[each["quantity"], each["kind"], each["gain"]] for each in one["tried"]],
              "All tables that were fitted, and what they predict on manoeuvres that were not")])


def detectable(report: dict[str, Any]) -> str:
    """Smallest sizes."""
    return table(["effect", "parameter", "smallest size with 80 % power", "unit", "noticed on simulated days"],
                 [[one["effect"], one["parameter"], one["value"] if one["value"] is not None else "not visible",
                   one["unit"], "" if one["power"] is None else f"{one['power']:.0%}"] for one in report["detectable"]])


def noise(report: dict[str, Any]) -> str:
    """Noise of each channel beside that of the reference days."""
    rows = [[name, one["factor"], *one["interval"], "yes" if one["changed"] else ""]
            for name, one in report["noise"].items()]
    return table(["channel", "noise over that of the reference days", "95 % from", "to", "surely another"], rows)


def base(report: dict[str, Any]) -> str:
    """Base parameters beside their day-to-day spread: what the last refits made of them."""
    return table(["parameter", "reference", "day-to-day spread", "refitted before", "after", "unit",
                  "after is off by [spreads]"],
                 [[one["name"], one["reference"], one["spread"], one["before"], one["after"], one["unit"], one["away"]]
                  for one in report["base"]])


def fixed(report: dict[str, Any]) -> str:
    """The manifest in short."""
    manifest = report["manifest"]
    return table(["setting", "value"],
                 [[key, str(value)] for part in ("settings", "thresholds") for key, value in manifest[part].items()],
                 f"{len(manifest['catalogue'])} hypotheses; SHA-256 {manifest['sha256']}")


def sentence(proposal: dict[str, Any]) -> str:
    """A proposal in words."""
    parts = []
    if proposal["name"] is not None:
        parameters, start = proposal["parameters"], proposal["start"]
        times = f"{proposal['replicates']} times" if proposal["replicates"] > 1 else "once"
        parts.append(f"{proposal['name']} at up to {parameters['v']:.2g} m/s and {parameters['omega']:.2g} rad/s, "
                     f"heading {math.degrees(start['heading']):.0f} degrees at the start, {times}, separates "
                     f"{', '.join(proposal['splits'])} apart by {proposal['expected_separation']:.0f} standard "
                     f"deviations a drive ({proposal['file']})")
    for one in proposal["not_split"]:
        parts.append(f"no drive separates {' from '.join(one['effects'])}; {one['sensor']} would")
    return "; ".join(parts)


def command_of(proposal: dict[str, Any]) -> Command:
    """The commands of a proposal."""
    parameters = proposal["parameters"]
    return make_command(proposal["name"], parameters["v"], parameters["omega"], parameters["seconds"],
                        parameters["dt"])


def describe_unnamed(one: dict[str, Any]) -> str:
    """The fitted wrench of a report in words."""
    units, symbolic = one["units"], one["symbolic"]
    way = "braking force and torque" if one["kind"] == "brake" else "force and torque"
    text = (f"{way} over z = {one['quantity']} [{units['quantity']}]: predicts {one['gain']['held_back']:.0%} of the "
            "excess on held-back manoeuvres")
    if not one["kept"]:
        return f"no wrench over one quantity explains it; the best, {text}"
    sums = ("no compact term stands for the tables" if symbolic is None else
            f"force {symbolic['force']} N, torque {symbolic['torque']} N m")
    return f"kept as effect `unnamed`: {text}; {sums}"

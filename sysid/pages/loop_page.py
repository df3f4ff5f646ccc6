"""The pages of a closed loop: report.html has what was found, method.html how that was decided; self-contained."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from sysid.logs.metrics import METRICS, UNITS, integrate
from sysid.logs.records import CHANNEL_NAMES, Start
from sysid.pages.before_after import drive_pictures, drive_table
from sysid.pages.loop_words import (
    another_floor,
    command_of,
    describe_unnamed,
    lead,
    not_determined,
    sentence,
    spoken,
    title,
    vehicles,
)  # fmt: skip
from sysid.pages.verdict_picture import draw
from whill_mjx.io.html import Section, bullets, charts, heading, html_page, links, paragraph, table
from whill_mjx.io.svg import PALETTE, Axes, Line, bar_chart, line_chart
from whill_mjx.logs.dataset import write_text

METRIC_WORDS = {"trajectory": "position", "yaw": "heading", "velocity": "speed", "angular_velocity": "turning rate"}
PART_WORDS = {"held_out": "Drives that no fit has seen", "training": "Drives that were fitted"}
SHOWN_UNITS = {"m": ("cm", 100.0), "rad": ("degrees", 180 / np.pi), "m/s": ("cm/s", 100.0),
               "rad/s": ("degrees/s", 180 / np.pi)}  # unit of a metric -> the one that is shown, and its factor


def write_page(out: Path, report: dict[str, Any]) -> Path:
    """Write the page of a report into a folder."""
    sections = [Section("What was found", found(report))]
    if report["effects"]:
        sections.append(Section("How large it is", effects(report)))
    if report["decision"] is not None:
        caption = "Evidence against chance, what each explanation explains, and its posterior weight"
        sections.append(Section("How the verdict was reached", charts([draw(report["decision"])], caption)))
    if report["next_manoeuvre"] is not None:
        sections.append(Section("Next drive", next_drive(report["next_manoeuvre"])))
    sections += [Section("All drives", errors(report)), Section("Each manoeuvre", by_manoeuvre(report))]
    if report["lives_in"]:
        sections.append(Section("Where the unexplained error is", lives(report)))
    if report["unnamed"] is not None:
        sections.append(Section("A force without a name", wrench(report["unnamed"])))
    if report["effects"]:
        sections.append(Section("Evidence", evidence(report)))
    if report["verdict"] != "named":
        sections.append(Section("What these drives would have shown", detectable(report)))
    page = html_page(title(report), sections, f"{report['dataset']['name']}, {report['dataset']['vehicle']}",
                     kind="Missing effect", lead=lead(report)[0])
    write_text(out / "report.html", page)
    return out / "report.html"


def found(report: dict[str, Any]) -> str:
    """Three sentences, what to do about doubts, and one drive before and after."""
    parts = [paragraph(" ".join(lead(report)[1:]))]
    if another_floor(report):
        rows = [[one["quantity"], "" if one["unit"] == "-" else one["unit"], one["before"], one["value"],
                 *one["interval"]] for one in report["floor"]["members"]]
        parts += [heading("Another floor"), table(["measured without the model", "unit", "reference", "these drives",
                                                   "95 % from", "to"], rows)]
    if advice := [*report["log_doubts"], *report["advice"]]:
        parts += [heading("Before you rely on it"), bullets(advice)]
    if text := report["noise_sentence"]:
        parts.append(paragraph(f"{text[0].upper()}{text[1:]}."))
    if report["contradicted"]:
        parts += [paragraph("Withdrawn, since the drives contradict them:"), bullets(report["contradicted"])]
    if report["shown"] is not None:
        names = vehicles(report)
        parts += [heading("One drive, before and after"), drive_pictures(report["shown"], names),
                  drive_table(report["shown"], names)]
    parts.append(links([("method.html", "how the verdict was reached: what was tried, thresholds, settings")]))
    return "".join(parts)


def effects(report: dict[str, Any]) -> str:
    """The named effects with sizes, intervals and laws."""
    rows = []
    for one in report["effects"]:
        for name, p in one["parameters"].items():
            was = p.get("was")
            rows.append([spoken(one["name"]), p.get("description") or name, p["value"], *p["interval"], p["unit"],
                         was if was is not None and np.isfinite(was) else "none", name])
    parts = [table(["effect", "what it is", "value", "95% from", "to", "unit", "before", "name in vehicle.toml"],
                   rows)]
    if left_open := [text for one in report["effects"] for text in not_determined(one["parameters"])]:
        parts.append(bullets(left_open))
    parts.append(bullets([f"{spoken(one['name'])}: {one['equation']}" for one in report["effects"] if one["equation"]]))
    return "".join(parts)


def evidence(report: dict[str, Any]) -> str:
    """What each manoeuvre says of the named effects, and what would have contradicted them."""
    parts = []
    for one in report["effects"]:
        mine = one["evidence"]
        parts.append(table(
            ["manoeuvre", "size it asks for, as a share of the value", "standard error", "gain when left out"],
            [[each["manoeuvre"], each["factor"], each["standard_error"], mine["left_out_gain"].get(each["manoeuvre"])]
             for each in mine["by_manoeuvre"]],
            f"{spoken(one['name'])}: each manoeuvre by itself (1 agrees with all together), and by how much the size "
            "fitted to the others lowers its squared error, in squared standard deviations of the noise"))
        parts += [paragraph(agreement(one)), form(one["name"], report["forms"].get(one["name"], [])), predictions(one)]
    return "".join(parts)


def form(effect: str, curves: list[dict[str, Any]]) -> str:
    """How far an effect is off its law, over each quantity."""
    if not curves:
        return ""
    drawn = []
    for one in curves:
        at, ends = np.asarray(one["at"]), [100 * np.asarray(one[key]) for key in ("low", "high")]
        lines = [Line(at, np.zeros_like(at), colour=PALETTE[7]), *(Line(at, end, dash="4 3") for end in ends),
                 Line(at, 100 * np.asarray(one["share"]), width=2.2)]
        drawn.append(line_chart(lines, f"{one['quantity']} [{one['unit']}]", "off its law [%]", "",
                                Axes(width=300, height=210)))
    return charts(drawn, f"{spoken(effect)}: by how much it is larger or smaller than its law says (95 % band dashed). "
                         "The law holds where the band contains 0")


def agreement(effect: dict[str, Any]) -> str:
    """What manoeuvres say together, in words."""
    evidence = effect["evidence"]
    test, (low, high) = evidence["heterogeneity"], evidence["left_out_interval"]
    said = {"agree": "agree on its size", "differ": f"differ on its size by {test['scatter']:.0%} of it",
            "untold": "are too few, or see too little of it, to differ on its size"}[test["outcome"]]
    return (f"{test['manoeuvres']} manoeuvres excite {effect['name']}. They {said} (p = {test['p_value']:.2g}, power "
            f"{test['power']:.0%}). Left out, manoeuvres gain {evidence['left_out_total']:.0f} of squared residual "
            f"together (95% interval {low:.0f} to {high:.0f}).")


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
                       "ideal path in the room (dot: start)", Axes(equal=True))]))
    return "".join(parts)


def errors(report: dict[str, Any]) -> str:
    """Mean errors of the three vehicles, drives that were fitted and others apart."""
    names = vehicles(report)
    parts = []
    for part, words in PART_WORDS.items():
        rows = []
        for channel, metrics in report["before"][part].items():
            floor = metrics.get("noise_floor") or {}
            for metric in (name for name in METRICS if name in metrics):
                unit, factor = SHOWN_UNITS[UNITS[metric]]
                moved = report["change"][part][channel][metric]
                values = [report[key][part][channel][metric] for key in names]
                if report["alone"] is not None:
                    values.append(report["alone"][part][channel][metric])
                least = floor.get(metric)
                rows.append([f"{METRIC_WORDS[metric]}, {CHANNEL_NAMES[channel]} [{unit}]",
                             *(factor * value for value in values), None if least is None else factor * least,
                             f"{moved['trials'] - moved['worse']} of {moved['trials']}"])
        if rows:
            only = ["effect alone"] if report["alone"] is not None else []
            short = {"before": "as it was", "refitted": "refitted", "after": "with the effect"}
            header = ["usual error", *(short[key] for key in names), *only, "repeats differ by", "not worse in"]
            parts.append(table(header, rows, words))
    parts.append(paragraph("Usual error: root mean square over a drive, averaged over drives. As it was: nothing has "
                           "moved. Refitted: base parameters moved, held by their day-to-day spread. Effect alone: "
                           "that vehicle with the effect, and nothing else moved for it. With the effect: both. "
                           "Repeats: no prediction can be better than two repeats of one drive agree.", "dim"))
    return "".join(parts)


def by_manoeuvre(report: dict[str, Any]) -> str:
    """Errors of each manoeuvre, and which of them surely grew."""
    grown = [f"{row['manoeuvre']} ({PART_WORDS[row['part']].lower()}), {METRIC_WORDS[row['metric']]} of the "
             f"{CHANNEL_NAMES[row['channel']]}: {row['before']:.3g} to {row['after']:.3g} {row['unit']}"
             for row in report["worse"]]
    parts = ([paragraph("Surely worse than refitted without it:"), bullets(grown)] if grown else
             [paragraph("No manoeuvre is surely predicted worse than by the refitted vehicle without it.")])
    for part, words in PART_WORDS.items():
        rows = []
        for row in report["by_manoeuvre"]:
            unit, factor = SHOWN_UNITS[row["unit"]]
            if row["part"] == part:
                rows.append([row["manoeuvre"], f"{METRIC_WORDS[row['metric']]}, {CHANNEL_NAMES[row['channel']]} "
                             f"[{unit}]", factor * row["before"], factor * row["after"],
                             *(factor * end for end in row["interval"]), row["trials"]])
        if rows:
            parts.append(table(["manoeuvre", "usual error", "as it was", "after", "change, 95% from", "to", "drives"],
                               rows, words))
    return "".join(parts)


def lives(report: dict[str, Any]) -> str:
    """Shares of the residual by quantity."""
    rows = report["lives_in"][:10]
    chart = bar_chart([one["quantity"] for one in rows], {"share": [one["share"] for one in rows]},
                      "share predicted on other drives", log_y=False)
    return charts([chart])


def wrench(one: dict[str, Any]) -> str:
    """The fitted tables, what they predict, and what else was tried."""
    text = describe_unnamed(one)
    z, units, brakes = np.asarray(one["knots"]), one["units"], one["kind"] == "brake"
    if one["periodic"]:
        z = np.append(z, 2 * np.pi)
    drawn = []
    for name, what in (("force", "force forward"), ("torque", "torque to the left")):
        values, said = np.asarray(one["values"][name]), f"{what}{', times the direction of motion' * brakes}"
        if z.ndim == 2:  # a map: a line over x for every row
            lines = [Line(z[z[:, 1] == y, 0], values[z[:, 1] == y], f"y = {y:.2f} m", markers=True)
                     for y in np.unique(z[:, 1])]
            drawn.append(line_chart(lines, "x in the room [m]", f"{name} [{units[name]}]", said))
            continue
        line = Line(z, np.append(values, values[0]) if one["periodic"] else values, markers=True)
        drawn.append(line_chart([line], f"{one['quantity']} [{units['quantity']}]", f"{name} [{units[name]}]", said))
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
    return table(["effect", "parameter", "smallest size that shows", "unit", "noticed on simulated days"],
                 [[spoken(one["effect"]), spoken(one["parameter"].partition(".")[2]),
                   one["value"] if one["value"] is not None else "not visible", one["unit"],
                   "" if one["power"] is None else f"{one['power']:.0%}"] for one in report["detectable"]],
                 "Each effect in the size in which drives like these show it on four of five days")


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

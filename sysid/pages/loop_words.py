"""What a closed loop found, in words: the title, three sentences, and what a reader should do about doubts."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Mapping
from typing import Any

from sysid.logs.manoeuvre_library import make_command
from sysid.logs.records import Command

DEGREES = {"rad": "degrees", "rad/s": "degrees/s", "rad/s^2": "degrees/s^2"}
LISTED = 4  # names in a sentence
FAR = 2.0  # day-to-day spreads, beyond which a refit went further than days do


def title(report: Mapping[str, Any]) -> str:
    """What was found, in one line: `Missing: command delay 0.152 s (0.113 to 0.190)`."""
    floor = ["another floor"] if another_floor(report) else []
    if report["verdict"] == "none" and not floor:
        return "No known effect stands out in these drives" if untold(report) else (
            "Nothing is missing that these drives show")
    if report["verdict"] == "unexplained":
        return "; ".join(["Something is missing that no known effect explains", *(f"changed: {one}" for one in floor)])
    changed = [one for one in report["effects"] if any(map(_differs, one["parameters"].values()))]
    missing = [sized(one) for one in report["effects"] if one not in changed]
    parts = [("Missing", missing), ("Changed", [*map(sized, changed), *floor])]
    return "; ".join(f"{what}: {'; '.join(those)}" for what, those in parts if those)


def another_floor(report: Mapping[str, Any]) -> bool:
    """Whether gyro and wheels show another floor than that of the reference."""
    return bool((report.get("floor") or {}).get("name"))


def untold(report: Mapping[str, Any]) -> bool:
    """Whether neither other days nor repeats show how large the noise of the drives is."""
    errors = [one for part in report["before"].values() for one in part.values()]
    return not report.get("known", True) and not any(one.get("noise_floor") for one in errors)


def lead(report: Mapping[str, Any]) -> list[str]:
    """Three sentences: what was found, what it changes, and what is still open."""
    return [_found(report), prediction(report), _open(report)]


def sized(effect: Mapping[str, Any]) -> str:
    """An effect with its sizes and their intervals."""
    parameters = effect["parameters"]
    name = spoken(effect["name"])
    if len(parameters) == 1:
        return f"{name} {size(next(iter(parameters.values())))}"
    known = {key: one for key, one in parameters.items() if not _may_be_none(one)} or parameters
    texts = [f"{spoken(key.partition('.')[2])} {size(one)}" for key, one in known.items()]
    return f"{name}, {', '.join(texts)}"


def size(one: Mapping[str, Any]) -> str:
    """A value with its unit and its interval, in as many digits as the interval allows."""
    factor = 180 / math.pi if one["unit"] in DEGREES else 1.0
    unit = DEGREES.get(one["unit"], one["unit"])
    unit = "" if unit == "-" else f" {unit}"
    value, low, high = (factor * x for x in (one["value"], *one["interval"]))
    below, above = one.get("open", (False, False))
    digits = _digits(low, high)
    if below and above:
        return f"of a size that these drives do not show (best {value:.{digits}f}{unit})"
    if above or below:
        return f"{'above' if above else 'below'} {low if above else high:.{digits}f}{unit}"
    text = f"{value:z.{digits}f}{unit} ({low:.{digits}f} to {high:.{digits}f})"
    was = one.get("was")
    return text if was is None or not _differs(one) else f"{text}, before {factor * was:.{digits}f}"


def spoken(name: str) -> str:
    """A name of the catalogue as one says it."""
    return name.replace("_", " ")


def prediction(report: Mapping[str, Any]) -> str:
    """How far off the vehicles are on drives that were not fitted."""
    part = "held_out" if any(report["before"]["held_out"].values()) else "training"
    channel = next((name for name in ("ground_truth", "odometry")
                    if "trajectory" in report["before"][part].get(name, {})), None)
    if channel is None:
        return "No position was measured; the tables below have the speeds."
    numbers = {key: report[key][part][channel]["trajectory"] for key in ("before", "refitted", "after")}
    floor = (report["before"][part][channel].get("noise_floor") or {}).get("trajectory")
    which = "On drives that no fit has seen" if part == "held_out" else "On the drives that were fitted"
    where = "" if channel == "ground_truth" else " of the odometry"
    names = vehicles(report)
    text = ", ".join(f"{100 * numbers[key]:.1f} cm {'for ' * name.startswith('the ')}{name}"
                     for key, name in names.items())
    repeats = "" if floor is None else f"; two repeats of one drive differ by {100 * floor:.1f} cm"
    return f"{which}, the predicted position{where} is off by {text}{repeats}."


def vehicles(report: Mapping[str, Any]) -> dict[str, str]:
    """The vehicles that are compared, by their key in the report: what each is called."""
    far = any(abs(row["before"] - row["reference"]) > FAR * row["spread"] for row in report.get("base", ()))
    found = {"before": "the vehicle as it was",
             "refitted": "refitted to these drives" if far else "refitted within its day-to-day spread"}
    if not report.get("known", True):
        found = {"before": "the model, fitted to short motions", "refitted": "the model, fitted to whole paths"}
    if report["verdict"] == "named":
        found["after"] = "with " + " and ".join(spoken(one["name"]) for one in report["effects"])
    elif report["unnamed"] is not None and report["unnamed"]["kept"]:
        found["after"] = "with an unnamed force"
    return found


MANOEUVRE_WORDS = {
    "prbs": "random full steps of speed and yaw rate", "chirp": "swings that get quicker and quicker",
    "yaw_sine": "slow turns to both sides on the spot", "step_ladder": "forward and back by growing steps",
    "turn_ladder": "turns on the spot by growing steps", "stop_and_go": "full speed and stop, forward and back",
    "square": "a square to the left and one to the right", "arcs": "arcs forward and back to both sides",
}  # fmt: skip
"""Of the manoeuvres that `sysid.logs.manoeuvre_library` makes."""


def sentence(proposal: Mapping[str, Any]) -> str:
    """A proposal of a next drive in words."""
    parts = []
    if proposal["name"] is not None:
        parameters, start = proposal["parameters"], proposal["start"]
        times = f"{proposal['replicates']} times" if proposal["replicates"] > 1 else "once"
        name = MANOEUVRE_WORDS.get(proposal["name"], spoken(proposal["name"]))
        parts.append(f"{name} at up to {parameters['v']:.2g} m/s and {parameters['omega']:.2g} rad/s, starting at a "
                     f"heading of {math.degrees(start['heading']):.0f} degrees, driven {times}, separates "
                     f"{' from '.join(map(spoken, proposal['splits']))} by {proposal['expected_separation']:.0f} "
                     f"standard deviations a drive ({proposal['file']})")
    for one in proposal["not_split"]:
        parts.append(f"no drive separates {' from '.join(one['effects'])}; {one['sensor']} would")
    return "; ".join(parts)


def command_of(proposal: Mapping[str, Any]) -> Command:
    """The commands of a proposal."""
    return make_command(proposal["name"], **proposal["parameters"])


def describe_unnamed(one: Mapping[str, Any]) -> str:
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


def not_determined(parameters: Mapping[str, Any]) -> list[str]:
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


def _found(report: Mapping[str, Any]) -> str:
    if report["verdict"] == "none" and untold(report):
        return ("Nothing shows how much of the error is noise: no drive was repeated, and there is no reference. "
                "Whether anything without a name is missing is unknown.")
    far = _far(report.get("base", ()))
    if report["verdict"] == "none" and another_floor(report):
        return "These drives differ from the reference as on another floor; no effect stands out beside that."
    if report["verdict"] == "none" and report.get("known", True) and far:
        more = f", and {len(far) - 1} more" if len(far) > 1 else ""
        return ("No effect stands out, but the vehicle differs from its other days by more than they do: "
                f"{spoken(far[0]['name'].partition('.')[2])} by {abs(far[0]['away']):.0f} day-to-day spreads{more}.")
    if report["verdict"] == "none":
        return ("The vehicle drives as it did on its other days; differences are within its noise and its day-to-day "
                "spread." if report.get("known", True) else "The model describes these drives to within their noise.")
    if report["verdict"] == "named":
        texts = []
        for one in report["effects"]:
            known = [p for p in one["parameters"].values() if not _may_be_none(p)] or list(one["parameters"].values())
            law = known[0].get("description") or ""
            texts.append(f"{spoken(one['name'])}" + (f" ({law[0].lower()}{law[1:]})" if law else ""))
        text = " and ".join(texts)
        return f"{text[0].upper()}{text[1:]} explain{'s' if len(texts) == 1 else ''} these drives."
    where = [one["quantity"] for one in report["lives_in"][:2]]
    return ("These drives differ from the vehicle as it was, in a way that no effect of the catalogue has"
            + (f"; the difference depends on {' and on '.join(where)}." if where else "."))


def _open(report: Mapping[str, Any]) -> str:
    proposal = report["next_manoeuvre"]
    if report["verdict"] == "named":
        alike = [spoken(name) for one in report["effects"] for name in one["class"] if name != one["name"]]
        if not alike:
            return "No other effect of the catalogue fits these drives as well."
        others = ", ".join(alike[:LISTED]) + (f" and {len(alike) - LISTED} more" if len(alike) > LISTED else "")
        remedy = "" if proposal is None else (" The next drive below separates them." if proposal["name"] is not None
                                              else " No drive would separate them; another sensor would.")
        return f"It could as well be {others}: these drives do not separate them.{remedy}"
    if report["verdict"] == "none":
        return "The table of smallest sizes says what these drives would have shown, and what may still hide in them."
    return ("An unnamed force that stands for it is in vehicle.toml." if (report["unnamed"] or {}).get("kept") else
            "No force that depends on one quantity stands for it: look for lost messages, mixed commands or a fault.")


def _may_be_none(one: Mapping[str, Any]) -> bool:
    """Whether a parameter may be without effect, by its interval."""
    neutral = one.get("neutral")
    return neutral is not None and one["interval"][0] <= neutral <= one["interval"][1]


def _differs(one: Mapping[str, Any]) -> bool:
    """Whether a parameter had a size before that is surely more than none, or was further from none than it is now."""
    was, neutral = one.get("was"), one.get("neutral")
    if was is None or not math.isfinite(was) or neutral is None:
        return was is not None and math.isfinite(was)
    low, high = one["interval"]
    return abs(was - neutral) > min((high - low) / 2, abs(one["value"] - neutral))


def _digits(low: float, high: float) -> int:
    width = abs(high - low)
    return min(max(1 - math.floor(math.log10(width)), 0), 6) if width > 0 else 3


def shifts(rows: list[dict[str, Any]]) -> list[str]:
    """Base parameters that the last refit moved by more than `FAR` day-to-day spreads, in words, furthest first."""
    return [f"{row['name']} {row['reference']:.4g} -> {row['after']:.4g} {row['unit']} ({row['away']:+.1f} spreads)"
            for row in _far(rows)]


def _far(rows: Iterable[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    return sorted((row for row in rows if abs(row["away"]) > FAR), key=lambda row: -abs(row["away"]))


def summary(report: dict[str, Any], width: int = 100) -> str:
    """What a person reads first, in lines of at most `width` characters."""
    lines = [title(report), *lead(report), *report["log_doubts"], *report["advice"]]
    if report["noise_sentence"] is not None:
        lines.append(f"noise: {report['noise_sentence']}")
    lines += ["", f"verdict: {report['verdict']} - {report['reason']}",
              f"asked: {report['question']}; {report['remark']}"]
    for one in report["effects"]:
        lines += [f"  {name} = {p['value']:.4g} [{p['interval'][0]:.4g}, {p['interval'][1]:.4g}] {p['unit']}"
                  for name, p in one["parameters"].items()]
        lines += [f"  {text}" for text in not_determined(one["parameters"])]
    if report["floor"] is not None and report["floor"]["sentence"]:
        lines.append(f"  changed: {report['floor']['sentence']}")
    moved = shifts(report["base"])
    if moved:
        lines += ["  base parameters further than from day to day:", *(f"    {one}" for one in moved)]
    if report["next_manoeuvre"] is not None:
        lines.append(f"  next drive: {sentence(report['next_manoeuvre'])}")
    for one in report["lives_in"][:4]:
        lines.append(f"  lives in {one['quantity']}: {one['share']:.0%} of what is left")
    if report["unnamed"] is not None:
        lines.append(f"  {describe_unnamed(report['unnamed'])}")
    return "\n".join(wrapped(line, width) for line in lines)


def wrapped(line: str, width: int) -> str:
    """A line folded at `width`; what follows is indented by two more."""
    indent = " " * (len(line) - len(line.lstrip()))
    return textwrap.fill(line.strip(), width, initial_indent=indent, subsequent_indent=f"{indent}  ",
                         break_long_words=False, break_on_hyphens=False) if line.strip() else ""

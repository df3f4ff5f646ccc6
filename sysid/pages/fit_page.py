"""The sections of a fit's `report.html`; `sysid.pages.report.write_html` puts them on a page."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from sysid.logs.metrics import METRICS, UNITS
from sysid.logs.records import CHANNEL_NAMES, CHECK
from sysid.pages.before_after import SMALLEST, drive_pictures, drive_table, shown_drive
from sysid.pages.series import REPLAYED, Channel, TrialSeries
from whill_mjx.io.html import (
    Cell,
    Section,
    bullets,
    charts,
    explained,
    folded,
    heading,
    legend,
    number,
    paragraph,
    table,
)
from whill_mjx.io.svg import COLOURS, PALETTE, Axes, Line, bar_chart, interval_bar, line_chart, replay_line

REPLAYS = ("ideal", "initial", "fitted")
REPLAY_WORDS = {"ideal": "a vehicle that follows its commands at once", "initial": "the model before the fit",
                "fitted": "the fitted vehicle"}
COLUMNS = {"ground_truth": ("along [m]", "left [m]", "yaw [rad]"),
           "odometry": ("along [m]", "left [m]", "yaw [rad]", "v [m/s]", "omega [rad/s]")}
MAX_TRIALS = 12  # drawn one by one
MAX_ROWS = 60  # of a table of trials
MAX_LAG = 3.0  # s of the autocorrelation
WORSE = 1.001  # times as much counts as worse


def fit_sections(report: dict[str, Any], series: Sequence[TrialSeries]) -> list[Section]:
    """All sections of the report of a fit (entries: docs/formats.md); without `series`, the charts are left out."""
    drawn = choose(series)
    sections = [Section("Summary", summary(report, series)), Section("Parameters", parameters(report))]
    if report.get("profiles"):
        sections.append(Section("Profile likelihoods", profiles(report)))
    if drawn:
        note = "Measured and replayed paths; all replays start at the measured start pose. Held-out trials first."
        sections += [Section("Trajectories", replayed_charts(drawn, path_chart, note)),
                     Section("Yaw", replayed_charts(drawn, yaw_chart)), Section("Residuals", residuals(series, drawn))]
    return [*sections, Section("Errors per trial", errors(report)), Section("What got worse", worse(report)),
            Section("Search", search(report)), Section("Data and code", origin(report))]


def choose(series: Sequence[TrialSeries]) -> list[TrialSeries]:
    """At most MAX_TRIALS, held-out ones first, each manoeuvre before its repetitions."""
    def repetition(trial: TrialSeries) -> int:
        tail = trial.name.rsplit("_", 1)[-1]
        return int(tail) if tail.isdigit() else 0

    order = sorted(series, key=repetition)
    held_out = [trial for trial in order if trial.held_out][: MAX_TRIALS // 2 + 2]
    return held_out + [trial for trial in order if not trial.held_out][: MAX_TRIALS - len(held_out)]


def summary(report: dict[str, Any], series: Sequence[TrialSeries]) -> str:
    """Three sentences and three pictures, then the mean errors, held-out trials first and apart."""
    held, train = report["summary"]["held_out"], report["summary"]["training"]
    dataset = report["dataset"]
    notes = dataset.get("notes") or []
    parts = [paragraph(" ".join(lead(report)[1:])), *(paragraph(f"{note[0].upper()}{note[1:].rstrip('.')}.")
                                                          for note in notes if _is_limit(note))]
    shown = shown_drive(series)
    if shown is not None:
        parts += [drive_pictures(shown, REPLAY_WORDS), drive_table(shown, REPLAY_WORDS)]
    parts.append(paragraph(f"Dataset {dataset['name']}, vehicle {dataset['vehicle']}: {len(dataset['training'])} "
                           f"trials fitted, {len(dataset['held_out'])} held out. Model: {report['model']['preset']} "
                           f"with {', '.join(report['model']['effects'])}."))
    for title, part in (("Held-out trials: predicted, never fitted", held), ("Training trials", train)):
        if part:
            parts += [heading(title), _summary_table(part)]
    parts.append(paragraph('"Ideal" follows its commands at once and without slip; "initial" is the model before the '
                           "fit. The floor is the spread between replicates, which no model of the mean motion can "
                           "beat. Root mean squares, averaged over trials.", "dim"))
    others = [note for note in notes if not _is_limit(note)]
    parts += [bullets(others)] if others else []
    return "".join(parts)


def lead(report: dict[str, Any]) -> list[str]:
    """Three sentences: how good the fit is, what it changed, and what it does not know."""
    known = [one for one in report["parameters"] if one["identifiable"]]
    unknown = [one["name"] for one in report["parameters"] if not one["identifiable"]]
    inside = [one for one in known if not one["remark"] and _change(one) > 1]  # not at the end of its range
    moved = sorted(inside, key=_change, reverse=True)[:2]
    changed = "; ".join(f"{_spoken(one['name'])} from {number(one['initial'])} to {number(one['value'])}"
                        + ("" if one["unit"] == "-" else f" {one['unit']}") for one in moved)
    second = (f"This log determines {len(known)} of {len(report['parameters'])} parameters; "
              f"{f'most surely changed: {changed}' if moved else 'none surely changed'}."
              if known else "This log determines none of the parameters.")
    if not report["summary"]["held_out"]:
        third = "Nothing was held out, so how well the vehicle predicts other drives is not known."
    elif unknown:
        listed = ", ".join(map(_spoken, unknown[:3])) + (f" and {len(unknown) - 3} more" if len(unknown) > 3 else "")
        third = f"It does not determine {listed}: do not rely on their values."
    else:
        third = "Nothing that was fitted is left open."
    return [headline(report), second, third]


def _is_limit(note: str) -> bool:
    """Whether a note says what the log does not determine, or what is wrong with it."""
    return note.startswith(("not fitted", "the log has no commands", CHECK))


def _spoken(name: str) -> str:
    """A dotted parameter as one says it."""
    effect, _, parameter = name.rpartition(".")
    return f"{effect} {parameter}".replace("_", " ").strip()


def warning(report: dict[str, Any]) -> str:
    """A sentence where held-out drives are predicted worse than by what the fit began with, and than the floor, the
    spread of replicates; nothing otherwise."""
    channels = report["summary"]["held_out"]
    channel = "ground_truth" if "trajectory" in channels.get("ground_truth", {}) else "odometry"
    for metric, spoken in (("trajectory", _cm), ("yaw", _degrees)):
        one = channels.get(channel, {}).get(metric)
        if one is None or one["initial"] is None or not np.isfinite(one["initial"]):
            continue
        fitted = np.inf if one["fitted"] is None or not np.isfinite(one["fitted"]) else one["fitted"]  # it diverged
        if _is_more(fitted, one["initial"]) and _is_more(fitted, one.get("noise_floor") or 0.0):
            what = {"trajectory": "position", "yaw": "heading"}[metric]
            return (f"This fit is worse than the vehicle as stated: on held-out drives its {what} is off by "
                    f"{spoken(one['fitted'])}, that of the vehicle as stated by {spoken(one['initial'])}. Keep the "
                    "stated values, and see what got worse.")
    return ""


def _degrees(radians: float | None) -> str:
    return "an unknown angle" if radians is None else f"{np.degrees(radians):.2f} degrees"


def headline(report: dict[str, Any]) -> str:
    """Two sentences: the error that the fit is judged by, and those it is compared with; a warning goes first."""
    return " ".join(one for one in (warning(report), _judged(report)) if one)


def _judged(report: dict[str, Any]) -> str:
    part = "held_out" if report["summary"]["held_out"] else "training"
    channels = report["summary"][part]
    channel = "ground_truth" if "trajectory" in channels.get("ground_truth", {}) else "odometry"
    one = channels.get(channel, {}).get("trajectory")
    if not one:
        return "No position was measured; see the table."
    which = "On drives that were never fitted" if part == "held_out" else "On the drives that were fitted"
    where = "" if channel == "ground_truth" else " of the odometry"
    text = f"{which}, the predicted position{where} is off by {_cm(one['fitted'])}"
    if one.get("noise_floor") and one["fitted"] is not None:
        times = f"{one['fitted'] / one['noise_floor']:.1f}"
        text += f", {times} times what two repeats of one drive differ by ({_cm(one['noise_floor'])})"
    return (f"{text}. It was off by {_cm(one['initial'])} before the fit, and is off by {_cm(one['ideal'])} for a "
            "vehicle that follows its commands at once.")


def _cm(metres: float | None) -> str:
    return "an unknown length" if metres is None else f"{100 * metres:.1f} cm"


def in_words(report: dict[str, Any], shown: int = 6) -> list[str]:
    """A few plain lines on a fit, for a terminal: the error, the parameters that changed most, and what is unknown."""
    lines = [headline(report)]
    known = [one for one in report["parameters"] if one["identifiable"]]
    for one in sorted(known, key=_change, reverse=True)[:shown]:
        low, high = one["interval"]
        unit = "" if one["unit"] == "-" else f" {one['unit']}"
        lines.append(f"{one['name']}: {one['initial']:.4g} -> {one['value']:.4g}{unit} "
                     f"({one['confidence']:.0%} interval {low:.4g} to {high:.4g})")
    unknown = [one["name"] for one in report["parameters"] if not one["identifiable"]]
    if len(known) > shown:
        lines.append(f"and {len(known) - shown} more parameters that this log determines")
    if unknown:
        lines.append(f"not determined by this log: {', '.join(unknown)}")
    return lines


def _change(one: dict[str, Any]) -> float:
    """Change of a parameter relative to the width of its interval."""
    low, high = one["interval"]
    return abs(one["value"] - one["initial"]) / max(high - low, 1e-12)


def _summary_table(part: dict[str, Any]) -> str:
    rows = []
    for channel, metrics in part.items():
        for metric in (name for name in METRICS if name in metrics):
            one = metrics[metric]
            floor = one.get("noise_floor")
            rows.append([CHANNEL_NAMES[channel], f"{metric.replace('_', ' ')} [{UNITS[metric]}]",
                         *(one[replay] for replay in REPLAYS[:2]),
                         Cell(one["fitted"], "bad" if _is_more(one["fitted"], one["initial"]) else "good"), floor,
                         one["fitted"] / floor if floor and one["fitted"] is not None else None, metrics["trials"]])
    return table(["channel", "RMSE", *REPLAYS, "floor", "fitted / floor", "trials"], rows)


def parameters(report: dict[str, Any]) -> str:
    """Initial and fitted values with intervals; what was not fitted; what the log does not determine."""
    rows: list[list[Any]] = []
    for one in report["parameters"]:
        low, high = one["interval"]
        bounds = one.get("bounds") or [low, high]
        values = (one["value"], low, high, *bounds, one["initial"])
        bar = interval_bar(one["value"], (low, high), (bounds[0], bounds[1]), one["initial"],
                           bounds[0] > 0 and bounds[1] > 10 * bounds[0]) if None not in values else ""
        name = explained(one["name"], one.get("meaning", ""))
        rows.append([name, one["unit"], one["initial"], one["value"], low, high, Cell(bar, html=True),
                     Cell("yes" if one["identifiable"] else "no", "good" if one["identifiable"] else "warn"),
                     one["remark"]])
    confidence = report["parameters"][0]["confidence"] if report["parameters"] else 0.9
    parts = [table(["parameter", "unit", "initial", "fitted", f"{confidence:.0%} from", "to", "within its bounds",
                    "identifiable", "remark"], rows),
             paragraph("Bar: interval (blue) and fitted value (dot) within the bounds of the search; the orange tick "
                       "is the initial value.", "dim")]
    if report["weak_combinations"]:
        parts += [heading("Combinations that this log does not determine"), bullets(report["weak_combinations"]),
                  paragraph("Each line is a direction in which the parameters may move together, by these shares of "
                            "their ranges, while the replayed drives hardly change.", "dim")]
    if report.get("spectrum"):
        spectrum = table(["combination", "information", "standard error"], [
            [one["combination"], one["information"], max(one["information"], 1e-12) ** -0.5]
            for one in report["spectrum"]])
        parts.append(folded("Fisher information: how well the log determines each combination of parameters", paragraph(
            "Eigenvalues, weakest first; the standard error along each is a share of the range between the bounds.",
            "dim") + spectrum))
    if report["fixed"]:
        parts += [heading("Not fitted"), table(["parameter", "value", "reason"], [
            [one["name"], one["value"], one["reason"]] for one in report["fixed"]])]
    return "".join(parts)


def profiles(report: dict[str, Any]) -> str:
    """Each profile with the parabola of the interval from curvature, and the interval that it gives."""
    items, rows = [], []
    fitted = {one["name"]: one for one in report["parameters"]}
    for one in report["profiles"]:
        values, statistic = (np.array(one[key], float) for key in ("values", "statistic"))
        about, top = fitted[one["name"]], 4 * one["threshold"]
        lines = [Line(values, np.where(statistic <= top, statistic, np.nan), "profile", PALETTE[0], markers=True)]
        low, high = about["interval"]
        if about["identifiable"] and high > low:
            fine = np.linspace(values[0], values[-1], 200)
            half = np.where(fine < about["value"], about["value"] - low, high - about["value"])
            parabola = one["threshold"] * ((fine - about["value"]) / np.maximum(half, 1e-12)) ** 2
            lines.append(Line(fine, np.where(parabola <= top, parabola, np.nan), "curvature", PALETTE[1], "5 3"))
        items.append(line_chart(lines, f"{one['name']} [{one['unit']}]", "2 x loss of log likelihood",
                                axes=Axes(band=(0.0, one["threshold"]), width=340, height=250)))
        rows.append([one["name"], one["unit"], about["value"], *one["interval"], low, high, one["remark"]])
    confidence = report["parameters"][0]["confidence"]
    header = ["parameter", "unit", "fitted", f"profile, {confidence:.0%} from", "to", "curvature from", "to", "remark"]
    return charts(items, "All other parameters are fitted again at each point. Inside the band, the log allows the "
                         "value; autocorrelation is accounted for.") + table(header, rows)


def replayed_charts(drawn: Sequence[TrialSeries], chart: Callable[[Channel, str], str], note: str = "") -> str:
    """A chart of the outside pose of each trial, or of its odometry without one."""
    return replay_legend() + charts([chart(channel, trial.label) for trial in drawn
                                     if (channel := _position_channel(trial)) is not None], note)


def path_chart(channel: Channel, title: str, replays: Sequence[str] = REPLAYED) -> str:
    """Paths of a channel as measured and replayed."""
    return line_chart([replay_line(channel.values[name][:, 0], channel.values[name][:, 1], name) for name in replays],
                      "x [m]", "y [m]", title, Axes(equal=True, smallest=SMALLEST))


def yaw_chart(channel: Channel, title: str, replays: Sequence[str] = REPLAYED) -> str:
    """Yaw of a channel over time, as measured and replayed."""
    return line_chart([replay_line(channel.t, channel.values[name][:, 2], name) for name in replays], "t [s]",
                      "yaw [rad]", title, Axes(smallest=0.05))


def replay_legend(replays: Sequence[str] = REPLAYED) -> str:
    """Colours of what was measured and of replays."""
    return legend([(name, COLOURS[name]) for name in replays])


def residuals(series: Sequence[TrialSeries], drawn: Sequence[TrialSeries]) -> str:
    """Fitted minus measured over time, and its autocorrelation."""
    parts = []
    for channel in ("ground_truth", "odometry"):
        mine = [trial for trial in drawn if channel in trial.channels][:6]
        if not mine:
            continue
        parts.append(heading(f"{CHANNEL_NAMES[channel].capitalize()}: fitted minus measured"))
        found = [(trial.channels[channel], trial.channels[channel].error()) for trial in mine]
        items = []
        for column, name in enumerate(COLUMNS[channel]):
            lines = [Line(one.t, error[:, column], "", PALETTE[k % len(PALETTE)], width=1.0)
                     for k, (one, error) in enumerate(found) if np.isfinite(error[:, column]).any()]
            if lines:
                items.append(line_chart(lines, "t [s]", name, f"residual {name}", Axes(smallest=1e-4)))
        parts += [legend([(trial.label, PALETTE[k % len(PALETTE)]) for k, trial in enumerate(mine)]), charts(items),
                  heading(f"{CHANNEL_NAMES[channel].capitalize()}: autocorrelation of the residual about zero"),
                  legend([("training trials", PALETTE[0]), ("held-out trials", PALETTE[1])]),
                  charts(_autocorrelations(series, channel), "White noise would lie in the band for 95% of the lags.")]
    return "".join(parts)


def _autocorrelations(series: Sequence[TrialSeries], channel: str) -> list[str]:
    items = []
    for column, name in enumerate(COLUMNS[channel]):
        lines, samples = [], 0
        for held_out, colour in ((False, PALETTE[0]), (True, PALETTE[1])):
            mine = [trial.channels[channel] for trial in series
                    if trial.held_out is held_out and channel in trial.channels]
            lag, value, count = autocorrelation(mine, column)
            if len(lag):
                lines.append(Line(lag, value, "", colour))
                samples = max(samples, count)
        if lines:
            bound = 1.96 / np.sqrt(samples)
            items.append(line_chart(lines, "lag [s]", "autocorrelation", name,
                                    Axes(band=(-bound, bound), width=280, height=200)))
    return items


def autocorrelation(
    channels: Sequence[Channel], column: int, max_lag: float = MAX_LAG
) -> tuple[np.ndarray, np.ndarray, int]:
    """Lags [s], autocorrelation about zero pooled over trials, and number of samples of a column's residual."""
    steps = [float(np.median(np.diff(one.t))) for one in channels if len(one.t) > 8]
    if not steps:
        return np.zeros(0), np.zeros(0), 0
    dt = float(np.median(steps))
    longest = min(max_lag, min(float(one.t[-1] - one.t[0]) for one in channels if len(one.t) > 8) / 2)
    lags = np.arange(0, int(longest / dt) + 1)
    sums, counts, samples = np.zeros(len(lags)), np.zeros(len(lags)), 0
    for one in channels:
        error = one.error()[:, column]
        known = np.isfinite(error)
        if known.sum() <= 8:
            continue
        grid = np.arange(one.t[known][0], one.t[known][-1], dt)
        values = np.interp(grid, one.t[known], error[known])
        samples += len(values)
        for k in lags[lags < len(values)]:
            sums[k] += values[: len(values) - k] @ values[k:]
            counts[k] += len(values) - k
    if samples == 0 or sums[0] <= 0:
        return np.zeros(0), np.zeros(0), 0
    mean = sums / np.maximum(counts, 1)
    return lags * dt, mean / mean[0], samples


def errors(report: dict[str, Any]) -> str:
    """Error of each trial as bars and as a table."""
    rows = sorted(report["errors"], key=lambda row: not row["held_out"])
    position = [row for row in rows if "trajectory" in row["metrics"]]
    channel = "ground_truth" if any(row["channel"] == "ground_truth" for row in position) else "odometry"
    shown = [row for row in position if row["channel"] == channel][:40]
    names = [row["trial"] + ("*" if row["held_out"] else "") for row in shown]
    items = [bar_chart(names, {replay: np.array([row["metrics"][metric][replay] for row in shown], float).tolist()
                               for replay in REPLAYS}, f"{metric} RMSE [{UNITS[metric]}]",
                       f"{CHANNEL_NAMES[channel]}, {metric}", width=max(420, min(1100, 30 * len(shown) + 120)))
             for metric in ("trajectory", "yaw") if shown]
    body = [[row["trial"], "held out" if row["held_out"] else "training", CHANNEL_NAMES[row["channel"]],
             *(Cell(row["metrics"][metric]["fitted"], "bad" if _is_more(row["metrics"][metric]["fitted"],
                                                                        row["metrics"][metric]["initial"]) else "")
               if metric in row["metrics"] else None for metric in METRICS)] for row in rows[:MAX_ROWS]]
    note = f"the first {MAX_ROWS} of {len(rows)} rows; all are in report.json" if len(rows) > MAX_ROWS else ""
    header = ["trial", "part", "channel", *(f"{metric.replace('_', ' ')} [{UNITS[metric]}]" for metric in METRICS)]
    return charts(items, "* held out. The scale is logarithmic.") + heading("Fitted vehicle") + table(
        header, body, note) + paragraph("Red: more than before the fit.", "dim")


def worse(report: dict[str, Any]) -> str:
    """Every error that the fit, or the model against an ideal vehicle, made larger."""
    found: list[tuple[float, list[Any]]] = []
    for row in report["errors"]:
        for metric, one in row["metrics"].items():
            for reference in ("initial", "ideal"):
                if _is_more(one["fitted"], one[reference]):
                    ratio = one["fitted"] / one[reference] if one[reference] else float("inf")
                    found.append((ratio, [row["trial"] + ("*" if row["held_out"] else ""),
                                          CHANNEL_NAMES[row["channel"]], f"{metric.replace('_', ' ')} "
                                          f"[{UNITS[metric]}]", f"{reference} vehicle", one[reference],
                                          Cell(one["fitted"], "bad"), ratio]))
    total = sum(len(row["metrics"]) for row in report["errors"])
    if not found:
        return paragraph(f"Nothing: none of {total} errors is more than before the fit or than an ideal vehicle's.")
    found.sort(key=lambda entry: -entry[0])
    initial = sum(1 for _, row in found if row[3] == "initial vehicle")
    return paragraph(f"Of {total} errors (trial, channel, quantity), {initial} are more than before the fit and "
                     f"{len(found) - initial} more than those of an ideal vehicle. The largest ratios first:") + table(
        ["trial", "channel", "RMSE", "than the", "was", "is", "ratio"], [row for _, row in found[:25]],
        f"25 of {len(found)}" if len(found) > 25 else "")


def search(report: dict[str, Any]) -> str:
    """Cost, evaluations, agreement of the starts, delay profiles."""
    about = report["search"]
    rows: list[list[Any]] = [["cost before", about["cost_initial"]], ["cost after", about["cost"]],
                             ["simulator evaluations", about["evaluations"]], ["seconds", about["seconds"]],
                             ["noise scales from", report["noise"]["source"]]]
    costs = [cost for cost in about.get("start_costs") or [] if cost is not None]
    if costs:
        near = sum(1 for cost in costs if cost < 1.02 * min(costs))
        rows.append(["starts within 2% of the best", f"{near} of {len(costs)}"])
    items = [line_chart([Line(np.array(one["values"], float), np.array(one["cost"], float), markers=True)],
                        f"{one['name']} [s]", "cost", "delay profile", Axes(width=320, height=220))
             for one in about.get("delay_profiles") or []]
    scale = table(["channel", "noise scale"], [[name, value] for name, value in report["noise"]["scale"].items()])
    return table(["", ""], rows) + (charts(items) if items else "") + heading("Noise scales") + scale


def origin(report: dict[str, Any]) -> str:
    """Hashes of data and code, and the settings of the fit."""
    dataset, code = report["dataset"], report.get("code") or {}
    rows: list[list[Any]] = [["dataset SHA-256", dataset["sha256"]],
                             *([f"code: {name}", value] for name, value in code.items())]
    settings = [[name, str(value)] for name, value in report["settings"].items()]
    return table(["", ""], rows) + heading("Settings") + table(["setting", "value"], settings) + paragraph(
        f"Training trials: {', '.join(dataset['training'][:60])}. Held out: "
        f"{', '.join(dataset['held_out'][:60]) or 'none'}.", "dim")


def _position_channel(trial: TrialSeries) -> Channel | None:
    for name in ("ground_truth", "odometry"):
        channel = trial.channels.get(name)
        if channel is not None and np.isfinite(channel.values["measured"][:, :3]).any():
            return channel
    return None


def _is_more(value: float | None, reference: float | None) -> bool:
    return value is not None and reference is not None and value > WORSE * reference

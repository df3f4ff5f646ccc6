"""What a driving log holds: regularity of its streams, clocks, excitation, and what no fit can identify from it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from sysid.logs.coverage import blind_spots, excitation, replicate_spread, sanity
from sysid.logs.records import Log
from sysid.logs.stream_quality import Shift, StreamQuality, clock_shift, pose_jitter, response_shift, trial_quality

MAX_ROWS = 40  # trials listed one by one; more are summed up by group
POSE_JITTER = 0.003  # s, more than rounding and noise of the speeds explain


def inspect(log: Log) -> dict[str, Any]:
    """All findings on a log as plain numbers and sentences (keys below); see `text` for how they read.

    `log`, `streams` (per stream, over all trials), `clocks`, `pose_jitter` [s], `sanity`, `trials` (excitation and
    shifts of each), `replicates`, `blind_spots`.
    """
    excitations = {trial.name: excitation(trial) for trial in log.trials}
    qualities = {trial.name: trial_quality(trial) for trial in log.trials}
    responses = {channel: {trial.name: response_shift(trial, channel) for trial in log.trials}
                 for channel in ("odometry", "ground_truth")}
    clocks = {trial.name: clock_shift(trial) for trial in log.trials}
    jitters = [jitter for trial in log.trials if np.isfinite(jitter := pose_jitter(trial))]
    return {
        "log": {"name": log.name, "sha256": log.sha256, "vehicle": log.spec.name, "drive": log.spec.drive,
                "trials": len(log.trials), "held_out": [trial.name for trial in log.held_out],
                "seconds": float(sum(trial.duration for trial in log.trials)), "notes": list(log.notes),
                "geometry": {key: getattr(log.spec, key) for key in ("wheel_radius", "track", "wheelbase", "mass")}},
        "streams": {name: _over_trials([found[name] for found in qualities.values() if name in found])
                    for name in ("command", "odometry", "ground_truth", "gyro")
                    if any(name in found for found in qualities.values())},
        "clocks": {
            **{f"{channel} after command": _pooled(list(found.values())) for channel, found in responses.items()
               if any(found.values())},
            **({"ground_truth after odometry": _pooled(list(clocks.values()))} if any(clocks.values()) else {})},
        "pose_jitter": float(np.median(jitters)) if jitters else float("nan"),
        "sanity": sanity(log, responses),
        "trials": [{"trial": trial.name, "group": trial.group, "manoeuvre": trial.manoeuvre, "seconds": trial.duration,
                    "held_out": trial.held_out, "excitation": asdict(excitations[trial.name]),
                    "streams": {name: asdict(one) | {"rate": one.rate} for name, one in qualities[trial.name].items()},
                    "clock": {name: asdict(one) for name, one in clocks[trial.name].items()}}
                   for trial in log.trials],
        "replicates": replicate_spread(log.trials),
        "blind_spots": [asdict(one) for one in blind_spots(log, excitations)],
    }


def _over_trials(found: Sequence[StreamQuality]) -> dict[str, float]:
    held = [one.held for one in found if np.isfinite(one.held)]
    rate, jitter = (float(np.median([getattr(one, name) for one in found])) for name in ("rate", "jitter"))
    return {"trials": len(found), "samples": sum(one.samples for one in found), "rate": rate, "jitter": jitter,
            "longest": max(one.longest for one in found), "gaps": sum(one.gaps for one in found),
            "missing": float(np.mean([one.missing for one in found])),
            "held": float(np.mean(held)) if held else float("nan")}


def _pooled(found: Sequence[dict[str, Shift]]) -> dict[str, dict[str, float]]:
    """Median and spread over trials of the shifts of each channel."""
    pooled = {}
    for name in ("v", "omega"):
        shifts = [one[name] for one in found if name in one and abs(one[name].correlation) > 0.8]
        if shifts:
            delays = np.array([one.delay for one in shifts])
            deviation = 1.4826 * float(np.median(np.abs(delays - np.median(delays))))
            pooled[name] = {"delay": float(np.median(delays)), "spread": deviation, "trials": len(shifts),
                            "error": deviation / float(np.sqrt(len(shifts))) * 1.25,
                            "lag": float(np.median([one.lag for one in shifts])),
                            "gain": float(np.median([one.gain for one in shifts]))}
    return pooled


def text(found: dict[str, Any]) -> str:
    """The findings as readable text."""
    log = found["log"]
    geometry = ", ".join(f"{key.replace('_', ' ')} {value:g}" for key, value in log["geometry"].items())
    lines = [f"{log['name']}: {log['trials']} trials ({len(log['held_out'])} held out), {log['seconds']:.0f} s, "
             f"vehicle {log['vehicle']} ({log['drive']}; {geometry})"]
    lines += [f"  note: {note}" for note in log["notes"]]
    lines += ["", "Streams          rate    jitter   longest     gaps  missing   repeated",
              "                   Hz        ms        ms                       samples"]
    for name, one in found["streams"].items():
        held = "-" if not np.isfinite(one["held"]) else f"{one['held']:.1%}"
        lines.append(f"  {name:13} {one['rate']:6.1f} {1e3 * one['jitter']:9.1f} {1e3 * one['longest']:9.0f} "
                     f"{one['gaps']:8d} {one['missing']:8.1%} {held:>10}")
    repeated = [name for name, one in found["streams"].items() if np.isfinite(one["held"]) and one["held"] > 0.05]
    if repeated:
        lines.append(f"  {' and '.join(repeated)}: pose or speeds repeat between updates; count each update once")
    if found["pose_jitter"] > POSE_JITTER:
        lines.append(f"  odometry: its pose is {1e3 * found['pose_jitter']:.0f} ms out of step with its speeds: it is "
                     "updated on another clock than it is sampled")
    lines += ["", "Clocks and response: clock offset plus transport delay (median over trials +- standard error)"]
    for name, channels in found["clocks"].items():
        for channel, one in channels.items():
            lag = f", then a lag of {one['lag']:.2f} s" if "command" in name else ""
            several = one["trials"] > 1  # one trial shows no spread
            error = f" +- {1e3 * one['error']:.0f}" if several else ""
            lines.append(f"  {name}, {channel}: {1e3 * one['delay']:+.0f}{error} ms{lag}; "
                         f"gain {one['gain']:.3f} ({one['trials']} trial{'s' * several})")
    if not found["clocks"]:
        lines.append("  no trial is long and lively enough to compare clocks")
    lines += ["", "Units, signs and frames", *(f"  ! {one}" for one in found["sanity"] or [])]
    if not found["sanity"]:
        lines.append("  nothing odd: measured speeds, yaw rates and path lengths fit the commands")
    lines += ["", *_trial_lines(found["trials"]), "", "Replicates (standard deviation between drives, m and rad)"]
    for group in found["replicates"]:
        spread = "  ".join(f"{name.replace('ground_truth', 'outside')} {value:.4f}"
                           for name, value in group["spread"].items())
        lines.append(f"  {_span(group['trials'])}: {spread}")
    if not found["replicates"]:
        lines.append("  none")
    lines += ["", "What this log cannot determine"]
    for blind in found["blind_spots"]:
        lines += [f"  {blind['cause']} -> {blind['hidden']}", f"      remedy: {blind['remedy']}"]
    if found.get("next_drives"):
        lines += ["", "Next drives (ramped, within the space; --out writes them; keep a hand on the stop)"]
    for one in found.get("next_drives", ()):
        length, width = one["floor"]
        lines += [f"  {one['file']} {one['manoeuvre']}, {one['seconds']:.0f} s, to {one['v']:.2f} m/s and "
                  f"{one['omega']:.2f} rad/s: {one['why']}",
                  f"      needs {length:.1f} x {width:.1f} m of free floor, margins included: {one['drive_it']}"]
    return "\n".join(lines)


def _trial_lines(trials: list[dict[str, Any]]) -> list[str]:
    """One line per trial, or per group where there are many."""
    groups: dict[str, list[dict[str, Any]]] = {}
    for trial in trials:
        name = trial["trial"] + "*" * bool(trial["held_out"])
        groups.setdefault(name if len(trials) <= MAX_ROWS else trial["trial"].split("/")[0], []).append(trial)
    if len(trials) > MAX_ROWS:
        groups = {f"{name} ({len(members)})": members for name, members in groups.items()}
    width = max([18, *map(len, groups)])
    return [f"{'Excitation':{width + 1}}v [m/s]       omega [rad/s]   rev. turns  slow  acc.  path  turn  "
            "still before, after",
            " " * (width + 43) + "s  m/s2     m   rad  s",
            *(_excitation_line(f"{name:{width}}", members) for name, members in groups.items()),
            *(["  * held out"] if len(trials) <= MAX_ROWS and any(t["held_out"] for t in trials) else [])]


def _excitation_line(name: str, trials: list[dict[str, Any]]) -> str:
    all_of = [t["excitation"] for t in trials]

    def total(key: str) -> float:
        return float(np.sum([one[key] for one in all_of]))

    v = min(one["v"][0] for one in all_of), max(one["v"][1] for one in all_of)
    omega = min(one["omega"][0] for one in all_of), max(one["omega"][1] for one in all_of)
    still = [float(np.median([one["standstill"][k] for one in all_of])) for k in (0, 1)]
    peaks = [one["acceleration"] for one in all_of if np.isfinite(one["acceleration"])]
    peak = f"{max(peaks):.2f}" if peaks else "-"
    return (f"  {name} {v[0]:+.2f} .. {v[1]:+.2f}  {omega[0]:+.2f} .. {omega[1]:+.2f}  {total('reversals'):5.0f} "
            f"{total('turn_changes'):5.0f} {total('slow_seconds'):5.1f} {peak:>5} "
            f"{total('distance'):5.0f} {total('turn'):5.0f}  {still[0]:.1f} / {still[1]:.1f}")


def _span(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{names[0]} .. {names[-1].rsplit('_', 1)[-1]}"

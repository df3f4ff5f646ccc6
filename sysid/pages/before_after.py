"""One drive as measured and as vehicles replay it, in one picture and one table, for people who drive vehicles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sysid.pages.series import TrialSeries
from whill_mjx.io.html import charts, legend, table
from whill_mjx.io.svg import Axes, Line, line_chart

POINTS = 240  # of a drawn path
SMALLEST = 0.3  # m; a turn on the spot would fill its chart with noise
DRAWN = ("#b2182b", "#e08214", "#1f6fb4")  # colours of the replays, worst first
MEASURED = "#111111"
DASHES = ("2 3", "6 3", "")
CHANNEL_WORDS = {"ground_truth": "as tracked from outside", "odometry": "as its own odometry reports it"}


def shown_drive(series: Sequence[TrialSeries]) -> dict[str, Any] | None:
    """The drive that a report shows: of the held-out ones (else of all) that of the median position error in the first
    replay, so that it is neither the best nor the worst. By the outside pose, or else by the odometry.

    Returns:
        `trial`, `held_out`, `channel`, `t` (T,) [s], and `measured` and each replay as (T, 3) x, y [m], yaw [rad], at
        most POINTS rows; `errors`: replay -> `position`, `largest`, `end` [m] and `yaw` [rad]. None without a drive.
    """
    drives = [(trial, channel) for trial in series if (channel := _placed(trial)) is not None]
    held = [(trial, channel) for trial, channel in drives if trial.held_out]

    def errors(trial: TrialSeries, channel: str) -> dict[str, dict[str, float]]:
        paths = {name: values[:, :3] for name, values in trial.channels[channel].values.items()}
        return {name: _errors(paths["measured"], path) for name, path in paths.items() if name != "measured"}

    among = sorted(held or drives, key=lambda one: next(iter(errors(*one).values()))["position"])
    if not among:
        return None
    one, channel = among[(len(among) - 1) // 2]
    t = one.channels[channel].t
    every = np.unique(np.linspace(0, len(t) - 1, min(len(t), POINTS)).astype(int))
    return {"trial": one.name, "held_out": one.held_out, "channel": channel, "t": t[every],
            **{name: path[every, :3] for name, path in one.channels[channel].values.items()},
            "errors": errors(one, channel)}


def drive_pictures(shown: Mapping[str, Any], names: Mapping[str, str]) -> str:
    """Path, and errors of position and heading over time, of the drive that is shown; `names`: replay -> what it is
    called, worst first."""
    t, measured = np.asarray(shown["t"], float), np.asarray(shown["measured"], float)
    replays = {name: np.asarray(shown[name], float) for name in names}
    style = {name: (DRAWN[k + len(DRAWN) - len(names)], DASHES[k + len(DRAWN) - len(names)])
             for k, name in enumerate(names)}
    path = [Line(measured[:, 0], measured[:, 1], "", MEASURED, width=3.0)]
    path += [Line(one[:, 0], one[:, 1], "", *style[name], 1.6) for name, one in replays.items()]
    path.append(Line(measured[:1, 0], measured[:1, 1], "", MEASURED, markers=True))
    off = [Line(t, 100 * _off(measured, one), "", *style[name], 1.6) for name, one in replays.items()]
    turned = [Line(t, np.rad2deg(_turned(measured, one)), "", *style[name], 1.6) for name, one in replays.items()]
    items = [
        line_chart(path, "x [m]", "y [m]", "path (dot: start)", Axes(equal=True, smallest=SMALLEST)),
        line_chart(off, "time [s]", "off by [cm]", "distance from where the vehicle was", Axes(smallest=1.0)),
        line_chart(turned, "time [s]", "off by [degrees]", "error of the heading (+: too far left)",
                   Axes(smallest=0.5)),
    ]
    kind = "held out: no fit has seen it" if shown["held_out"] else "a training drive"
    entries = [("measured", MEASURED), *((text, style[name][0]) for name, text in names.items())]
    return legend(entries) + charts(items, f"Drive {shown['trial']} ({kind}), {CHANNEL_WORDS[shown['channel']]}. All "
                                           "start at the measured start and get the recorded commands, nothing else. "
                                           "Chosen because its error is the median one.")


def drive_table(shown: Mapping[str, Any], names: Mapping[str, str]) -> str:
    """Errors of the drive that is shown."""
    rows = [[text, 100 * one["position"], 100 * one["largest"], 100 * one["end"], float(np.rad2deg(one["yaw"]))]
            for name, text in names.items() if (one := shown["errors"][name])]
    return table(["this drive, replayed by", "usually off by [cm]", "at most [cm]", "at its end [cm]",
                  "heading usually off by [degrees]"], rows, "\"usually\": root mean square over the drive")


def _placed(trial: TrialSeries) -> str | None:
    """The channel in which the position of a trial was measured."""
    return next((name for name in CHANNEL_WORDS if name in trial.channels and np.isfinite(
        trial.channels[name].values["measured"][:, :3]).all()), None)


def _off(measured: np.ndarray, replayed: np.ndarray) -> np.ndarray:
    """(T,) distance between two paths [m]."""
    return np.asarray(np.hypot(*(replayed - measured)[:, :2].T))


def _turned(measured: np.ndarray, replayed: np.ndarray) -> np.ndarray:
    """(T,) difference of headings [rad]."""
    return np.asarray(np.angle(np.exp(1j * (replayed - measured)[:, 2])))


def _errors(measured: np.ndarray, replayed: np.ndarray) -> dict[str, float]:
    off = _off(measured, replayed)
    return {"position": float(np.sqrt(np.mean(np.square(off)))), "largest": float(off.max()), "end": float(off[-1]),
            "yaw": float(np.sqrt(np.mean(np.square(_turned(measured, replayed)))))}

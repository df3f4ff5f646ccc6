"""Thin logs: parameters that a log cannot determine keep their value; logs that determine nothing are refused."""

from __future__ import annotations

from collections.abc import Sequence
from fnmatch import fnmatchcase

from sysid.errors.features import check_length
from sysid.errors.space import Space
from sysid.logs.records import Log, Trial
from whill_mjx.vehicle.specs import WHILL_CR, VehicleSpec

LEAST_SECONDS = 2.0  # s of commanded motion that a log must have
TURNS, DRIVES = 0.1, 0.05  # rad/s and m/s of commands below which nothing turns or drives: the latter of the chair
UNSEEN = "the log cannot show it"  # begins the reason for which a parameter keeps its value

HIDDEN = {
    "no outside pose": ("slip_traction.*", "axle_pivot.*", "lateral_damping.*", "geom.*.friction"),
    "no turn": ("body.yaw_inertia", "body.com_y", "yaw_scrub.*", "lateral_damping.*", "axle_pivot.*",
                "slip_traction.side_slip_speed", "slip_traction.mu_free", "track_width.*", "wheels.track",
                "body.*.inertia"),
    "no straight motion": ("rolling_resistance.*", "slip_traction.slip_speed", "suspension.*", "body.com_x",
                           "body.com_z"),
}  # cause -> parameters that it hides, as patterns: of the simulator's vehicle and of robot files
REMEDIES = {"no outside pose": "log motion capture, lidar or RTK", "no turn": "turn on the spot and drive circles",
            "no straight motion": "drive straight at two speeds"}


def drives_from(spec: VehicleSpec) -> float:
    """Least speed of commands that drive a vehicle [m/s]: a small robot's wheels turn as quickly at less."""
    return DRIVES * min(spec.wheel_radius / WHILL_CR.wheel_radius, 1.0)


def causes(trials: Sequence[Trial], least: float = DRIVES) -> list[str]:
    """Which of `HIDDEN` hold for the training trials; `least`: speed of commands that drive [m/s]."""
    holds = {"no outside pose": all(trial.ground_truth is None for trial in trials),
             "no turn": not any((abs(trial.command.omega) > TURNS).any() for trial in trials),
             "no straight motion": not any((abs(trial.command.v) > least).any() for trial in trials)}
    return [cause for cause, true in holds.items() if true]


def check_moves(log: Log) -> None:
    """Refuse a log of which no training trial is commanded to move for a while, or lasts: it determines nothing."""
    seconds, least = 0.0, drives_from(log.spec)
    for trial in log.training:
        command = trial.command
        moving = (abs(command.v) > least) | (abs(command.omega) > TURNS)
        ends = [*command.t[1:], max(trial.duration, float(command.t[-1]))]
        seconds += float(sum(max(end - begin, 0.0) for begin, end, one in zip(
            command.t, ends, moving, strict=True) if one))
    if log.training and seconds < LEAST_SECONDS:
        raise ValueError(f"log {log.name!r}: its training trials are commanded to move for {seconds:.1f} s in all, "
                         f"which determines nothing: commands below {least:.2g} m/s and {TURNS:g} rad/s do not count. "
                         "Record longer drives; sysid.inspect says which.")
    if log.training:
        check_length(log.name, log.training)


def without_hidden(space: Space, log: Log, asked: Sequence[str] = ()) -> Space:
    """The space without parameters that the log cannot show, but for those that were asked for by name."""
    for cause in causes(log.training, drives_from(log.spec)):
        for name in space.names:
            if name not in asked and any(fnmatchcase(name, pattern) for pattern in HIDDEN[cause]):
                space = space.without(name, f"{UNSEEN}: {cause}")
    return space


def notes(space: Space) -> list[str]:
    """Sentences on what is not fitted since the log cannot show it."""
    found = []
    for cause, remedy in REMEDIES.items():
        names = [name for name, reason in space.fixed if reason == f"{UNSEEN}: {cause}"]
        if names:
            found.append(f"not fitted, since the log has {cause}: {', '.join(names)}. To determine them, {remedy}")
    return found

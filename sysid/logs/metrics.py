"""Errors between a simulated and a measured trial: the paper's four numbers, per channel.

Frames: the simulation starts at the measured start pose in the room frame, which comes from the standstill second alone
(`sysid.logs.log.make_trial`); nothing else is aligned. Odometry counts from that start. Odometry and outside pose
are scored apart: a vehicle whose wheels slip has two different motions.
"""

from __future__ import annotations

import numpy as np

from sysid.logs.records import Command, OdometryStream, PoseStream, Prediction, Start, Trial, logged_pose, manoeuvre_of
from sysid.logs.replicates import same_course, shifts

METRICS = ("trajectory", "velocity", "angular_velocity", "yaw")
UNITS = {"trajectory": "m", "velocity": "m/s", "angular_velocity": "rad/s", "yaw": "rad"}
CHANNELS = ("ground_truth", "odometry")


def rmse(error: np.ndarray) -> float:
    """Root mean square of (T,)."""
    return float(np.sqrt(np.mean(np.square(error))))


def errors_of(trial: Trial, prediction: Prediction) -> dict[str, dict[str, tuple[np.ndarray, np.ndarray]]]:
    """channel -> metric -> times (T,) [s] and errors (T,) of what was measured."""
    found: dict[str, dict[str, tuple[np.ndarray, np.ndarray]]] = {}
    for channel in CHANNELS:
        measured, simulated = getattr(trial, channel), getattr(prediction, channel)
        if measured is None or simulated is None:
            continue
        mine = {}
        if logged_pose(measured) is not None:
            mine["trajectory"] = measured.t, np.hypot(simulated.x - measured.x, simulated.y - measured.y)
            mine["yaw"] = measured.t, simulated.yaw - measured.yaw
        if channel == "odometry":
            mine["velocity"] = measured.t, simulated.v - measured.v
            mine["angular_velocity"] = measured.t, simulated.omega - measured.omega
        found[channel] = mine
    return found


def score(trial: Trial, prediction: Prediction) -> dict[str, dict[str, float | None]]:
    """channel ("ground_truth", "odometry") -> metric -> root mean square error; None where it was not measured."""
    return {channel: {metric: rmse(mine[metric][1]) if metric in mine else None for metric in METRICS}
            for channel, mine in errors_of(trial, prediction).items()}


def ideal_replay(trial: Trial) -> Prediction:
    """What a vehicle would do that follows its commands at once and without slip: the baseline of every table."""
    truth = odometry = None
    if trial.ground_truth is not None:
        x, y, yaw = integrate(trial.command, trial.start, trial.ground_truth.t)
        truth = PoseStream(trial.ground_truth.t, x, y, yaw)
    if trial.odometry is not None:
        t = trial.odometry.t
        x, y, yaw = integrate(trial.command, Start(), t)
        odometry = OdometryStream(t, x, y, yaw, *trial.commanded(t))
    return Prediction(truth, odometry)


def integrate(command: Command, start: Start, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Exact pose (x, y, yaw) at times t of a unicycle that obeys each command at once, from `start` at 0."""
    times = np.concatenate([[0.0], np.maximum(command.t, 0.0)])
    v = np.concatenate([[start.v], command.v])
    omega = np.concatenate([[start.omega], command.omega])
    hold = np.diff(times)
    yaw = start.yaw + np.concatenate([[0.0], np.cumsum(omega[:-1] * hold)])
    dx, dy = _arc(v[:-1], omega[:-1], yaw[:-1], hold)
    x = start.x + np.concatenate([[0.0], np.cumsum(dx)])
    y = start.y + np.concatenate([[0.0], np.cumsum(dy)])
    k = np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(times) - 1)
    rest = np.maximum(t - times[k], 0.0)
    dx, dy = _arc(v[k], omega[k], yaw[k], rest)
    return x[k] + dx, y[k] + dy, yaw[k] + omega[k] * rest


def replicate_groups(trials: tuple[Trial, ...]) -> list[list[Trial]]:
    """Trials that are true replicates: of one manoeuvre with the same commands after its first motion, two at least."""
    numbered = [trial for trial in trials if trial.name != trial.manoeuvre == manoeuvre_of(trial.name)]
    return [[numbered[i] for i in group] for group in same_course(numbered) if len(group) > 1]


def replicate_noise(trials: tuple[Trial, ...]) -> dict[str, np.ndarray] | None:
    """Pooled standard deviation between replicates, which no model of the mean motion can beat; None without any.

    "ground_truth" (3,) of x, y [m], yaw [rad] and "odometry" (5,) of x, y, yaw, v, omega, in the frame of each trial's
    start; channels without data are nan.
    """
    groups = replicate_groups(trials)
    if not groups:
        return None
    sums = {"ground_truth": np.zeros(3), "odometry": np.zeros(5)}
    counts = {"ground_truth": 0.0, "odometry": 0.0}
    for group in groups:
        for channel in CHANNELS:
            known = [(stream.t - shift, stream.values) for trial, shift in zip(group, shifts(group), strict=True)
                     if (stream := _from_start(trial, channel)) is not None]
            if len(known) < len(group):
                continue
            begin, end = max(t[0] for t, _ in known), min(t[-1] for t, _ in known)
            t = known[0][0][(known[0][0] >= begin) & (known[0][0] <= end)]
            values = np.stack([np.stack([np.interp(t, time, column) for column in table.T], axis=-1)
                               for time, table in known])
            sums[channel] += values.var(axis=0, ddof=1).sum(axis=0)
            counts[channel] += len(t)
    return {channel: np.sqrt(sums[channel] / counts[channel]) if counts[channel]
            else np.full(len(sums[channel]), np.nan) for channel in CHANNELS}


def noise_floor(trials: tuple[Trial, ...]) -> dict[str, dict[str, float | None]] | None:
    """The four errors that a perfect model of the mean motion would still have, per channel, from replicates."""
    noise = replicate_noise(trials)
    if noise is None:
        return None

    floor = {}
    for channel in CHANNELS:
        x, y, yaw, v, omega = [*noise[channel], np.nan, np.nan][:5]
        values = zip(METRICS, (np.hypot(x, y), v, omega, yaw), strict=True)
        floor[channel] = {metric: float(value) if np.isfinite(value) else None for metric, value in values}
    return floor


def own_floor(trials: tuple[Trial, ...], held_out: bool) -> dict[str, dict[str, float | None]]:
    """channel -> metric -> mean over the training or held-out trials of what replicates of each differ by, if any.

    Replicates count whichever part they are in: drives that turn a lot differ by far more than others.
    """
    manoeuvres = [one.manoeuvre for one in trials if one.held_out is held_out]
    each = {name: noise_floor(tuple(one for one in trials if one.manoeuvre == name)) for name in set(manoeuvres)}
    floors = [floor for name in manoeuvres if (floor := each[name])]
    out: dict[str, dict[str, float | None]] = {}
    for channel in floors[0] if floors else ():
        out[channel] = {}
        for metric in floors[0][channel]:
            values = [value for floor in floors if (value := floor[channel][metric]) is not None]
            out[channel][metric] = float(np.mean(values)) if values else None
    return out


def _from_start(trial: Trial, channel: str) -> PoseStream | OdometryStream | None:
    """A stream whose poses are in the frame of the trial's start, as those of the odometry are."""
    start, pose = trial.start, trial.ground_truth
    if channel == "odometry" or pose is None:
        return getattr(trial, channel)
    return pose.seen_from(start.x, start.y, start.yaw)


def _arc(v: np.ndarray, omega: np.ndarray, yaw: np.ndarray, dt: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Displacement of constant v and omega over dt: a chord of length v dt sinc(omega dt / 2) at the mean heading."""
    chord = v * dt * np.sinc(omega * dt / (2 * np.pi))
    return chord * np.cos(yaw + omega * dt / 2), chord * np.sin(yaw + omega * dt / 2)

"""The time step at which the peers' chair (`benchmarks.plant.chair`) is as exact as ours: `benchmarks.physics`.

A figure-eight by C MuJoCo in float64, whose model and integrator `mjx` and MuJoCo Warp share: wheel-speed control
sampled every `TICK` at all steps, the torques held in between, so that only the contact dynamics differ. Largest
difference from a drive with steps eight times smaller, at every tick, over the whole drive.

The commands of our own test end in a stop that the tyres cannot follow: they skid, and skidding contacts chatter. So a
second drive has the same commands behind the maker's ramp of 1.7 m/s^2, in which no tyre skids.
"""

from __future__ import annotations

import json
import math
from typing import Any

import mujoco
import numpy as np

from benchmarks.harness import RESULTS, figure
from benchmarks.plant.chair import TIMESTEP, Chair, Nominal, build
from whill_mjx.logs.manoeuvres import command_table

STEPS = (0.008, 0.004, 0.002, 0.001, 0.0005)  # s
TICK = 0.008  # s, of the wheel-speed control: a multiple of every step
RAMP = (1.7, 2 * 1.7 / Nominal.track)  # m/s^2, rad/s^2
DRIVES = {"": False, "_ramped": True}
WITHIN = 2.0  # mm and mrad


def commands(ramped: bool) -> np.ndarray:
    """The figure-eight (T, 3) t, v, omega; `ramped` at no more than RAMP."""
    table = np.array(command_table("figure_eight"))
    if ramped:
        largest = np.array(RAMP) * (table[1, 0] - table[0, 0])
        for before, row in zip(table, table[1:], strict=False):
            row[1:] = before[1:] + np.clip(row[1:] - before[1:], -largest, largest)
    return table


def drive(dt: float, table: np.ndarray) -> np.ndarray:
    """x, y [m], yaw [rad] and the speeds of both wheels' rims [m/s] (K, 5) at every tick, with steps of dt [s]."""
    chair = Chair()
    model = build(chair)
    model.opt.timestep = dt
    data = mujoco.MjData(model)
    wheels = [int(model.joint(f"wheel_{side}").dofadr[0]) for side in ("left", "right")]
    for _ in range(round(1.0 / dt)):
        data.qfrc_applied[wheels] = -20.0 * data.qvel[wheels]  # brakes on
        mujoco.mj_step(model, data)
    data.qpos[:2], data.qvel[:] = 0.0, 0.0
    half, integral, rows = Nominal.track / 2, np.zeros(2), []
    for time in np.arange(round(table[-1, 0] / TICK)) * TICK:
        _, v, omega = table[np.searchsorted(table[:, 0], time + 1e-9, side="right") - 1]
        error = np.array([v - half * omega, v + half * omega]) / Nominal.radius - data.qvel[wheels]
        integral += error * TICK
        torque = chair.kp * error + chair.ki * integral
        data.qfrc_applied[wheels] = np.clip(torque, -chair.torque_limit, chair.torque_limit)
        mujoco.mj_step(model, data, round(TICK / dt))
        w, x, y, z = data.qpos[3:7]
        yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2))
        rows.append([*data.qpos[:2], yaw, *(Nominal.radius * data.qvel[wheels])])
    return np.array(rows)


def step_errors(steps: tuple[float, ...] = STEPS, ramped: bool = False) -> dict[float, tuple[float, float, float]]:
    """Largest differences from steps eight times smaller: position [mm], heading [mrad], rim speed [mm/s]."""
    table = commands(ramped)
    driven = {dt: drive(dt, table) for dt in {*steps, *(dt / 8 for dt in steps)}}
    errors: dict[float, tuple[float, float, float]] = {}
    for dt in steps:
        coarse, fine = driven[dt], driven[dt / 8]
        position = np.hypot(*(coarse[:, :2] - fine[:, :2]).T).max()
        turn = np.abs(np.unwrap(coarse[:, 2]) - np.unwrap(fine[:, 2])).max()
        rim = np.abs(coarse[:, 3:] - fine[:, 3:]).max()
        errors[dt] = 1e3 * float(position), 1e3 * float(turn), 1e3 * float(rim)
    return errors


def measure_steps(steps: tuple[float, ...] = STEPS) -> dict[str, dict[str, Any]]:
    """Figures: the error of every step, and the largest step that is within 2 mm and 2 mrad, if there is one."""
    figures = {}
    for ending, ramped in DRIVES.items():
        errors = step_errors(steps, ramped)
        for dt, (position, turn, rim) in errors.items():
            print(f"contact chair{ending} dt {dt * 1e3:g} ms: {position:.2f} mm, {turn:.2f} mrad, {rim:.1f} mm/s")
            entry = {**figure([position], "mm"), "yaw_mrad": turn, "rim_mm_per_s": rim}
            figures[f"peer_figure_eight_error_dt_{dt * 1e3:g}ms{ending}"] = entry
        within = [dt for dt, (position, turn, _) in errors.items() if position <= WITHIN and turn <= WITHIN]
        if within:
            figures[f"peer_largest_dt_within_2mm_2mrad{ending}"] = figure([max(within)], "s")
    return figures


def equal_error_steps() -> dict[str, float]:
    """Recorded largest step [s] of either drive by the ending of its figures; the chair's own step before a record."""
    path = RESULTS / "physics.json"
    known = json.loads(path.read_text())["figures"] if path.exists() else {}
    names = {ending: f"peer_largest_dt_within_2mm_2mrad{ending}" for ending in DRIVES}
    return {ending: known[name]["value"] if name in known else TIMESTEP for ending, name in names.items()}

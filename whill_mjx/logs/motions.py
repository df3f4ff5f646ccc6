"""Motions of a simulated vehicle along command tables, and what sensors report of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from whill_mjx.logs.dataset import (
    COMMAND_HEADER,
    Noise,
    write_csv,
    write_encoder,
    write_ground_truth,
    write_imu,
    write_odometry,
)
from whill_mjx.logs.simulated_sensors import Sensors, seen, times
from whill_mjx.vehicle.config import VehicleConfig
from whill_mjx.vehicle.dynamics import place, substep
from whill_mjx.vehicle.kinematics import reference_pose
from whill_mjx.vehicle.model import build_model
from whill_mjx.vehicle.specs import VehicleSpec
from whill_mjx.vehicle.types import VehicleParams, VehicleState

MEASUREMENT_DT = 0.05  # s


def write_streams(
    folder: Path, command: np.ndarray, motion: dict[str, np.ndarray], sensors: Sensors, noise: Noise
) -> None:
    """Write the streams of one trial: its commands, and what each sensor reports of the motion (T, C) it sees."""
    write_csv(folder / "command.csv", COMMAND_HEADER, command)
    duration, dt = float(command[-1, 0]), VehicleConfig().physics_dt

    def sampled(sensor: str) -> tuple[np.ndarray, np.ndarray]:
        t = times(duration, getattr(sensors, f"{sensor}_rate"))
        return t, seen(t, getattr(sensors, f"{sensor}_latency"), dt, motion[sensor])

    if sensors.ground_truth_rate:
        write_ground_truth(folder, *sampled("ground_truth"), noise)
    if sensors.odometry_rate:
        write_odometry(folder, *sampled("odometry"), noise)
    if sensors.imu_rate:
        write_imu(folder, *sampled("imu"), noise)
    if sensors.encoder_rate:
        t, angles = sampled("encoder")
        write_encoder(folder, t, sensors.encoder_latency, angles, noise)


def record_motion(
    spec: VehicleSpec, params: VehicleParams, commands: Sequence[np.ndarray], starts: Sequence[Sequence[float]]
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Drive B command tables (T, 3) from B starts (x [m], y [m], yaw [rad]) at rest, all in one compiled call.

    Returns:
        What each sensor sees at every physics step from t = 0 to the end of the longest: "ground_truth" (B, T, 3)
        pose of the reference point, yaw unwrapped; "odometry" (B, T, 5); "imu" (B, T, 1) gyro [rad/s]; "encoder"
        (B, T, 2) angles of the driven wheels [rad]; and (B,) bool where the motion became non-finite.
    """
    config = VehicleConfig()
    model = build_model(spec, config)
    stride = round(MEASUREMENT_DT / config.physics_dt)
    duration = max(float(command[-1, 0]) for command in commands)
    t = (np.arange(math.ceil(duration / MEASUREMENT_DT) * stride) + 0.5) * config.physics_dt
    held = [command[np.searchsorted(command[:, 0], t, side="right") - 1, 1:] for command in commands]

    def observe(state: VehicleState) -> dict[str, jax.Array]:
        odometry = state.odometry
        reported = (odometry.x, odometry.y, odometry.yaw, odometry.v, odometry.omega)
        return {
            "ground_truth": jnp.stack(reference_pose(model, state.qpos)),
            "odometry": jnp.stack(reported),
            "imu": jnp.stack([jnp.asarray(odometry.gyro)]),
            "encoder": state.qpos[7:9],
        }

    def one(command: jax.Array, start: jax.Array) -> tuple[dict[str, jax.Array], jax.Array]:
        def physics(state: VehicleState, command: jax.Array) -> tuple[VehicleState, dict[str, jax.Array]]:
            state = substep(model, params, state, command)
            return state, observe(state)

        first = place(model, params, *start)
        last, rest = jax.lax.scan(physics, first, command)
        return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), observe(first), rest), last.diverged

    dtype = jnp.result_type(float)
    driven, begun = jnp.asarray(np.stack(held), dtype), jnp.asarray(np.asarray(starts), dtype)
    motion, diverged = jax.jit(jax.vmap(one))(driven, begun)
    motion = {sensor: np.array(table, float) for sensor, table in motion.items()}
    motion["ground_truth"][:, :, 2] = np.unwrap(motion["ground_truth"][:, :, 2], axis=1)
    return motion, np.asarray(diverged)

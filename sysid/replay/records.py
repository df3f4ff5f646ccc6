"""What a replay takes and gives: a plant, a batch of trials, measurements, and simulated records."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from flax import struct

RECORD_DT = 0.01  # s between recorded states: speeds that pass a low-pass of 40 ms bend by 1 mm/s between them
POSE, ODOMETRY = slice(0, 3), slice(3, 8)  # of what `Plant.observe` returns
TURN = slice(9, 10)  # of a path with what a gyro turns
SPEEDS = slice(6, 8)
YAW_COLUMNS = (2, 5)


@dataclass(frozen=True)
class Host:
    """A model that the host steps by itself, and what is traced around it."""

    place: Callable[[Any, jax.Array], Any]  # (params, start (5,)) -> state of the bare model
    commands: Callable[[Any, jax.Array], jax.Array]
    """(params, commands (S, 2)) -> the same behind the effects on commands."""
    drive: Callable[[dict[str, np.ndarray], Any, np.ndarray, int, np.ndarray], np.ndarray]
    """(values (N,) by name, states (N, B), commands (N, B, W + S, 2), warm-up steps W, starts (N, B, 3)) ->
    (N, B, S, 6) x, y, yaw, v, omega, and 1 from where it diverged, after each step."""
    recorded: Plant  # A plant whose commands are what was observed


@dataclass(frozen=True)
class Plant:
    """A vehicle as pure functions of one instance."""

    place: Callable[[Any, jax.Array], Any]  # (params, start (5,) x, y, yaw, v, omega) -> state
    substep: Callable[[Any, Any, jax.Array], Any]  # (params, state, command (2,)) -> state after one physics step
    observe: Callable[[Any], jax.Array]
    """state -> (9,): x, y, yaw of the reference point; x, y, yaw, v, omega of the odometry; 1 if it diverged."""
    dt: float  # physics step [s]
    move: Callable[[Any, jax.Array], Any]
    """(state, start (5,)) -> the same motion at the start's pose, with the odometry at its origin."""
    substeps: Callable[[Any, Any, jax.Array], Any] | None = None
    """(params, state, commands (K, 2)) -> state after K physics steps, where there is a quicker way than one by one."""
    record: Callable[[Any, Any, jax.Array], jax.Array] | None = None
    """(params, state, commands (R, K, 2)) -> observed (R, 9) after each K physics steps, if there is a quicker way."""
    frame: float | None = None
    """Time between frames of the odometry [s], if known: speeds are means over it, low-passed once a frame."""
    host: Host | None = None  # where the host steps it more quickly
    arithmetic: bool = False
    """Whether its steps are arithmetic on single numbers, without products of matrices or solvers."""


@dataclass(frozen=True)
class FreeVehicle:
    """A vehicle of which some parameters are free."""

    plant: Plant
    params: Any
    names: tuple[str, ...]  # of the free ones


@struct.dataclass
class Batch:
    """Trials on a common grid; B trials, R records of K physics steps, M measurements (padded)."""

    command: jax.Array  # (B, R, K, 2) m/s, rad/s
    start: jax.Array  # (B, 5) x, y, yaw, v, omega
    pose_index: jax.Array  # (B, M) int, record before each pose measurement
    pose_weight: jax.Array  # (B, M) share of the record after it
    odometry_index: jax.Array  # (B, L)
    odometry_weight: jax.Array  # (B, L)
    gyro_index: jax.Array | None = None  # (B, G); None where no trial has a gyro
    gyro_weight: jax.Array | None = None  # (B, G)
    warm_up: int = struct.field(pytree_node=False, default=0)
    """Physics steps at the start's speeds before the trial; 0 where all trials start at rest."""
    speeds: jax.Array | None = None  # (B, W, 2) m/s, rad/s where W pieces of drives begin (`sysid.replay.pieces`)


@dataclass(frozen=True)
class Measured:
    """The measurements of a batch (host arrays); masked samples are 0."""

    pose: np.ndarray  # (B, M, 3)
    pose_mask: np.ndarray  # (B, M, 3)
    odometry: np.ndarray  # (B, L, 5)
    odometry_mask: np.ndarray  # (B, L, 5)
    gyro: np.ndarray | None = None  # (B, G, 1) rad turned since the first sample; None where no trial has a gyro
    gyro_mask: np.ndarray | None = None  # (B, G, 1)
    gyro_t: np.ndarray | None = None  # (B, G) s


@struct.dataclass
class Simulated:
    """Simulated values at the measurements' times."""

    pose: jax.Array  # (B, M, 3)
    odometry: jax.Array  # (B, L, 5)
    diverged: jax.Array  # (B,) above 0.5 where the state became non-finite
    gyro: jax.Array | None = None  # (B, G, 1) rad that a gyro turned, up to a constant

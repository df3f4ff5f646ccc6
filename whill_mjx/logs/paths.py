"""Where a vehicle may drive under a command table: the paths of a fitted vehicle, as surely as its fit knows it.

    python -m whill_mjx.logs.paths COMMANDS.csv VEHICLE.toml --out paths.csv

One path is that of the vehicle file; the others have parameters drawn from the file's 90 % intervals, and each a start
heading of its own, because slopes and winds of the room push to where the vehicle happens to face. `bridge.manoeuvre`
calls this before anything moves.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from whill_mjx.io.command_line import COUNT, SEED, listen, refusing, run, starts

if starts(__name__):
    listen()

import jax
import jax.numpy as jnp
import numpy as np

from whill_mjx.io.fields import COLUMNS
from whill_mjx.io.folders import check_file, note_written
from whill_mjx.io.reading import read_csv
from whill_mjx.logs.dataset import write_csv
from whill_mjx.vehicle.config import VehicleConfig
from whill_mjx.vehicle.dynamics import place, substep
from whill_mjx.vehicle.kinematics import reference_pose
from whill_mjx.vehicle.model import build_model
from whill_mjx.vehicle.parameters import describe, get_values, set_values
from whill_mjx.vehicle.specs import VehicleSpec
from whill_mjx.vehicle.types import VehicleParams
from whill_mjx.vehicle.vehicle_file import load_intervals, load_vehicle

PERIOD = 0.05
"""Seconds between two rows of a path."""
NINETY = 1.645
"""Standard deviations from the middle to an end of a 90 % interval."""
FARTHEST = 2.5
"""Standard deviations that a draw is from the value at most."""
HEADER = "path,t,x,y,yaw"


@dataclass(frozen=True)
class PathOptions:
    """Options of the command."""

    commands: Path
    """CSV file with the columns t [s], v [m/s], omega [rad/s]; each row holds until the next."""
    vehicle: str
    """Vehicle file, or the name of a built-in vehicle (one path only)."""
    out: Path = Path("paths.csv")
    """File to write: path, t [s], x, y [m], yaw [rad], from the start."""
    count: Annotated[int, COUNT] = 64
    """Paths, that of the file's own values among them."""
    seed: Annotated[int, SEED] = 0
    """Of the draws."""


def draw_values(
    params: VehicleParams, intervals: Mapping[str, tuple[float, float]], count: int, seed: int = 0
) -> tuple[tuple[str, ...], np.ndarray]:
    """Names (K) of the parameters that have an interval, and values (N, K) as surely as the intervals know them.

    The first row is the vehicle's own. The others are normal, with the interval as the middle 90 %, each side with its
    own width, and lie within what the parameter can be.
    """
    known = describe(params)
    names = tuple(name for name in intervals if name in known)
    middle = np.asarray(get_values(params, names), float) if names else np.zeros(0)
    ends = np.array([intervals[name] for name in names], float).reshape(len(names), 2)
    drawn = np.random.default_rng(seed).standard_normal((count, len(names))).clip(-FARTHEST, FARTHEST) / NINETY
    drawn[0] = 0.0
    below, above = np.maximum(middle - ends[:, 0], 0.0), np.maximum(ends[:, 1] - middle, 0.0)
    values = middle + drawn * np.where(drawn < 0, below, above)
    low = np.array([known[name].low for name in names])
    high = np.array([known[name].high for name in names])
    inside = np.clip(values, low, high)
    return names, np.where(drawn == 0, middle, inside)


def simulate_paths(
    spec: VehicleSpec, params: VehicleParams, names: tuple[str, ...], values: np.ndarray, table: np.ndarray,
    seed: int = 0,
) -> np.ndarray:  # fmt: skip
    """Paths (N, T, 4) t [s], x, y [m], yaw [rad] of vehicles with such values (N, K), seen from their starts.

    Args:
        spec, params: the vehicle.
        names: (K) of the parameters.
        values: (N, K).
        table: (M, 3) t [s], v [m/s], omega [rad/s], from rest.
        seed: of the start headings; the first path starts at 0.

    Raises:
        ValueError: the motion of one became non-finite.
    """
    config = VehicleConfig()
    model = build_model(spec, config)
    stride = round(PERIOD / config.physics_dt)
    count = int(np.ceil((table[-1, 0] - table[0, 0]) / PERIOD)) + 1
    t = table[0, 0] + (np.arange(count * stride) + 0.5) * config.physics_dt
    held = table[np.maximum(np.searchsorted(table[:, 0], t, side="right") - 1, 0), 1:].reshape(count, stride, 2)
    headings = np.random.default_rng([seed, 1]).uniform(-np.pi, np.pi, len(values))
    headings[0] = 0.0

    def one(values: jax.Array, heading: jax.Array, commands: jax.Array) -> tuple[jax.Array, jax.Array]:
        vehicle = set_values(params, names, values) if names else params

        def period(state, commands):
            state = jax.lax.fori_loop(0, stride, lambda i, s: substep(model, vehicle, s, commands[i]), state)
            return state, jnp.stack(reference_pose(model, state.qpos))

        first = place(model, vehicle, 0.0, 0.0, heading)
        last, poses = jax.lax.scan(period, first, commands)
        return jnp.concatenate([jnp.stack(reference_pose(model, first.qpos))[None], poses]), last.diverged

    dtype = jnp.result_type(float)
    poses, diverged = jax.jit(jax.vmap(one, in_axes=(0, 0, None)))(
        jnp.asarray(values, dtype), jnp.asarray(headings, dtype), jnp.asarray(held, dtype))
    if np.asarray(diverged).any():
        raise ValueError(f"the motion of {int(np.asarray(diverged).sum())} of {len(values)} drawn vehicles became "
                         "non-finite. Fit the vehicle again, or drive more slowly.")
    poses = np.array(poses, float)
    cos, sin = np.cos(headings)[:, None], np.sin(headings)[:, None]
    x, y = poses[..., 0] - poses[:, :1, 0], poses[..., 1] - poses[:, :1, 1]
    yaw = np.unwrap(poses[..., 2], axis=1)
    times = np.broadcast_to(np.arange(count + 1) * PERIOD, yaw.shape)
    return np.stack([times, cos * x + sin * y, cos * y - sin * x, yaw - headings[:, None]], axis=-1)


def read_table(path: Path) -> np.ndarray:
    """Rows (M, 3) of a command file.

    Raises:
        FileNotFoundError, ValueError: it is none.
    """
    columns = read_csv(path, [COLUMNS[name] for name in ("t", "v", "omega")], "no such command file.")
    table = np.column_stack([columns[name] for name in ("t", "v", "omega")])
    if not (np.diff(table[:, 0]) > 0).all():
        raise ValueError(f"{path}: t does not increase from row to row. Sort the rows.")
    return table


def main(options: PathOptions) -> None:
    """Simulate and write the paths."""
    with refusing():
        check_file("--out", options.out)
        table = read_table(options.commands)
        spec, params, _ = load_vehicle(options.vehicle)
        intervals = load_intervals(options.vehicle) if options.vehicle.endswith(".toml") else {}
        names, values = draw_values(params, intervals, options.count, options.seed)
        if not names:
            values = values[:1]
    paths = simulate_paths(spec, params, names, values, table, options.seed)
    numbers = np.repeat(np.arange(len(paths)), paths.shape[1])
    write_csv(options.out, HEADER, np.column_stack([numbers, paths.reshape(-1, 4)]))
    note_written(options.out)
    print(f"{options.out}: {len(paths)} paths, {len(names)} parameters drawn")


if __name__ == "__main__":
    run(PathOptions, main, __doc__)

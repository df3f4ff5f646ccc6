"""A vehicle as one stand-alone Python file: its step, with all its effects, in numpy alone."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from whill_mjx import __version__
from whill_mjx.export.numpy_lines import HELPERS, lines_of, literal
from whill_mjx.vehicle.config import VehicleConfig
from whill_mjx.vehicle.dynamics import place, substep
from whill_mjx.vehicle.kinematics import reference_pose
from whill_mjx.vehicle.model import build_model
from whill_mjx.vehicle.parameters import describe, get_values
from whill_mjx.vehicle.specs import VehicleSpec
from whill_mjx.vehicle.types import VehicleParams, VehicleState


def vehicle_source(spec: VehicleSpec, params: VehicleParams, physics_dt: float = 0.005) -> str:
    """Python source of a vehicle, for numpy alone.

    Args:
        spec: geometry and limits.
        params: physical parameters and effects; effects of the outside pose are sensors of others and left out.
        physics_dt: time of one step [s]; part of the vehicle, since its controller counts steps.

    Raises:
        ValueError: an effect computes with an operation that has no counterpart in numpy.
    """
    with jax.enable_x64(True):
        params = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), params)
        model = build_model(spec, VehicleConfig(control_dt=physics_dt, physics_dt=physics_dt))
        like = place(model, params, 0.0, 0.0, 0.0)
        names, kinds = state_names(like, [effect.name for effect in params.effects])

        def stepped(*given: jax.Array) -> list[jax.Array]:
            state = _from_numbers(like, given[:-2])
            return _to_numbers(substep(model, params, state, jnp.stack(given[-2:])))

        def placed(x: jax.Array, y: jax.Array, yaw: jax.Array, v: jax.Array, omega: jax.Array) -> list[jax.Array]:
            return _to_numbers(place(model, params, x, y, yaw, (v, omega)))

        def posed(*given: jax.Array) -> list[jax.Array]:
            return list(reference_pose(model, _from_numbers(like, given).qpos))

        numbers = [np.zeros((), kind)[()] for kind in kinds]
        zero = np.float64(0)
        step_lines, after = lines_of(stepped, [*numbers, zero, zero], [*map(_key, names), "v", "omega"])
        start_lines, first = lines_of(placed, [zero] * 5, ["x", "y", "yaw", "v", "omega"])
        pose_lines, pose = lines_of(posed, numbers, list(map(_key, names)))
    values = get_values(params, list(describe(params)))
    about = {name: (float(value), described.unit)
             for (name, described), value in zip(describe(params).items(), np.asarray(values), strict=True)}
    effects = [effect.name for effect in params.effects]
    return "\n".join([
        _head(spec, effects, physics_dt, about), HELPERS, "",
        *_start_function(names, kinds, start_lines, first), "", "",
        *_step_function(names, step_lines, after), "", "",
        *_pose_function(pose_lines, pose), "", "",
        "def odometry(state):",
        '    """What the vehicle reports: x, y [m], yaw [rad], v [m/s], omega [rad/s] and gyro [rad/s], each (N,)."""',
        '    return tuple(state["odometry." + name] for name in ("x", "y", "yaw", "v", "omega", "gyro"))', "",
    ])


def state_names(state: VehicleState, effects: Sequence[str]) -> tuple[list[str], list[np.dtype]]:
    """Name and type of every number of a state, in the order of its leaves."""
    names, kinds = [], []
    for path, leaf in jax.tree_util.tree_flatten_with_path(state)[0]:
        parts = [getattr(key, "name", getattr(key, "idx", None)) for key in path]
        if parts[0] == "memory":
            parts = [effects[int(str(parts[1]))], *parts[2:]]
        base = ".".join(str(part) for part in parts)
        names += [base] if leaf.ndim == 0 else [f"{base}.{k}" for k in range(leaf.size)]
        kinds += [np.dtype(leaf.dtype)] * leaf.size
    return names, kinds


def _from_numbers(like: VehicleState, numbers: Sequence[jax.Array]) -> VehicleState:
    """The state of these numbers, shaped as another."""
    remaining = iter(numbers)

    def leaf(one: jax.Array) -> jax.Array:
        if one.ndim == 0:
            return jnp.asarray(next(remaining))
        values = [next(remaining) for _ in range(one.size)]
        return jnp.stack(values).reshape(one.shape) if values else one

    return jax.tree.map(leaf, like)


def _to_numbers(state: VehicleState) -> list[jax.Array]:
    flat = [jnp.reshape(leaf, (-1,)) for leaf in jax.tree.leaves(state)]
    return [leaf[k] for leaf in flat for k in range(leaf.size)]


def _key(name: str) -> str:
    return f's["{name}"]'


def _head(spec: VehicleSpec, effects: Sequence[str], dt: float, about: dict[str, tuple[float, str]]) -> str:
    table = "\n".join(f"    {name!r}: ({literal(np.asarray(value))}, {unit!r}),"
                      for name, (value, unit) in about.items())
    return f'''"""One physics step of {dt:g} s of a vehicle (NAME below), with its effects, in numpy alone.

    state = start(count=1000)                      # 1000 vehicles at rest at the origin
    for _ in range(200):
        state = step(state, v=0.5, omega=0.3)      # v [m/s], omega [rad/s]; numbers or arrays (N,)
    x, y, yaw = pose(state)                        # each (N,)

A state is a dict of numbers or arrays (N,); `step` returns a new one. Every function takes `xp`, the module that
computes: numpy, or torch, cupy and jax.numpy for arrays of theirs.

Made by `python -m whill_mjx.export_python` (whill-mjx {__version__}) from the simulator itself; do not edit it.
"""

import numpy

NAME = {spec.name!r}
DT = {dt!r}
"""Time of one step [s]."""
EFFECTS = {tuple(effects)!r}
LIMITS = {{"v": ({spec.v_min!r}, {spec.v_max!r}), "omega": ({-spec.omega_max!r}, {spec.omega_max!r})}}
"""Commands are limited to these [m/s], [rad/s]."""
PARAMETERS = {{
{table}
}}
"""Value and unit of each; for reading alone, since the lines below have them in them."""
'''


def _start_function(names: list[str], kinds: list[np.dtype], lines: list[str], results: list[str]) -> list[str]:
    body = ["def start(x=0.0, y=0.0, yaw=0.0, v=0.0, omega=0.0, count=1, xp=numpy):",
            '    """State of vehicles that were never driven, at poses [m, rad], moving at v [m/s] and omega [rad/s].',
            "", "    Each argument is a number or an array (N,); `count` is N where all are numbers.", '    """',
            "    zero = xp.zeros(count) + 0.0 * (x + y + yaw + v + omega)",
            "    x, y, yaw, v, omega = zero + x, zero + y, zero + yaw, zero + v, zero + omega",
            *(f"    {line}" for line in lines), "    return {"]
    for name, kind, result in zip(names, kinds, results, strict=True):
        shaped = {"b": f"(zero != zero) | {result}", "f": f"zero + {result}"}.get(
            kind.kind, f"xp.zeros(zero.shape, dtype=xp.{kind.name}) + {result}")
        body.append(f'        "{name}": {shaped},')
    return [*body, "    }"]


def _step_function(names: list[str], lines: list[str], results: list[str]) -> list[str]:
    return ['@numpy.errstate(all="ignore")', "def step(state, v, omega, xp=numpy):",
            '    """State one step of DT later, under the command v [m/s] and omega [rad/s]: numbers or arrays (N,).',
            "", '    Where the state would not be finite it stays as it is, and `state["diverged"]` becomes true.',
            '    """',
            "    s = state", '    zero = 0.0 * s["qpos.0"]', "    v, omega = zero + v, zero + omega",
            *(f"    {line}" for line in lines), "    return {",
            *(f'        "{name}": {result},' for name, result in zip(names, results, strict=True)), "    }"]


def _pose_function(lines: list[str], results: list[str]) -> list[str]:
    return ["def pose(state, xp=numpy):", '    """True x, y [m] and yaw [rad] of the reference point, each (N,)."""',
            "    s = state", *(f"    {line}" for line in lines), f"    return {', '.join(results)}"]

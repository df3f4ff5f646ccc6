"""Export a vehicle as one stand-alone Python file: its step, with all its effects, in numpy alone.

    python -m whill_mjx.export_python VEHICLE --out vehicle.py

VEHICLE is a vehicle file or a built-in vehicle. The file imports nothing of this project, so it can be copied into
another simulator:

    from vehicle import odometry, pose, start, step

    state = start(count=1000)                      # 1000 vehicles at rest at the origin
    for _ in range(200):
        state = step(state, v=0.5, omega=0.3)      # one physics step; numbers or arrays (N,)
    x, y, yaw = pose(state)                        # each (N,)

Every function takes `xp`, the module that computes: numpy by default, or torch, cupy and jax.numpy for their arrays.

The file is not written by hand. `whill_mjx.vehicle.dynamics.substep` is traced into operations on single numbers, with
the vehicle's parameters as constants, and each operation becomes a line. It therefore does what the simulator does.
"""

from __future__ import annotations

import math
import runpy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from whill_mjx.io.command_line import PHYSICS_DT, OptionError, listen, refusing, run, starts

if starts(__name__):
    listen()

import jax
import jax.numpy as jnp
import numpy as np

from whill_mjx import __version__
from whill_mjx.io.folders import check_file, note_written, write_whole
from whill_mjx.vehicle.config import VehicleConfig
from whill_mjx.vehicle.dynamics import place, substep
from whill_mjx.vehicle.kinematics import reference_pose
from whill_mjx.vehicle.model import build_model
from whill_mjx.vehicle.parameters import describe, get_values
from whill_mjx.vehicle.scalars import MOVES, apart
from whill_mjx.vehicle.specs import VehicleSpec
from whill_mjx.vehicle.types import VehicleParams, VehicleState
from whill_mjx.vehicle.vehicle_file import load_vehicle

OPERATIONS = {
    "abs": "xp.abs({0})", "acos": "xp.arccos({0})", "add": "{0} + {1}", "and": "{0} & {1}", "asin": "xp.arcsin({0})",
    "atan": "xp.arctan({0})", "atan2": "xp.arctan2({0}, {1})", "ceil": "xp.ceil({0})",
    "clamp": "_most(xp, _least(xp, {1}, {2}), {0})", "copy": "{0}", "cos": "xp.cos({0})", "div": "{0} / {1}",
    "eq": "{0} == {1}", "exp": "xp.exp({0})", "expm1": "xp.expm1({0})", "floor": "xp.floor({0})", "ge": "{0} >= {1}",
    "gt": "{0} > {1}", "is_finite": "xp.isfinite({0})", "le": "{0} <= {1}", "log": "xp.log({0})",
    "log1p": "xp.log1p({0})", "logistic": "1.0 / (1.0 + xp.exp(-{0}))", "lt": "{0} < {1}", "max": "_most(xp, {0}, {1})",
    "min": "_least(xp, {0}, {1})", "mul": "{0} * {1}", "ne": "{0} != {1}", "neg": "-{0}", "not": "~{0}",
    "or": "{0} | {1}", "pow": "{0} ** {1}", "round": "xp.round({0})", "rsqrt": "1.0 / xp.sqrt({0})",
    "select_n": "xp.where({0}, {2}, {1})", "shift_left": "{0} << {1}", "shift_right_logical": "{0} >> {1}",
    "sign": "xp.sign({0})", "sin": "xp.sin({0})", "sinh": "xp.sinh({0})", "sqrt": "xp.sqrt({0})", "square": "{0} * {0}",
    "stop_gradient": "{0}", "sub": "{0} - {1}", "tan": "xp.tan({0})", "tanh": "xp.tanh({0})", "xor": "{0} ^ {1}",
}  # fmt: skip
"""Operations of JAX as expressions; all but these are refused."""
CALLS = ("jit", "pjit", "closed_call", "custom_jvp_call", "custom_vjp_call", "remat")
HELPERS = '''
def _most(xp, a, b):
    """The larger one; nan where either is."""
    return xp.where((a > b) | (a != a), a, b)


def _least(xp, a, b):
    """The smaller one; nan where either is."""
    return xp.where((a < b) | (a != a), a, b)
'''


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
        step_lines, after = _lines(stepped, [*numbers, zero, zero], [*map(_key, names), "v", "omega"])
        start_lines, first = _lines(placed, [zero] * 5, ["x", "y", "yaw", "v", "omega"])
        pose_lines, pose = _lines(posed, numbers, list(map(_key, names)))
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


def export(spec: VehicleSpec, params: VehicleParams, out: Path, physics_dt: float = 0.005) -> Path:
    """Write the file, whole or not at all; arguments and errors as of `vehicle_source`."""
    write_whole(out, vehicle_source(spec, params, physics_dt))
    return out


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


def _lines(function: Callable, example: Sequence[Any], inputs: Sequence[str]) -> tuple[list[str], list[str]]:
    """A function of numbers as lines of Python, and the expressions of its results."""
    traced = jax.make_jaxpr(apart(function))(*example)
    values: dict[Any, str] = dict(zip(traced.jaxpr.invars, inputs, strict=True))
    consts = zip(traced.jaxpr.constvars, traced.consts, strict=True)
    values |= {name: _literal(np.asarray(value)) for name, value in consts}
    lines: list[tuple[str, str]] = []
    known: dict[str, str] = {}
    _emit(traced.jaxpr, values, lines, known)
    results = [_read(atom, values) for atom in traced.jaxpr.outvars]
    return _used(lines, results), results


def _read(atom: Any, values: dict[Any, str]) -> str:
    return _literal(np.asarray(atom.val, atom.aval.dtype)) if hasattr(atom, "val") else values[atom]


def _emit(jaxpr: Any, values: dict[Any, str], lines: list[tuple[str, str]], known: dict[str, str]) -> None:
    """Append a line for each operation that is not there yet."""
    whole = [one.primitive.name for one in jaxpr.eqns if any(atom.aval.shape for atom in (*one.invars, *one.outvars))]
    if whole:
        name = next((name for name in whole if name not in MOVES), whole[0])
        raise ValueError(f"the vehicle's step needs the operation {name!r} on whole arrays, which has no form in plain "
                         "numbers. Leave out the effect that uses it.")
    for equation in jaxpr.eqns:
        name, operands = equation.primitive.name, [_read(atom, values) for atom in equation.invars]
        if name in CALLS:
            inner = equation.params.get("jaxpr") or equation.params.get("call_jaxpr")
            inside = dict(zip(inner.jaxpr.invars, operands, strict=True))
            inside |= {v: _literal(np.asarray(c)) for v, c in zip(inner.jaxpr.constvars, inner.consts, strict=True)}
            _emit(inner.jaxpr, inside, lines, known)
            for outer, result in zip(equation.outvars, inner.jaxpr.outvars, strict=True):
                values[outer] = _read(result, inside)
            continue
        text = _expression(equation, operands)
        if all(_is_literal(operand) for operand in operands):
            text = _folded(text, equation.outvars[0].aval.dtype)
        if _is_literal(text) or text in operands:
            values[equation.outvars[0]] = text
            continue
        if text not in known:
            known[text] = f"t{len(known)}"
            lines.append((known[text], text))
        values[equation.outvars[0]] = known[text]


def _expression(equation: Any, operands: list[str]) -> str:
    """One operation as a Python expression of its operands."""
    name, params = equation.primitive.name, equation.params
    if name == "integer_pow":
        return f"{operands[0]} * {operands[0]}" if params["y"] == 2 else f"{operands[0]} ** {params['y']}"
    if name == "convert_element_type":
        before, after = equation.invars[0].aval.dtype.kind, np.dtype(params["new_dtype"]).kind
        if before == after:
            return operands[0]
        if after == "f":
            return f"xp.where({operands[0]}, 1.0, 0.0)" if before == "b" else f"{operands[0]} * 1.0"
        if before == "b":
            kind = np.dtype(params["new_dtype"]).name
            return f"xp.where({operands[0]}, numpy.{kind}(1), numpy.{kind}(0))"
    if name not in OPERATIONS:
        raise ValueError(f"the vehicle's step needs the operation {name!r}, which has no counterpart in numpy. Leave "
                         "out the effect that uses it.")
    return OPERATIONS[name].format(*operands)


def _literal(value: np.ndarray) -> str:
    """A constant () as source; negative ones in brackets."""
    kind, number = value.dtype.kind, value.item()
    if kind == "b":
        return repr(number)
    if kind in "iu":
        return f"numpy.{value.dtype.name}({number})"
    if not math.isfinite(number):
        return f'float("{number}")'
    return f"({number!r})" if number < 0 or math.copysign(1, number) < 0 else repr(number)


def _is_literal(text: str) -> bool:
    return text in ("True", "False") or text.startswith(("numpy.", 'float("')) or (
        text.strip("()-").replace(".", "", 1).replace("e", "", 1).replace("-", "", 1).replace("+", "", 1).isdigit())


def _folded(text: str, dtype: Any) -> str:
    space: dict[str, Any] = {"xp": np, "numpy": np}
    exec(HELPERS, space)
    with np.errstate(all="ignore"):
        return _literal(np.asarray(eval(text, space), dtype))  # an expression of `OPERATIONS` on constants


def _used(lines: list[tuple[str, str]], results: Sequence[str]) -> list[str]:
    """The lines that the results need, in their order."""
    needed, kept = set(results), []
    for name, text in reversed(lines):
        if name in needed:
            kept.append(f"{name} = {text}")
            needed.update(word for word in text.replace("(", " ").replace(")", " ").replace(",", " ").replace("-", " ")
                          .replace("~", " ").split() if word.startswith("t"))
    return kept[::-1]


def _key(name: str) -> str:
    return f's["{name}"]'


def _head(spec: VehicleSpec, effects: Sequence[str], dt: float, about: dict[str, tuple[float, str]]) -> str:
    table = "\n".join(f"    {name!r}: ({_literal(np.asarray(value))}, {unit!r}),"
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


@dataclass(frozen=True)
class Options:
    """Options of the command."""

    vehicle: str
    """Vehicle file, or a built-in vehicle."""
    out: Path = Path("vehicle.py")
    """File to write; an earlier one is replaced."""
    physics_dt: Annotated[float, PHYSICS_DT] = 0.005
    """Physics step [s]; part of the vehicle, since its controller counts steps."""
    check: bool = True
    """Then drive a figure-eight with the file and in the simulator and print how far apart they are."""


def difference(path: Path, spec: VehicleSpec, params: VehicleParams, commands: np.ndarray) -> float:
    """Largest distance [m] between a drive of an exported file and the same drive in the simulator.

    Args:
        commands: (T, 2) v [m/s] and omega [rad/s] in force in each physics step.
    """
    with jax.enable_x64(True):
        space = runpy.run_path(str(path))
        state, driven = space["start"](), []
        for v, omega in commands:
            state = space["step"](state, v, omega)
            driven.append(np.concatenate(space["pose"](state))[:2])
        params = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), params)
        model = build_model(spec, VehicleConfig(control_dt=space["DT"], physics_dt=space["DT"]))

        def one(state: VehicleState, command: jax.Array) -> tuple[VehicleState, jax.Array]:
            state = substep(model, params, state, command)
            return state, jnp.stack(reference_pose(model, state.qpos))[:2]

        first = place(model, params, 0.0, 0.0, 0.0)
        simulated = jax.jit(lambda given: jax.lax.scan(one, first, given)[1])(jnp.asarray(commands))
        return float(np.linalg.norm(np.stack(driven) - np.asarray(simulated), axis=1).max())


def main(options: Options) -> None:
    """Export, check and say what was written."""
    from whill_mjx.export_mjcf import held
    from whill_mjx.logs.manoeuvres import Scenario, command_table

    with refusing():
        spec, params, _ = load_vehicle(options.vehicle)
        if options.out.suffix != ".py":
            raise OptionError(f"--out {options.out}: must be a file that ends in .py. Correct the name.")
        check_file("--out", options.out)
        source = vehicle_source(spec, params, options.physics_dt)
    write_whole(options.out, source)
    note_written(options.out)
    print(f"wrote {options.out}: {source.count(chr(10))} lines, effects {', '.join(e.name for e in params.effects)}")
    if options.check:
        table = command_table("figure_eight", Scenario())
        commands = held(table, options.physics_dt)
        apart_by = difference(options.out, spec, params, commands)
        print(f"figure-eight of {len(commands) * options.physics_dt:.0f} s: the file and the simulator are at most "
              f"{apart_by:.1e} m apart")


def cli() -> None:
    """Command line."""
    run(Options, main, __doc__)


if __name__ == "__main__":
    cli()

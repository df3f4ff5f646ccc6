"""A JAX function of single numbers as lines of Python for numpy and its like.

It is traced, and each operation becomes a line; equal ones become one, unused ones are left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from whill_mjx.vehicle.scalars import MOVES, apart

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


def lines_of(function: Callable, example: Sequence[Any], inputs: Sequence[str]) -> tuple[list[str], list[str]]:
    """A function of numbers as lines of Python, and the expressions of its results."""
    traced = jax.make_jaxpr(apart(function))(*example)
    values: dict[Any, str] = dict(zip(traced.jaxpr.invars, inputs, strict=True))
    consts = zip(traced.jaxpr.constvars, traced.consts, strict=True)
    values |= {name: literal(np.asarray(value)) for name, value in consts}
    lines: list[tuple[str, str]] = []
    known: dict[str, str] = {}
    _emit(traced.jaxpr, values, lines, known)
    results = [_read(atom, values) for atom in traced.jaxpr.outvars]
    return _used(lines, results), results


def _read(atom: Any, values: dict[Any, str]) -> str:
    return literal(np.asarray(atom.val, atom.aval.dtype)) if hasattr(atom, "val") else values[atom]


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
            inside |= {v: literal(np.asarray(c)) for v, c in zip(inner.jaxpr.constvars, inner.consts, strict=True)}
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


def literal(value: np.ndarray) -> str:
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
        return literal(np.asarray(eval(text, space), dtype))  # an expression of `OPERATIONS` on constants


def _used(lines: list[tuple[str, str]], results: Sequence[str]) -> list[str]:
    """The lines that the results need, in their order."""
    needed, kept = set(results), []
    for name, text in reversed(lines):
        if name in needed:
            kept.append(f"{name} = {text}")
            needed.update(word for word in text.replace("(", " ").replace(")", " ").replace(",", " ").replace("-", " ")
                          .replace("~", " ").split() if word.startswith("t"))
    return kept[::-1]

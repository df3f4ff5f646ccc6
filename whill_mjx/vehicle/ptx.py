"""Writes the plain arithmetic of a jaxpr of single numbers as a few blocks of PTX, the assembly of NVIDIA GPUs.

Triton's compiler takes minutes for some thousand operations. As one block of inline assembly they cost it nothing, and
the GPU's own assembler schedules them. What PTX has no instruction for (sin, exp, tanh, integers) stays with Triton:
`stages` cuts the jaxpr into blocks with such operations between them.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np

FLOAT, BOOL = np.dtype(np.float32), np.dtype(bool)


@dataclass(frozen=True)
class Stage:
    """One block of assembly and the operations that follow it."""

    inputs: tuple = ()
    """Variables of the jaxpr that the block reads."""
    outputs: tuple = ()
    """Variables that it gives, in order."""
    code: str = ""
    """The block; operands are numbered outputs first."""
    constraints: str = ""
    """Kinds of the operands, outputs first: =f and f for float32, =r and r for truth values as integers."""
    others: tuple = ()
    """Equations to evaluate after it."""


def stages(equations: list, wanted: set) -> list[Stage]:
    """The equations in blocks; `wanted` are the variables that are needed afterwards."""
    ready: dict[Any, int] = {}
    blocks: list[list] = []
    others: list[list] = []
    for one in equations:
        at = max([ready.get(v, 0) for v in variables(one.invars)], default=0)
        while len(blocks) <= at:
            blocks.append([])
            others.append([])
        written = can_write(one)
        (blocks if written else others)[at].append(one)
        ready[one.outvars[0]] = at if written else at + 1
    later = wanted | {v for rest in others for one in rest for v in variables(one.invars)}
    result = []
    for block, rest in zip(reversed(blocks), reversed(others), strict=True):
        result.append(_stage(block, [one.outvars[0] for one in block if one.outvars[0] in later], rest))
        later |= set(result[-1].inputs)
    return result[::-1]


def variables(atoms: Sequence) -> set:
    """Those that are no literals."""
    return {atom for atom in atoms if not hasattr(atom, "val")}


def needed(jaxpr: Any) -> list:
    """The equations of a jaxpr whose results something needs."""
    wanted = variables(jaxpr.outvars)
    kept = []
    for one in reversed(jaxpr.eqns):
        if wanted & set(one.outvars):
            kept.append(one)
            wanted |= variables(one.invars)
    return kept[::-1]


def apart_from(equations: list, moving: set) -> tuple[list, list]:
    """The equations that depend on none of the variables `moving`, and the others."""
    still, rest = [], []
    moving = set(moving)
    for one in equations:
        if moving & variables(one.invars):
            rest.append(one)
            moving |= set(one.outvars)
        else:
            still.append(one)
    return still, rest


def can_write(equation: Any) -> bool:
    """Whether PTX has the operation: on float32 and truth values only."""
    name, params = equation.primitive.name, equation.params
    kinds = {v.aval.dtype for v in (*equation.invars, *equation.outvars)}
    if name not in WRITERS or not kinds <= {FLOAT, BOOL}:
        return False
    if name == "round":
        return params["rounding_method"] == jax.lax.RoundingMethod.TO_NEAREST_EVEN
    if name == "integer_pow":
        return 1 <= abs(params["y"]) <= 8
    return name not in FLOATS_ONLY or BOOL not in {v.aval.dtype for v in equation.invars}


def _stage(block: list, outputs: list, others: list) -> Stage:
    writer = _Writer({one.outvars[0] for one in block})
    for one in block:
        writer.names[one.outvars[0]] = WRITERS[one.primitive.name](writer, one, *map(writer.read, one.invars))
    count = len(outputs)
    lines = ["{"]
    lines += [f".reg .{kind} {letter}<{number}>;" for kind, letter, number in
              (("f32", "f", writer.counts["f"]), ("pred", "p", writer.counts["p"])) if number]  # fmt: skip
    for place, variable in enumerate(writer.inputs):
        name = writer.names[variable]
        here = f"${count + place}"
        lines.append(f"setp.ne.b32 {name}, {here}, 0;" if name[0] == "p" else f"mov.f32 {name}, {here};")
    lines += writer.lines
    for place, variable in enumerate(outputs):
        name = writer.names[variable]
        lines.append(f"selp.b32 ${place}, 1, 0, {name};" if name[0] == "p" else f"mov.f32 ${place}, {name};")
    kinds = ["=r" if v.aval.dtype == BOOL else "=f" for v in outputs]
    kinds += ["r" if v.aval.dtype == BOOL else "f" for v in writer.inputs]
    return Stage(tuple(writer.inputs), tuple(outputs), "\n".join([*lines, "}"]), ",".join(kinds), tuple(others))


@dataclass
class _Writer:
    """Lines of one block; an instruction with the same operands is written once."""

    own: set
    names: dict = field(default_factory=dict)
    inputs: list = field(default_factory=list)
    lines: list = field(default_factory=list)
    counts: dict = field(default_factory=lambda: {"f": 0, "p": 0})
    known: dict = field(default_factory=dict)

    def read(self, atom: Any) -> str:
        if hasattr(atom, "val"):
            if atom.aval.dtype == BOOL:
                return self.op("p", "setp.eq.u32", "0", "0" if atom.val else "1")
            return "0f" + struct.pack(">f", float(atom.val)).hex().upper()
        if atom not in self.names:
            assert atom not in self.own
            self.inputs.append(atom)
            self.names[atom] = self.new("p" if atom.aval.dtype == BOOL else "f")
        return self.names[atom]

    def new(self, letter: str) -> str:
        self.counts[letter] += 1
        return f"{letter}{self.counts[letter] - 1}"

    def op(self, letter: str, code: str, *operands: str) -> str:
        """The register with the result of an instruction."""
        if code in COMMUTATIVE:
            operands = tuple(sorted(operands))
        key = (code, *operands)
        if key not in self.known:
            self.known[key] = self.new(letter)
            self.lines.append(f"{code} {', '.join([self.known[key], *operands])};")
        return self.known[key]


FLOATS_ONLY = {"ge", "gt", "le", "lt", "max", "min", "add", "mul", "sub", "sign", "clamp"}
COMMUTATIVE = {"add.f32", "mul.f32", "max.NaN.f32", "min.NaN.f32"}


def _floats(code: str) -> Callable:
    return lambda w, one, *operands: w.op("f", code, *operands)


def _truths(code: str) -> Callable:
    return lambda w, one, *operands: w.op("p", code, *operands)


def _compare(floats: str, truths: str | None = None) -> Callable:
    def write(w: _Writer, one: Any, a: str, b: str) -> str:
        if one.invars[0].aval.dtype == FLOAT:
            return w.op("p", f"setp.{floats}.f32", a, b)
        differ = w.op("p", "xor.pred", a, b)
        return differ if truths == "ne" else w.op("p", "not.pred", differ)

    return write


def _divide(w: _Writer, one: Any, a: str, b: str) -> str:
    inverse = w.op("f", "rcp.approx.ftz.f32", b)
    return inverse if a == "0f3F800000" else w.op("f", "mul.f32", a, inverse)


def _power(w: _Writer, one: Any, a: str) -> str:
    y = one.params["y"]
    result = None
    for bit in bin(abs(y))[:1:-1]:
        if bit == "b":
            break
        if bit == "1":
            result = a if result is None else w.op("f", "mul.f32", result, a)
        a = w.op("f", "mul.f32", a, a)
    assert result is not None
    return w.op("f", "rcp.approx.ftz.f32", result) if y < 0 else result


def _select(w: _Writer, one: Any, which: str, off: str, on: str) -> str:
    if one.outvars[0].aval.dtype == FLOAT:
        return w.op("f", "selp.f32", on, off, which)
    other = w.op("p", "and.pred", w.op("p", "not.pred", which), off)
    return w.op("p", "or.pred", w.op("p", "and.pred", which, on), other)


def _sign(w: _Writer, one: Any, a: str) -> str:
    below = w.op("f", "selp.f32", "0fBF800000", a, w.op("p", "setp.lt.f32", a, "0f00000000"))
    return w.op("f", "selp.f32", "0f3F800000", below, w.op("p", "setp.gt.f32", a, "0f00000000"))


def _convert(w: _Writer, one: Any, a: str) -> str:
    old, new = one.invars[0].aval.dtype, one.outvars[0].aval.dtype
    if old == new:
        return a
    if new == FLOAT:
        return w.op("f", "selp.f32", "0f3F800000", "0f00000000", a)
    return w.op("p", "setp.neu.f32", a, "0f00000000")


WRITERS: dict[str, Callable] = {
    "abs": _floats("abs.f32"),
    "add": _floats("add.f32"),
    "and": _truths("and.pred"),
    "ceil": _floats("cvt.rpi.f32.f32"),
    "clamp": lambda w, one, low, a, high: w.op("f", "min.NaN.f32", w.op("f", "max.NaN.f32", low, a), high),
    "convert_element_type": _convert,
    "copy": lambda w, one, a: a,
    "div": _divide,
    "eq": _compare("eq", "eq"),
    "floor": _floats("cvt.rmi.f32.f32"),
    "ge": _compare("ge"),
    "gt": _compare("gt"),
    "integer_pow": _power,
    "is_finite": _truths("testp.finite.f32"),
    "le": _compare("le"),
    "lt": _compare("lt"),
    "max": _floats("max.NaN.f32"),
    "min": _floats("min.NaN.f32"),
    "mul": _floats("mul.f32"),
    "ne": _compare("neu", "ne"),
    "neg": _floats("neg.f32"),
    "not": _truths("not.pred"),
    "or": _truths("or.pred"),
    "round": _floats("cvt.rni.f32.f32"),
    "rsqrt": _floats("rsqrt.approx.f32"),
    "select_n": _select,
    "sign": _sign,
    "sqrt": _floats("sqrt.approx.f32"),
    "square": lambda w, one, a: w.op("f", "mul.f32", a, a),
    "sub": _floats("sub.f32"),
    "xor": _truths("xor.pred"),
}
"""(writer, equation, operands) -> register. Comparisons other than eq and ne, max and min are of float32 only."""

"""Evaluates functions of small arrays on their single elements, so that a compiler fuses them into few kernels.

The vehicle is written with vectors of 2 to 9 numbers, which read like the equations. Compiled over many instances,
each slice, stack, sum and small product of such vectors ends a fused loop: a physics step becomes a hundred kernels.
`apart(function)` traces `function` and evaluates its operations element by element. What moves elements about happens
while tracing, constants are folded (a term with a factor that is 0 by construction is left out), and what remains is
arithmetic on scalars: one loop over the instances. Values stay the same to rounding, derivatives exist as before.

Operations unknown here are evaluated whole, on arrays put together and taken apart again: slower, never wrong.
"""

from __future__ import annotations

import itertools
import operator
from collections.abc import Callable, Sequence
from functools import cache, reduce
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

LARGEST = 256  # elements; larger arrays stay whole

ELEMENTWISE = {
    "abs", "acos", "acosh", "add", "and", "asin", "asinh", "atan", "atan2", "atanh", "cbrt", "ceil", "clamp",
    "convert_element_type", "copy", "cos", "cosh", "div", "eq", "erf", "exp", "exp2", "expm1", "floor", "ge", "gt",
    "integer_pow", "is_finite", "le", "log", "log1p", "logistic", "lt", "max", "min", "mul", "ne", "neg", "not", "or",
    "pow", "rem", "round", "rsqrt", "select_n", "shift_left", "shift_right_arithmetic", "shift_right_logical", "sign",
    "sin", "sinh", "sqrt", "square", "sub", "tan", "tanh", "xor",
}  # fmt: skip
KNOWN: dict[str, Callable] = {
    "abs": np.abs, "add": np.add, "and": np.logical_and, "ceil": np.ceil, "cos": np.cos, "div": np.true_divide,
    "eq": np.equal, "exp": np.exp, "floor": np.floor, "ge": np.greater_equal, "gt": np.greater,
    "is_finite": np.isfinite, "le": np.less_equal, "lt": np.less, "max": np.maximum, "min": np.minimum,
    "mul": np.multiply, "ne": np.not_equal, "neg": np.negative, "or": np.logical_or, "sign": np.sign, "sin": np.sin,
    "sqrt": np.sqrt, "square": np.square, "sub": np.subtract, "tanh": np.tanh,
}  # fmt: skip
"""Folded where all operands are constants."""
OF_INTEGERS = {"abs", "add", "eq", "ge", "gt", "le", "lt", "max", "min", "mul", "ne", "neg", "sub"}
"""Those of them that are the same for integers."""
REDUCTIONS = {"reduce_sum": "add", "reduce_max": "max", "reduce_min": "min", "reduce_prod": "mul", "reduce_and": "and",
              "reduce_or": "or"}  # fmt: skip
BINARY = {name: getattr(jax.lax, f"{name}_p") for name in set(REDUCTIONS.values()) | {"neg"}}
Elements = np.ndarray
"""Object array of an array's elements: numpy scalars where they are constants, JAX scalars elsewhere."""
Parts = Any
"""Elements, or a whole JAX array."""


def apart(function: Callable) -> Callable:
    """`function` evaluated on single elements; same arguments and results (pytrees of arrays)."""

    def evaluated(*args: Any) -> Any:
        traced, shapes = jax.make_jaxpr(function, return_shape=True)(*args)
        outputs = evaluate(traced, [take_apart(leaf) for leaf in jax.tree.leaves(args)])
        return jax.tree.unflatten(jax.tree.structure(shapes), [put_together(*pair) for pair in _typed(traced, outputs)])

    return evaluated


def scan_apart(
    function: Callable[[Any, Any], tuple[Any, Any]], carry: Any, xs: Any = None, length: int | None = None,
    unroll: int = 1,
) -> tuple[Any, Any]:
    """The last carry and all outputs of `carry, y = function(carry, x)` over the leading axis of `xs`, as by
    `jax.lax.scan`.

    Between two steps the carry stays in single elements, so that no step puts an array together.
    """
    start, structure = jax.tree.flatten(carry)
    first = jax.tree.map(lambda leaf: leaf[0], xs)
    traced, (_, given) = jax.make_jaxpr(function, return_shape=True)(carry, first)
    outputs, outside = jax.tree.flatten(given)

    def body(pieces: list, x: Any) -> tuple[list, list]:
        given = [*_regroup(pieces, start), *(take_apart(leaf) for leaf in jax.tree.leaves(x))]
        found = evaluate(traced, given)
        after = [_as_arrays(parts, like) for parts, like in zip(found, start, strict=False)]
        return _flat(after), [put_together(*pair) for pair in zip(found[len(start) :], outputs, strict=True)]

    pieces = _flat([_as_arrays(take_apart(leaf), leaf) for leaf in start])
    pieces, ys = jax.lax.scan(body, pieces, xs, length=length, unroll=unroll)
    leaves = [put_together(parts, like) for parts, like in zip(_regroup(pieces, start), start, strict=True)]
    return jax.tree.unflatten(structure, leaves), jax.tree.unflatten(outside, ys)


def in_pieces(function: Callable, *args: Any) -> Any:
    """The closed jaxpr of `function` from all elements of `args`, in order, to those of its results; arrays that stay
    whole are one each."""
    traced, leaves = jax.make_jaxpr(function)(*args), jax.tree.leaves(args)

    def evaluated(pieces: list) -> list:
        found = evaluate(traced, _regroup(pieces, leaves))
        return _flat([_as_arrays(parts, like) for parts, like in _typed(traced, found)])

    return jax.make_jaxpr(evaluated)(_flat([_as_arrays(take_apart(leaf), leaf) for leaf in leaves]))


def take_apart(array: Any) -> Parts:
    """Elements of an array; the array itself where it is large or not numeric."""
    if np.size(array) > LARGEST or jnp.issubdtype(jnp.result_type(array), jax.dtypes.extended):
        return array
    shape = np.shape(array)
    elements = np.empty(shape, object)
    if not isinstance(array, jax.core.Tracer):
        array = np.asarray(array)
        for index in np.ndindex(shape):
            elements[index] = array[index]
    elif shape == ():
        elements[()] = array
    else:
        flat = jax.lax.reshape(array, (array.size,))
        for position, index in enumerate(np.ndindex(shape)):
            elements[index] = jax.lax.squeeze(jax.lax.slice_in_dim(flat, position, position + 1), (0,))
    return elements


def put_together(parts: Parts, like: Any) -> jax.Array:
    """The array of these parts, with the shape and type of `like`."""
    if not _is_elements(parts):
        return parts
    elements = [jnp.asarray(value, like.dtype) for value in parts.ravel()]
    if parts.shape == ():
        return elements[0]
    if not elements:
        return jnp.zeros(parts.shape, like.dtype)
    return jnp.stack(elements).reshape(parts.shape)


def evaluate(traced: Any, inputs: list[Parts]) -> list[Parts]:
    """Outputs of a closed jaxpr for inputs in parts."""
    values: dict[Any, Parts] = {}

    def read(atom: Any) -> Parts:
        return take_apart(np.asarray(atom.val, atom.aval.dtype)) if hasattr(atom, "val") else values[atom]

    jaxpr = traced.jaxpr
    values.update(zip(jaxpr.constvars, (take_apart(const) for const in traced.consts), strict=True))
    values.update(zip(jaxpr.invars, inputs, strict=True))
    for equation in jaxpr.eqns:
        outputs = _evaluate_one(equation, [read(atom) for atom in equation.invars])
        values.update(zip(equation.outvars, outputs, strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _evaluate_one(equation: Any, operands: list[Parts]) -> list[Parts]:
    """Outputs of one operation."""
    name, params = equation.primitive.name, equation.params
    if name in ("jit", "pjit", "closed_call"):
        return evaluate(params.get("jaxpr") or params["call_jaxpr"], operands)
    if all(_is_elements(operand) for operand in operands):
        shape = equation.outvars[0].aval.shape
        if name in ELEMENTWISE:
            return [_elementwise(equation, operands, shape)]
        if name in MOVES:
            return [MOVES[name](operands, params).reshape(shape)]
        if name == "unstack":
            return _lines(operands[0], params["axis"])
        if name == "iota":
            return [take_apart(np.indices(shape, params["dtype"])[params["dimension"]])]
        if name in REDUCTIONS:
            return [_reduce(REDUCTIONS[name], operands[0], params["axes"])]
        if name == "dot_general" and not any(params["dimension_numbers"][1]):
            return [_dot(operands, params["dimension_numbers"][0]).reshape(shape)]
    return _whole(equation, operands)


MOVES: dict[str, Callable[[list[Elements], dict], Elements]] = {
    "broadcast_in_dim": lambda x, p: _broadcast(x[0], p["shape"], p["broadcast_dimensions"]),
    "concatenate": lambda x, p: np.concatenate(x, p["dimension"]),
    "pad": lambda x, p: _pad(x[0], x[1], p["padding_config"]),
    "reshape": lambda x, p: x[0],
    "squeeze": lambda x, p: x[0],
    "rev": lambda x, p: np.flip(x[0], p["dimensions"]),
    "slice": lambda x, p: x[0][_slices(p)],
    "stack": lambda x, p: np.stack(x, p["axis"]),
    "transpose": lambda x, p: np.transpose(x[0], p["permutation"]),
}
"""Operations that only move elements about; the result has the right order and gets its shape from the caller."""


def _elementwise(equation: Any, operands: list[Elements], shape: tuple[int, ...]) -> Elements:
    result = np.empty(shape, object)
    dtype = equation.outvars[0].aval.dtype
    spread = [np.broadcast_to(operand, shape) for operand in operands]  # a scalar operand goes with all
    for index in np.ndindex(shape):
        given = [operand[index] for operand in spread]
        result[index] = _combine(equation.primitive, equation.params, given, dtype)
    return result


def _combine(primitive: Any, params: dict, given: list, dtype: Any) -> Any:
    """One elementwise operation on scalars; constants are folded."""
    name = primitive.name
    known = [isinstance(value, np.generic) for value in given]
    if name == "integer_pow" and known[0]:
        return np.asarray(given[0] ** params["y"], dtype)[()]
    if name == "convert_element_type" and known[0]:
        return np.asarray(given[0], dtype)[()]
    if name == "select_n" and known[0]:
        return given[1 + int(given[0])]
    kinds = "fbiu" if name in OF_INTEGERS else "fb"
    if all(known) and name in KNOWN and all(value.dtype.kind in kinds for value in given):
        with np.errstate(all="ignore"):
            return np.asarray(KNOWN[name](*given), dtype)[()]
    if len(given) == 2 and any(known) and dtype.kind == "f":
        a, b = given
        constant = float(a if known[0] else b)
        if name == "mul" and constant in (0.0, 1.0):
            return dtype.type(0) if constant == 0.0 else (b if known[0] else a)
        if name == "add" and constant == 0.0:
            return b if known[0] else a
        if name == "sub" and constant == 0.0:
            return a if known[1] else BINARY["neg"].bind(b)
        if name == "div" and (known[1] and constant == 1.0 or known[0] and constant == 0.0):
            return a
    return primitive.bind(*given, **params)


def _reduce(name: str, operand: Elements, axes: tuple[int, ...]) -> Elements:
    """Combine over `axes`, in their order."""
    kept = [axis for axis in range(operand.ndim) if axis not in axes]
    ordered = np.transpose(operand, [*kept, *axes])
    shape = ordered.shape[: len(kept)]
    result = np.empty(shape, object)
    for index in np.ndindex(shape):
        values = ordered[index].ravel()
        result[index] = reduce(lambda a, b: _binary(name, a, b), values)
    return result


def _dot(operands: list[Elements], contracted: tuple) -> Elements:
    """Product summed over the contracted axes; the other axes of both follow one another."""
    left, right = (_contracted_last(*pair) for pair in zip(operands, contracted, strict=True))
    result = np.empty((len(left), len(right)), object)
    for i, j in itertools.product(range(len(left)), range(len(right))):
        result[i, j] = reduce(
            lambda a, b: _binary("add", a, b),
            [_binary("mul", a, b) for a, b in zip(left[i], right[j], strict=True)],
        )
    return result


def _contracted_last(operand: Elements, axes: tuple[int, ...]) -> Elements:
    kept = [axis for axis in range(operand.ndim) if axis not in axes]
    size = int(np.prod([operand.shape[axis] for axis in axes], dtype=int))
    return np.transpose(operand, [*kept, *axes]).reshape(-1, size)


def _binary(name: str, a: Any, b: Any) -> Any:
    dtype = next(np.dtype(value.dtype) for value in (a, b))
    return _combine(BINARY[name], _product_parameters() if name == "mul" else {}, [a, b], dtype)


@cache
def _product_parameters() -> dict:
    """What this version of JAX notes on a product; its reverse-mode rule asks for it."""
    return jax.make_jaxpr(jax.lax.mul)(1.0, 1.0).jaxpr.eqns[0].params


def _whole(equation: Any, operands: list[Parts]) -> list[Parts]:
    """An operation on arrays put together, its results taken apart."""
    arrays = [
        put_together(operand, atom.aval) for operand, atom in zip(operands, equation.invars, strict=True)
    ]
    bound = equation.primitive.get_bind_params(equation.params)
    functions, params = bound if isinstance(bound, tuple) else ((), bound)  # depends on the version of JAX
    outputs = equation.primitive.bind(*functions, *arrays, **params)
    return [take_apart(output) for output in (outputs if equation.primitive.multiple_results else [outputs])]


def _broadcast(operand: Elements, shape: tuple[int, ...], dimensions: tuple[int, ...]) -> Elements:
    spread = [1] * len(shape)
    for axis, dimension in enumerate(dimensions):
        spread[dimension] = operand.shape[axis]
    return np.broadcast_to(operand.reshape(spread), shape)


def _lines(operand: Elements, axis: int) -> list[Elements]:
    moved = np.moveaxis(operand, axis, 0)
    return [moved[i, ...] for i in range(len(moved))]


def _pad(operand: Elements, value: Elements, sizes: Sequence[tuple[int, int, int]]) -> Elements:
    """With a `value` () before, behind and between elements; negative sizes cut."""
    for axis, (before, behind, between) in enumerate(sizes):
        filled = np.broadcast_to(value, operand.shape[:axis] + operand.shape[axis + 1 :])
        lines = [filled] * max(before, 0)
        for line in _lines(operand, axis):
            lines += [line, *[filled] * between]
        lines = lines[max(-before, 0) : len(lines) - between + min(behind, 0)] + [filled] * max(behind, 0)
        operand = np.stack(lines, axis)
    return operand


def _slices(params: dict) -> tuple[slice, ...]:
    strides = params["strides"] or [1] * len(params["start_indices"])
    return tuple(map(slice, params["start_indices"], params["limit_indices"], strides))


def _is_elements(parts: Parts) -> bool:
    return isinstance(parts, np.ndarray) and parts.dtype == object


def _typed(traced: Any, outputs: list[Parts]) -> list[tuple[Parts, Any]]:
    return [(parts, atom.aval) for parts, atom in zip(outputs, traced.jaxpr.outvars, strict=True)]


def _as_arrays(parts: Parts, like: Any) -> list[jax.Array]:
    """Parts as a list of arrays of the type of `like`, as a loop carries them."""
    values = parts.ravel() if _is_elements(parts) else [parts]
    dtype = jnp.result_type(like)
    return [jax.lax.convert_element_type(value, dtype) for value in values]


def _flat(lists: list[list]) -> list:
    return reduce(operator.iadd, lists, [])


def _regroup(pieces: list, likes: list) -> list[Parts]:
    """The parts of each array of `likes` out of the flat list of all their elements."""
    remaining = iter(pieces)
    groups: list[Parts] = []
    for like in likes:
        shape = take_apart_shape(like)
        if shape is None:
            groups.append(next(remaining))
            continue
        elements = np.empty(shape, object)
        for index in np.ndindex(shape):
            elements[index] = next(remaining)
        groups.append(elements)
    return groups


def take_apart_shape(array: Any) -> tuple[int, ...] | None:
    """Shape of the elements that `take_apart` would give; None where the array would stay whole."""
    if np.size(array) > LARGEST or jnp.issubdtype(jnp.result_type(array), jax.dtypes.extended):
        return None
    return np.shape(array)

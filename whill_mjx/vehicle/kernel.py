"""Many vehicles through many steps in one kernel for NVIDIA GPUs (Pallas, Triton): the state stays in registers.

The kernel is made of the traced step: `scalars.in_pieces` gives its operations on single numbers, and each becomes one
on a block of instances, an instance to a thread. Parameters and state are read once and the state is written once, in
whatever number of steps. Derivatives are those of the plain function.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap

from whill_mjx.vehicle import ptx
from whill_mjx.vehicle.scalars import in_pieces

PRIMITIVES = {
    "abs", "acos", "acosh", "add", "and", "asin", "asinh", "atan", "atan2", "atanh", "cbrt", "ceil", "clamp",
    "convert_element_type", "copy", "cos", "cosh", "div", "eq", "exp", "exp2", "expm1", "floor", "ge", "gt",
    "integer_pow", "is_finite", "le", "log", "log1p", "logistic", "lt", "max", "min", "mul", "ne", "neg", "not", "or",
    "pow", "rem", "round", "rsqrt", "select_n", "shift_left", "shift_right_arithmetic", "shift_right_logical", "sign",
    "sin", "sinh", "sqrt", "square", "sub", "tan", "tanh", "xor",
}  # fmt: skip
"""Operations on single numbers that Triton knows, or that are replaced here by some that it knows."""


@dataclass(frozen=True)
class Launch:
    """How instances are given to the GPU. Static."""

    lanes: int = 32
    """Instances of a program; a power of two."""
    warps: int = 1
    """Warps of 32 threads that share them; a power of two."""
    fast: bool = True
    """Divide and take roots by the GPU's approximations (2 units in the last place)."""
    assembly: bool = True
    """Write plain arithmetic as PTX (`ptx.py`) instead of operations of Triton, which takes minutes to compile them."""
    hoist: bool = True
    """Compute before the loop what does not change in it."""
    unroll: int = 1
    """Steps written out in the kernel's loop; divides the number of steps."""

    def __post_init__(self) -> None:
        for name in ("lanes", "warps"):
            value = getattr(self, name)
            if value < 1 or value & (value - 1):
                raise ValueError(f"launch: {name} is {value}; Triton needs a power of two.")


Step = Callable[[Any, Any, Any], Any]
"""(parameters, state, input) -> state, of one instance."""


def held_in_registers(
    step: Step, steps: int, plain: Step, args: tuple[Any, Any, Any], launch: Launch | None = None, forced: bool = False
) -> Any:
    """The state after `steps` steps of one instance with its input held; of all instances of a `vmap` at once.

    Args:
        step: one step of one instance.
        steps: how many.
        plain: the same as all of them, for derivatives and for devices other than NVIDIA GPUs.
        args: parameters, state and input, pytrees of arrays of one instance.
        launch: how the kernel runs.
        forced: interpret the kernel on other devices, and refuse a step that it cannot run, instead of `plain`.

    Raises:
        ValueError: the step has operations that the kernel lacks, and `forced`.
    """
    args = jax.tree.map(jnp.asarray, args)
    traced = in_pieces(step, *args)
    lacking = unknown(traced)
    if lacking and not forced:
        warnings.warn(f"physics without its GPU kernel, which lacks {lacking}: slower, with the same results",
                      stacklevel=2)  # fmt: skip
        return plain(*args)
    if lacking:
        raise ValueError(f"the physics kernel for GPUs lacks {lacking}; choose kernel=False for this vehicle.")
    many, native = jax.vmap(plain), partial(_run, traced, steps, launch or Launch(), False)
    elsewhere = partial(_run, traced, steps, launch or Launch(), True) if forced else many

    @jax.custom_jvp
    def instances(*args: Any) -> Any:
        return _along_the_axis(partial(jax.lax.platform_dependent, cuda=native, default=elsewhere))(*args)

    @instances.defjvp
    def _(primals: tuple, tangents: tuple) -> tuple[Any, Any]:
        return jax.jvp(many, primals, tangents)

    alone = jax.tree.map(lambda leaf: leaf[None], args)
    return jax.tree.map(lambda leaf: leaf[0], instances(*alone))


def unknown(traced: Any) -> str:
    """Names of the operations of a closed jaxpr that the kernel lacks; "" where it has all."""
    whole = {one.primitive.name for one in traced.jaxpr.eqns if any(v.aval.shape for v in (*one.invars, *one.outvars))}
    names = {one.primitive.name for one in traced.jaxpr.eqns} - PRIMITIVES
    arrays = [name + " of arrays" for name in sorted(whole - names)]
    return ", ".join([*sorted(names), *arrays, *(["arrays"] if any(v.aval.shape for v in traced.jaxpr.invars) else [])])


def _along_the_axis(function: Callable) -> Callable:
    """`function` of arrays (N, ...), with a batching rule that makes N larger instead of adding an axis."""

    @custom_vmap
    def call(*args: Any) -> Any:
        return function(*args)

    @call.def_vmap
    def _(size: int, mapped: Any, *args: Any) -> tuple[Any, Any]:
        def longer(leaf: jax.Array, has_axis: bool) -> jax.Array:
            every = leaf if has_axis else jnp.broadcast_to(leaf, (size, *leaf.shape))
            return every.reshape(-1, *every.shape[2:])

        args = jax.tree.map(longer, args, tuple(mapped))
        result = _along_the_axis(function)(*args)
        result = jax.tree.map(lambda leaf: leaf.reshape(size, -1, *leaf.shape[1:]), result)
        return result, jax.tree.map(lambda _: True, result)

    return call


def _run(traced: Any, steps: int, launch: Launch, interpret: bool, *args: Any) -> Any:
    """The kernel's states (N, ...) for arguments (N, ...)."""
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton as plt

    params, state, given = (jax.tree.leaves(part) for part in args)
    likes, structure = jax.tree.flatten(args[1])
    count = likes[0].shape[0]
    sizes = [math.prod(leaf.shape[1:]) for leaf in (*params, *state, *given)]

    def kernel(*refs: Any) -> None:
        rows = pl.program_id(0) * launch.lanes + jax.lax.iota(jnp.int32, launch.lanes)
        there = jnp.minimum(rows, count - 1)
        inputs, outputs = refs[: len(sizes)], refs[len(sizes) :]
        pieces = [
            plt.load(ref.at[there * size + place])
            for ref, size in zip(inputs, sizes, strict=True) for place in range(size)
        ]  # fmt: skip
        first, last = (sum(sizes[:end]) for end in (len(params), len(params) + len(state)))
        jaxpr = traced.jaxpr
        carry = jaxpr.invars[first:last]
        still, moved = ptx.apart_from(ptx.needed(jaxpr), set(carry) if launch.hoist else set(jaxpr.invars))
        ends = {v for v in jaxpr.outvars if not hasattr(v, "val")}
        used = ends | {v for one in moved for v in ptx.variables(one)}
        fixed = dict(zip(jaxpr.invars, pieces, strict=True))
        _follow(still, used, fixed, launch, interpret)

        def body(_: Any, moving: tuple) -> tuple:
            for _ in range(launch.unroll):
                values = fixed | dict(zip(carry, moving, strict=True))
                _follow(moved, ends, values,
                        launch, interpret)  # fmt: skip
                moving = tuple(_block(atom, values, pieces[0].shape) for atom in jaxpr.outvars)
            return moving

        moving = iter(jax.lax.fori_loop(0, steps // launch.unroll, body, tuple(pieces[first:last])))
        for ref, size in zip(outputs, sizes[len(params) :], strict=False):
            for place in range(size):
                plt.store(ref.at[rows * size + place], next(moving), mask=rows < count)

    ends = pl.pallas_call(
        kernel,
        out_shape=[jax.ShapeDtypeStruct((leaf.size,), leaf.dtype) for leaf in state],
        grid=(-(-count // launch.lanes),),
        compiler_params=plt.CompilerParams(num_warps=launch.warps, num_stages=1),
        interpret=interpret,
        name="physics",
    )(*(leaf.reshape(-1) for leaf in (*params, *state, *given)))
    return jax.tree.unflatten(structure, [end.reshape(like.shape) for end, like in zip(ends, likes, strict=True)])


def _block(atom: Any, values: dict, shape: tuple[int, ...]) -> jax.Array:
    """The block of a variable or a literal."""
    return jnp.full(shape, np.asarray(atom.val, atom.aval.dtype)) if hasattr(atom, "val") else values[atom]


def _follow(equations: list, wanted: set, values: dict, launch: Launch, interpret: bool) -> None:
    """Put the blocks that the equations give into `values`."""
    if interpret or not launch.assembly:
        for one in equations:
            _operate(one, values, launch.fast and not interpret)
        return
    for stage in ptx.stages(equations, wanted):
        _assemble(stage, values)
        for one in stage.others:
            _operate(one, values, launch.fast)


def _operate(one: Any, values: dict, fast: bool) -> None:
    """One operation as Pallas has it."""
    shape = next(iter(values.values())).shape
    given = [_block(atom, values, shape) for atom in one.invars]
    other = (REPLACED | (APPROXIMATE if fast else {})).get(one.primitive.name)
    values[one.outvars[0]] = other(one, *given) if other else one.primitive.bind(*given, **one.params)


def _assemble(stage: ptx.Stage, values: dict) -> None:
    """One block of inline assembly; truth values pass as integers."""
    if not stage.outputs:
        return
    given = [values[v] for v in stage.inputs]
    given = [block.astype(jnp.int32) if block.dtype == bool else block for block in given]
    shape = next(iter(values.values())).shape
    kinds = [jax.ShapeDtypeStruct(shape, jnp.int32 if v.aval.dtype == bool else v.aval.dtype) for v in stage.outputs]
    results = _assembly().bind(*given, code=stage.code, constraints=stage.constraints, kinds=tuple(kinds))
    for variable, result in zip(stage.outputs, results, strict=True):
        values[variable] = result != 0 if variable.aval.dtype == bool else result


@cache
def _assembly() -> Any:
    """The primitive of a block of assembly with several results; Pallas' own has one."""
    from jax._src.lib.triton import dialect
    from jax._src.pallas.triton import lowering
    from jax.extend.core import Primitive
    from jax.interpreters import mlir

    primitive = Primitive("assembly")
    primitive.multiple_results = True
    primitive.def_abstract_eval(lambda *_, kinds, **__: [jax.core.ShapedArray(k.shape, k.dtype) for k in kinds])

    @lowering.register_lowering(primitive)
    def _(ctx: Any, *args: Any, code: str, constraints: str, kinds: tuple) -> Any:
        types = [mlir.ir.RankedTensorType.get(k.shape, mlir.dtype_to_ir_type(np.dtype(k.dtype))) for k in kinds]
        made = dialect.ElementwiseInlineAsmOp(
            types, code, constraints=constraints, pure=True, packed_element=1, args=args
        )
        return list(made.results)

    return primitive


def _round(one: Any, x: jax.Array) -> jax.Array:
    low = jnp.floor(x)
    behind = x - low
    if one.params["rounding_method"] == jax.lax.RoundingMethod.TO_NEAREST_EVEN:
        up = (behind > 0.5) | ((behind == 0.5) & (low != 2 * jnp.floor(low / 2)))
    else:
        up = (behind > 0.5) | ((behind == 0.5) & (x > 0))
    return jnp.where(up, low + 1, low)


REPLACED: dict[str, Callable] = {"round": _round, "copy": lambda one, x: x}
"""What stands for operations that Triton lacks: (equation, operands) -> result."""


def _special(code: str, x: jax.Array) -> jax.Array:
    """One instruction of the special-function unit, on float32."""
    from jax.experimental.pallas import triton as plt

    result = jax.ShapeDtypeStruct(x.shape, x.dtype)
    return plt.elementwise_inline_asm(f"{code} $0, $1;", args=[x], constraints="=f,f", pack=1,
                                      result_shape_dtypes=[result])[0]  # fmt: skip


def _divide(one: Any, x: jax.Array, y: jax.Array) -> jax.Array:
    return x * _special("rcp.approx.ftz.f32", y) if x.dtype == jnp.float32 else one.primitive.bind(x, y)


def _root(one: Any, x: jax.Array) -> jax.Array:
    return _special("sqrt.approx.f32", x) if x.dtype == jnp.float32 else one.primitive.bind(x, **one.params)


APPROXIMATE: dict[str, Callable] = {"div": _divide, "sqrt": _root}

"""Many vehicles through many steps in one kernel for NVIDIA GPUs (Pallas, Triton): the state stays in registers.

The kernel is made of the traced step: `scalars.in_pieces` gives its operations on single numbers, and each becomes one
on a block of instances, an instance to a thread. Plain arithmetic is written as assembly (`ptx.py`), the rest are
operations of Triton. Parameters and state are read once and the state is written once, in whatever number of steps.
What does not change from step to step is computed before the first. Derivatives are those of the plain function.
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
    *ptx.WRITERS, "acos", "acosh", "asin", "asinh", "atan", "atan2", "atanh", "cbrt", "cos", "cosh", "exp", "exp2",
    "expm1", "log", "log1p", "logistic", "pow", "rem", "shift_left", "shift_right_arithmetic", "shift_right_logical",
    "sin", "sinh", "tan", "tanh",
}  # fmt: skip
"""Operations that are written as assembly, or that Triton knows."""


@dataclass(frozen=True)
class Launch:
    """How instances are given to the GPU. Static."""

    lanes: int = 32
    """Instances of a program; a power of two."""
    warps: int = 1
    """Warps of 32 threads that share them; a power of two."""

    def __post_init__(self) -> None:
        for name in ("lanes", "warps"):
            value = getattr(self, name)
            if value < 1 or value & (value - 1):
                raise ValueError(f"launch: {name} is {value}; Triton needs a power of two.")


Step = Callable[[Any, Any, Any], Any]
"""(parameters, state, input) -> state, of one instance."""


@dataclass(frozen=True, eq=False)
class Roll:
    """Several steps of one instance with its input held. Static."""

    step: Step
    steps: int
    plain: Step
    """All steps without the kernel: for derivatives, and for devices other than NVIDIA GPUs."""


def held_in_registers(
    roll: Roll, args: tuple[Any, Any, Any], launch: Launch | None = None, forced: bool = False
) -> Any:
    """The state of one instance after the steps; `vmap` makes one kernel of all instances.

    Args:
        roll: the steps.
        args: parameters, state and input, pytrees of arrays of one instance.
        launch: how the kernel runs.
        forced: interpret the kernel on other devices, and refuse a step that it cannot run, instead of `roll.plain`.

    Raises:
        ValueError: the kernel lacks something that the step needs, and `forced`.
    """
    args = jax.tree.map(jnp.asarray, args)
    traced = in_pieces(roll.step, *args)
    lacking = _lacking(traced)
    if lacking and forced:
        raise ValueError(f"the physics kernel for GPUs lacks {lacking}; choose kernel=False for this vehicle.")
    if lacking or not forced and any(v.aval.dtype == np.float64 for v in traced.jaxpr.invars):
        if lacking:
            warnings.warn(
                f"physics without its GPU kernel, which lacks {lacking}: slower, the same results", stacklevel=2
            )
        return roll.plain(*args)
    many, run = jax.vmap(roll.plain), partial(_run, traced, roll.steps, launch or Launch())
    native, elsewhere = partial(run, False), partial(run, True) if forced else many

    @jax.custom_jvp
    def instances(*args: Any) -> Any:
        return _along_the_axis(partial(jax.lax.platform_dependent, cuda=native, default=elsewhere))(*args)

    @instances.defjvp
    def _(primals: tuple, tangents: tuple) -> tuple[Any, Any]:
        return jax.jvp(many, primals, tangents)

    alone = jax.tree.map(lambda leaf: leaf[None], args)
    return jax.tree.map(lambda leaf: leaf[0], instances(*alone))


def _lacking(traced: Any) -> str:
    """What a closed jaxpr needs that the kernel lacks; "" where it has all."""
    names = {one.primitive.name for one in traced.jaxpr.eqns} - PRIMITIVES
    if any(v.aval.shape for v in traced.jaxpr.invars):
        names.add("large arrays")
    known = [one for one in traced.jaxpr.eqns if one.primitive.name in PRIMITIVES]
    names |= {f"{one.primitive.name} of arrays" for one in known if any(v.aval.shape for v in one.invars + one.outvars)}
    try:
        _assembly()
    except (ImportError, AttributeError) as error:
        names.add(f"assembly in this version of JAX ({error})")
    return ", ".join(sorted(names))


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

        result = _along_the_axis(function)(*jax.tree.map(longer, args, tuple(mapped)))
        result = jax.tree.map(lambda leaf: leaf.reshape(size, -1, *leaf.shape[1:]), result)
        return result, jax.tree.map(lambda _: True, result)

    return call


def _run(traced: Any, steps: int, launch: Launch, interpret: bool, *args: Any) -> Any:
    """The kernel's states (N, ...) for arguments (N, ...)."""
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton as plt

    leaves, (state, structure) = jax.tree.leaves(args), jax.tree.flatten(args[1])
    count = state[0].shape[0]
    sizes = [math.prod(leaf.shape[1:]) for leaf in leaves]
    before = len(jax.tree.leaves(args[0]))
    first, last = sum(sizes[:before]), sum(sizes[: before + len(state)])

    def kernel(*refs: Any) -> None:
        rows = pl.program_id(0) * launch.lanes + jax.lax.iota(jnp.int32, launch.lanes)
        there = jnp.minimum(rows, count - 1)
        places = [(ref, size, place) for ref, size in zip(refs, sizes, strict=False) for place in range(size)]
        pieces = [plt.load(ref.at[there * size + place]) for ref, size, place in places]
        ends = _steps(traced.jaxpr, steps, pieces, slice(first, last), interpret)
        outputs = zip(refs[len(sizes) :], sizes[before:], strict=False)
        places = [(ref, size, place) for ref, size in outputs for place in range(size)]
        for (ref, size, place), end in zip(places, ends, strict=True):
            plt.store(ref.at[rows * size + place], end, mask=rows < count)

    ends = pl.pallas_call(
        kernel,
        out_shape=[jax.ShapeDtypeStruct((leaf.size,), leaf.dtype) for leaf in state],
        grid=(-(-count // launch.lanes),),
        compiler_params=plt.CompilerParams(num_warps=launch.warps, num_stages=1),
        interpret=interpret,
        name="physics",
    )(*(leaf.reshape(-1) for leaf in leaves))
    return jax.tree.unflatten(structure, [end.reshape(like.shape) for end, like in zip(ends, state, strict=True)])


def _steps(jaxpr: Any, steps: int, pieces: list, moving: slice, interpret: bool) -> tuple:
    """The blocks `pieces[moving]` after the steps; the others are the same in each."""
    carry, ends = jaxpr.invars[moving], ptx.variables(jaxpr.outvars)
    still, moved = ptx.apart_from(ptx.needed(jaxpr), set(carry))
    used = ends | {v for one in moved for v in ptx.variables(one.invars)}
    fixed = _followed(still, used, dict(zip(jaxpr.invars, pieces, strict=True)), interpret)

    def body(_: Any, blocks: tuple) -> tuple:
        values = _followed(moved, ends, fixed | dict(zip(carry, blocks, strict=True)), interpret)
        return tuple(_block(atom, values) for atom in jaxpr.outvars)

    return jax.lax.fori_loop(0, steps, body, tuple(pieces[moving]))


def _followed(equations: list, wanted: set, values: dict, interpret: bool) -> dict:
    """`values`, the blocks of variables, with those that the equations give."""
    values = dict(values)
    stages = [ptx.Stage(others=tuple(equations))] if interpret else ptx.stages(equations, wanted)
    for stage in stages:
        if stage.outputs:
            _assemble(stage, values)
        for one in stage.others:
            given = [_block(atom, values) for atom in one.invars]
            other = REPLACED.get(one.primitive.name)
            values[one.outvars[0]] = other(one, *given) if other else one.primitive.bind(*given, **one.params)
    return values


def _block(atom: Any, values: dict) -> jax.Array:
    """The block of a variable or a literal."""
    shape = next(iter(values.values())).shape
    return jnp.full(shape, np.asarray(atom.val, atom.aval.dtype)) if hasattr(atom, "val") else values[atom]


def _assemble(stage: ptx.Stage, values: dict) -> None:
    """One block of assembly; truth values pass as integers."""
    given = [values[v].astype(jnp.int32) if v.aval.dtype == bool else values[v] for v in stage.inputs]
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

    make = dialect.ElementwiseInlineAsmOp
    primitive = Primitive("assembly")
    primitive.multiple_results = True
    primitive.def_abstract_eval(lambda *_, kinds, **__: [jax.core.ShapedArray(k.shape, k.dtype) for k in kinds])

    @lowering.register_lowering(primitive)
    def _(ctx: Any, *args: Any, code: str, constraints: str, kinds: tuple) -> list:
        types = [mlir.ir.RankedTensorType.get(k.shape, mlir.dtype_to_ir_type(np.dtype(k.dtype))) for k in kinds]
        return list(make(types, code, constraints=constraints, pure=True, packed_element=1, args=args).results)

    return primitive


def _round(one: Any, x: jax.Array) -> jax.Array:
    """`lax.round`, which Triton lacks."""
    low = jnp.floor(x)
    behind = x - low
    even = one.params["rounding_method"] == jax.lax.RoundingMethod.TO_NEAREST_EVEN
    up = (low != 2 * jnp.floor(low / 2)) if even else x > 0
    return jnp.where((behind > 0.5) | ((behind == 0.5) & up), low + 1, low)


REPLACED: dict[str, Callable] = {"round": _round, "copy": lambda one, x: x}
"""What stands for operations that Triton lacks: (equation, operands) -> result."""

"""The whole posterior recurrence as one Pallas kernel (Triton): a try against the scan that XLA compiles.

One program per streaming multiprocessor keeps running through all steps. A step has five stages, each of them a matrix
product of which every program makes some columns; between stages the programs wait for one another at a counter in
global memory. Norms are computed anew by every program that reads their result, so that a stage needs no second wait.
It makes the forward pass only: what it saves there bounds what it can be worth, since the backward pass has the same
shape with two products for one.

`benchmarks.learner --tries fused_posterior` times it beside `rssm.observe` in one run.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp

from benchmarks import harness
from benchmarks.learner_updates import ACTION_DIM, OBS_SHAPE
from dreamer import image, rssm
from dreamer.config import DreamerConfig
from dreamer.nets import NORM_EPS
from dreamer.recurrence import Step, Tree
from dreamer.rssm import Latent
from dreamer.types import Params

PARTS = 4
"""Shares into which the rows of the widest product are split, so that every program has one."""
ROUNDS = 20
"""Passes over a sequence in one timed call."""


@dataclass(frozen=True)
class Layout:
    """How the kernel is laid out. Static."""

    columns: int = 16
    """Columns of a tile: the programs are as many as the state has tiles. A power of two, at least 16."""
    warps: int = 4
    """Warps of 32 threads in a program."""
    early: bool = True
    """Load a stage's weights before waiting for the stage before it."""
    work: bool = True
    """Whether the stages do anything: without, the time is that of the waiting alone."""
    alone: bool = False
    """One program does all tiles, which needs no waiting: for interpretation on a CPU."""


def fused_scan(
    layout: Layout, step: Step, unroll: int, weights: dict[str, jax.Array], carry: Tree, terms: dict[str, jax.Array],
    inputs: Tree,
) -> tuple[Tree, Tree]:
    """What `recurrence.scan_products` gives for the step of `rssm.observe`, by one kernel; not differentiable.

    Raises:
        ValueError: a width is not a power of two, which Triton needs.
    """
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton as plt

    config: DreamerConfig = step.args[0]  # type: ignore[attr-defined]
    for name in ("deter", "hidden", "stoch", "classes", "blocks", "batch_size"):
        value = getattr(config, name)
        if value & (value - 1):
            raise ValueError(f"fused posterior: {name} is {value}; Triton needs a power of two.")
    deter, stoch, product = carry
    (count, batch), width, hidden, latent = inputs["is_first"].shape[:2], config.deter, config.hidden, stoch.shape[-1]
    dtype = deter.dtype
    tiles = width // layout.columns
    programs = 1 if layout.alone else tiles
    constants = {name: terms[name][0, 0].reshape(-1) for name in terms if name not in ("core", "deter")}
    read = {**{f"{name}_weight": value for name, value in weights.items()},
            **{f"{name}_constant": value for name, value in constants.items()},
            "core_term": terms["core"].reshape(count, batch, width), "post_term": terms["deter"][..., hidden:],
            "first": inputs["is_first"][..., 0].astype(jnp.int32), "uniform": inputs["uniform"]}
    begun = {
        "deter": jnp.zeros((count + 1, batch, width), dtype).at[0].set(deter),
        "stoch": jnp.zeros((count + 1, batch, latent), dtype).at[0].set(stoch),
        "products": jnp.zeros((PARTS, batch, 2 * hidden), jnp.float32).at[0, :, :hidden].set(product),
        "waiting": jnp.zeros((1,), jnp.int32),
    }  # fmt: skip
    made = {
        "from_stoch": ((batch, hidden), jnp.float32), "wide": ((batch, width), jnp.float32),
        "squares": ((tiles, batch), jnp.float32), "probs": ((count, batch, latent), jnp.float32),
    }  # fmt: skip
    names, shared, fresh = list(read), list(begun), list(made)

    def kernel(*refs: Any) -> None:
        own = dict(zip([*names, *[f"{name}_before" for name in shared], *shared, *fresh], refs, strict=True))
        _run_steps(config, layout, own, pl, plt, tiles, programs, count, batch)

    call = pl.pallas_call(
        kernel,
        out_shape=[*(jax.ShapeDtypeStruct(begun[name].shape, begun[name].dtype) for name in shared),
                   *(jax.ShapeDtypeStruct(*made[name]) for name in fresh)],
        grid=(programs,),
        input_output_aliases={len(names) + i: i for i in range(len(shared))},
        compiler_params=plt.CompilerParams(num_warps=layout.warps, num_stages=1),
        interpret=layout.alone,
        name="fused_posterior",
    )  # fmt: skip
    out = dict(zip([*shared, *fresh], call(*read.values(), *begun.values()), strict=True))
    last = (out["deter"][-1], out["stoch"][-1], out["products"][..., :hidden].sum(0).astype(dtype))
    probs = out["probs"].reshape(count, batch, config.stoch, config.classes)
    return last, (out["deter"][1:], out["stoch"][1:], probs)


def _run_steps(
    config: DreamerConfig, layout: Layout, ref: dict[str, Any], pl: Any, plt: Any, tiles: int, programs: int,
    count: int, batch: int,
) -> None:
    """The kernel of one program: all stages of all steps, for its tiles."""
    me, size, hidden, classes = pl.program_id(0), layout.columns, config.hidden, config.classes
    block = config.deter // config.blocks
    per_block, latent = block // size, config.stoch * classes
    dtype = ref["deter"].dtype

    def shared(name: str, *at: Any) -> jax.Array:
        """Read what other programs wrote: past the cache of this multiprocessor."""
        return plt.load(ref[name].at[_index(at)], volatile=True)

    def constant(name: str, *at: Any) -> jax.Array:
        return plt.load(ref[f"{name}_constant"].at[_index(at)]).astype(jnp.float32)

    def norm_act(x: jax.Array, scale: jax.Array, squares: jax.Array | None = None) -> jax.Array:
        mean = jnp.mean(x * x, -1) if squares is None else squares
        return jax.nn.silu(x * jax.lax.rsqrt(mean + NORM_EPS)[:, None] * scale[None]).astype(dtype)

    def dot(x: jax.Array, weight: jax.Array) -> jax.Array:
        return jnp.dot(x, weight, preferred_element_type=jnp.float32)

    def columns(tile: Any, of: int = size) -> Any:
        return pl.ds(tile * of, of)

    def kept(x: jax.Array, first: jax.Array) -> jax.Array:
        return jnp.where((first > 0)[:, None], jnp.zeros_like(x), x)

    everything = slice(None)

    def stage(of: int, load: Callable[[Any], tuple], make: Callable[..., None]) -> Callable[[Any], Any]:
        """Wait for the stage before, then make this stage's tiles; the weights may be on their way meanwhile."""

        def enter(waits: Any) -> Any:
            if layout.alone:
                for number in range(of):
                    make(number, *load(number))
                return waits
            tile = jnp.minimum(me, of - 1)  # loads of programs without a tile are not used
            held = load(tile) if layout.early and layout.work else ()
            _wait(ref["waiting"], (waits + 1) * programs, plt)
            if layout.work:
                @pl.when(me < of)
                def _() -> None:
                    make(tile, *(held or load(tile)))
            return waits + 1

        return enter

    def one(t: Any, waits: Any) -> Any:
        first = plt.load(ref["first"].at[t, everything])

        def from_stoch(tile: Any, weight: jax.Array) -> None:
            value = dot(kept(shared("stoch", t, everything, everything), first), weight)
            plt.store(ref["from_stoch"].at[:, columns(tile, 16)], value + constant("in_stoch", columns(tile, 16))[None])

        def core(tile: Any, own: jax.Array, deter_share: jax.Array, stoch_share: jax.Array) -> None:
            group = tile // per_block
            old = kept(shared("deter", t, everything, columns(group, block)), first)
            product = kept(_summed(partial(shared, "products"), 0, hidden, pl), first)
            deter_part = norm_act(product + constant("in_deter_bias", everything)[None],
                                  constant("in_deter_scale", everything))
            stoch_part = norm_act(shared("from_stoch", everything, everything), constant("in_stoch_scale", everything))
            value = dot(old, own) + dot(deter_part, deter_share) + dot(stoch_part, stoch_share)
            value += plt.load(ref["core_term"].at[t, :, columns(tile)]).astype(jnp.float32)
            plt.store(ref["wide"].at[:, columns(tile)], value)
            plt.store(ref["squares"].at[_index((tile, everything))], jnp.sum(value * value, -1))

        def gates(tile: Any, reset: jax.Array, candidate: jax.Array, update: jax.Array) -> None:
            group, inside = tile // per_block, tile % per_block
            squares = jnp.sum(shared("squares", everything, everything), 0) / config.deter
            wide = norm_act(shared("wide", everything, columns(group, block)),
                            constant("core_scale", columns(group, block)), squares)

            def gate(weight: jax.Array, number: int) -> jax.Array:
                place = pl.ds(group * 3 * block + number * block + inside * size, size)
                return dot(wide, weight) + constant("gates", place)[None]

            value = jnp.tanh(jax.nn.sigmoid(gate(reset, 0)) * gate(candidate, 1))
            share = jax.nn.sigmoid(gate(update, 2) - 1.0)
            old = kept(shared("deter", t, everything, columns(tile)), first).astype(jnp.float32)
            plt.store(ref["deter"].at[t + 1, :, columns(tile)], (share * value + (1 - share) * old).astype(dtype))

        def products(tile: Any, weight: jax.Array) -> None:
            part, place = tile % PARTS, tile // PARTS
            rows = shared("deter", t + 1, everything, columns(part, config.deter // PARTS))
            plt.store(ref["products"].at[_index((part, everything, columns(place)))], dot(rows, weight))

        def sample(tile: Any, weight: jax.Array) -> None:
            value = _summed(partial(shared, "products"), hidden, hidden, pl)
            value += plt.load(ref["post_term"].at[t, :, :]).astype(jnp.float32)
            place = columns(tile, classes)
            logits = dot(norm_act(value, constant("post_scale", everything)), weight)
            logits += constant("post_logit", place)[None]
            scaled = jnp.exp(logits - jnp.max(logits, -1)[:, None])
            probs = (1 - config.unimix) * scaled / jnp.sum(scaled, -1)[:, None] + config.unimix / classes
            row = jax.lax.broadcasted_iota(jnp.int32, (batch, classes, classes), 1)
            column = jax.lax.broadcasted_iota(jnp.int32, (batch, classes, classes), 2)
            reached = jnp.sum(jnp.where(row <= column, probs[:, :, None], 0.0), 1)
            position = jax.lax.broadcasted_iota(jnp.int32, (batch, classes), 1)
            drawn = plt.load(ref["uniform"].at[_index((t, everything, tile))])
            passed = (drawn[:, None] >= reached) & (position < classes - 1)
            index = jnp.sum(passed.astype(jnp.int32), -1)
            plt.store(ref["stoch"].at[t + 1, :, place], (position == index[:, None]).astype(dtype))
            plt.store(ref["probs"].at[t, :, place], probs)

        def weight(name: str, *at: Any) -> jax.Array:
            return plt.load(ref[f"{name}_weight"].at[_index(at)])

        def core_weights(tile: Any) -> tuple[jax.Array, ...]:
            place = (tile // per_block, tile % per_block)
            return tuple(weight("core", place[0], pl.ds(start, rows), columns(place[1]))
                         for start, rows in ((0, block), (block, hidden), (block + hidden, hidden)))

        def gate_weights(tile: Any) -> tuple[jax.Array, ...]:
            return tuple(weight("gates", tile // per_block, everything,
                                pl.ds(number * block + tile % per_block * size, size)) for number in range(3))

        def product_weights(tile: Any) -> tuple[jax.Array]:
            return (weight("deter", columns(tile % PARTS, config.deter // PARTS), columns(tile // PARTS)),)

        for enter in (
            stage(hidden // 16, lambda tile: (weight("in_stoch", everything, columns(tile, 16)),), from_stoch),
            stage(tiles, core_weights, core),
            stage(tiles, gate_weights, gates),
            stage(2 * hidden // size * PARTS, product_weights, products),
            stage(latent // classes, lambda tile: (weight("post_logit", everything, columns(tile, classes)),), sample),
        ):
            waits = enter(waits)
        return waits

    jax.lax.fori_loop(0, count, one, jnp.int32(0))


def _index(at: tuple[Any, ...]) -> tuple[Any, ...]:
    """Whole numbers as Pallas wants them."""
    return tuple(jnp.int32(one) if isinstance(one, int) else one for one in at)


def _summed(read: Callable[..., jax.Array], start: int, width: int, pl: Any) -> jax.Array:
    """(B, width) sum over the parts of the split product."""
    total = read(0, slice(None), pl.ds(start, width))
    for part in range(1, PARTS):
        total += read(part, slice(None), pl.ds(start, width))
    return total


def _wait(counter: Any, target: Any, plt: Any) -> None:
    """Go on when all programs have come here: each adds one, and the counter is then at `target`."""
    plt.debug_barrier()  # what this program's threads wrote is written before it says so
    seen = plt.atomic_add(counter, (0,), jnp.int32(1)) + 1
    jax.lax.while_loop(lambda seen: seen < target, lambda _: plt.atomic_add(counter, (0,), jnp.int32(0)), seen)
    plt.debug_barrier()


LAYOUTS: dict[str, Layout] = {
    "fused": Layout(),
    "fused_8_warps": Layout(warps=8),
    "fused_wide": Layout(columns=32, warps=8),
    "fused_late": Layout(early=False),
    "fused_waiting": Layout(work=False),
}
"""What is timed; the last does nothing but wait."""


def measure(config: DreamerConfig, label: str, blocks: int) -> dict[str, dict[str, Any]]:
    """Milliseconds of the forward pass over a batch of sequences, by the scan and by the kernel.

    `latents_as_scanned` is the share of latents that are drawn as the scan draws them in the first step, from the same
    random numbers: where they differ, a probability lies within rounding of its number.

    Raises:
        RuntimeError: there is no GPU.
    """
    if jax.devices()[0].platform != "gpu":
        raise RuntimeError("the fused posterior is a Triton kernel: run this on a machine with an NVIDIA GPU")
    arguments = sequences(config)
    figures: dict[str, dict[str, Any]] = {}
    scanned, times = _timed(config, None, arguments, blocks)
    figures[f"observe_forward_ms_{label}"] = harness.figure(times, "ms")
    for name, layout in LAYOUTS.items():
        try:
            states, times = _timed(config, layout, arguments, blocks)
        except Exception as error:  # one layout that does not fit is no reason to lose the others
            print(f"{name}: failed, {type(error).__name__}: {str(error)[:300]}", flush=True)
            continue
        figures[f"observe_forward_ms_{label}_{name}"] = harness.figure(times, "ms")
        if layout.work:
            same = jnp.mean((states.stoch[0] == scanned.stoch[0]).reshape(-1, config.classes).all(-1))
            figures[f"latents_as_scanned_{label}_{name}"] = harness.figure([float(same)], "share")
    return figures


def sequences(config: DreamerConfig) -> tuple[Any, ...]:
    """Arguments of `rssm.observe` after the configuration: noise, with an episode's start now and then."""
    keys = jax.random.split(jax.random.key(0), 6)
    steps = (config.batch_length, config.batch_size)
    width = image.token_size(config, OBS_SHAPE)
    params = rssm.init(config, width, ACTION_DIM, keys[0])
    return (params, rssm.initial(config, config.batch_size), jax.random.normal(keys[1], (*steps, ACTION_DIM)),
            jax.random.normal(keys[2], (*steps, width), config.dtype), jax.random.uniform(keys[3], steps) < 0.01,
            jax.random.uniform(keys[4], (*steps, config.stoch)))


def _timed(config: DreamerConfig, layout: Layout | None, arguments: tuple[Any, ...], blocks: int
           ) -> tuple[Latent, list[float]]:
    """States of one pass, and milliseconds of a pass in each block of `ROUNDS`, each from where the last one ended."""
    params, start, *rest = arguments

    def observe(params: Params, start: Latent, *rest: jax.Array) -> Latent:
        return rssm.observe(config, params, start, *rest)[0]

    def many(params: Params, start: Latent, *rest: jax.Array) -> Latent:
        def one(_: jax.Array, start: Latent) -> Latent:
            return jax.tree.map(lambda leaf: leaf[-1], observe(params, start, *rest))

        return jax.lax.fori_loop(0, ROUNDS, one, start)

    with contextlib.ExitStack() as stack:
        if layout is not None:
            stack.enter_context(mock.patch.object(rssm, "scan_products", partial(fused_scan, layout)))
        states = jax.jit(observe)(params, start, *rest)
        program = jax.jit(many).lower(params, start, *rest).compile()
    seconds = harness.time_calls(lambda: program(params, start, *rest), repeats=blocks)
    return states, [1e3 * one / ROUNDS for one in seconds]

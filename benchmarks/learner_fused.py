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
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as plt

from benchmarks import harness
from benchmarks.learner_updates import ACTION_DIM, OBS_SHAPE
from dreamer.config import DreamerConfig
from dreamer.layers import image
from dreamer.layers.nets import NORM_EPS
from dreamer.layers.recurrence import Step, Tree
from dreamer.model import rssm
from dreamer.model.rssm import Latent
from dreamer.types import Params

ALL = slice(None)
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


def _check_widths(config: DreamerConfig) -> None:
    """Raise ValueError for a width that is not a power of two, which Triton needs."""
    for name in ("deter", "hidden", "stoch", "classes", "blocks", "batch_size"):
        value = getattr(config, name)
        if value & (value - 1):
            raise ValueError(f"fused posterior: {name} is {value}; Triton needs a power of two.")


def fused_scan(layout: Layout) -> Callable[..., tuple[Tree, Tree]]:
    """`recurrence.scan_products` for the step of `rssm.observe`, by one kernel; not differentiable."""
    def scan(step: Step, unroll: int, weights: dict[str, jax.Array], carry: Tree, terms: dict[str, jax.Array],
             inputs: Tree) -> tuple[Tree, Tree]:
        config: DreamerConfig = step.args[0]  # type: ignore[attr-defined]
        _check_widths(config)
        deter, stoch, product = carry
        (count, batch), width, hidden = inputs["is_first"].shape[:2], config.deter, config.hidden
        latent = stoch.shape[-1]
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
            _Program(config, layout, own, batch, pl.program_id(0)).run(count)

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

    return scan


@dataclass(frozen=True)
class _Program:
    """One program of the kernel: all stages of all steps, for its tiles."""

    config: DreamerConfig
    layout: Layout
    ref: dict[str, Any]
    """What the kernel reads and writes, by name."""
    batch: int
    me: Any
    """Number of this program."""

    @property
    def block(self) -> int:
        """Units of a block."""
        return self.config.deter // self.config.blocks

    @property
    def per_block(self) -> int:
        """Tiles of a block."""
        return self.block // self.layout.columns

    @property
    def tiles(self) -> int:
        """Tiles of the state."""
        return self.config.deter // self.layout.columns

    def run(self, count: int) -> None:
        """All steps."""
        jax.lax.fori_loop(0, count, self.step, jnp.int32(0))

    def step(self, t: Any, waits: Any) -> Any:
        """The stages of one step; returns how often the program has waited."""
        config, size = self.config, self.layout.columns
        latent, classes = config.stoch * config.classes, config.classes
        step = _Step(self, t, plt.load(self.ref["first"].at[t, ALL]))

        def stoch_weight(tile: Any) -> tuple[jax.Array]:
            return (self.weight("in_stoch", ALL, self.columns(tile, 16)),)

        def logit_weight(tile: Any) -> tuple[jax.Array]:
            return (self.weight("post_logit", ALL, self.columns(tile, classes)),)

        stages: tuple[tuple[int, Callable[[Any], tuple], Callable[..., None]], ...] = (
            (config.hidden // 16, stoch_weight, step.from_stoch),
            (self.tiles, self.core_weights, step.core),
            (self.tiles, self.gate_weights, step.gates),
            (2 * config.hidden // size * PARTS, self.product_weights, step.products),
            (latent // classes, logit_weight, step.sample),
        )
        for of, load, make in stages:
            waits = self.stage(of, load, make, waits)
        return waits

    def stage(self, of: int, load: Callable[[Any], tuple], make: Callable[..., None], waits: Any) -> Any:
        """Wait for the stage before, then make this stage's tiles; the weights may be on their way meanwhile."""
        layout = self.layout
        if layout.alone:
            for number in range(of):
                make(number, *load(number))
            return waits
        tile = jnp.minimum(self.me, of - 1)  # loads of programs without a tile are not used
        held = load(tile) if layout.early and layout.work else ()
        _wait(self.ref["waiting"], (waits + 1) * self.tiles)
        if layout.work:
            @pl.when(self.me < of)
            def _() -> None:
                make(tile, *(held or load(tile)))
        return waits + 1

    def shared(self, name: str, *at: Any) -> jax.Array:
        """Read what other programs wrote: past the cache of this multiprocessor."""
        return plt.load(self.ref[name].at[_index(at)], volatile=True)

    def constant(self, name: str, *at: Any) -> jax.Array:
        """Read a constant of the step."""
        return plt.load(self.ref[f"{name}_constant"].at[_index(at)]).astype(jnp.float32)

    def weight(self, name: str, *at: Any) -> jax.Array:
        """Read a part of a weight."""
        return plt.load(self.ref[f"{name}_weight"].at[_index(at)])

    def columns(self, tile: Any, of: int | None = None) -> Any:
        """Columns of a tile, of so many."""
        size = of or self.layout.columns
        return pl.ds(tile * size, size)

    def core_weights(self, tile: Any) -> tuple[jax.Array, ...]:
        """Of the core's product: its own block, the state's share and the latent's."""
        block, hidden = self.block, self.config.hidden
        place = (tile // self.per_block, tile % self.per_block)
        return tuple(self.weight("core", place[0], pl.ds(start, rows), self.columns(place[1]))
                     for start, rows in ((0, block), (block, hidden), (block + hidden, hidden)))

    def gate_weights(self, tile: Any) -> tuple[jax.Array, ...]:
        """Of reset, candidate and update."""
        size, per_block = self.layout.columns, self.per_block
        return tuple(self.weight("gates", tile // per_block, ALL,
                                 pl.ds(number * self.block + tile % per_block * size, size)) for number in range(3))

    def product_weights(self, tile: Any) -> tuple[jax.Array]:
        """Of the new state, into the posterior and the next step."""
        return (self.weight("deter", self.columns(tile % PARTS, self.config.deter // PARTS),
                            self.columns(tile // PARTS)),)


@dataclass(frozen=True)
class _Step:
    """The stages of step `t`: each makes one tile."""

    program: _Program
    t: Any
    first: jax.Array

    def kept(self, x: jax.Array) -> jax.Array:
        """Zero where an episode begins."""
        return jnp.where((self.first > 0)[:, None], jnp.zeros_like(x), x)

    def norm_act(self, x: jax.Array, scale: jax.Array, squares: jax.Array | None = None) -> jax.Array:
        """Normalised and activated, in the type of the state."""
        mean = jnp.mean(x * x, -1) if squares is None else squares
        normed = x * jax.lax.rsqrt(mean + NORM_EPS)[:, None] * scale[None]
        return jax.nn.silu(normed).astype(self.program.ref["deter"].dtype)

    def from_stoch(self, tile: Any, weight: jax.Array) -> None:
        """The latent's share of the core's input."""
        own = self.program
        value = _dot(self.kept(own.shared("stoch", self.t, ALL, ALL)), weight)
        place = own.columns(tile, 16)
        plt.store(own.ref["from_stoch"].at[:, place], value + own.constant("in_stoch", place)[None])

    def core(self, tile: Any, block_share: jax.Array, deter_share: jax.Array, stoch_share: jax.Array) -> None:
        """The core's product, and its squares for the norm."""
        own, hidden = self.program, self.program.config.hidden
        old = self.kept(own.shared("deter", self.t, ALL, own.columns(tile // own.per_block, own.block)))
        product = self.kept(_summed(partial(own.shared, "products"), 0, hidden))
        deter_part = self.norm_act(product + own.constant("in_deter_bias", ALL)[None],
                                   own.constant("in_deter_scale", ALL))
        stoch_part = self.norm_act(own.shared("from_stoch", ALL, ALL), own.constant("in_stoch_scale", ALL))
        value = _dot(old, block_share) + _dot(deter_part, deter_share) + _dot(stoch_part, stoch_share)
        value += plt.load(own.ref["core_term"].at[self.t, :, own.columns(tile)]).astype(jnp.float32)
        plt.store(own.ref["wide"].at[:, own.columns(tile)], value)
        plt.store(own.ref["squares"].at[_index((tile, ALL))], jnp.sum(value * value, -1))

    def gates(self, tile: Any, reset: jax.Array, candidate: jax.Array, update: jax.Array) -> None:
        """The new state."""
        own, block, size = self.program, self.program.block, self.program.layout.columns
        group, inside = tile // own.per_block, tile % own.per_block
        squares = jnp.sum(own.shared("squares", ALL, ALL), 0) / own.config.deter
        wide = self.norm_act(own.shared("wide", ALL, own.columns(group, block)),
                             own.constant("core_scale", own.columns(group, block)), squares)

        def gate(weight: jax.Array, number: int) -> jax.Array:
            place = pl.ds(group * 3 * block + number * block + inside * size, size)
            return _dot(wide, weight) + own.constant("gates", place)[None]

        value = jnp.tanh(jax.nn.sigmoid(gate(reset, 0)) * gate(candidate, 1))
        share = jax.nn.sigmoid(gate(update, 2) - 1.0)
        old = self.kept(own.shared("deter", self.t, ALL, own.columns(tile))).astype(jnp.float32)
        new = (share * value + (1 - share) * old).astype(own.ref["deter"].dtype)
        plt.store(own.ref["deter"].at[self.t + 1, :, own.columns(tile)], new)

    def products(self, tile: Any, weight: jax.Array) -> None:
        """A part of the new state's products."""
        own = self.program
        part, place = tile % PARTS, tile // PARTS
        rows = own.shared("deter", self.t + 1, ALL, own.columns(part, own.config.deter // PARTS))
        plt.store(own.ref["products"].at[_index((part, ALL, own.columns(place)))], _dot(rows, weight))

    def sample(self, tile: Any, weight: jax.Array) -> None:
        """Posterior probabilities of one class variable, and what is drawn of them."""
        own, config = self.program, self.program.config
        classes, hidden, shape = config.classes, config.hidden, (own.batch, config.classes, config.classes)
        value = _summed(partial(own.shared, "products"), hidden, hidden)
        value += plt.load(own.ref["post_term"].at[self.t, :, :]).astype(jnp.float32)
        place = own.columns(tile, classes)
        logits = _dot(self.norm_act(value, own.constant("post_scale", ALL)), weight)
        logits += own.constant("post_logit", place)[None]
        scaled = jnp.exp(logits - jnp.max(logits, -1)[:, None])
        probs = (1 - config.unimix) * scaled / jnp.sum(scaled, -1)[:, None] + config.unimix / classes
        row, column = (jax.lax.broadcasted_iota(jnp.int32, shape, axis) for axis in (1, 2))
        reached = jnp.sum(jnp.where(row <= column, probs[:, :, None], 0.0), 1)
        position = jax.lax.broadcasted_iota(jnp.int32, shape[:2], 1)
        drawn = plt.load(own.ref["uniform"].at[_index((self.t, ALL, tile))])
        passed = (drawn[:, None] >= reached) & (position < classes - 1)
        index = jnp.sum(passed.astype(jnp.int32), -1)
        chosen = (position == index[:, None]).astype(own.ref["deter"].dtype)
        plt.store(own.ref["stoch"].at[self.t + 1, :, place], chosen)
        plt.store(own.ref["probs"].at[self.t, :, place], probs)


def _dot(x: jax.Array, weight: jax.Array) -> jax.Array:
    return jnp.dot(x, weight, preferred_element_type=jnp.float32)


def _index(at: tuple[Any, ...]) -> tuple[Any, ...]:
    """Whole numbers as Pallas wants them."""
    return tuple(jnp.int32(one) if isinstance(one, int) else one for one in at)


def _summed(read: Callable[..., jax.Array], start: int, width: int) -> jax.Array:
    """(B, width) sum over the parts of the split product."""
    total = read(0, slice(None), pl.ds(start, width))
    for part in range(1, PARTS):
        total += read(part, slice(None), pl.ds(start, width))
    return total


def _wait(counter: Any, target: Any) -> None:
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
        return rssm.observe(config, params, start, rssm.Sequences(*rest))[0]

    def many(params: Params, start: Latent, *rest: jax.Array) -> Latent:
        def one(_: jax.Array, start: Latent) -> Latent:
            return jax.tree.map(lambda leaf: leaf[-1], observe(params, start, *rest))

        return jax.lax.fori_loop(0, ROUNDS, one, start)

    with contextlib.ExitStack() as stack:
        if layout is not None:
            stack.enter_context(mock.patch.object(rssm, "scan_products", fused_scan(layout)))
        states = jax.jit(observe)(params, start, *rest)
        program = jax.jit(many).lower(params, start, *rest).compile()
    seconds = harness.time_calls(lambda: program(params, start, *rest), repeats=blocks)
    return states, [1e3 * one / ROUNDS for one in seconds]

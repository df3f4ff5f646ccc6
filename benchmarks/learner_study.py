"""What `benchmarks.learner` measures beside one update: batch sizes, seeds side by side, a profile, other programs.

Every variant is a program of its own, and compiling it takes most of the time: `--compile-threads` compiles several
at once. A variant that fails is printed and left out, and what is finished is recorded at once. With `--limit-s` no
further variant is begun after so long.

The variants of `--tries`, each against the program as it is:

- unrollN: N steps of the recurrences in one loop body;
- scan_gradients: the scan over time is differentiated as it is, so that every step adds to the weights' gradients;
- unhoisted: besides, the action's and the tokens' share of the products, the masks and the casts are inside the scan;
- no_command_buffers, command_buffers_while: no CUDA graphs, and graphs that hold whole loops;
- deterministic, no_autotune, no_triton_gemm: flags of XLA; the reference learner sets the first, the others show what
  choosing among kernels costs in compilation and brings in speed;
- fused_posterior: the forward pass of the observing scan as one kernel (`benchmarks.learner_fused`), against that scan.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp

from benchmarks import harness, learner_fused, learner_profile
from benchmarks.learner_updates import Updates
from bridge.nodes.options import in_range, whole
from dreamer.config import DreamerConfig
from dreamer.layers import distributions, recurrence
from dreamer.model import rssm
from dreamer.model.rssm import Latent
from dreamer.types import Params

Figures = dict[str, dict[str, Any]]
WHILE = "FUSION,CUBLAS,CUBLASLT,CUDNN,CUSTOM_CALL,DYNAMIC_SLICE_FUSION,CONDITIONAL,WHILE"
NO_GRAPHS = "--xla_gpu_enable_command_buffer="
FLAGS = {
    "no_command_buffers": NO_GRAPHS,
    "command_buffers_while": f"--xla_gpu_enable_command_buffer={WHILE}",
    "deterministic": "--xla_gpu_deterministic_ops=true",
    "no_autotune": "--xla_gpu_autotune_level=0",
    "no_triton_gemm": "--xla_gpu_enable_triton_gemm=false",
}
"""Tries that need a process of their own, for XLA reads its flags once."""
UNROLLS = (1, 2, 4, 8)
FORMS = ("scan_gradients", "unhoisted")
FUSED = "fused_posterior"
TRIES = (*(f"unroll{count}" for count in UNROLLS), *FORMS, *FLAGS, FUSED)


@dataclass(frozen=True)
class Variant:
    """One program to be timed."""

    label: str
    """How its figures end."""
    config: DreamerConfig
    runs: int = 0
    """Seeds side by side; 0: one agent without a seed axis."""
    form: str = ""
    """One of `FORMS`, or the program as it is."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the study."""
    parser.add_argument("--batches", type=whole(), nargs="+", default=[], help="time these batch sizes")
    parser.add_argument("--seeds-under-vmap", type=whole(), nargs="+", default=[],
                        help="time so many seeds side by side")
    parser.add_argument("--host-replay", action="store_true", help="time it with the observations on the host")
    parser.add_argument("--profile", action="store_true", help="count the kernels of an update and share out its time")
    parser.add_argument("--tries", nargs="*", choices=TRIES, help="time other programs; all of them unless named")
    parser.add_argument("--compile-threads", type=whole(), default=1, help="programs compiled at once")
    parser.add_argument("--limit-s", type=in_range(0), default=float("inf"),
                        help="begin no further variant after so long")
    parser.add_argument("--skip-base", action="store_true", help="do not time the update as it is")
    parser.add_argument("--one-profile", action="store_true", help=argparse.SUPPRESS)  # in a process of its own
    parser.add_argument("--one-fused", action="store_true", help=argparse.SUPPRESS)  # likewise: it could hang
    parser.add_argument("--json", action="store_true", help=argparse.SUPPRESS)


def label_of(name: str, batch: int | None) -> str:
    """How the figures of a size and a batch size end."""
    return name.removeprefix("size") + (f"_batch{batch}" if batch else "")


def run(name: str, config: DreamerConfig, args: argparse.Namespace, keep: Callable[[Figures], None]) -> None:
    """Measure what the options ask for; `keep` gets the figures of each variant as soon as they are known."""
    until = time.monotonic() + args.limit_s
    label = label_of(name, args.batch_size)
    if args.one_profile:
        keep(learner_profile.measure(config, label, args.per_block))
    if args.one_fused:
        keep(learner_fused.measure(config, label, args.blocks))
    if args.profile:
        keep(in_process("profile", args, NO_GRAPHS, ["--one-profile"]))
    tries = TRIES if args.tries == [] else args.tries or ()
    for figures in time_variants(list(variants(name, label, config, args, tries)), args, until):
        keep(figures)
    if FUSED in tries and not skipped(FUSED, until):
        keep(in_process(FUSED, args, "", ["--one-fused"]))
    for one in (one for one in tries if one in FLAGS):
        if skipped(one, until):
            continue
        for key, value in in_process(one, args, FLAGS[one], ["--compile-threads", "1"]).items():
            if re.search("per_s(_|$)|^compile_s", key):
                keep({f"{key}_{one}": value})


def variants(
    name: str, label: str, config: DreamerConfig, args: argparse.Namespace, tries: tuple[str, ...] | list[str]
) -> Iterator[Variant]:
    """Those that are timed in this process."""
    if args.host_replay:
        yield Variant(f"{label}_host_replay", dataclasses.replace(config, replay_memory="host"))
    for batch in args.batches:
        yield Variant(label_of(name, batch), dataclasses.replace(config, batch_size=batch))
    for runs in args.seeds_under_vmap:
        yield Variant(f"{label}_seeds{runs}", config, runs)
    for one in tries:
        if one in FORMS:
            yield Variant(f"{label}_{one}", config, form=one)
        elif one.startswith("unroll"):
            unrolled = dataclasses.replace(config, scan_unroll=int(one.removeprefix("unroll")))
            yield Variant(f"{label}_{one}", unrolled)


def time_variants(found: list[Variant], args: argparse.Namespace, until: float) -> Iterator[Figures]:
    """Figures of each variant: rates of updates and of replayed steps, both of all its runs together."""
    with ThreadPoolExecutor(args.compile_threads) as pool:
        while found:
            group, found = found[: args.compile_threads], found[args.compile_threads :]
            programs = [
                (one, _trace(one, args.per_block, pool)) for one in group if not skipped(one.label, until)
            ]  # traced one after the other, compiled together, and only then timed
            for _, program in programs:
                if program is not None:
                    program[1].exception()
            for one, program in programs:
                yield _timed(one, program, args.blocks)


def skipped(label: str, until: float) -> bool:
    """Whether the time is up; then it says what is left out."""
    late = time.monotonic() > until
    if late:
        print(f"{label}: left out, --limit-s is over", flush=True)
    return late


def _trace(one: Variant, per_block: int, pool: ThreadPoolExecutor) -> tuple[Updates, Future[float]] | None:
    try:
        with in_form(one.form):
            updates = Updates(one.config, per_block, one.runs)
        return updates, pool.submit(updates.compile)
    except Exception as error:  # whatever is wrong with one variant, the others are measured
        _report(one.label, error)
        return None


def _timed(one: Variant, program: tuple[Updates, Future[float]] | None, blocks: int) -> Figures:
    if program is None:
        return {}
    try:
        compile_s = program[1].result()
        seconds, _ = program[0].time(blocks)
    except Exception as error:
        _report(one.label, error)
        return {}
    rates = [max(one.runs, 1) / s for s in seconds]
    return {
        f"compile_s_{one.label}": harness.figure([compile_s], "s"),
        f"updates_per_s_{one.label}": harness.figure(rates, "1/s"),
        f"replayed_steps_per_s_{one.label}": harness.figure(
            [one.config.replayed_per_update * rate for rate in rates], "1/s"
        ),
    }


def _report(label: str, error: Exception) -> None:
    print(f"{label}: failed, {type(error).__name__}: {str(error)[:300]}", flush=True)


def in_process(name: str, args: argparse.Namespace, flags: str, more: list[str]) -> Figures:
    """Figures of this benchmark in a process of its own with `flags` for XLA; none where it fails."""
    given = {"--preset": args.preset, "--batch-size": args.batch_size, "--unroll": args.unroll, "--dtype": args.dtype,
             "--blocks": args.blocks, "--per-block": args.per_block}
    command = [sys.executable, "-m", "benchmarks.learner", "--dry", "--json", *more]
    command += ["--skip-base"] if any(one.startswith("--one-") for one in more) else []
    command += [word for option, value in given.items() if value is not None for word in (option, str(value))]
    on_cpu = jax.devices()[0].platform == "cpu"
    flags = "" if on_cpu else flags  # a CPU knows none of them; there the process repeats the program as it is
    environment = {**os.environ, "XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} {flags}".strip(),
                   "XLA_PYTHON_CLIENT_PREALLOCATE": "false"}  # this process holds most of the device's memory
    try:
        answer = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=240)
        if answer.returncode == 0:
            return json.loads(answer.stdout.splitlines()[-1])
        reason = (answer.stderr.strip().splitlines() or ["no message"])[-1]
    except subprocess.TimeoutExpired:
        reason = "took more than 240 s"
    print(f"{name}: failed, {reason[:300]}", flush=True)
    return {}


@contextlib.contextmanager
def in_form(form: str) -> Iterator[None]:
    """The learner traced within has its observing scan in one of `FORMS`."""
    with contextlib.ExitStack() as stack:
        if form:
            stack.enter_context(mock.patch.object(rssm, "scan_products", plain_scan))
        if form == "unhoisted":
            stack.enter_context(mock.patch.object(rssm, "observe", plain_observe))
        yield


def plain_scan(
    step: recurrence.Step, unroll: int, weights: Params, carry: Any, terms: Params, inputs: Any
) -> tuple[Any, Any]:
    """`recurrence.scan_products` differentiated by JAX, which adds a weight's gradient at every step."""

    def body(carry: Any, x: Any) -> tuple[Any, Any]:
        carry, outputs, _ = step(weights, carry, *x)
        return carry, outputs

    return jax.lax.scan(body, carry, (terms, inputs), unroll=unroll)


def plain_observe(
    config: DreamerConfig, params: Params, start: Latent, sequences: rssm.Sequences
) -> tuple[Latent, jax.Array]:
    """`rssm.observe` as it is read, with everything inside the scan; arguments and results as there."""

    def body(latent: Latent, x: tuple[jax.Array, ...]) -> tuple[Latent, tuple[Latent, jax.Array]]:
        action, token, first, draw = x
        begun = first[:, None]
        latent = jax.tree.map(lambda leaf: jnp.where(begun, jnp.zeros_like(leaf), leaf), latent)
        deter = rssm.core(config, params, latent, jnp.where(begun, 0.0, action))
        probs = rssm.posterior_probs(config, params, deter, token)
        index = distributions.sample_index(jax.lax.stop_gradient(probs), draw)
        stoch = distributions.straight_through(probs, index).reshape(latent.stoch.shape).astype(deter.dtype)
        return Latent(deter, stoch), (Latent(deter, stoch), probs)

    scan = partial(jax.lax.scan, unroll=config.scan_unroll)
    return scan(body, start, tuple(sequences))[1]

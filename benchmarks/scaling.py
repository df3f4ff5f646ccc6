"""Measures how stepping the environment and learning scale over the devices of one host, at a fixed work per device.

    python -m benchmarks.scaling                          # 1, 2 and 4 devices, those that exist
    python -m benchmarks.scaling --devices 1 2 --parts learner
    XLA_FLAGS=--xla_force_host_platform_device_count=4 python -m benchmarks.scaling --tiny --out DIR   # on a CPU

Efficiency is the share of linear scaling, rate_n / (n * rate_1). All device counts are compiled first and then take
turns block by block, so that a drift of the machine hits them alike. Both programs are those of a training run.
"""

from __future__ import annotations

import collections
import dataclasses
import re
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from benchmarks.harness import RESULTS, figure, record
from dreamer.config import DreamerConfig, preset
from dreamer.experience.iteration import Metrics, TrainState, compile_iteration, init_state, replayed_updates
from dreamer.experience.replay import Replay
from dreamer.model import agent as agents
from dreamer.training import parallel
from dreamer.types import FunctionalEnv, Transition
from whill_mjx.devices import choose_devices
from whill_mjx.io.command_line import COUNT, run
from whill_mjx.learning.setup import functional_env, make_evaluation_env
from whill_mjx.tasks.tasks import make_task

CLAIM = "Stepping the environment and learning on several devices of one host, at a fixed work per device"
DEFAULT_COUNTS = (1, 2, 4)
OBS_SHAPE = (64, 64, 3)
ACTION_DIM = 2
TINY: dict[str, Any] = dict(
    deter=16, hidden=8, units=8, stoch=2, classes=4, blocks=2, patch_units=4, depth=1, imag_horizon=2, scan_unroll=1,
    value_layers=1, policy_layers=1,
)  # fmt: skip
Name = tuple[str, int]
"""Part and device count."""
BYTES = {"pred": 1, "s8": 1, "u8": 1, "bf16": 2, "f16": 2, "s64": 8, "u64": 8, "f64": 8}
"""Bytes of an element where they are not 4."""


@dataclass(frozen=True)
class Options:
    """Options of the benchmark; everything counts per device."""

    devices: Annotated[tuple[int, ...], COUNT] = ()
    """Device counts; none takes those of 1, 2 and 4 that exist. 1 is always measured, as the base."""
    instances: Annotated[int, COUNT] = 2048
    """Chairs."""
    steps: Annotated[int, COUNT] = 100
    """Environment steps of a block, in one dispatch."""
    batch: Annotated[int, COUNT] = 16
    """Sequences of a batch."""
    length: Annotated[int, COUNT] = 64
    """Steps of a sequence."""
    updates: Annotated[int, COUNT] = 10
    """Updates of a block, in one dispatch."""
    streams: Annotated[int, COUNT] = 256
    """Streams of the replay."""
    rows: Annotated[int, COUNT] = 256
    """Steps of each stream that the replay holds."""
    preset: str = "size12m"
    """Size of the learner."""
    blocks: Annotated[int, COUNT] = 7
    """Timed blocks of each device count."""
    parts: tuple[str, ...] = ("env", "learner")
    """What to measure."""
    tiny: bool = False
    """Sizes that only show that everything runs."""
    out: Path = RESULTS
    """Folder of scaling.json."""


@dataclass
class Program:
    """A compiled block of work and the state it goes on from."""

    run: Callable[[Any], Any]
    """state -> state, the old one donated."""
    state: Any
    work: int
    """Steps of one block, of all devices together."""
    compile_s: float


def counts_of(options: Options) -> tuple[int, ...]:
    """Device counts to measure, 1 first; ValueError if there are not so many devices."""
    existing = [count for count in DEFAULT_COUNTS if count <= len(jax.devices())]
    counts = tuple(sorted({1, *(options.devices or existing)}))
    for count in counts:
        choose_devices(count)
    return counts


def sized(options: Options) -> Options:
    """The options with the smallest sizes, if they ask for them."""
    if not options.tiny:
        return options
    return dataclasses.replace(
        options, instances=2, steps=2, batch=2, length=4, updates=2, streams=2, rows=16,
        preset="cpu", blocks=5,
    )  # fmt: skip


def env_program(options: Options, count: int) -> Program:
    """`steps` steps of `instances` chairs on each device: obstacle course, camera image, auto-reset, random actions."""
    devices = choose_devices(count)
    total = count * options.instances
    task = make_task("obstacle_course")
    env = functional_env(make_evaluation_env(task, "whill_cr_ramp", total, devices=devices))

    def body(carry: tuple[Any, Transition, jax.Array], key: jax.Array) -> tuple[Any, None]:
        state, transition, earned = carry
        state, transition = env.step(state, jax.random.uniform(key, (total, ACTION_DIM), minval=-1.0))
        return (state, transition, earned + transition.reward), None

    def block(carry: tuple[Any, Transition, jax.Array, jax.Array]) -> tuple[Any, Transition, jax.Array, jax.Array]:
        state, transition, earned, key = carry
        key, used = jax.random.split(key)
        (state, transition, earned), _ = jax.lax.scan(
            body, (state, transition, earned), jax.random.split(used, options.steps)
        )
        return state, transition, earned, key

    def begin() -> tuple[Any, Transition, jax.Array, jax.Array]:
        state, transition = env.reset(jax.random.key(0))
        return state, transition, jnp.zeros_like(transition.reward), jax.random.key(1)

    state = jax.block_until_ready(jax.jit(begin)())
    start = time.perf_counter()
    placement = jax.tree.map(lambda leaf: leaf.sharding, state)
    compiled = jax.jit(block, donate_argnums=0, out_shardings=placement).lower(state).compile()
    compile_s = time.perf_counter() - start
    show_exchange(f"environment, {count} devices, {compile_s:.1f} s", compiled)
    return Program(compiled, state, total * options.steps, compile_s)


def learner_program(options: Options, count: int) -> Program:
    """`updates` updates: draw from the replay, gradient step, latents written back; split as in a training run."""
    config = preset(
        options.preset, batch_size=count * options.batch, batch_length=options.length,
        replay_capacity=count * options.streams * options.rows, **(TINY if options.tiny else {}),
    )  # fmt: skip
    devices = choose_devices(count)
    env = still_env(count * options.streams)
    mesh = parallel.make_mesh(devices, env.num_envs, config.batch_size) if devices else None

    def begin() -> TrainState:
        state = init_state(env, config, 0)
        return dataclasses.replace(state, replay=filled(config, state.replay), credit=jnp.int32(options.updates))

    placement = parallel.state_shardings(mesh, jax.eval_shape(begin), env.num_envs) if mesh else None
    state = jax.block_until_ready(jax.jit(begin, out_shardings=placement)())
    start = time.perf_counter()
    iterate = compile_iteration(env, config, state, mesh, updates_alone)
    compile_s = time.perf_counter() - start
    show_exchange(f"learner, {count} devices, {compile_s:.1f} s", iterate)
    work = config.replayed_per_update * options.updates
    return Program(lambda one: iterate(one)[0], state, work, compile_s)


def updates_alone(
    env: FunctionalEnv, config: DreamerConfig, state: TrainState, mesh: Mesh | None
) -> tuple[TrainState, Metrics]:
    """A training iteration that collects nothing; the credit says how many updates it makes, and is not used up."""
    key, used = jax.random.split(state.key)
    return replayed_updates(config, dataclasses.replace(state, key=key), state.credit, used, agents.update, mesh)


def still_env(count: int) -> FunctionalEnv:
    """Black frames in which nothing happens: the learner's state needs an environment's sizes, not its steps."""

    def frames() -> Transition:
        images, rewards, no = (jnp.zeros((count, *shape), kind) for shape, kind in
                               ((OBS_SHAPE, jnp.uint8), ((), jnp.float32), ((), bool)))  # fmt: skip
        return Transition(images, rewards, ~no, no, no, {})

    return FunctionalEnv(count, OBS_SHAPE, ACTION_DIM, lambda key: ((), frames()), lambda state, action: ((), frames()))


def filled(config: DreamerConfig, memory: Replay) -> Replay:
    """The memory (L, N) full of noise, with an episode's start every 100 rows and no sequence waiting as fresh."""
    rows, streams = memory.reward.shape
    obs_key, action_key, stoch_key = jax.random.split(jax.random.key(0), 3)
    starts = jnp.broadcast_to((jnp.arange(rows) % 100 == 0)[:, None], (rows, streams))
    return dataclasses.replace(
        memory,
        obs=jax.random.bits(obs_key, memory.obs.shape, jnp.uint8),
        action=jax.random.normal(action_key, memory.action.shape),
        stoch=jax.random.randint(stoch_key, memory.stoch.shape, 0, config.classes).astype(jnp.uint8),
        is_first=starts,
        is_last=jnp.roll(starts, -1, 0),
        written=jnp.int32(rows),
        online_next=jnp.int32(rows * streams),
    )


def exchange(program: str) -> dict[str, tuple[int, int]]:
    """Collectives in the text of a compiled program: how many, and bytes of their results; loops count once."""
    found: dict[str, tuple[int, int]] = collections.defaultdict(lambda: (0, 0))
    pattern = r"= (.*?) (all-reduce|all-gather|all-to-all|collective-permute|reduce-scatter)(?:-start)?\("
    for shapes, name in re.findall(pattern, program):
        size = 0
        for kind, sides in re.findall(r"([a-z]+\d*)\[([\d,]*)\]", shapes):
            elements = 1
            for side in filter(None, sides.split(",")):
                elements *= int(side)
            size += elements * BYTES.get(kind, 4)
        found[name] = (found[name][0] + 1, found[name][1] + size)
    return dict(found)


def show_exchange(what: str, program: Any) -> None:
    """Print what each device computes, which should not grow with their number, and what they send each other."""
    found = [f"{count} {name} ({size / 2**20:.3g} MiB)" for name, (count, size) in exchange(program.as_text()).items()]
    flops = (program.cost_analysis() or {}).get("flops", float("nan"))  # loops count once here, too
    print(f"compiled {what}: {flops:.4g} flops per device; {', '.join(found) or 'nothing exchanged'}", flush=True)


def rates(programs: dict[Name, Program], blocks: int) -> dict[Name, list[float]]:
    """Steps per second of each block of each program; they take turns, after a round that is not counted."""
    found: dict[Name, list[float]] = {name: [] for name in programs}
    for block in range(blocks + 1):
        for name, program in programs.items():
            start = time.perf_counter()
            program.state = jax.block_until_ready(program.run(program.state))
            if block:
                found[name].append(program.work / (time.perf_counter() - start))
    return found


def measure(unit: str, programs: dict[Name, Program], blocks: int) -> dict[str, dict[str, Any]]:
    """Rates, efficiencies of their medians (share of linear) and seconds to compile; printed too."""
    found = rates(programs, blocks)
    figures = {}
    for (part, count), each in found.items():
        figures[f"{part}_{unit}_{count}"] = figure(each, "1/s")
        figures[f"{part}_compile_s_{count}"] = figure([programs[part, count].compile_s], "s")
        if count > 1:
            share = statistics.median(each) / (count * statistics.median(found[part, 1]))
            figures[f"{part}_efficiency_{count}"] = figure([share], "of linear")
    for name, one in figures.items():
        print(f"{name}: {one['value']:,.4g} {one['unit']}", flush=True)
    return figures


def main(options: Options) -> None:
    """Measure and write scaling.json; ValueError if more devices are asked for than there are."""
    options = sized(options)
    counts = counts_of(options)
    print(f"{', '.join(map(str, counts))} of {len(jax.devices())} devices: {jax.devices()[0].device_kind}", flush=True)
    figures: dict[str, dict[str, Any]] = {}
    if "env" in options.parts:
        programs = {("env", count): env_program(options, count) for count in counts}
        figures |= measure("steps_per_s", programs, options.blocks)
        programs.clear()
    if "learner" in options.parts:
        programs = {("learner", count): learner_program(options, count) for count in counts}
        figures |= measure("replayed_steps_per_s", programs, options.blocks)
    print(record("scaling", CLAIM, figures, options.out))


if __name__ == "__main__":
    run(Options, main, __doc__, positional=False)

"""Measures the learner: whole updates (draw from the replay, gradient step, latents written back), and their parts.

    python -m benchmarks.learner                  # size12m on an accelerator, the cpu preset on a CPU
    python -m benchmarks.learner --preset size25m --batch-size 32
    python -m benchmarks.learner --preset size1m --dtype float32 --unroll 1 --per-block 2     # on a CPU
    python -m benchmarks.learner --peer           # and SheepRL's learner in the same run (pip install sheeprl)
    python -m benchmarks.learner --batches 16 32 64 128 256 --seeds-under-vmap 1 2 4 8 --profile --tries
        # scaling, where an update's time goes, other ways to compile it (benchmarks.learner_study)
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp

from benchmarks import harness, learner_study
from benchmarks.learner_updates import ACTION_DIM, OBS_SHAPE, ROWS, STREAMS, random_replay, time_updates
from bridge.nodes.options import Parser, in_range, whole
from dreamer.config import DreamerConfig, preset
from dreamer.experience import replay
from dreamer.layers import distributions, image
from dreamer.model import agent as agents
from dreamer.model import behavior, optim, rssm, world_model
from dreamer.model.rssm import Latent
from whill_mjx.io.command_line import guarded

Figures = dict[str, dict[str, Any]]
CLAIM = "One DreamerV3 update, all of it on the device, as the training loop runs it."


def parts(config: DreamerConfig) -> dict[str, Callable[[], Any]]:
    """The parts of an update as separate calls. They overlap and miss what connects them, so they do not add up."""
    key = jax.random.PRNGKey(0)
    agent = agents.init_agent(config, OBS_SHAPE, ACTION_DIM, key)
    memory = jax.jit(lambda k: random_replay(config, k))(key)
    _, batch, _ = jax.jit(lambda m, k: replay.sample(config, m, k))(memory, key)
    steps = batch.reward.shape
    tokens = jnp.zeros((*steps, image.token_size(config, OBS_SHAPE)), config.dtype)
    latent = rssm.initial(config, steps[0] * steps[1])
    start = rssm.initial(config, config.start_steps * steps[1])

    def observe(params: Any, tokens: jax.Array) -> jax.Array:
        uniform = jax.random.uniform(key, (*steps, config.stoch))
        sequences = rssm.Sequences(batch.prev_action, tokens, batch.is_first, uniform)
        states, post = rssm.observe(config, params["dyn"], batch.start, sequences)
        prior = rssm.prior_probs(config, params["dyn"], states.deter)
        features = states.features().astype(jnp.float32)
        return jnp.mean(jnp.square(features)) + jnp.mean(distributions.categorical_kl(post, prior))

    def encode(params: Any) -> jax.Array:
        return jnp.mean(jnp.square(image.encode(config, params["enc"], batch.obs).astype(jnp.float32)))

    def heads(params: Any, features: jax.Array) -> jax.Array:
        reward = world_model.head(params["reward"], features)
        alive = world_model.head(params["continue"], features)[..., 0]
        target = world_model.continue_target(config, batch.is_terminal)
        loss = distributions.cross_entropy(reward, distributions.twohot(batch.reward, config.bins))
        return jnp.mean(loss) + jnp.mean(distributions.bernoulli_loss(alive, target))

    def images(params: Any, latent: Latent) -> jax.Array:
        encoded = image.encode(config, params["enc"], batch.obs).astype(jnp.float32)
        frames = batch.obs.reshape(-1, *OBS_SHAPE)
        recon = image.reconstruction_loss(config, params["dec"], latent.deter, latent.stoch, frames)
        return jnp.mean(jnp.square(encoded)) + jnp.mean(recon)

    def behave(params: Any, latent: Latent) -> jax.Array:
        losses, *_ = behavior.imagination_loss(config, params, agent.slow_value, agent.return_norm, latent, key)
        return sum((jnp.mean(value) for value in losses.values()), jnp.zeros(()))

    features = jnp.zeros((*steps, config.deter + config.stoch_size), config.dtype)
    calls: dict[str, tuple[Callable[..., Any], tuple]] = {
        "encode": (jax.grad(encode), (agent.params,)),
        "heads": (jax.grad(heads, argnums=(0, 1)), (agent.params, features)),
        "observe": (jax.grad(observe, argnums=(0, 1)), (agent.params, tokens)),
        "images": (jax.grad(images, argnums=(0, 1)), (agent.params, latent)),
        "behavior": (jax.grad(behave), (agent.params, start)),
        "imagine": (lambda p, s: _arrays(behavior.imagine(config, p, s, key)), (agent.params, start)),
        "optimiser": (lambda p, o: optim.update(config, p, p, o), (agent.params, agent.opt)),
        "draw": (lambda m: replay.sample(config, m, key)[1], (memory,)),
    }
    return {name: _bind(jax.jit(function), arguments) for name, (function, arguments) in calls.items()}


def peer(size: str, batch: int | None, blocks: int, per_block: int, limit_s: float) -> dict[str, Any]:
    """Updates/s of SheepRL's learner, plain and through `torch.compile`; of the faster one as the peer's.

    One that takes longer than `limit_s` is left out; with only the other one, which is faster is not known.
    """
    found = {}
    for name, more in (("eager", []), ("compiled", ["--compile"])):
        command = [sys.executable, "-m", "benchmarks.learner_peer", "--size", size, "--blocks", str(blocks),
                   "--per-block", str(per_block), "--batch-size", str(batch or 16), *more]
        try:
            answer = subprocess.run(command, capture_output=True, text=True, timeout=limit_s)
        except subprocess.TimeoutExpired:
            print(f"peer, {name}: left out, not done after {limit_s:g} s", flush=True)
            continue
        if answer.returncode:
            print(f"peer, {name}: left out, {answer.stderr.strip().splitlines()[-1]}", flush=True)
            continue
        one = json.loads(answer.stdout.splitlines()[-1])
        found[name] = harness.figure(one["updates_per_s"], "1/s", one["device"])
    label = f"{size.lower()}" + (f"_batch{batch}" if batch else "")
    figures = {f"peer_updates_per_s_{label}_{name}": one for name, one in found.items()}
    if len(found) == 2:
        figures[f"peer_updates_per_s_{label}"] = max(found.values(), key=lambda one: one["value"])
    return figures


def replay_bytes(config: DreamerConfig) -> float:
    """Bytes of the replay for each of its steps."""
    memory = jax.eval_shape(lambda: replay.init(config, STREAMS, OBS_SHAPE, ACTION_DIM))
    stored = [leaf for leaf in jax.tree.leaves(memory) if leaf.ndim >= 2 and leaf.shape[:2] == memory.reward.shape]
    return sum(leaf.size * leaf.dtype.itemsize for leaf in stored) / memory.reward.size


def _arrays(rollout: behavior.Imagined) -> tuple[jax.Array, jax.Array]:
    return rollout.features, rollout.actions


def _bind(function: Callable[..., Any], arguments: tuple) -> Callable[[], Any]:
    return lambda: function(*arguments)


def arguments() -> argparse.ArgumentParser:
    """The options."""
    parser = Parser(
        prog="python -m benchmarks.learner", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--preset", help="size; size12m on an accelerator and cpu on a CPU unless given")
    parser.add_argument("--batch-size", type=whole())
    parser.add_argument("--unroll", type=whole())
    parser.add_argument("--dtype", choices=("bfloat16", "float32"), help="type of the products")
    parser.add_argument("--blocks", type=whole(), default=5)
    parser.add_argument("--per-block", type=whole(), default=10)
    parser.add_argument("--parts", action="store_true", help="also time the parts of an update")
    parser.add_argument("--peer", action="store_true", help="also time the learner of SheepRL at this size")
    parser.add_argument("--peer-limit-s", type=in_range(0), default=600.0, help="for each of the peer's two ways")
    learner_study.add_arguments(parser)
    parser.add_argument("--dry", action="store_true", help="print only")
    return parser


def base(name: str, config: DreamerConfig, args: argparse.Namespace) -> Figures:
    """Figures of the update as it is configured."""
    on_cpu = jax.devices()[0].platform == "cpu"
    seconds, processor_seconds, compile_s = time_updates(config, args.blocks, args.per_block)
    rates = [1.0 / s for s in seconds]
    replayed = [config.replayed_per_update * rate for rate in rates]
    label = learner_study.label_of(name, args.batch_size)
    figures = {f"compile_s_{f'cpu_{label}' if on_cpu and name != 'cpu' else label}": harness.figure([compile_s], "s")}
    if on_cpu:
        cores = [config.replayed_per_update / s for s in processor_seconds]
        suffix = "" if name == "cpu" else f"_{label}"
        figures[f"cpu_replayed_steps_per_s{suffix}"] = harness.figure(replayed, "1/s")
        figures[f"cpu_replayed_steps_per_core_s{suffix}"] = harness.figure(cores, "1/s")
    else:
        figures[f"updates_per_s_{label}"] = harness.figure(rates, "1/s")
        figures[f"replayed_steps_per_s_{label}"] = harness.figure(replayed, "1/s")
    return figures | {f"replay_bytes_per_step_{label}": harness.figure([replay_bytes(config)], "B")}


def time_parts(label: str, config: DreamerConfig, repeats: int) -> Iterator[Figures]:
    """Figures of `parts`, one after the other."""
    for part, call in parts(config).items():
        times = [1e3 * s for s in harness.time_calls(call, repeats=repeats, warm_up=2)]
        yield {f"{part}_ms_{label}": harness.figure(times, "ms")}


def main() -> None:
    """Measure, and write benchmarks/results/learner.json after every part."""
    args = arguments().parse_args()
    on_cpu = jax.devices()[0].platform == "cpu"
    name = args.preset or ("cpu" if on_cpu else "size12m")
    given = {"batch_size": args.batch_size, "scan_unroll": args.unroll, "compute_dtype": args.dtype,
             "replay_capacity": STREAMS * ROWS}
    config = preset(name, **{field: value for field, value in given.items() if value is not None})
    label = learner_study.label_of(name, args.batch_size)

    known: Figures = {}

    def keep(figures: Figures) -> None:
        known.update(figures)
        for key, value in figures.items():
            print(f"{key}: {value['value']:.4g} {value['unit']}", flush=True)
        if figures and not args.dry:
            harness.record("learner", CLAIM, figures)

    if not args.skip_base:
        keep(base(name, config, args))
    if args.parts:
        for figures in time_parts(label, config, args.per_block):
            keep(figures)
    learner_study.run(name, config, args, keep)
    if args.peer:
        keep(peer(name.removeprefix("size").upper(), args.batch_size, args.blocks, args.per_block, args.peer_limit_s))
    if args.json:
        print(json.dumps(known))


if __name__ == "__main__":
    with guarded():
        main()

"""Run by test_parallel.py in fresh processes: a short training on some devices, its parameters written to a file.

    run_parallel.py devices OUT               one process, all its devices, and one of them alone
    run_parallel.py process OUT PORT INDEX    one of two processes
"""

import dataclasses
import json
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parents[2])]
from dreamer_toys import corridor_env, tiny_config, with_redraw  # noqa: E402

from dreamer.experience import iteration, redraw  # noqa: E402
from dreamer.layers import sensors  # noqa: E402
from dreamer.train import TrainingOptions, train  # noqa: E402
from dreamer.training import parallel  # noqa: E402
from dreamer.training.first_state import first_state  # noqa: E402
from dreamer.training.programs import Place  # noqa: E402
from dreamer.types import Mirror  # noqa: E402

# Learning starts with the last iteration: two updates. Later ones amplify rounding, since the outer bins of a young
# two-hot critic are near 5e8, so that runs agree in what they learn but not in every digit.
# Of 16 sequences each of the eight devices has two: what is merged with time lies in another order than on one device.
CONFIG = tiny_config(batch_size=16, learning_starts=72, train_ratio=32.0, warmup=1)
ENV = corridor_env(8)
QUIET = TrainingOptions(progress=False, log_every_s=1e9, checkpoint_every_s=1e9)


def run(devices, iterations=9):
    """Parameters and summed metrics after some iterations, and how the state lies on the devices."""
    mesh = parallel.make_mesh(devices, ENV.num_envs, CONFIG.batch_size)
    state = iteration.compile_init(ENV, CONFIG, 0, mesh)()
    step = iteration.compile_iteration(ENV, CONFIG, state, mesh)
    sums = {}
    for _ in range(iterations):
        state, metrics = step(state)
        sums = {name: sums.get(name, 0.0) + float(value) for name, value in metrics.items()}
    placed = {
        "shards": len(state.replay.obs.addressable_shards),
        "columns": state.replay.obs.addressable_shards[0].data.shape[1],
        "replicated": all(leaf.sharding.is_fully_replicated for leaf in jax.tree.leaves(state.agent)),
        "reduces": "all-reduce" in step.as_text(),
        "flops": step.cost_analysis()["flops"],
    }  # fmt: skip
    return flat(state.agent.params), sums, placed


def flat(params):
    """All parameters in one row."""
    return np.concatenate([np.asarray(leaf).ravel() for leaf in jax.tree.leaves(params)])


def redundancy(mesh):
    """Loss by correlations over a batch (4, 16) of one projection, its gradient, and random numbers for all rows."""
    inputs, tokens = jax.random.normal(jax.random.key(0), (2, 4, 16, 3))
    weight = jax.random.normal(jax.random.key(1), (3, 3))

    def share(weight, inputs, tokens):
        value, gradient = jax.value_and_grad(lambda w: sensors.barlow_loss(inputs @ w, tokens, 0.1))(weight)
        drawn = parallel.own_rows(lambda rows: jax.random.uniform(jax.random.key(2), (2, rows)), inputs.shape[:2])
        return *parallel.mean((value, gradient)), drawn.reshape(2, *inputs.shape[:2])

    value, gradient, drawn = jax.jit(parallel.over_batch(mesh, share, (None, 1, 1), (None, None, 2)))(
        weight, inputs, tokens
    )
    return np.concatenate([np.ravel(value), np.ravel(gradient), np.ravel(drawn)])


def drawn_anew(mesh):
    """Redrawn images (4, 16, ...) of steps that are dark and light in turn, every second one of a mirrored stream."""
    mirror = Mirror(lambda state, obs, worlds: 255 - obs[None], lambda action, worlds: -action[None])
    env = dataclasses.replace(with_redraw(ENV), mirror=mirror)
    config = dataclasses.replace(CONFIG, redraw=True, mirror=1)
    levels = jnp.arange(64.0).reshape(4, 16) % 3 / 2

    def share(levels, stream):
        batch = SimpleNamespace(reward=levels, obs=levels, stream=stream)
        return redraw.drawn(env, config, batch, jax.random.PRNGKey(4))

    return jax.jit(parallel.over_batch(mesh, share, (1, 0), 1))(levels, jnp.arange(16) % 2 * env.num_envs)


def several_devices(out):
    alone, alone_sums, before = run(jax.devices()[:1])
    many, many_sums, placed = run(jax.devices())
    mesh = parallel.make_mesh(jax.devices(), 8, 16)
    kept = {"statistics_alone": redundancy(None), "statistics_many": redundancy(mesh),
            "drawn_alone": drawn_anew(None), "drawn_many": drawn_anew(mesh)}  # fmt: skip
    np.savez(out, alone=alone, many=many, **kept)
    told = {"alone": alone_sums, "many": many_sums, "flops_alone": before["flops"], **placed}
    out.with_suffix(".json").write_text(json.dumps(told))


def one_of_two(out, port, index):
    jax.distributed.initialize(f"localhost:{port}", 2, index)
    assert jax.process_count() == 2 and len(jax.local_devices()) == 1
    folder, devices = out.parent / "run", jax.devices()
    run = dataclasses.replace(QUIET, devices=devices, eval_fn=lambda params, steps: {"x": float(index)})
    result = train(ENV, CONFIG, folder, 72, 0, run)
    mesh = parallel.make_mesh(devices, ENV.num_envs, CONFIG.batch_size)
    again, _ = first_state(ENV, CONFIG, folder, 0, True, Place(mesh))  # what a second start would go on from
    assert len(again.replay.obs.sharding.device_set) == 2 and int(again.env_steps) == 72
    many, restored = (flat(jax.device_get(agent.params)) for agent in (result.agent, again.agent))
    if index == 0:
        np.savez(out, many=many, restored=restored)


if __name__ == "__main__":
    if sys.argv[1] == "devices":
        several_devices(Path(sys.argv[2]))
    else:
        one_of_two(Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]))

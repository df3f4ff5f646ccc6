"""Control steps per second of the obstacle course, image included: `python -m benchmarks.environment`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import jax

from benchmarks.harness import figure, record, time_calls
from whill_mjx.batch import make_batch
from whill_mjx.env import make_env
from whill_mjx.io.command_line import COUNT, NOT_NEGATIVE, run


@dataclass(frozen=True)
class Options:
    """Options of the benchmark."""

    instances: Annotated[int, NOT_NEGATIVE] = 0
    """Instances; 0 takes 16,384 on an accelerator and 256 on a CPU."""
    steps: Annotated[int, COUNT] = 20
    """Control steps per timed call."""
    repeats: Annotated[int, COUNT] = 5
    """Timed calls."""


def main(options: Options) -> None:
    """Measure with random actions, new vehicles and worlds after each episode, and record."""
    on_cpu = jax.devices()[0].platform == "cpu"
    count = options.instances or (256 if on_cpu else 16384)
    env, params = make_env("obstacle_course", random_looks=True)
    batch = make_batch(env, params, count, spread=0.05)

    def one_step(state, key):
        state, time_step = batch.step(state, jax.random.uniform(key, (count, 2), minval=-1.0))
        return state, (time_step.reward.sum(), time_step.obs.max())

    roll = jax.jit(lambda state, key: jax.lax.scan(one_step, state, jax.random.split(key, options.steps)))
    state = jax.block_until_ready(jax.jit(batch.reset)(jax.random.key(0))[0])
    seconds = time_calls(lambda: roll(state, jax.random.key(1)), options.repeats)
    rates = [count * options.steps / one for one in seconds]
    name = "cpu_control_steps_per_s" if on_cpu else "control_steps_per_s_course"
    claim = "Obstacle course with physics, camera image, reward and auto-reset"
    path = record("environment", claim, {name: figure(rates, "1/s")})
    print(f"{name}: {sorted(rates)[len(rates) // 2]:,.0f} with {count} instances -> {path}")


if __name__ == "__main__":
    run(Options, main, __doc__, positional=False)

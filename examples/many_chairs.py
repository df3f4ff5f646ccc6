"""Many chairs in one compiled step, each with its own parameters: how far do they get when they drive straight on?"""

import argparse

import jax
import jax.numpy as jnp

from whill_mjx import device_per_core, make_batch, make_env, share_results


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=1024, help="chairs")
    parser.add_argument("--steps", type=int, default=20, help="control periods of 0.1 s")
    given = parser.parse_args()

    share_results()  # before JAX starts: steps on a CPU are several times faster
    devices = device_per_core(given.count)  # so too: each core steps its share
    env, vehicle = make_env("point_goal")
    chairs = make_batch(env, vehicle, count=given.count, spread=0.1, devices=devices)
    state, step = jax.jit(chairs.reset)(jax.random.key(0))
    advance = jax.jit(chairs.step)
    for _ in range(given.steps):
        state, step = advance(state, jnp.tile(jnp.array([0.5, 0.0]), (given.count, 1)))
    speed = step.metrics["v"]
    print(f"{given.count} chairs: {speed.mean():.3f} m/s on average, from {speed.min():.3f} to {speed.max():.3f}")


if __name__ == "__main__":
    main()

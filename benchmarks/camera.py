"""Frames per second of the camera: `python -m benchmarks.camera`. 64x64 RGB, 32 boxes and a textured ground."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from benchmarks.harness import figure, record, time_calls
from whill_mjx.randomize import randomize_looks
from whill_mjx.render import pinhole, render
from whill_mjx.scene import Boxes, Marker, Scene, default_looks

BOXES = 32  # the goal marker is one of them


@dataclass(frozen=True)
class Options:
    """Options of the benchmark."""

    worlds: int = 0
    """Worlds per call; 0 takes 16,384 on an accelerator and 512 on a CPU."""
    calls: int = 20
    """Calls per repeat on an accelerator, so that the launch of a call does not count; a CPU makes 2."""
    repeats: int = 7
    """Timed repeats."""


def crowded_scene(key: jax.Array, boxes: int = BOXES) -> tuple[jax.Array, jax.Array, Scene]:
    """Camera position, rotation and scene: boxes all around, half of them in view, and random looks."""
    keys = jax.random.split(key, 7)
    count = boxes - 1
    half = jax.random.uniform(keys[0], (count, 3), minval=0.1, maxval=0.5)
    place = jax.random.uniform(keys[1], (count, 2), minval=jnp.array([-2.0, -4.0]), maxval=jnp.array([10.0, 4.0]))
    apart = jnp.abs(place) + half[:, :2] + 0.4  # the camera's own square metre stays free
    place = jnp.where((apart.max(1) < 1.4)[:, None], place + 2.0, place)
    solid = Boxes(
        jnp.concatenate([place, half[:, 2:]], 1),
        half,
        jax.random.uniform(keys[2], (count,), maxval=6.28),
        jax.random.uniform(keys[3], (count, 3)),
        jnp.ones(count, bool),
    )
    half_marker, blue = jnp.array([0.02, 0.3, 0.3]), jnp.array([0.04, 0.16, 0.9])
    marker = Marker(jnp.array([5.3, 0.0, 1.05]), half_marker, jnp.zeros(()), blue)
    scene = randomize_looks(keys[4], Scene(solid, marker, default_looks()))
    yaw, pitch = jax.random.uniform(keys[5], minval=-0.4, maxval=0.4), 0.15
    c, s, cp, sp = jnp.cos(yaw), jnp.sin(yaw), jnp.cos(pitch), jnp.sin(pitch)
    zero = jnp.zeros(())
    right, forward = jnp.stack([s, -c, zero]), jnp.stack([c * cp, s * cp, -sp])
    rotation = jnp.stack([right, jnp.cross(forward, right), forward], 1)
    return jnp.array([0.0, 0.0, 0.68]), rotation, scene


def main(options: Options) -> None:
    """Measure and record."""
    on_cpu = jax.devices()[0].platform == "cpu"
    worlds = options.worlds or (512 if on_cpu else 16384)
    calls = 2 if on_cpu else options.calls
    position, rotation, scenes = jax.jit(jax.vmap(crowded_scene))(jax.random.split(jax.random.key(0), worlds))
    lens = pinhole(1.2)
    draw = jax.jit(jax.vmap(lambda position, rotation, scene: render(position, rotation, lens, scene)))

    def several():
        return [draw(position, rotation, scenes) for _ in range(calls)]

    seconds = time_calls(several, options.repeats, warm_up=2)
    rates = [worlds * calls / one for one in seconds]
    name = "cpu_frames_per_s" if on_cpu else "jnp_frames_per_s"
    path = record("camera", "Images of 64x64 with 32 boxes and a textured ground", {name: figure(rates, "frames/s")})
    print(f"{name}: {sorted(rates)[len(rates) // 2]:,.0f} with {worlds} worlds -> {path}")


if __name__ == "__main__":
    import tyro

    main(tyro.cli(Options))

"""Frames per second of the camera: `python -m benchmarks.camera`. 64x64 RGB.

Parts: "crowd" is 32 boxes and a textured ground (the goal marker is one of the boxes), by the jnp renderer and, on
NVIDIA GPUs, by the kernel; "best" the same with anti-aliasing and hard shadows; "map" 200 pieces of real corridor walls
and 8 people, by the kernel with the walls as they are and sorted by distance; "peer" MuJoCo Warp's ray tracer on the
crowd, where it is installed; "tilings" compares tile sizes. The kernel comes first, the slower jnp renderer last.
"""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.harness import figure, record, time_calls
from whill_mjx.io.command_line import COUNT, NOT_NEGATIVE, run
from whill_mjx.world.randomize import randomize_looks
from whill_mjx.world.render import Quality, camera_rotation, pinhole, render
from whill_mjx.world.render.pallas import Tiling, render_pallas
from whill_mjx.world.scene import Boxes, Marker, Scene, default_looks
from whill_mjx.world.solids import Solids, person, stack_rounds

BOXES = 32  # the goal marker is one of them
WALLS = Path(__file__).parent / "stata_basement_walls.csv"
CLAIM = "Images of 64x64: 32 boxes and a textured ground; a real corridor with 200 wall pieces and 8 people"
LENS = pinhole(1.2)
BEST = Quality(antialias=True, shadows=True)
TILINGS = (
    Tiling(8, 16),
    Tiling(16, 16),
    Tiling(16, 16, warps=2),
    Tiling(16, 32, warps=2),
    Tiling(32, 32, warps=4),
    Tiling(8, 16, fast=False),
    Tiling(8, 16, words=True),
    Tiling(8, 16, cull=False),
    Tiling(8, 8),
)
JNP_CALLS = 4
"""Calls per repeat of the jnp renderer on an accelerator at most: one call of it lasts long enough."""


@dataclass(frozen=True)
class Options:
    """Options of the benchmark."""

    parts: tuple[str, ...] = ("crowd", "best", "map", "peer")
    """Parts to measure: crowd, best, map, peer, tilings."""
    worlds: Annotated[int, NOT_NEGATIVE] = 0
    """Worlds per call; 0 takes 16,384 on an accelerator and 512 on a CPU."""
    calls: Annotated[int, COUNT] = 20
    """Calls per repeat on an accelerator, so that the launch of a call does not count; a CPU makes 2."""
    repeats: Annotated[int, COUNT] = 7
    """Timed repeats."""
    keep: Annotated[int, COUNT] = 64
    """Walls that the jnp renderer keeps in each strip of the map's image."""


def crowded_scene(key: jax.Array, boxes: int = BOXES) -> tuple[jax.Array, jax.Array, Scene]:
    """Camera position, rotation and scene: boxes ahead, aside and a few behind, and random looks.

    Of 31 boxes and the marker, 15.4 boxes fill at least one pixel each on average (200 worlds, the marker not counted);
    2 lie behind the camera and 7 aside, and the others hide one another.
    """
    keys = jax.random.split(key, 7)
    count = boxes - 1
    half = jax.random.uniform(keys[0], (count, 3), minval=0.1, maxval=0.5)
    place = jax.random.uniform(keys[1], (count, 2), minval=jnp.array([-2.0, -4.0]), maxval=jnp.array([10.0, 4.0]))
    close = jnp.abs(place).max(1, keepdims=True) < 2.5  # one box right ahead would hide all others
    place = jnp.where(close, place + jnp.array([5.0, 0.0]), place)
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
    yaw = jax.random.uniform(keys[5], minval=-0.4, maxval=0.4)
    return jnp.array([0.0, 0.0, 0.68]), camera_rotation(yaw, 0.15), scene


def map_scene(key: jax.Array, people: int = 8) -> tuple[jax.Array, jax.Array, Scene]:
    """Camera position, rotation and scene: the 200 wall pieces of `WALLS`, people in the corridor, random looks."""
    walls = jnp.asarray(np.loadtxt(WALLS, delimiter=",", dtype=np.float32))
    keys = jax.random.split(key, 5)
    count, height = walls.shape[0], 2.4
    tall = jnp.full(count, height / 2)
    colour = jax.random.uniform(keys[0], (1, 3), minval=0.4, maxval=0.9) * jnp.ones((count, 1))
    half = jnp.concatenate([walls[:, 2:], tall[:, None]], 1)
    centre = jnp.concatenate([walls[:, :2], tall[:, None]], 1)
    solid = Boxes(centre, half, jnp.zeros(count), colour, jnp.ones(count, bool))
    along = jax.random.uniform(keys[1], (people,), minval=-2.0, maxval=6.0)  # of the corridor, which runs at 45 degrees
    aside = jax.random.uniform(keys[2], (people,), minval=-0.7, maxval=0.7)
    x, y = (along - aside) * 0.7, (along + aside) * 0.7 + 0.3
    standing = stack_rounds([person(x[i], y[i], clothes=(0.2 + 0.07 * i, 0.3, 0.6 - 0.05 * i)) for i in range(people)])
    half_marker, blue = jnp.array([0.02, 0.25, 0.25]), jnp.array([0.04, 0.16, 0.9])
    marker = Marker(jnp.array([3.2, 3.6, 1.2]), half_marker, jnp.array(0.785), blue)
    scene = randomize_looks(keys[3], Scene(solid, marker, default_looks(), Solids(rounds=standing)))
    scene = dataclasses.replace(scene, boxes=dataclasses.replace(scene.boxes, colour=colour))
    turn = jax.random.uniform(keys[4], minval=-0.4, maxval=0.4)
    return jnp.array([-2.4, -2.0, 0.68]), camera_rotation(0.785 + turn, 0.1), scene


def measure(name: str, draw, make, options: Options, worlds: int, calls: int) -> tuple[list[float], dict[str, Any]]:
    """Frames/s of `draw(position, rotation, scene)` on worlds of `make`; what it cost to compile, in s and bytes."""
    data = jax.jit(jax.vmap(make))(jax.random.split(jax.random.key(0), worlds))
    start = time.perf_counter()
    compiled = jax.jit(jax.vmap(draw)).lower(*data).compile()
    seconds = time.perf_counter() - start
    memory = compiled.memory_analysis()
    cost = {"compile_s": seconds, "bytes_per_world": getattr(memory, "temp_size_in_bytes", 0) / worlds}
    spent = time_calls(lambda: [compiled(*data) for _ in range(calls)], options.repeats, warm_up=2)
    rates = [worlds * calls / one for one in spent]
    print(f"{name}: {sorted(rates)[len(rates) // 2]:,.0f} frames/s with {worlds} worlds; {cost}", flush=True)
    return rates, cost


def main(options: Options) -> None:
    """Measure and record."""
    on_cpu = jax.devices()[0].platform == "cpu"
    worlds = options.worlds or (512 if on_cpu else 16384)
    calls = 2 if on_cpu else options.calls
    jobs: list[tuple[str, Any, Any]] = []
    if not on_cpu:
        jobs += kernel_jobs(options)
    jnp_name = "cpu_frames_per_s" if on_cpu else "jnp_frames_per_s"
    if "crowd" in options.parts:
        jobs.append((jnp_name, _draw, crowded_scene))
    if "best" in options.parts:
        jobs.append((f"{jnp_name}_aa_shadow", partial(_draw, quality=BEST), crowded_scene))
    if "map" in options.parts:
        jobs.append((f"{jnp_name}_map", partial(_draw, quality=Quality(keep=options.keep)), map_scene))
    for name, draw, make in jobs:
        print(f"{name}: compiling", flush=True)
        jnp_only = name.startswith(("jnp", "cpu"))
        if not jnp_only:
            check(name, draw, make)
        some = min(calls, JNP_CALLS) if jnp_only else calls
        rates, cost = measure(name, draw, make, options, worlds, some)
        stem = name.removeprefix("cpu_").removeprefix("jnp_")
        prefix = name[: len(name) - len(stem)]
        figures = {name: figure(rates, "frames/s"), f"{prefix}compile_s_{stem}": figure([cost["compile_s"]], "s"),
                   f"{prefix}bytes_{stem}": figure([cost["bytes_per_world"]], "temporary bytes per world")}
        record("camera", CLAIM, figures)
    if "peer" in options.parts:
        from benchmarks.camera_peer import warp_rates

        rates = warp_rates(worlds, calls, options.repeats, crowded_scene)
        if rates:
            record("camera", CLAIM, {"peer_mujoco_warp_frames_per_s": figure(rates, "frames/s")})


def kernel_jobs(options: Options) -> list[tuple[str, Any, Any]]:
    """Name of the figure, function and scene of each measurement of the kernel."""
    jobs: list[tuple[str, Any, Any]] = []
    if "crowd" in options.parts:
        jobs.append(("frames_per_s_32box_16384", _draw_kernel, crowded_scene))
    if "best" in options.parts:
        jobs.append(("frames_per_s_aa_shadow", partial(_draw_kernel, quality=BEST), crowded_scene))
    if "map" in options.parts:
        jobs.append(("frames_per_s_map", _draw_kernel, map_scene))
        jobs.append(("frames_per_s_map_sorted", partial(_draw_kernel, tiling=Tiling(sort=True)), map_scene))
    if "tilings" in options.parts:
        for one in TILINGS:
            switches = f"{'' if one.fast else '_exact'}{'_words' if one.words else ''}{'' if one.cull else '_all'}"
            name = f"frames_per_s_tile_{one.rows}x{one.columns}_{one.warps}{switches}"
            jobs.append((name, partial(_draw_kernel, tiling=one), crowded_scene))
    return jobs


def check(name: str, draw, make) -> None:
    """Compare a kernel with the jnp renderer on this device; RuntimeError when more than silhouettes differ."""
    data = jax.jit(jax.vmap(make))(jax.random.split(jax.random.key(1), 64))
    one = _reference(make, BEST if "aa_shadow" in name else Quality())
    other = np.asarray(jax.jit(jax.vmap(draw))(*data))
    share = (np.abs(one - other).max(-1) > 1).mean()
    print(f"{name}: {share:.2e} of the pixels differ from the jnp renderer by more than one grey level", flush=True)
    if share > 0.01:
        raise RuntimeError(f"{name}: {share:.1%} of the pixels differ from the jnp renderer; at most 1 % may.")


@cache
def _reference(make, quality: Quality) -> np.ndarray:
    """Images int of the jnp renderer, for `check`."""
    data = jax.jit(jax.vmap(make))(jax.random.split(jax.random.key(1), 64))
    return np.asarray(jax.jit(jax.vmap(partial(_draw, quality=quality)))(*data)).astype(int)


def _draw(position, rotation, scene, quality=None):
    return render(position, rotation, LENS, scene, quality=quality or Quality())


def _draw_kernel(position, rotation, scene, quality=None, tiling=None):
    return render_pallas(position, rotation, LENS, scene, quality=quality or Quality(), tiling=tiling)


if __name__ == "__main__":
    run(Options, main, __doc__, positional=False)

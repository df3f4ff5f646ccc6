"""Control steps per second of environments, images included, and a long run: `python -m benchmarks.environment`.

The real map is one of ../shared/data/maps.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.harness import figure, record, time_calls
from whill_mjx.batch import BatchEnv, make_batch
from whill_mjx.env import make_env
from whill_mjx.io.command_line import COUNT, NOT_NEGATIVE, OptionError, run
from whill_mjx.processor import device_per_core
from whill_mjx.sensors.base import Sensor
from whill_mjx.sensors.camera import Camera
from whill_mjx.sensors.depth import Depth
from whill_mjx.sensors.goal import Goal
from whill_mjx.sensors.lidar import Lidar
from whill_mjx.sensors.odometry import Odometry
from whill_mjx.tasks.map_goal import MapGoal
from whill_mjx.tasks.tasks import Task, sample_world
from whill_mjx.vehicle.kinematics import reference_pose
from whill_mjx.world.lidar import first_hits
from whill_mjx.world.maps import make_map_scene, read_map

PEOPLE, RAYS = 8, 360
HELD = 10
"""Control steps for which the long run holds an action: a vehicle that is given a new one in each hardly moves."""
BLOCKS = 20
"""Parts of the long run whose statistics are compared."""
SLACK = 0.15
"""How far a straightened wall may lie outside the cells of its map [m]: 1.42 cells of 5 cm, and rounding up."""
COUNTED = ("success", "collision", "timeout")
CLAIM = "Obstacle course with physics, camera image, reward and auto-reset"


@dataclass(frozen=True)
class Options:
    """Options of the benchmark."""

    parts: tuple[str, ...] = ("course",)
    """Of course, sensors, map, map_lidar, rays, soak."""
    instances: Annotated[int, NOT_NEGATIVE] = 0
    """Instances; 0 takes 16,384 on an accelerator and 256 on a CPU."""
    steps: Annotated[int, COUNT] = 20
    """Control steps per timed call."""
    repeats: Annotated[int, COUNT] = 5
    """Timed calls."""
    map: Path = Path("../shared/data/maps/stata_basement/stata_basement.yaml")
    """The real map."""
    split: bool = True
    """On a CPU: give each core its share of the instances."""
    soak: float = 1e8
    """Control steps of the long run, all instances together."""

    @property
    def count(self) -> int:
        """Instances side by side."""
        return self.instances or (256 if on_cpu() else 16384)

    @property
    def devices(self) -> tuple:
        """Devices among which the instances are split."""
        return device_per_core(self.count) if self.split and on_cpu() else ()


def on_cpu() -> bool:
    """Whether this runs without an accelerator."""
    return jax.devices()[0].platform == "cpu"


def rates_of(batch: BatchEnv, options: Options) -> list[float]:
    """Control steps per second in each timed call, with random actions and new worlds after each episode."""

    def one_step(carry: Any, key: jax.Array) -> tuple[Any, Any]:
        state, time_step = batch.step(carry[0], jax.random.uniform(key, (batch.count, 2), minval=-1.0))
        return (state, time_step.obs), time_step.reward.sum()  # all that is observed is there after each step

    roll = jax.jit(lambda carry, key: jax.lax.scan(one_step, carry, jax.random.split(key, options.steps)))
    state, time_step = jax.block_until_ready(jax.jit(batch.reset)(jax.random.key(0)))
    seconds = time_calls(lambda: roll((state, time_step.obs), jax.random.key(1)), options.repeats)
    return [batch.count * options.steps / one for one in seconds]


def course(options: Options) -> dict[str, Any]:
    """The paper's obstacle course with its image; vehicles differ."""
    env, params = make_env("obstacle_course", random_looks=True)
    rates = rates_of(make_batch(env, params, options.count, spread=0.05, devices=options.devices), options)
    return {"cpu_control_steps_per_s" if on_cpu() else "control_steps_per_s_course": figure(rates, "1/s")}


def observed(name: str, task: str | Task, sensors: Mapping[str, Sensor], options: Options) -> dict[str, Any]:
    """A task with these sensors."""
    env, params = make_env(task, observations=sensors)
    rates = rates_of(make_batch(env, params, options.count, devices=options.devices), options)
    return {f"{'cpu_' if on_cpu() else ''}control_steps_per_s_{name}": figure(rates, "1/s")}


def sensors(options: Options) -> dict[str, Any]:
    """The obstacle course with image, depth, scan and odometry together."""
    four = {"camera": Camera(), "depth": Depth(), "lidar": Lidar(rays=RAYS), "odometry": Odometry()}
    return observed("sensors", "obstacle_course", four, options)


def map_image(options: Options) -> dict[str, Any]:
    """A real map with people and an image."""
    return observed("map", MapGoal(map=str(options.map), people=PEOPLE), {"camera": Camera()}, options)


def map_lidar(options: Options) -> dict[str, Any]:
    """The same with a scan as well."""
    both = {"camera": Camera(), "lidar": Lidar(rays=RAYS)}
    return observed("map_lidar", MapGoal(map=str(options.map), people=PEOPLE), both, options)


def rays(options: Options) -> dict[str, Any]:
    """Rays per second in worlds of the corridor, `RAYS` from each place."""
    env, _ = make_env("corridor")
    keys = jax.random.split(jax.random.key(0), options.count)
    scenes = jax.jit(jax.vmap(lambda key: sample_world(env.task, key).scene))(keys)
    angles = jnp.arange(RAYS) * 2 * jnp.pi / RAYS

    def scan(scene: Any, turn: jax.Array) -> jax.Array:
        return first_hits(scene, 1.0 + 0.1 * jnp.sin(turn), 0.1 * jnp.cos(turn), turn + angles, 0.3)

    def one_round(total: jax.Array, turn: jax.Array) -> tuple[jax.Array, None]:
        return total + jnp.minimum(jax.vmap(scan, (0, None))(scenes, turn), 10.0).sum(-1), None

    turns = jnp.linspace(0.0, 1.0, options.steps)
    roll = jax.jit(lambda: jax.lax.scan(one_round, jnp.zeros(options.count), turns)[0])
    found = [options.count * options.steps * RAYS / one for one in time_calls(roll, options.repeats)]
    return {f"{'cpu_' if on_cpu() else ''}lidar_rays_per_s": figure(found, "1/s")}


def outside(path: Path) -> Callable[[jax.Array, jax.Array], jax.Array]:
    """Whether a place lies outside the space of a map, `SLACK` around it included."""
    from scipy.ndimage import distance_transform_edt

    made = make_map_scene(read_map(path))
    size, (x0, y0, turn) = made.grid.resolution, made.grid.origin
    near = jnp.asarray(distance_transform_edt(~np.pad(made.space, 1)) * size <= SLACK)

    def lies(x: jax.Array, y: jax.Array) -> jax.Array:
        dx, dy = x - x0, y - y0
        column = jnp.floor((dx * np.cos(turn) + dy * np.sin(turn)) / size).astype(jnp.int32) + 1
        row = jnp.floor((dy * np.cos(turn) - dx * np.sin(turn)) / size).astype(jnp.int32) + 1
        return ~near[jnp.clip(row, 0, near.shape[0] - 1), jnp.clip(column, 0, near.shape[1] - 1)]

    return lies


def soak(options: Options) -> dict[str, Any]:
    """Many control steps among people, without images: numbers that are none, vehicles outside, drift of statistics.

    The drift is the largest difference between the two halves' shares of endings, in its own standard errors.
    """
    env, params = make_env(MapGoal(map=str(options.map), people=PEOPLE), observations={"goal": Goal()})
    batch, lies = make_batch(env, params, options.count), outside(options.map)

    def one_step(carry: Any, number: jax.Array) -> tuple[Any, Any]:
        state, actions, key = carry
        drawn = jax.random.uniform(jax.random.fold_in(key, number), (batch.count, 2), minval=jnp.array([0.0, -1.0]))
        actions = jnp.where(number % HELD == 0, drawn, actions)
        state, time_step = batch.step(state, actions)
        vehicle = state.env.vehicle
        x, y, _ = jax.vmap(functools.partial(reference_pose, env.model))(vehicle.qpos)
        people = state.env.scene.people
        assert people is not None
        leaves = (vehicle.qpos, vehicle.qvel, time_step.reward, time_step.obs["goal"], people.position)
        row = jnp.concatenate([leaf.reshape(batch.count, -1) for leaf in leaves], 1)
        broken = ~jnp.isfinite(row).all(1) | (time_step.metrics["diverged"] > 0.5)
        ends = jnp.stack([time_step.metrics[name].sum() for name in COUNTED])
        return (state, actions, key), (broken.sum(), jax.vmap(lies)(x, y).sum(), ends)

    length = max(1, round(options.soak / batch.count / BLOCKS))
    roll = jax.jit(lambda carry: jax.lax.scan(one_step, carry, jnp.arange(length)))
    state = jax.jit(batch.reset)(jax.random.key(0))[0]
    broken, escaped = 0, 0
    ends: list[np.ndarray] = []
    for block in range(BLOCKS):
        (state, *_), seen = roll((state, jnp.zeros((batch.count, 2)), jax.random.key(block)))
        one, other, counts = (np.asarray(leaf, np.int64).sum(0) for leaf in seen)
        broken, escaped, ends = broken + int(one), escaped + int(other), [*ends, counts]
        shares = " ".join(f"{name} {share:.3f}" for name, share in zip(COUNTED, counts / counts.sum(), strict=True))
        print(f"soak: {(block + 1) * length * batch.count:,} steps, {broken} broken, {escaped} outside; {shares}",
              flush=True)  # fmt: skip
    # All episodes begin at once, so short ones end first: a quarter of the blocks is left out.
    rest = np.array(ends[BLOCKS // 4 :])
    halves = [part.sum(0) for part in np.array_split(rest, 2)]
    total = [half.sum() for half in halves]
    first, last = (half / count for half, count in zip(halves, total, strict=True))
    both = rest.sum(0) / rest.sum()
    spread = np.sqrt(both * (1 - both) * sum(1 / count for count in total))
    drift = float(np.max(np.abs(first - last) / np.maximum(spread, 1e-12)))
    return {
        "soak_steps": figure([float(BLOCKS * length * batch.count)], "count"),
        "soak_nan": figure([float(broken)], "count"),
        "soak_escaped": figure([float(escaped)], "count"),
        "soak_drift": figure([drift], "standard errors"),
    }


PARTS: dict[str, Callable[[Options], dict[str, Any]]] = {
    "course": course, "sensors": sensors, "map": map_image, "map_lidar": map_lidar, "rays": rays, "soak": soak,
}  # fmt: skip


def main(options: Options) -> None:
    """Measure the parts and record each."""
    if options.split:
        device_per_core(1)  # before JAX starts
    for part in options.parts:
        if part not in PARTS:
            raise OptionError(f"--parts: unknown part {part!r} (known: {', '.join(PARTS)}). Correct it.")
    for part in options.parts:
        figures = PARTS[part](options)
        path = record("environment", CLAIM, figures)
        for name, one in figures.items():
            print(f"{name}: {one['value']:,.4g} {one['unit']} with {options.count} instances -> {path}", flush=True)


if __name__ == "__main__":
    run(Options, main, __doc__, positional=False)

"""Point goals among people in maps that no training saw: `python -m benchmarks.among`.

PPO trains for some minutes on two recordings of one office and on made floor plans, once for each of the runs, and then
drives in two other buildings, with its senses and without. The maps are those of ../shared/data/maps. A run that is
there is not made again, so the same command goes on after an interruption. Runs of other options are refused.
"""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import serialization

from benchmarks.harness import RESULTS, device_name, figure, provenance, record
from whill_mjx.evaluation.drivers import Driver
from whill_mjx.evaluation.episodes import Course, episode_keys
from whill_mjx.io.command_line import COUNT, SEED, OptionError, Range, run
from whill_mjx.io.folders import claim_folder, write_whole
from whill_mjx.learning import ppo
from whill_mjx.learning.options import TrainOptions, choose_preset
from whill_mjx.learning.outcome import export
from whill_mjx.learning.setup import (
    Preset,
    functional_env,
    make_evaluation_env,
    make_training_env,
    obs_shape_of,
    ppo_policy,
)
from whill_mjx.learning.trainings import Trained
from whill_mjx.logs.dataset import plain, write_json
from whill_mjx.tasks.among_people import SENSES
from whill_mjx.tasks.options import read_fields
from whill_mjx.vehicle.vehicle_file import load_vehicle, save_vehicle
from whill_mjx.world.maps import make_map_scene, read_map
from whill_mjx.world.maps.several import side_by_side

KIND = "benchmarks.among"
OUTPUTS = ("result.json", "training.json", "weights.msgpack")
CLAIM = "Obstacle course with physics, camera image, reward and auto-reset"
TRAINED = ("fetch_office/3_1_16_localization.yaml", "fetch_office/9_16_15.yaml")
UNSEEN = ("stata_basement/stata_basement.yaml", "willow_garage/willow-full.yaml")
VEHICLE = "whill_cr_ramp"
SIGHTS = ("open", "blank", "freeze", "lost")
"""What the policy is shown: everything; zeros; its first observation all the time; goal, speeds and last command alone,
with scans that meet nothing and black images."""
JUDGED = 3_000_029
"""Seed of the worlds in which policies are judged."""
EVERY_S = 20.0
"""Time between two lines of the log [s]."""


@dataclass(frozen=True)
class Options:
    """Options of the benchmark."""

    runs: tuple[str, ...] = ("lidar:0", "both:0", "camera:0", "lidar:1", "lidar:2")
    """Trainings in their order, SENSES:SEED."""
    out: Path = Path("runs/among")
    """Folder of the runs."""
    maps: Path = Path("../shared/data/maps")
    """Folder of the real maps."""
    trained: tuple[str, ...] = TRAINED
    """Real maps of the training, or made:SEED."""
    unseen: tuple[str, ...] = UNSEEN
    """Maps of the test."""
    made: Annotated[int, Range(0, 60)] = 8
    """Made floor plans that the training has besides; all maps lie in one row, which may be 4 km long."""
    minutes: Annotated[float, Range(0.0, 1000.0, above=True)] = 7.0
    """Time of each training, without its compilation; the step size falls to zero over it."""
    instances: Annotated[int, COUNT] = 4096
    """Vehicles side by side in a training."""
    episodes: Annotated[int, COUNT] = 2048
    """Episodes of each judgement, in both maps together."""
    set: tuple[str, ...] = ()
    """Other fields of the task."""
    change: tuple[str, ...] = ()
    """Other settings of PPO."""
    safety: str = "monitor"
    """As of the training command; "none" where nothing scans."""
    sights: tuple[str, ...] = SIGHTS
    """What the policies are shown while they are judged: of open, blank, freeze and lost. What was judged stays."""
    seed: Annotated[int, SEED] = JUDGED
    """Of the worlds of the test."""
    results: Path = RESULTS
    """Folder of the result file."""


def maps_of(options: Options, names: tuple[str, ...]) -> str:
    """Maps as a task reads them."""
    return ",".join(name if name.startswith("made:") else str(options.maps / name) for name in names)


def preset_of(options: Options, senses: str, seed: int, folder: Path) -> tuple[TrainOptions, Preset]:
    """The training command that a run stands for, and its preset."""
    maps = maps_of(options, (*options.trained, *(f"made:{number}" for number in range(options.made))))
    asked = TrainOptions(
        out=folder, vehicle=Path(VEHICLE), task="among_people", preset="wallclock", learner="ppo", seed=seed,
        set=(f"map={maps}", f"senses={senses}", *options.set), change=options.change, instances=options.instances,
        safety="none" if senses == "camera" else options.safety,
    )  # fmt: skip
    return asked, choose_preset(asked)


def train(preset: Preset, seed: int, folder: Path, minutes: float) -> dict[str, Any]:
    """Train for a time, and return the weights with what the training took.

    The step size falls to zero over the iterations that the time allows, as it is estimated after each of them.
    """
    batch = make_training_env(preset, VEHICLE)
    env, config = functional_env(batch, preset.safety), preset.ppo
    began = time.monotonic()
    state = jax.jit(lambda seed: ppo.init_state(env, config, seed))(np.int32(seed))
    iterate = jax.jit(lambda state, total: ppo.iterate(env, config, total, state), donate_argnums=0)
    program = iterate.lower(state, np.int32(1)).compile()
    compiled_s, began = time.monotonic() - began, time.monotonic()
    each, done, spent, logged = env.num_envs * config.rollout, 0, 0.0, 0.0
    with (folder / "metrics.jsonl").open("w") as log:
        while spent < 60 * minutes:
            total = max(done + 1, round(done * 60 * minutes / spent)) if done else 10**6
            state, metrics = program(state, np.int32(total))
            metrics = jax.device_get(metrics)
            done, spent = done + 1, time.monotonic() - began
            if spent - logged >= EVERY_S or spent >= 60 * minutes:
                logged = spent
                line = {"env_steps": done * each, "wall_s": spent, **shares(metrics)}
                log.write(json.dumps(line) + "\n")
                log.flush()
                shown = " ".join(f"{name} {line[name]:.3f}" for name in ("success", "collision", "timeout", "entropy"))
                print(f"  {spent:5.0f} s, {done * each:,} decisions: {shown}", flush=True)
                write_whole(folder / "weights.msgpack", serialization.to_bytes(jax.device_get(state.params)))
    return {"decisions": done * each, "training_s": spent, "compilation_s": compiled_s, "updates": done}


def shares(metrics: dict[str, Any]) -> dict[str, float]:
    """Sums over the ended episodes of an iteration as means, and the losses."""
    episodes = max(float(metrics["episodes"]), 1.0)
    return {name.removeprefix("episode/"): float(value) / (episodes if name.startswith("episode/") else 1.0)
            for name, value in metrics.items()}  # fmt: skip


def judged_driver(preset: Preset, course: Course, params: Any) -> tuple[Driver, Any]:
    """The policy, and its first memory, whose number of a sight says what it is shown: one program judges them all."""
    step, carry = ppo_policy(preset, course.env)
    readings = {name: sensor.reading(course.env) for name, sensor in course.env.sensors}
    empty: dict[str, jax.Array] = {name: jnp.zeros(one.shape, one.dtype) for name, one in readings.items()}
    unseen: dict[str, jax.Array] = {}
    for name in ("camera", "lidar"):
        if name in empty:
            unseen[name] = jnp.full_like(empty[name], 0 if name == "camera" else readings[name].high)

    def act(weights: Any, memory: Any, state: Any, seen: dict[str, jax.Array], key: jax.Array) -> tuple[Any, jax.Array]:
        carry, first, begun, sight = memory
        first = jax.tree.map(lambda kept, now: jnp.where(begun, kept, now), first, seen)
        kinds = (seen, empty, first, {**seen, **unseen})
        shown = jax.tree.map(lambda *values: jnp.stack(values)[sight], *kinds)
        carry, action = step(weights, carry, shown)
        return (carry, first, jnp.array(True), sight), action

    memory = (carry, empty, jnp.array(False), jnp.int32(0))
    weights = jax.tree.map(jnp.asarray, params)
    return Driver("policy", lambda state, key: memory, act, preset.task.action_repeat, weights=weights), memory


def judge(options: Options, preset: Preset, params: Any, sights: list[str]) -> dict[str, Any]:
    """Shares of the endings in the unseen maps, with each of some sights, all maps together and each alone."""
    task = dataclasses.replace(preset.task, **read_fields(preset.task, (f"map={maps_of(options, options.unseen)}",)))
    batch = make_evaluation_env(task, VEHICLE, 1)
    course = Course(batch.env, batch.params, batch=options.episodes)
    keys = episode_keys(options.seed, options.episodes)
    driver, memory = judged_driver(preset, course, params)
    memory = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (len(keys), *jnp.shape(leaf))), memory)
    found: dict[str, Any] = {}
    for sight in sights:
        episodes = course.drive(driver, keys, memory=(*memory[:3], jnp.full(len(keys), SIGHTS.index(sight))))
        people = episodes.scene.people
        assert people is not None
        bumped = np.asarray(people.held & people.there).sum(-1)
        rows = {"arrived": episodes.ends["success"], "collided": episodes.ends["collision"],
                "timeout": episodes.ends["timeout"], "bumped": bumped > 0, "people_bumped": bumped,
                "people": np.asarray(people.there).sum(-1), "time_s": episodes.ends["time_s"]}  # fmt: skip
        found[sight] = {name: float(np.mean(row)) for name, row in rows.items()}
        places = _map_of(options, np.stack([episodes.channel(axis)[:, 0] for axis in "xy"], -1))
        if sight == "open":
            found["maps"] = {name: {"episodes": int((places == part).sum()),
                                    **{key: float(np.mean(row[places == part])) for key, row in rows.items()}}
                             for part, name in enumerate(options.unseen) if (places == part).any()}  # fmt: skip
    return found


def _map_of(options: Options, starts: np.ndarray) -> np.ndarray:
    """Number (N,) of the map in which each episode began at (N, 2) [m]: the one around it, of those side by side."""
    group = side_by_side([make_map_scene(read_map(name)) for name in maps_of(options, options.unseen).split(",")])
    pairs = zip(group.parts, group.shifts, strict=True)
    corners = [part.walls.segments.reshape(-1, 2) + shift for part, shift in pairs]
    away = [np.maximum(one.min(0) - starts, starts - one.max(0)).max(-1) for one in corners]  # 0 or less inside
    return np.argmin(away, 0)


@contextmanager
def held_run(options: Options, senses: str, seed: int) -> Iterator[Path]:
    """Hold the folder of a run until the block ends; FolderRefused where it was trained or judged by other options."""
    folder = options.out / f"{senses}_{seed}"
    asked = dataclasses.asdict(options)
    identity = {name: asked[name] for name in asked if name not in ("runs", "out", "results", "sights")}
    with claim_folder(folder, KIND, OUTPUTS) as claim:
        claim.settle(identity, (folder / "training.json").exists())
        yield folder


def one_run(options: Options, senses: str, seed: int) -> dict[str, Any]:
    """Train and judge one policy, or read what is there."""
    with held_run(options, senses, seed) as folder:
        return made_run(options, senses, seed, folder)


def made_run(options: Options, senses: str, seed: int, folder: Path) -> dict[str, Any]:
    """Result of a run whose folder this process holds: what it lacks is made."""
    path = folder / "result.json"
    known = dict(json.loads(path.read_text())) if path.exists() else {}
    lacking = [sight for sight in options.sights if sight not in known.get("sights", {})]
    if not lacking:
        return known
    _, preset = preset_of(options, senses, seed, folder)
    save_vehicle(folder / "vehicle.toml", *load_vehicle(VEHICLE)[:2])
    took_path = folder / "training.json"
    if not took_path.exists():
        took = train(preset, seed, folder, options.minutes)
        write_json(took_path, {**took, "device": device_name(), "task": plain(preset.task), "ppo": plain(preset.ppo)})
    took = json.loads(took_path.read_text())
    env = make_evaluation_env(preset.task, VEHICLE, 1).env
    params = weights_of(preset, env, folder / "weights.msgpack")
    began = time.monotonic()
    judged = {**known.get("sights", {}), **judge(options, preset, params, lacking)}
    result = {"senses": senses, "seed": seed, **took, **provenance(), "episodes": options.episodes, "sights": judged,
              "safety": plain(preset.safety), "judging_s": time.monotonic() - began}  # fmt: skip
    write_json(path, result)
    return result


def write_policy(options: Options, senses: str, seed: int) -> None:
    """Write the policy file of a run, unless it is there."""
    folder = options.out / f"{senses}_{seed}"
    if (folder / "policy").exists():
        return
    asked, preset = preset_of(options, senses, seed, folder)
    params = weights_of(preset, make_evaluation_env(preset.task, VEHICLE, 1).env, folder / "weights.msgpack")
    took = json.loads((folder / "training.json").read_text())
    trained = Trained(params, took["decisions"], took["updates"], took["training_s"])
    export(asked, preset, folder / "vehicle.toml", trained, folder / "policy")


def weights_of(preset: Preset, env: Any, path: Path) -> Any:
    """Weights that a training left."""
    frames = ppo.empty_frames(preset.ppo, obs_shape_of(env), (1,))
    network = ppo.Network(preset.ppo, 2)
    shapes = jax.eval_shape(lambda: network.init(jax.random.key(0), frames))
    zeros = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), shapes)
    return serialization.from_bytes(zeros, path.read_bytes())


def figures_of(results: list[dict[str, Any]]) -> dict[str, Any]:
    """Figures of all runs, those of one set of sensors together."""
    figures: dict[str, Any] = {}
    units = {"decisions": "count", "training_s": "s"}
    for senses in SENSES:
        mine = sorted((one for one in results if one["senses"] == senses), key=lambda one: one["seed"])
        if not mine:
            continue
        sights = [one["sights"] for one in mine]
        columns = {name: [one["open"][name] for one in sights]
                   for name in ("arrived", "collided", "timeout", "bumped")}  # fmt: skip
        if all({"blank", "freeze"} <= set(one) for one in sights):
            columns["blinded"] = [max(one[kind]["arrived"] for kind in ("blank", "freeze")) for one in sights]
        if all("lost" in one for one in sights):
            columns["goal_alone"] = [one["lost"]["arrived"] for one in sights]
        columns["decisions"] = [float(one["decisions"]) for one in mine]
        columns["training_s"] = [one["training_s"] for one in mine]
        stamp = {key: mine[-1][key] for key in ("command", "release", "versions", "commit", "date")}
        for name, values in columns.items():
            entry = {**stamp, **figure(values, units.get(name, "-"), mine[-1]["device"])}
            entry["episodes"] = mine[0]["episodes"]
            if name in ("arrived", "collided", "bumped"):
                entry["maps"] = {place: [one["maps"][place][name] for one in sights] for place in sights[0]["maps"]}
            figures[f"among_{senses}_{name}"] = entry
    return figures


def main(options: Options) -> None:
    """Make all runs, record the figures after each, and write the policy files."""
    if not options.sights or options.sights[0] != "open" or not set(options.sights) <= set(SIGHTS):
        raise OptionError(f"--sights {' '.join(options.sights)}: give open first, then some of {', '.join(SIGHTS)}.")
    runs = []
    for text in options.runs:
        senses, _, seed = text.partition(":")
        if senses not in SENSES or not seed.isdecimal():
            raise OptionError(f"--runs {text}: give SENSES:SEED with senses of {', '.join(SENSES)}, such as lidar:0.")
        runs.append((senses, int(seed)))
    for senses, number in runs:
        with held_run(options, senses, number):
            pass  # before the first training, so that none is in vain
    results = []
    for senses, number in runs:
        print(f"{senses}, seed {number}", flush=True)
        results.append(one_run(options, senses, number))
        figures = figures_of(results)
        path = record("environment", CLAIM, figures, options.results)
        for name in ("arrived", "collided", "bumped", "timeout", "blinded", "goal_alone"):
            if one := figures.get(f"among_{senses}_{name}"):
                print(f"among_{senses}_{name}: {one['value']:.4f} {one['repeats']} -> {path}", flush=True)
    for senses, number in runs:
        write_policy(options, senses, number)


if __name__ == "__main__":
    run(Options, main, __doc__, positional=False)

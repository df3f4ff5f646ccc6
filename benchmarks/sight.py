"""Sight that transfers: `python -m benchmarks.sight`. Figures of rich looks and of the foreign corridor.

Parts: "frames" times images with rich looks, "steps" control steps of an environment that shows them, "foreign" gathers
what `python -m benchmarks.foreign --out FILE` wrote (`--drives FILE ...`), "training" the speed of trainings and their
last evaluation (`--runs NAME=FOLDER ...`, names that begin with paper or transfer), "foretell" how well success here
foretells success there, over policies named NAME or, of an evaluation inside a training, NAME@STEPS.
"""

from __future__ import annotations

import json
import statistics
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from benchmarks.harness import device_name, figure, record, time_calls
from whill_mjx.batch import BatchEnv, make_batch
from whill_mjx.env import RICH, Env, State, make_env, reset_state
from whill_mjx.io import command_line
from whill_mjx.io.reading import read_lines
from whill_mjx.vehicle.kinematics import camera_pose
from whill_mjx.world.render import pinhole, render
from whill_mjx.world.render.pallas import render_pallas

CLAIM = "A policy trained with rich looks drives where nobody trained: another simulator, renderer and furniture"
DIFFERENT = 64
"""Worlds drawn; more are copies of these."""


@dataclass(frozen=True)
class Options:
    """Options of the benchmark."""

    parts: tuple[str, ...] = ("frames", "steps")
    """Parts to measure: frames, steps, foreign, training, foretell."""
    worlds: int = 0
    """Worlds per call; 0 takes 16,384 on an accelerator and 64 on a CPU."""
    repeats: int = 5
    """Timed repeats."""
    drives: tuple[Path, ...] = ()
    """Files that `benchmarks.foreign` wrote."""
    runs: tuple[str, ...] = ()
    """Folders of trainings."""
    device: str = ""
    """Device on which those drives or trainings ran; none says this one."""


def many_states(env: Env, params: Any, worlds: int) -> State:
    """States at the start of `worlds` episodes, of DIFFERENT worlds."""
    keys = jax.random.split(jax.random.key(0), min(DIFFERENT, worlds))
    states = jax.jit(jax.vmap(lambda key: reset_state(env, params, key)))(keys)
    copies = -(-worlds // keys.shape[0])
    return jax.tree.map(lambda leaf: jnp.tile(leaf, (copies, *[1] * (leaf.ndim - 1)))[:worlds], states)


def frames(options: Options, worlds: int) -> dict[str, dict[str, Any]]:
    """Images per second, by the jnp renderer and, on NVIDIA GPUs, by the kernel, and how far the two differ there."""
    env, params = make_env("corridor", looks="rich")
    states = many_states(env, params, worlds)
    lens = pinhole(env.model.spec.camera.fov_y)

    def picture(draw):
        return lambda state: draw(*camera_pose(env.model, state.vehicle.qpos), lens, state.scene, quality=RICH)

    ways = {"rich_jnp_frames_per_s": render}
    if jax.devices()[0].platform == "gpu":
        ways = {"rich_frames_per_s": render_pallas, **ways}
    found = {}
    if len(ways) > 1:
        few = jax.tree.map(lambda leaf: leaf[:DIFFERENT], states)
        one, other = (jax.jit(jax.vmap(picture(draw)))(few).astype(jnp.int32) for draw in ways.values())
        apart = float(jnp.mean(jnp.max(jnp.abs(one - other), -1) > 1))
        found["rich_pixels_apart"] = figure([apart], "share of pixels that differ by more than one grey level")
        print(f"kernel and renderer: {apart:.2%} of the pixels differ by more than one grey level", flush=True)
    for name, draw in ways.items():
        try:
            call = jax.jit(jax.vmap(picture(draw)))
            seconds = time_calls(partial(call, states), options.repeats)
        except Exception as error:
            print(f"{name}: {type(error).__name__}: {str(error)[:300]}")
            continue
        found[name] = figure([worlds / one for one in seconds], "frames/s, 64x64 RGB")
        print(f"{name}: {found[name]['value']:.3g}")
    return found


def _ten_steps(batch: BatchEnv, actions: jax.Array, state: Any) -> tuple[Any, jax.Array]:
    """The state after ten steps, and a number of every image, so that none is left out."""

    def one(state, _):
        state, step = batch.step(state, actions)
        return state, jnp.sum(step.obs.astype(jnp.int32))

    return jax.lax.scan(one, state, None, length=10)


def steps(options: Options, worlds: int) -> dict[str, dict[str, Any]]:
    """Control steps per second, images included."""
    found = {}
    for looks in ("rich", "paper"):
        env, params = make_env("corridor", looks=looks)
        batch = make_batch(env, params, worlds)
        state, _ = jax.jit(batch.reset)(jax.random.key(0))
        actions = jnp.zeros((worlds, 2))

        ten = jax.jit(partial(_ten_steps, batch, actions))
        seconds = time_calls(partial(ten, state), options.repeats)
        name = f"{looks}_control_steps_per_s"
        found[name] = figure([10 * worlds / one for one in seconds], "1/s")
        print(f"{name}: {found[name]['value']:.3g}")
    return found


def foreign(options: Options) -> dict[str, dict[str, Any]]:
    """Shares of arrivals and collisions of every policy, driver and variant; the transfer policies' medians.

    Names say the task, unless it is the corridor.
    """
    drives = [one for path in options.drives for one in json.loads(path.read_text())["drives"]]
    groups: dict[tuple[str, str, str, str], list[str]] = {}
    for one in drives:
        place = "foreign" if one.get("task", "corridor") == "corridor" else f"foreign_{one['task']}"
        groups.setdefault((place, one["policy"], one["driver"], one["variant"]), []).append(one["end"])
    found: dict[str, dict[str, Any]] = {}
    seeds: dict[tuple[str, str, str, str], list[float]] = {}
    device = options.device or device_name()
    for (place, policy, driver, variant), ends in sorted(groups.items()):
        for end in ("arrived", "collided", *(["stopped"] if driver == "with_stop" else [])):
            share = ends.count(end) / len(ends)
            name = "_".join([place, policy, *([driver] if driver not in (policy, "policy") else []), variant, end])
            found[name] = {"value": share, "unit": "share", "device": device, "drives": len(ends)}
            if policy.startswith("transfer") and driver in ("policy", "with_stop"):
                seeds.setdefault((place, driver, variant, end), []).append(share)
    for (place, driver, variant, end), shares in seeds.items():
        name = "_".join([place, *(["with_stop"] if driver == "with_stop" else []), variant])
        found[name if end == "arrived" else f"{name}_{end}"] = figure(shares, "share", device)
    driver = "with_stop" if any(key[:2] == ("foreign", "with_stop") for key in seeds) else "policy"
    collided = [shares for key, shares in seeds.items() if (key[:2], key[3]) == (("foreign", driver), "collided")]
    if collided:
        found["foreign_collided_worst"] = figure(max(collided, key=statistics.median), "share", device)
    return found


def training(options: Options) -> dict[str, dict[str, Any]]:
    """Time of a control step with rich looks over one with the paper's, and the last evaluation of each training."""
    speeds: dict[str, list[float]] = {"paper": [], "transfer": []}
    ends: dict[str, list[float]] = {"paper": [], "transfer": []}
    steps_done = {}
    for text in options.runs:
        name, folder = text.split("=", 1)
        kind = next(kind for kind in speeds if name.startswith(kind))
        rows = [line for _, line in read_lines(Path(folder) / "metrics.jsonl")]
        rates = [row["env_steps_per_s"] for row in rows if "env_steps_per_s" in row]
        speeds[kind].append(statistics.median(rates[5:]))  # the first rows compile
        evaluated = [row for row in rows if "eval/success" in row]
        ends[kind].append(evaluated[-1]["eval/success"])
        steps_done[kind] = evaluated[-1]["env_steps"]
    found: dict[str, dict[str, Any]] = {}
    device = options.device or None
    for kind, values in ends.items():
        if values:
            name = f"{kind}_training_success"
            found[name] = {**figure(values, "share", device), "env_steps": steps_done[kind], "episodes": 200}
    if all(speeds.values()):
        ratios = [statistics.median(speeds["paper"]) / one for one in speeds["transfer"]]
        found["rich_step_time_ratio"] = figure(ratios, "ratio", device)
    return found


def foretell(options: Options) -> dict[str, dict[str, Any]]:
    """Spearman's rank correlation and Pearson's r of success here and in each foreign variant (SRCC, Kadian 2020)."""
    from scipy.stats import pearsonr, spearmanr

    here: dict[str, float] = {}
    for text in options.runs:
        name, folder = text.split("=", 1)
        rows = [line for _, line in read_lines(Path(folder) / "metrics.jsonl")]
        evaluated = {int(row["env_steps"]): row["eval/success"] for row in rows if "eval/success" in row}
        best = max(evaluated, key=lambda steps: evaluated[steps])
        here |= {name: evaluated[best], **{f"{name}@{steps}": share for steps, share in evaluated.items()}}
    there: dict[str, dict[str, list[bool]]] = {}
    for one in (one for path in options.drives for one in json.loads(path.read_text())["drives"]):
        if one["driver"] == "policy" and one["policy"] in here:
            there.setdefault(one["variant"], {}).setdefault(one["policy"], []).append(one["end"] == "arrived")
    found: dict[str, dict[str, Any]] = {}
    for variant, policies in sorted(there.items()):
        names = sorted(policies)
        ours, theirs = [here[name] for name in names], [statistics.mean(policies[name]) for name in names]
        points = {name: [a, b] for name, a, b in zip(names, ours, theirs, strict=True)}
        common = {"device": options.device or device_name(), "policies": len(names), "success_here_and_there": points}
        found[f"srcc_{variant}"] = {"value": float(spearmanr(ours, theirs)[0]), "unit": "rank correlation", **common}
        found[f"pearson_{variant}"] = {"value": float(pearsonr(ours, theirs)[0]), "unit": "correlation", **common}
    return found


def main(options: Options) -> None:
    """Measure the parts, print and record."""
    worlds = options.worlds or (64 if jax.devices()[0].platform == "cpu" else 16_384)
    found: dict[str, dict[str, Any]] = {}
    if "frames" in options.parts:
        found |= frames(options, worlds)
    if "steps" in options.parts:
        found |= steps(options, worlds)
    if "foreign" in options.parts:
        found |= foreign(options)
    if "training" in options.parts:
        found |= training(options)
    if "foretell" in options.parts:
        found |= foretell(options)
    record("sight", CLAIM, found)


if __name__ == "__main__":
    command_line.run(Options, main, __doc__, positional=False)

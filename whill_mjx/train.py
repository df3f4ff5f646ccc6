"""The main job: fit the vehicle to a driving log, train a policy in its simulator, evaluate it and export it.

    python -m whill_mjx.train --out RUN [--vehicle RUN/vehicle.toml] [--task obstacle_course] [--preset auto]

A run that was interrupted goes on where it stopped when the same command is given again.
"""

from __future__ import annotations

import dataclasses
import json
import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dreamer import agent as agents
from dreamer.export import PolicyContract, export_policy
from dreamer.train import TrainResult, train
from whill_mjx.batch import BatchEnv
from whill_mjx.training import (
    Drives,
    Preset,
    find_preset,
    functional_env,
    make_training_env,
    policy_driver,
    random_driver,
    record_drives,
    summarise,
)

FINAL_SEED = 1_000_003  # keys of the final evaluation, apart from those of the training
SHIPPED_LOG = "chair"


@dataclass(frozen=True)
class TrainOptions:
    """Options of the command."""

    out: Path = Path("runs/train")
    """Folder of the run."""
    vehicle: Path | None = None
    """Vehicle file, or the name of a built-in vehicle; none fits one to `log`."""
    log: Path | None = None
    """Driving-log dataset to fit the vehicle to; none takes the small one that ships with the project."""
    task: str = "obstacle_course"
    """obstacle_course or corridor."""
    preset: str = "auto"
    """paper, cpu or smoke; auto takes paper on an accelerator and cpu elsewhere."""
    layout: str = "randomised"
    """randomised (a new world in each episode) or fixed."""
    seed: int = 0
    """Seed of the training."""
    steps: int | None = None
    """Environment steps to train; none takes the preset's."""
    episodes: int = 100
    """Episodes of the final evaluation, of the policy and of a random one."""
    checkpoint_every_s: float = 60.0
    """Time between checkpoints [s]."""
    lr: float | None = None
    """Learning rate; none takes the preset's."""
    train_ratio: float | None = None
    """Replayed steps per environment step; none takes the preset's."""


def main(options: TrainOptions) -> dict[str, Any]:
    """Do the whole job and return the evaluation; everything is left in `options.out`."""
    started = time.perf_counter()
    say(f"devices: {', '.join(str(device) for device in jax.devices())}")
    preset = choose_preset(options)
    options.out.mkdir(parents=True, exist_ok=True)
    write_json(options.out / "config.json", {"command": _plain(options), "preset": _plain(preset)})
    vehicle = prepare_vehicle(options)
    result = train_policy(options, preset, vehicle)
    evaluation = evaluate_policy(options, preset, vehicle, result)
    policy = export(options, preset, vehicle, result)
    seconds = time.perf_counter() - started
    evaluation["seconds"] = {"this_command": seconds, "training": result.wall_s}
    write_json(options.out / "evaluation.json", evaluation)
    share, interval = evaluation["policy"]["success"], evaluation["policy"]["success_interval_95"]
    say(
        f"success {share:.0%} (95 % interval {interval[0]:.0%} to {interval[1]:.0%}), random policy "
        f"{evaluation['random']['success']:.0%}; policy file {policy}; {seconds / 60:.1f} min"
    )
    return evaluation


def choose_preset(options: TrainOptions) -> Preset:
    """The preset with the options' changes put in."""
    on_cpu = jax.devices()[0].platform == "cpu"
    name = options.preset if options.preset != "auto" else ("cpu" if on_cpu else "paper")
    preset = find_preset(name, options.task)
    say(f"preset {name}")
    learner = preset.learner
    if options.lr is not None:
        learner = dataclasses.replace(learner, lr=options.lr)
    if options.train_ratio is not None:
        learner = dataclasses.replace(learner, train_ratio=options.train_ratio)
    task = dataclasses.replace(preset.task, layout=options.layout)
    return dataclasses.replace(preset, task=task, learner=learner, total_steps=options.steps or preset.total_steps)


def prepare_vehicle(options: TrainOptions) -> Path:
    """RUN/vehicle.toml: a copy of the given file, a preset, or fitted to the log."""
    from whill_mjx.presets import preset
    from whill_mjx.vehicle_file import load_vehicle, save_vehicle

    target = options.out / "vehicle.toml"
    if options.vehicle is not None:
        if options.vehicle.suffix == ".toml":
            spec, params, provenance = load_vehicle(options.vehicle)  # a bad file is refused before anything is written
        else:
            spec, params = preset(str(options.vehicle))
            provenance = {"preset": str(options.vehicle)}
        return save_vehicle(target, spec, params, provenance=provenance)
    if target.exists():
        load_vehicle(target)
        say(f"vehicle: {target} from an earlier run")
        return target
    import sysid
    from sysid.fit import FitConfig, expected_steps, fit_dataset, progress_bar

    log = options.log or Path(sysid.__file__).parent / "data" / SHIPPED_LOG
    say(f"vehicle: fitting to {log.name}")
    config = FitConfig(quick=True)
    progress, close = progress_bar(expected_steps(config))
    try:
        fit_dataset(log, options.out / "fit", config=config, progress=progress)
    finally:
        close()
    text = (options.out / "fit" / "vehicle.toml").read_text()
    write_text(target, text)
    return target


def train_policy(options: TrainOptions, preset: Preset, vehicle: Path) -> TrainResult:
    """Train, with an evaluation every `eval_every` steps."""
    batch = make_training_env(preset.task, vehicle, preset.instances)
    held_out = make_training_env(preset.task, vehicle, min(preset.eval_episodes, 200))
    evaluate = evaluation_of(held_out, preset, options.seed)
    return train(
        functional_env(batch),
        preset.learner,
        options.out,
        preset.total_steps,
        options.seed,
        eval_fn=evaluate,
        eval_every=preset.eval_every,
        checkpoint_every_s=options.checkpoint_every_s,
    )


def evaluation_of(batch: BatchEnv, preset: Preset, seed: int):
    """(params, steps) -> figures of one episode in every instance of `batch`; always the same worlds."""
    from dreamer.train import evaluate

    env = functional_env(batch)

    def run(params: Any, env_steps: int) -> dict[str, float]:
        episodes = evaluate(env, preset.learner, params, jax.random.key(seed + 77), batch.count)
        success = episodes["success"] > 0.5
        figures = {name: float(np.mean(episodes[name])) for name in ("return", "success", "collision", "timeout")}
        if success.any():
            figures["arrival_s"] = float(np.mean(episodes["time_s"][success]))
        return figures

    return run


def evaluate_policy(options: TrainOptions, preset: Preset, vehicle: Path, result: TrainResult) -> dict[str, Any]:
    """Drive the final evaluation with the policy and with random actions; write pictures and video."""
    from whill_mjx import pictures

    batch = make_training_env(preset.task, vehicle, options.episodes)
    key = jax.random.key(FINAL_SEED + options.seed)
    drives = record_drives(batch, *policy_driver(preset.learner, result.agent.params, batch.count), key)
    at_random = record_drives(batch, *random_driver(), key, videos=1)
    rate = 1.0 / (batch.env.model.config.control_dt * preset.task.action_repeat)
    summary = {"policy": summarise(drives), "random": summarise(at_random)}
    references = {"random policy": summary["random"]["return_mean"]}
    draw = {
        "reward_curve.png": lambda path: pictures.reward_curve(
            options.out / "metrics.jsonl", path, preset.task.action_repeat, references
        ),
        "drives.png": lambda path: pictures.drives_from_above(drives, preset.task.goal_radius, path),
        "camera.mp4": lambda path: pictures.camera_video(drives, path, rate),
    }
    for name, draw_one in draw.items():
        try:
            draw_one(options.out / name)
        except ImportError as error:
            say(f"{name} is left out: {error}. Install the base package to draw it.")
    save_drives(options.out / "drives.npz", drives)
    return {"task": _plain(preset.task), "seed": options.seed, "env_steps": result.env_steps,
            "updates": result.updates, **summary}


def save_drives(path: Path, drives: Drives) -> None:
    """Paths, lengths and endings of the evaluation drives as plain arrays."""
    temporary = path.with_name(path.name + ".tmp")
    with temporary.open("wb") as file:
        arrays: dict[str, Any] = {"path": drives.path, "length": drives.length, **drives.metrics}
        np.savez_compressed(file, **arrays)
    os.replace(temporary, path)


def export(options: TrainOptions, preset: Preset, vehicle: Path, result: TrainResult) -> Path | None:
    """Write the policy file RUN/policy."""
    from whill_mjx.vehicle_file import load_vehicle

    task, learner = preset.task, preset.learner
    spec, _, _ = load_vehicle(vehicle)
    contract = PolicyContract(
        action_low=(task.v_min, -task.omega_max),
        action_high=(task.v_max, task.omega_max),
        task=options.task,
        rate_hz=10.0,
        action_repeat=task.action_repeat,
        camera=dataclasses.asdict(spec.camera),
    )
    params = jax.tree.map(jnp.asarray, result.agent.params)

    def step(carry: Any, image: jax.Array) -> tuple[Any, jax.Array]:
        return agents.policy_step(learner, params, carry, image)

    try:
        return export_policy(
            options.out / "policy", step, agents.policy_carry(learner, 2), params, contract, vehicle_file=vehicle
        )
    except ImportError as error:
        say(f"the policy file is left out: {error}. Install the base package and give the same command again.")
        return None


def write_json(path: Path, content: Any) -> None:
    """Write JSON, whole or not at all."""
    write_text(path, json.dumps(content, indent=1) + "\n")


def write_text(path: Path, text: str) -> None:
    """Write a text file, whole or not at all."""
    temporary = path.with_name(path.name + ".tmp")
    temporary.write_text(text)
    os.replace(temporary, path)


def say(text: str) -> None:
    """Tell the user how far the run is."""
    print(text, file=sys.stderr, flush=True)


def _plain(value: Any) -> Any:
    """A dataclass as JSON data."""
    return json.loads(json.dumps(dataclasses.asdict(value), default=str))


if __name__ == "__main__":
    import tyro

    try:
        main(tyro.cli(TrainOptions, description=__doc__))
    except (ValueError, FileNotFoundError) as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit("stopped; give the same command again to go on from the last checkpoint.")

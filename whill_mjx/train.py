"""Fit the vehicle to a driving log, train a policy in its simulator, evaluate it and export it.

    python -m whill_mjx.train --out RUN [--vehicle FIT/vehicle.toml] [--task obstacle_course] [--preset auto]

A run that was interrupted goes on where it stopped when the same command is given again. RUN is a folder of its own: a
command with another vehicle, seed, learner or setting is refused there (docs/reliability.md).
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from whill_mjx.io.command_line import listen, refusing, run, starts
from whill_mjx.io.heartbeat import Heartbeat, say, say_loading

if starts(__name__):
    listen()
    say_loading()

import jax

if starts(__name__):
    from whill_mjx.io.wake import wake_gpu

    wake_gpu()

from dreamer.training import checkpoint, parallel
from whill_mjx.devices import join
from whill_mjx.io.folders import claim_folder
from whill_mjx.learning.identity import KIND, OUTPUTS
from whill_mjx.learning.index_page import list_results, write_index
from whill_mjx.learning.options import TrainOptions, choose_preset, preset_name
from whill_mjx.learning.outcome import diverged_note, evaluate_policy, export, outcome_line
from whill_mjx.learning.refusals import check
from whill_mjx.learning.setup import Preset
from whill_mjx.learning.trainings import Stage, best_params, train_baseline, train_policy
from whill_mjx.learning.vehicle_of_run import given_vehicle, prepare_vehicle
from whill_mjx.logs.dataset import write_json

STOPPED = "stopped; give the same command again to go on from the last checkpoint."
LEAST_FREE = 32_000_000
"""Bytes that must be free for a training's folder; a checkpoint of the smallest preset takes some of them."""


def main(options: TrainOptions) -> dict[str, Any]:
    """Do the whole job and return the evaluation; everything is left in `options.out`."""
    started = time.perf_counter()
    processes = join()
    with refusing():
        preset = choose_preset(options)
        check(options, preset, processes)
    with Heartbeat() as heartbeat, begin(options, preset, heartbeat.stage) as vehicle:
        say(f"preset {preset_name(options.preset)}; devices: {', '.join(str(device) for device in jax.devices())}")
        return finish(options, preset, vehicle, started, heartbeat.stage)


@contextmanager
def begin(options: TrainOptions, preset: Preset, stage: Stage = say) -> Iterator[Path]:
    """Hold RUN as this training's and yield its vehicle file; of several processes, the first does.

    Raises:
        FolderRefused: RUN holds another training or somebody's files, or another process writes there.
    """
    with refusing():
        given = given_vehicle(options)
    if not parallel.is_first_process():
        parallel.agree(True)  # wait for the vehicle file
        yield options.out / "vehicle.toml"
        return
    with claim_folder(options.out, KIND, OUTPUTS, LEAST_FREE) as claim:
        try:
            prepare_vehicle(options, preset, claim, given, stage)
            parallel.agree(True)
            yield options.out / "vehicle.toml"
        except OSError as error:
            if checkpoint.complete(options.out / "checkpoints"):
                error.add_note(f"What was trained is in {options.out / 'checkpoints'}; the same command goes on there.")
            raise


def finish(
    options: TrainOptions, preset: Preset, vehicle: Path, started: float, stage: Stage = say
) -> dict[str, Any]:
    """Train, evaluate and export."""
    learn = train_policy if options.learner == "dreamer" else train_baseline
    result = learn(options, preset, vehicle, stage)
    stage("preparing the final evaluation")
    if not parallel.is_first_process():
        return {}
    best = best_params(options, preset, result) if options.learner == "dreamer" else None
    chosen, other, name = result, best, "policy_best"
    if options.export == "best" and best is not None:
        chosen, other, name = best, result, "policy_last"
    evaluation = evaluate_policy(options, preset, vehicle, chosen, stage)
    write_json(options.out / "evaluation.json", evaluation)  # kept, whatever becomes of the export
    stage("exporting the policy")
    policy = export(options, preset, vehicle, chosen, options.out / "policy")
    if other is not None:
        stage(f"exporting {name}")
        export(options, preset, vehicle, other, options.out / name)
    seconds = time.perf_counter() - started
    evaluation["seconds"] = {"this_command": seconds, "training": result.wall_s}
    write_json(options.out / "evaluation.json", evaluation)
    write_index(options.out, evaluation, options.task)
    say(f"{outcome_line(evaluation)}; policy file {policy}; {seconds / 60:.1f} min{diverged_note(evaluation)}")
    for line in list_results(options.out):
        say(line)
    return evaluation


def cli() -> None:
    """Command line."""
    run(TrainOptions, main, __doc__, stopped=STOPPED)


if __name__ == "__main__":
    cli()

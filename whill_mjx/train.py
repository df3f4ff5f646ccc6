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

from whill_mjx.io.command_line import OptionError, listen, refusing, run, starts
from whill_mjx.io.heartbeat import Heartbeat, say, say_loading

if starts(__name__):
    listen()
    say_loading()

import jax

if starts(__name__):
    from whill_mjx.io.wake import wake_gpu

    wake_gpu()

from dreamer import checkpoint, parallel
from whill_mjx.batch import make_batch
from whill_mjx.devices import choose_devices, join
from whill_mjx.env import make_env
from whill_mjx.io.fields import percent
from whill_mjx.io.folders import RUN_FILE, Claim, FolderRefused, claim_folder, write_whole
from whill_mjx.learning.identity import KIND, OUTPUTS, identity_of, vehicle_label
from whill_mjx.learning.index_page import list_results, write_index
from whill_mjx.learning.memory import check_memory
from whill_mjx.learning.options import TrainOptions, choose_preset, preset_name
from whill_mjx.learning.outcome import evaluate_policy, export
from whill_mjx.learning.setup import Preset, check_learner, variations_of
from whill_mjx.learning.trainings import Stage, best_params, train_baseline, train_policy
from whill_mjx.logs.dataset import plain, write_json
from whill_mjx.tasks.check import check_world
from whill_mjx.vehicle.specs import VehicleSpec
from whill_mjx.vehicle.types import VehicleParams
from whill_mjx.vehicle.vehicle_file import load_intervals, load_vehicle, save_vehicle

STOPPED = "stopped; give the same command again to go on from the last checkpoint."
SHIPPED_LOG = "chair"
LEAST_FREE = 32_000_000
"""Bytes that must be free for a training's folder; a checkpoint of the smallest preset takes some of them."""
Vehicle = tuple[VehicleSpec, VehicleParams, dict[str, Any]]
"""Spec, parameters and provenance."""


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


def check(options: TrainOptions, preset: Preset, processes: int = 1) -> None:
    """Raise ValueError for what would end the training later; nothing is written yet."""
    if options.log is not None and options.vehicle is not None:
        raise ValueError(f"--log {options.log}: nothing is fitted to it, since --vehicle is given. Leave one out.")
    if options.log is not None and not options.log.exists():
        raise FileNotFoundError(f"--log {options.log}: no such dataset. Correct the path.")
    vehicle: Any = options.vehicle
    if options.log is not None:
        from sysid import load_any

        vehicle = load_any(options.log).spec
    env, params = make_env(preset.task, vehicle, looks=preset.looks)
    check_world(env.task)  # of this vehicle, which a map may not have room for
    check_memory(preset, options.learner, env)
    check_learner(preset, options.learner, make_batch(env, params, preset.instances))
    if any(text != "fit" for text in preset.vary):
        variations_of([text for text in preset.vary if text != "fit"], None)
    if "fit" in preset.vary and options.vehicle is not None:
        variations_of(["fit"], options.vehicle)
    if processes > 1 and options.learner == "ppo":
        raise ValueError("the baseline trains in one process; start it alone or choose --learner dreamer.")
    devices = choose_devices(options.devices)
    if devices and options.learner == "dreamer":
        parallel.make_mesh(devices, preset.instances, preset.learner.batch_size)
    if options.tensorboard:
        try:
            import tensorboardX  # noqa: F401
        except ImportError:
            raise ValueError("--tensorboard: tensorboardX is missing. Install it or leave the option out.") from None


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
    share, interval = evaluation["policy"]["success"], evaluation["policy"]["success_interval_95"]
    baselines = [name for name in ("planner", "random") if name in evaluation]
    others = ", ".join(f"{name} {percent(evaluation[name]['success'])}" for name in baselines)
    say(
        f"success {percent(share)} (95% interval {percent(interval[0])} to {percent(interval[1])}), {others}; "
        f"policy file {policy}; {seconds / 60:.1f} min"
    )
    for line in list_results(options.out):
        say(line)
    return evaluation


def given_vehicle(options: TrainOptions) -> Vehicle | None:
    """The vehicle that the options name; None if they name none. A bad file is refused before anything is written."""
    return None if options.vehicle is None else load_vehicle(options.vehicle)


def prepare_vehicle(
    options: TrainOptions, preset: Preset, claim: Claim, given: Vehicle | None = None, stage: Stage = say
) -> None:
    """Settle what RUN is and write RUN/vehicle.toml: the given vehicle, that of the run so far, or one fitted to a log.

    Raises:
        FolderRefused: RUN holds a training that differs in anything that changes its result.
    """
    target, known = options.out / "vehicle.toml", claim.identity
    if absent := sorted({"vehicle", "data"} - set({"vehicle": "", "data": ""} if known is None else known)):
        raise FolderRefused(f"--out {options.out}: {options.out / RUN_FILE} does not say which run this is: it has no "
                            f"{absent[0]}. Choose another --out.")
    here = load_vehicle(target) if target.exists() else None
    begun = bool(checkpoint.complete(options.out / "checkpoints")) or _has_lines(options.out / "metrics.jsonl")
    vehicle, data, fitted = given or here, known["data"] if known else None, None
    if given is not None and not (known and known["vehicle"] == vehicle_label(*given[:2])):
        data = None
    elif given is None and (options.log or not known):
        log = options.log or _shipped_log()
        data = _hash_of(log)
        if not known or (not begun and known["data"] != data):
            fitted = _fitted(log, options.out / "fit", stage)
            vehicle = load_vehicle(fitted)
    if vehicle is None:
        raise OptionError(f"--out {options.out}: its vehicle.toml is missing. Give the vehicle by --vehicle.")
    identity = identity_of(preset, options.learner, options.seed, vehicle_label(*vehicle[:2]), data)
    claim.settle(identity, begun, command=plain(options), preset=plain(preset))
    if here is not None and vehicle_label(*here[:2]) == identity["vehicle"]:
        return
    if here is not None and begun:
        raise OptionError(f"{target}: holds {vehicle_label(*here[:2])}, but the run was begun with "
                          f"{identity['vehicle']}. Put the old file back or choose another --out.")
    if fitted is not None:
        write_whole(target, fitted.read_text())
    else:
        source = options.vehicle if given is not None else None
        known_intervals = load_intervals(source) if source is not None and source.is_file() else None
        save_vehicle(target, *vehicle[:2], known_intervals, provenance=vehicle[2])


def _shipped_log() -> Path:
    import sysid

    return Path(sysid.__file__).parent / "data" / SHIPPED_LOG


def _hash_of(log: Path) -> str:
    from sysid.logs.log import hash_files

    return hash_files(log)


def _has_lines(path: Path) -> bool:
    return path.exists() and path.stat().st_size > 0


def _fitted(log: Path, out: Path, stage: Stage) -> Path:
    """Vehicle file fitted to a driving log; its result is said in a few lines."""
    from sysid import FitConfig, fit_dataset
    from sysid.command_line import progress_bar
    from sysid.pages.fit_page import in_words
    from sysid.search.fitting import expected_steps

    stage(f"vehicle: fitting to the driving log {log.name}, usually 1 to 3 minutes")
    config = FitConfig(quick=True)
    with progress_bar(expected_steps(config)) as progress:
        report = fit_dataset(log, out, config=config, progress=progress)
    for line in in_words(report):
        say(f"  {line}")
    say(f"  report of the fit: {out / 'report.html'}")
    return out / "vehicle.toml"


def cli() -> None:
    """Command line."""
    run(TrainOptions, main, __doc__, stopped=STOPPED)


if __name__ == "__main__":
    cli()

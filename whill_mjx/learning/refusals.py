"""What would end a training later, refused before anything is written."""

from __future__ import annotations

from typing import Any

from dreamer.training import parallel
from whill_mjx.batch import make_batch
from whill_mjx.devices import choose_devices
from whill_mjx.env import make_env
from whill_mjx.io.command_line import OptionError
from whill_mjx.learning.memory import check_memory
from whill_mjx.learning.options import TrainOptions
from whill_mjx.learning.setup import Preset, check_learner, variations_of
from whill_mjx.learning.vehicle_of_run import spec_of_log
from whill_mjx.tasks.base import Task
from whill_mjx.tasks.check import check_world, ending_names


def check(options: TrainOptions, preset: Preset, processes: int = 1) -> None:
    """Raise ValueError for what would end the training later; nothing is written yet."""
    if options.log is not None and options.vehicle is not None:
        raise ValueError(f"--log {options.log}: nothing is fitted to it, since --vehicle is given. Leave one out.")
    if options.log is not None and not options.log.exists():
        raise FileNotFoundError(f"--log {options.log}: no such dataset. Correct the path.")
    vehicle: Any = options.vehicle
    if options.log is not None:
        vehicle = spec_of_log(options.log)
    env, params = make_env(preset.task, vehicle, looks=preset.looks)
    check_world(env.task)  # of this vehicle, which a map may not have room for
    check_stop_success(preset.stop_success, env.task)
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


def check_stop_success(share: float | None, task: Task) -> None:
    """Raise OptionError for a share of successes where no episode can be one."""
    names = () if share is None else ending_names(task)
    if share is not None and "success" not in names:
        raise OptionError(f"--stop-success {share:g}: task {task.name!r} has no ending 'success' (it has: "
                          f"{', '.join(names)}). Leave it out, of the task's budget too, or call one of the endings "
                          "'success'.")

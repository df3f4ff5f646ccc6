"""Options of the training command, and the preset that they ask for."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import jax

from dreamer.config import LEAST_TRAIN_RATIO, DreamerConfig
from whill_mjx.io.command_line import COUNT, NOT_NEGATIVE, SEED, SHARE, OptionError, Range, With, check_known
from whill_mjx.io.fields import REPEATS
from whill_mjx.learning.setup import TRUTH, Preset, find_preset, with_layout, with_repeat, with_settings
from whill_mjx.learning.shaping import SAFETY, find_safety
from whill_mjx.tasks.options import named_task, read_fields
from whill_mjx.tasks.tasks import LAYOUTS

MODEL = With("learner", ("dreamer",))
"""Only the world model has it."""
PRESETS = ("auto", "paper", "transfer", "wallclock", "cpu", "smoke")


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
    """Name of a task (obstacle_course, corridor, ...), package.module:TASK or path/to/file.py:TASK."""
    preset: str = "auto"
    """paper, transfer, wallclock, cpu or smoke; auto takes paper on an accelerator and cpu elsewhere."""
    learner: Literal["dreamer", "ppo"] = "dreamer"
    """The world model, or the model-free baseline with as many environment steps."""
    set: tuple[str, ...] = ()
    """Fields of the task, such as gates=1; they count more than those that the preset changes."""
    layout: str = "randomised"
    """randomised (a new world in each episode) or fixed."""
    looks: Literal["plain", "paper", "rich"] | None = None
    """What changes the picture from episode to episode: nothing, what the paper randomises, or a furnished room with
    other materials, light and camera (docs/looks.md). None takes the preset's."""
    seed: Annotated[int, SEED] = 0
    """Seed of the training."""
    steps: Annotated[int | None, COUNT] = None
    """Environment steps to train; none takes the preset's."""
    eval_every: Annotated[int | None, COUNT] = None
    """Environment steps between evaluations inside the run; none takes the preset's."""
    episodes: Annotated[int, Range(1, 1_000_000)] = 100
    """Episodes of the final evaluation, of the policy, the planner and a random one."""
    planner: bool = True
    """Whether the planner that knows the truth drives the final evaluation too."""
    videos: Annotated[int, Range(0, 1000)] = 4
    """Episodes, and failures, of the final evaluation shown as videos."""
    checkpoint_every_s: Annotated[float | None, NOT_NEGATIVE] = None
    """Time between checkpoints [s]; none: a minute, or as much more as makes them a twentieth of the run's time."""
    lr: Annotated[float | None, Range(0, 1, above=True)] = None
    """Learning rate; none takes the preset's."""
    train_ratio: Annotated[float | None, Range(LEAST_TRAIN_RATIO, 1e6), MODEL] = None
    """Replayed steps per environment step; none takes the preset's."""
    change: tuple[str, ...] = ()
    """Other settings of the learner, such as greedy_share=0.25 entropy_scale=3e-4."""
    action_repeat: Annotated[int | None, Range(1, REPEATS)] = None
    """Control periods (0.1 s) that a decision holds; the budget in control periods, the updates and the horizon in
    seconds stay the preset's. None takes the preset's."""
    targets: Annotated[bool, MODEL] = False
    """Let the world model also predict goal, speeds and free distances, which the simulator knows
    (`whill_mjx.sensors.privileged`). The
    policy still sees the camera alone. The presets paper and wallclock do so anyway."""
    exploring_starts: Annotated[float | None, SHARE] = None
    """Share of training episodes that begin at a random free place on the way to the goal, which the simulator can do
    and a real course cannot; evaluations always begin at the start. None takes the preset's."""
    second_tries: Annotated[float | None, SHARE] = None
    """Share of the training episodes without a success after which the same world is begun again, which a simulator
    can do; evaluations never do. None takes the preset's."""
    spread: Annotated[float | None, Range(0, 1, below=True)] = None
    """Relative spread of all parameters of the vehicle from episode to episode of the training; none takes the
    preset's."""
    vary: tuple[str, ...] = ()
    """Parameters of the vehicle drawn anew in each episode of the training: body.mass=0.9x:1.1x, an effect such as
    command_delay.delay=0:0.2 (added where the vehicle lacks it), or fit for all intervals of the vehicle file."""
    instances: Annotated[int | None, Range(1, 10**7)] = None
    """Chairs side by side; none takes the preset's."""
    safety: str = "none"
    """none (the task's reward alone), smooth (gentle commands), safe (gentle commands and a distance kept) or monitor
    (slower before what the scanners see: a collision monitor in the policy itself)."""
    stop_success: Annotated[float | None, SHARE] = None
    """End when two evaluations inside the run in a row reach this share of successes. A file RUN/stop ends it too."""
    export: Annotated[Literal["last", "best"], MODEL] = "best"
    """Which parameters become RUN/policy: those at the end, or those of the best evaluation inside the run. The others
    become RUN/policy_best or RUN/policy_last, where they differ."""
    tensorboard: Annotated[bool, MODEL] = False
    """Write the curves of the world model's training for TensorBoard too, to RUN/tensorboard (needs tensorboardX)."""
    devices: Annotated[int | None, COUNT] = None
    """Devices over which instances and batches are split; none takes all."""


def preset_name(name: str) -> str:
    """The name of a preset, "auto" being that of the device."""
    if name != "auto":
        return name
    return "cpu" if jax.devices()[0].platform == "cpu" else "paper"


def choose_preset(options: TrainOptions) -> Preset:
    """The preset with the options' changes put in."""
    check_known("--preset", options.preset, PRESETS)
    task = named_task(options.task)
    check_known("--layout", options.layout, LAYOUTS)
    check_known("--safety", options.safety, SAFETY)
    name = preset_name(options.preset)
    preset = find_preset(name, task, options.steps)
    preset = dataclasses.replace(preset, task=dataclasses.replace(preset.task, **read_fields(task, options.set)))
    _check_twice(options)
    preset = with_layout(preset, options.layout, options.looks, options.vehicle)
    if options.action_repeat is not None:
        preset = with_repeat(preset, options.action_repeat)
    learner, baseline = preset.learner, preset.ppo
    if options.lr is not None:
        learner = dataclasses.replace(learner, lr=options.lr)
        baseline = dataclasses.replace(baseline, lr=options.lr)
    if options.train_ratio is not None:
        learner = dataclasses.replace(learner, train_ratio=options.train_ratio)
    if options.targets:
        learner = dataclasses.replace(learner, decode_only=(TRUTH,))
    if options.learner == "ppo":
        baseline = with_settings(baseline, options.change)
    else:
        learner = with_settings(learner, options.change)
    if not any(text.partition("=")[0] == "lr_decay" for text in options.change):
        learner = _spanning(learner, preset.learner)
    return dataclasses.replace(
        preset,
        learner=learner,
        ppo=baseline,
        total_steps=preset.total_steps if options.steps is None else options.steps,
        instances=preset.instances if options.instances is None else options.instances,
        eval_every=preset.eval_every if options.eval_every is None else options.eval_every,
        exploring_starts=preset.exploring_starts if options.exploring_starts is None else options.exploring_starts,
        second_tries=preset.second_tries if options.second_tries is None else options.second_tries,
        spread=preset.spread if options.spread is None else options.spread,
        vary=options.vary or preset.vary,
        safety=find_safety(options.safety),
        stop_success=options.stop_success if options.stop_success is not None else preset.stop_success,
    )


def _spanning(learner: DreamerConfig, before: DreamerConfig) -> DreamerConfig:
    """A changed learner whose falling rate spans as long a run as before, whatever its updates per step are now."""
    shorter = before.replayed_per_update / learner.replayed_per_update
    if not learner.lr_decay or (learner.train_ratio == before.train_ratio and shorter == 1.0):
        return learner
    updates = round(learner.lr_decay * learner.train_ratio / before.train_ratio * shorter)
    return dataclasses.replace(learner, lr_decay=max(learner.warmup + 1, updates))


def _check_twice(options: TrainOptions) -> None:
    """Raise OptionError for a setting that has an option of its own and is given by --change or --set too."""
    for option, texts, names in (("--change", options.change, ("lr", "train_ratio")),
                                 ("--set", options.set, ("action_repeat",))):  # fmt: skip
        for text in texts:
            name = text.partition("=")[0]
            if name in names and getattr(options, name) is not None:
                raise OptionError(f"{option} {text}: --{name.replace('_', '-')} gives it too. Leave one out.")

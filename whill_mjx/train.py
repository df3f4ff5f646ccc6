"""The main job: fit the vehicle to a driving log, train a policy in its simulator, evaluate it and export it.

    python -m whill_mjx.train --out RUN [--vehicle FIT/vehicle.toml] [--task obstacle_course] [--preset auto]

A run that was interrupted goes on where it stopped when the same command is given again. RUN is a folder of its own: a
command with another vehicle, seed, learner or setting is refused there (docs/reliability.md).
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from whill_mjx.io.command_line import (
    COUNT,
    NOT_NEGATIVE,
    POSITIVE,
    SEED,
    SHARE,
    OptionError,
    Range,
    check_known,
    listen,
    refusing,
    run,
    starts,
)
from whill_mjx.io.heartbeat import Heartbeat, say, say_loading

if starts(__name__):
    listen()
    say_loading()

import jax
import jax.numpy as jnp

from dreamer import checkpoint, parallel
from dreamer.export import PolicyContract, export_policy, export_sensing
from dreamer.train import TrainingOptions, train
from whill_mjx.batch import BatchEnv
from whill_mjx.devices import choose_devices, join
from whill_mjx.evaluation.drivers import planner_driver, random_driver
from whill_mjx.evaluation.episodes import Course, episode_keys
from whill_mjx.evaluation.novelty import largest_surprise, limits
from whill_mjx.evaluation.policy_file import camera_contract
from whill_mjx.evaluation.rollouts import rollout
from whill_mjx.io.folders import Claim, claim_folder, write_whole
from whill_mjx.io.formats import stamp
from whill_mjx.learning.checks import Evaluate, Stopper, keep_best, mean_figures, read_best
from whill_mjx.learning.final_report import evaluate_drivers, write_report
from whill_mjx.learning.identity import KIND, OUTPUTS, identity_of, vehicle_label
from whill_mjx.learning.index_page import list_results, write_index
from whill_mjx.learning.ppo import check_minibatches
from whill_mjx.learning.ppo_training import train_ppo
from whill_mjx.learning.prediction import write_prediction
from whill_mjx.learning.setup import (
    TRUTH,
    Preset,
    dreamer_policy,
    find_preset,
    functional_env,
    make_training_env,
    obs_shape_of,
    ppo_policy,
    step_driver,
    variations_of,
    with_layout,
    with_repeat,
    with_settings,
)
from whill_mjx.learning.shaping import SAFETY, Step, find_safety
from whill_mjx.logs.dataset import plain, write_json
from whill_mjx.tasks.check import check_task
from whill_mjx.tasks.options import named_task, read_fields
from whill_mjx.tasks.tasks import LAYOUTS
from whill_mjx.vehicle.specs import VehicleSpec
from whill_mjx.vehicle.types import VehicleParams
from whill_mjx.vehicle.vehicle_file import load_intervals, load_vehicle, save_vehicle

STOPPED = "stopped; give the same command again to go on from the last checkpoint."
Stage = Callable[[str], None]
"""Gets a line when a stage of the command begins."""
NOVELTY_SEED, NOVELTY_EPISODES = 3_000_017, 200  # episodes in which a policy meets its own world
FINAL_SEED = 1_000_003  # keys of the final evaluation, apart from those of the training
SHIPPED_LOG = "chair"
LEAST_FREE = 32_000_000
"""Bytes that must be free for a training's folder; a checkpoint of the smallest preset takes some of them."""
PRESETS = ("auto", "paper", "transfer", "wallclock", "cpu", "smoke")
Vehicle = tuple[VehicleSpec, VehicleParams, dict[str, Any]]
"""Spec, parameters and provenance."""


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
    episodes: Annotated[int, COUNT] = 100
    """Episodes of the final evaluation, of the policy, the planner and a random one."""
    planner: bool = True
    """Whether the planner that knows the truth drives the final evaluation too."""
    videos: Annotated[int, NOT_NEGATIVE] = 4
    """Episodes, and failures, of the final evaluation shown as videos."""
    checkpoint_every_s: Annotated[float, NOT_NEGATIVE] = 60.0
    """Time between checkpoints [s]."""
    lr: Annotated[float | None, Range(0, 1, above=True)] = None
    """Learning rate; none takes the preset's."""
    train_ratio: Annotated[float | None, POSITIVE] = None
    """Replayed steps per environment step; none takes the preset's."""
    change: tuple[str, ...] = ()
    """Other settings of the learner, such as greedy_share=0.25 entropy_scale=3e-4."""
    action_repeat: Annotated[int | None, COUNT] = None
    """Control periods (0.1 s) that a decision holds; the budget in control periods, the updates and the horizon in
    seconds stay the preset's. None takes the preset's."""
    targets: bool = False
    """Let the world model also predict goal, speeds and free distances, which the simulator knows
    (`whill_mjx.sensors.privileged`). The
    policy still sees the camera alone. The presets paper and wallclock do so anyway."""
    exploring_starts: Annotated[float | None, SHARE] = None
    """Share of training episodes that begin at a random free place on the way to the goal, which the simulator can do
    and a real course cannot; evaluations always begin at the start. None takes the preset's."""
    second_tries: Annotated[float | None, SHARE] = None
    """Share of the training episodes without an arrival after which the same world is begun again, which a simulator
    can do; evaluations never do. None takes the preset's."""
    spread: Annotated[float | None, Range(0, 1, below=True)] = None
    """Relative spread of all parameters of the vehicle from episode to episode of the training; none takes the
    preset's."""
    vary: tuple[str, ...] = ()
    """Parameters of the vehicle drawn anew in each episode of the training: body.mass=0.9x:1.1x, an effect such as
    command_delay.delay=0:0.2 (added where the vehicle lacks it), or fit for all intervals of the vehicle file."""
    instances: Annotated[int | None, COUNT] = None
    """Chairs side by side; none takes the preset's."""
    safety: str = "none"
    """none (the task's reward alone), smooth (gentle commands) or safe (gentle commands and a distance kept)."""
    stop_success: Annotated[float | None, SHARE] = None
    """End when two evaluations inside the run in a row reach this share of successes. A file RUN/stop ends it too."""
    export: Literal["last", "best"] = "best"
    """Which parameters become RUN/policy: those at the end, or those of the best evaluation inside the run. The others
    become RUN/policy_best or RUN/policy_last, where they differ."""
    tensorboard: bool = False
    """Write the curves of the world model's training for TensorBoard too, to RUN/tensorboard (needs tensorboardX)."""
    devices: Annotated[int | None, COUNT] = None
    """Devices over which instances and batches are split; none takes all."""


@dataclass(frozen=True)
class Trained:
    """What either learner leaves."""

    params: Any
    env_steps: int
    updates: int
    wall_s: float


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
    check_task(preset.task)
    if any(text != "fit" for text in preset.vary):
        variations_of([text for text in preset.vary if text != "fit"], None)
    if "fit" in preset.vary and options.vehicle is not None:
        variations_of(["fit"], options.vehicle)
    if processes > 1 and options.learner == "ppo":
        raise ValueError("the baseline trains in one process; start it alone or choose --learner dreamer.")
    devices = choose_devices(options.devices)
    if options.learner == "ppo":
        check_minibatches(preset.ppo, preset.instances)
    elif devices:
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
    others = ", ".join(f"{name} {evaluation[name]['success']:.0%}" for name in baselines)
    say(
        f"success {share:.0%} (95 % interval {interval[0]:.0%} to {interval[1]:.0%}), {others}; policy file {policy}; "
        f"{seconds / 60:.1f} min"
    )
    for line in list_results(options.out):
        say(line)
    return evaluation


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
    preset = with_layout(preset, options.layout)
    if options.action_repeat is not None:
        preset = with_repeat(preset, options.action_repeat)
    learner, baseline = preset.learner, preset.ppo
    if options.lr is not None:
        learner = dataclasses.replace(learner, lr=options.lr)
        baseline = dataclasses.replace(baseline, lr=options.lr)
    if options.train_ratio is not None:
        updates = round(learner.lr_decay * options.train_ratio / learner.train_ratio)  # the falling rate spans the run
        decay = max(learner.warmup + 1, updates) if learner.lr_decay else 0
        learner = dataclasses.replace(learner, train_ratio=options.train_ratio, lr_decay=decay)
    if options.targets:
        learner = dataclasses.replace(learner, decode_only=(TRUTH,))
    if options.learner == "ppo":
        baseline = with_settings(baseline, options.change)
    else:
        learner = with_settings(learner, options.change)
    return dataclasses.replace(
        preset,
        learner=learner,
        ppo=baseline,
        total_steps=preset.total_steps if options.steps is None else options.steps,
        instances=preset.instances if options.instances is None else options.instances,
        eval_every=preset.eval_every if options.eval_every is None else options.eval_every,
        exploring_starts=preset.exploring_starts if options.exploring_starts is None else options.exploring_starts,
        second_tries=preset.second_tries if options.second_tries is None else options.second_tries,
        looks=preset.looks if options.looks is None else options.looks,
        spread=preset.spread if options.spread is None else options.spread,
        vary=options.vary or preset.vary,
        safety=find_safety(options.safety),
        stop_success=options.stop_success if options.stop_success is not None else preset.stop_success,
    )


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
    progress, close = progress_bar(expected_steps(config))
    try:
        report = fit_dataset(log, out, config=config, progress=progress)
    finally:
        close()
    for line in in_words(report):
        say(f"  {line}")
    say(f"  report of the fit: {out / 'report.html'}")
    return out / "vehicle.toml"


def train_policy(options: TrainOptions, preset: Preset, vehicle: Path, stage: Stage = say) -> Trained:
    """Train the world model and its policy, with an evaluation every `eval_every` steps."""
    devices = choose_devices(options.devices)
    batch = make_training_env(
        preset.task, vehicle, preset.instances, preset.spread, devices, preset.exploring_starts, preset.second_tries,
        preset.looks, preset.vary,
    )  # fmt: skip
    held_out = make_training_env(preset.task, vehicle, preset.eval_episodes, looks=preset.looks)
    evaluate = evaluation_of(held_out, preset, options.seed)
    stopper = Stopper(options.out, preset.stop_success)
    result = train(
        functional_env(batch, preset.safety, targets=TRUTH in preset.learner.decode_only),
        preset.learner,
        options.out,
        stopper.total_steps(preset.total_steps),
        options.seed,
        TrainingOptions(
            eval_fn=keep_best(options.out, preset, evaluate),
            eval_ahead=lambda params: evaluate(params, 0),
            eval_every=preset.eval_every,
            checkpoint_every_s=options.checkpoint_every_s,
            stop=stopper,
            devices=devices,
            tensorboard=options.tensorboard,
            announce=stage,
        ),
    )
    return Trained(jax.device_get(result.agent.acting), result.env_steps, result.updates, result.wall_s)


def train_baseline(options: TrainOptions, preset: Preset, vehicle: Path, stage: Stage = say) -> Trained:
    """Train the model-free baseline with as many environment steps."""
    devices = choose_devices(options.devices)
    batch = make_training_env(
        preset.task, vehicle, preset.instances, preset.spread, devices, preset.exploring_starts, preset.second_tries,
        preset.looks, preset.vary,
    )  # fmt: skip
    course = make_course(preset, vehicle)
    keys = episode_keys(options.seed + 77, preset.eval_episodes)
    vehicles = course.vehicles(keys)
    step, carry = policy_of(options, preset, course)

    @jax.jit
    def ends(params: Any, vehicles: Any, keys: jax.Array) -> dict[str, jax.Array]:
        driver = step_driver(step, params, carry, preset.task.action_repeat)
        return rollout(course.env, vehicles, keys, driver).ends

    def evaluate(params: Any, env_steps: int) -> dict[str, float]:
        episodes = jax.device_get(ends(params, vehicles, keys))
        return mean_figures({**episodes, "return": episodes["episode_return"]})

    stopper = Stopper(options.out, preset.stop_success)
    how = TrainingOptions(
        eval_fn=evaluate,
        eval_ahead=None if devices else lambda params: evaluate(params, 0),
        eval_every=preset.eval_every,
        checkpoint_every_s=options.checkpoint_every_s,
        stop=stopper,
        announce=stage,
    )
    env, last_step = functional_env(batch, preset.safety), stopper.total_steps(preset.total_steps)
    return Trained(*train_ppo(env, preset.ppo, options.out, preset.total_steps, options.seed, how, last_step))


def evaluation_of(batch: BatchEnv, preset: Preset, seed: int) -> Evaluate:
    """(params, steps) -> figures of one episode in every instance of `batch`; always the same worlds."""
    from dreamer.train import evaluate

    env = functional_env(batch, preset.safety, shaped=False)

    def run(params: Any, env_steps: int) -> dict[str, float]:
        return mean_figures(evaluate(env, preset.learner, params, jax.random.key(seed + 77), batch.count))

    return run


def best_params(options: TrainOptions, preset: Preset, result: Trained) -> Trained | None:
    """The best parameters, if they are not those at the end of the run."""
    best = read_best(options.out)
    if best is None or best["env_steps"] == result.env_steps:
        return None
    path = options.out / "best" / f"{int(best['env_steps']):012d}"
    try:
        state, _ = checkpoint.load(path, {"params": result.params}, preset.learner)
    except checkpoint.CheckpointError as error:
        say(f"the best parameters are lost, so the last ones become the policy: {error}")
        return None
    return Trained(state["params"], int(best["env_steps"]), result.updates, result.wall_s)


def make_course(preset: Preset, vehicle: Path) -> Course:
    """The environment of evaluations."""
    batch = make_training_env(preset.task, vehicle, 1, looks=preset.looks)
    return Course(batch.env, batch.params)


def policy_of(options: TrainOptions, preset: Preset, course: Course) -> tuple[Step, dict[str, Any]]:
    """What drives, and is exported: the step of one instance and its first carry."""
    control_dt = course.env.model.config.control_dt
    if options.learner == "ppo":
        return ppo_policy(preset, control_dt, course.env)
    return dreamer_policy(preset, control_dt)


def evaluate_policy(
    options: TrainOptions, preset: Preset, vehicle: Path, result: Trained, stage: Stage = say
) -> dict[str, Any]:
    """Drive the final evaluation with the policy, the planner and random actions; write pictures and videos."""
    from whill_mjx.evaluation import pictures

    course = make_course(preset, vehicle)
    step, carry = policy_of(options, preset, course)
    driver = step_driver(step, jax.tree.map(jnp.asarray, result.params), carry, preset.task.action_repeat)
    drivers = {"policy": driver, "random": random_driver(preset.task.action_repeat)}
    if options.planner:
        drivers["planner"] = planner_driver(course.env)
    driven = evaluate_drivers(course, drivers, FINAL_SEED + options.seed, options.episodes, stage)
    stage("drawing pictures and videos of the final evaluation")
    summary = write_report(options.out, course, driven, options.videos, say)
    references: dict[str, float] = {name: summary[name]["return"] for name in drivers if name != "policy"}
    try:
        pictures.reward_curve(
            options.out / "metrics.jsonl", options.out / "reward_curve.png", references, preset.task.action_repeat
        )
    except ImportError as error:
        say(f"reward_curve.png is left out: {error}. Install the base package to draw it.")
    seen = options.learner == "dreamer" and not course.env.sensors  # other observations make no picture
    if options.videos and seen and preset.learner.representation == "reconstruct":
        stage("drawing what the world model predicts")
        try:
            key = jax.random.key(FINAL_SEED + options.seed)
            write_prediction(options.out / "prediction.gif", preset, vehicle, result.params, options.videos, key)
        except ImportError as error:
            say(f"prediction.gif is left out: {error}. Install the base package to draw it.")
    return {**stamp("whill-mjx-evaluation"), "task": plain(preset.task), "learner": options.learner,
            "seed": options.seed, "env_steps": result.env_steps, "updates": result.updates, **summary}


def export(options: TrainOptions, preset: Preset, vehicle: Path, result: Trained, path: Path) -> Path | None:
    """Write a policy file."""
    task = preset.task
    course = make_course(preset, vehicle)
    contract = PolicyContract(
        action_low=(task.v_min, -task.omega_max),
        action_high=(task.v_max, task.omega_max),
        task=options.task,
        rate_hz=10.0,
        action_repeat=task.action_repeat,
        camera=camera_contract(course.env.model, course.params),
    )
    policy, carry = policy_of(options, preset, course)
    weights = jax.tree.map(jnp.asarray, result.params)
    if "surprise" in carry:
        keys = episode_keys(NOVELTY_SEED + options.seed, NOVELTY_EPISODES)
        largest, _ = largest_surprise(course.env, course.params, policy, weights, carry, keys)
        contract = dataclasses.replace(contract, novelty=limits(largest))
    shown, step = obs_shape_of(course.env), partial(policy, weights)
    try:
        if isinstance(shown, dict):
            return export_sensing(path, step, carry, shown, result.params, contract, vehicle_file=vehicle)
        return export_policy(path, step, carry, result.params, contract, vehicle_file=vehicle)
    except ImportError as error:
        say(f"the policy file is left out: {error}. Install the base package and give the same command again.")
        return None


def cli() -> None:
    """Command line."""
    run(TrainOptions, main, __doc__, stopped=STOPPED)


if __name__ == "__main__":
    cli()

"""The parts of a training run: presets, the environment as the learner sees it, and what it leaves to drive with."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dreamer.config import DreamerConfig
from dreamer.config import preset as learner_preset
from dreamer.experience.iteration import check_fit
from dreamer.model import agent as agents
from dreamer.types import FunctionalEnv, Mirror, Redraw, Transition
from whill_mjx.batch import BatchEnv, make_batch
from whill_mjx.env import POSE_METRICS, Env, State, make_env, observe, repainted, unpainted
from whill_mjx.evaluation.drivers import Driver
from whill_mjx.evaluation.policies.novelty import watched
from whill_mjx.learning import ppo
from whill_mjx.learning.ppo import PpoConfig
from whill_mjx.learning.shaping import Safety, Step, limited_policy, limiter_of, penalty
from whill_mjx.sensors import privileged
from whill_mjx.sensors.image import is_aside
from whill_mjx.tasks.tasks import Budget, Task, make_task
from whill_mjx.vehicle.types import TimeStep
from whill_mjx.vehicle.vehicle_file import load_intervals
from whill_mjx.world.people.crowd import People
from whill_mjx.world.randomize import Variation, check_factor, check_parameter, read_variation

PAINTS = 15
"""Worlds of other looks that the mirror shows at most; any number could be drawn, but each takes memory."""
TRUTH = "truth"
"""Name of the observation that `whill_mjx.sensors.privileged` makes; for `DreamerConfig.decode_only`."""


@dataclass(frozen=True)
class Preset:
    """A task and the size of the learner and of the run that go with it."""

    task: Task
    learner: DreamerConfig
    total_steps: int
    """Environment steps (decisions of the policy), summed over instances."""
    instances: int = 16
    eval_every: int = 1000
    """Environment steps between evaluations."""
    eval_episodes: int = 100
    """Episodes of an evaluation inside the run; they are not those of the final one."""
    exploring_starts: float = 0.0
    """Share of training episodes that begin anywhere on the way (`whill_mjx.tasks.starts`); evaluations never do."""
    second_tries: float = 0.0
    """Share of the training episodes without an arrival whose world is begun again (`whill_mjx.batch`)."""
    looks: str | None = None
    """What changes the picture from episode to episode: "plain" nothing, "paper" what the paper randomises, "rich"
    a furnished room (`whill_mjx.world.rich`); None leaves it to the task."""
    from_outline: bool = False
    """Whether the free distances that a world model predicts begin at the vehicle's outline, not at its middle."""
    spread: float = 0.0
    """Relative spread of the vehicle's parameters from episode to episode, in training."""
    vary: tuple[str, ...] = ()
    """Parameters of the vehicle drawn from a range in each episode of the training, as `variations_of` reads them."""
    safety: Safety = Safety()
    """What is asked besides the task."""
    ppo: PpoConfig = PpoConfig()
    """The model-free baseline, where it is chosen instead."""
    stop_success: float | None = None
    """End when two evaluations in a row have had this share of successes."""


PRESETS = ("paper", "transfer", "wallclock", "cpu", "smoke")


def find_preset(name: str, task: str | Task, steps: int | None = None) -> Preset:
    """Preset by name ("paper", "transfer", "wallclock", "cpu" or "smoke") for a task, which brings its own budget.

    "paper" is the reference paper's setting: 16 instances and few steps. Its updates are few, so it learns faster at
    first and explores more than DreamerV3's defaults; it also learns from the mirrored world and predicts what the
    simulator knows. A quarter of its instances act without noise; an average of its parameters drives. On the course it
    looks 5 s ahead, not 33, trusts its critic less, and begins half of its training episodes anywhere on the way: from
    the paper's start and with noise alone, two seeds in five learned a fixed layout. Its drives are short, so twice as
    many sequences of half the length make a batch, in less time. In the corridor, whose box may look like the floor
    behind it, what the simulator knows weighs more, half of the failed worlds are begun again, and every drive is seen
    in four paints.
    "transfer" is for a policy that drives where nobody trained: furnished rooms with other materials, light, film and
    vehicle in each episode. Free distances to predict begin at the vehicle's outline, so that near things count most.
    In the corridor each update draws its images anew; a task without a budget of its own for it takes that of "paper",
    with twice as many paints of each drive.
    "wallclock" spends environment steps to save time: thousands of instances, few updates per step. "cpu" is for 2
    cores: a decision every 0.5 s, a small network on 8x8 patches; tasks may make themselves easier for it. "smoke" only
    shows that everything runs.

    Args:
        name: of the preset.
        task: name of a task, or a task.
        steps: environment steps where the task has no budget for this preset; "smoke" needs none.

    Raises:
        ValueError: unknown preset or task, a budget with a wrong setting, or no budget and no steps.
    """
    if name not in PRESETS:
        known = "'paper', 'transfer', 'wallclock', 'cpu', 'smoke', or 'auto' to go by the device"
        raise ValueError(f"unknown preset {name!r}; use {known}.")
    chosen = make_task(task) if isinstance(task, str) else task
    for key, one in chosen.budgets.items():
        if key not in PRESETS or not isinstance(one, Budget):
            raise ValueError(f"task {chosen.name!r}: budgets has {key!r}: {one!r}; it needs a Budget by the name of a "
                             f"preset ({', '.join(PRESETS)}). Correct it.")
    budget = _budget(chosen, name, steps)
    chosen = _changed(chosen, budget.fields, f"task {chosen.name!r}: budget {name!r}")
    preset = _preset(name, chosen, budget)
    learner = _changed(preset.learner, budget.learner, f"task {chosen.name!r}: budget {name!r}")
    if name == "transfer" and name not in chosen.budgets:  # rooms differ more than the paper's looks do
        learner = dataclasses.replace(learner, mirror=2 * learner.mirror + 1)
    if name in ("paper", "transfer"):  # the falling rate spans the run
        updates = int(budget.steps * learner.train_ratio) // learner.replayed_per_update
        learner = dataclasses.replace(learner, lr_decay=max(learner.warmup + 1, updates))
    return dataclasses.replace(
        preset,
        learner=learner,
        ppo=_changed(preset.ppo, budget.ppo, f"task {chosen.name!r}: budget {name!r}"),
        eval_every=budget.eval_every or max(1, budget.steps // 20),
        eval_episodes=budget.eval_episodes or preset.eval_episodes,
        instances=budget.instances or preset.instances,
        exploring_starts=budget.exploring_starts,
        second_tries=budget.second_tries,
        stop_success=budget.stop_success,
    )


def _budget(task: Task, name: str, steps: int | None) -> Budget:
    """The task's budget for a preset; raises ValueError where it has none and no steps are given."""
    budget = task.budgets.get(name, task.budgets.get("paper") if name == "transfer" else None)
    if budget is None and name == "smoke":
        budget = Budget(400, eval_every=200)
    if budget is None and steps is None:
        has = f"it has some for {', '.join(task.budgets)}" if task.budgets else "it has none at all"
        raise ValueError(f"task {task.name!r} has no budget for the preset {name!r} ({has}). Give --steps, or add "
                         f"{name!r} to its budgets.")
    return budget or Budget(steps or 0)


def _preset(name: str, task: Task, budget: Budget) -> Preset:
    """What a preset says of learners and instances, before the task's budget changes it."""
    match name:
        case "paper" | "transfer":
            learner = learner_preset(
                "size12m", lr=1.5e-4, entropy_scale=1e-3, replay_capacity=250_000, average_rate=0.002,
                greedy_share=0.25, decode_only=(TRUTH,),
            )  # fmt: skip
            preset = Preset(task, learner, budget.steps, eval_episodes=200)
            if name == "paper":
                return preset
            return dataclasses.replace(preset, looks="rich", spread=0.1, from_outline=True)
        case "wallclock":
            learner = learner_preset(
                "size12m", train_ratio=4.0, batch_size=64, learning_starts=150_000, lr=3e-4, entropy_scale=1e-3,
                horizon=100.0, return_lambda=0.98, decode_only=(TRUTH,),
            )  # fmt: skip
            wide = PpoConfig(rollout=32, minibatches=16)
            return Preset(task, learner, budget.steps, instances=2048, eval_episodes=1000, ppo=wide)
        case "cpu":
            small = PpoConfig(rollout=32, minibatches=4, width=128, channels=(16, 32, 32))
            learner = learner_preset("cpu", lr=6e-4, mean_pull=0.01)
            slow = dataclasses.replace(task, **{"action_repeat": 5, **budget.fields})
            return Preset(slow, learner, budget.steps, instances=8, ppo=small)
        case _:
            tiny = learner_preset("cpu", deter=64, hidden=32, units=32, stoch=8, patch_units=16, batch_size=4)
            tiny = dataclasses.replace(tiny, batch_length=8, learning_starts=64, train_ratio=4.0, imag_horizon=4)
            small = PpoConfig(rollout=16, minibatches=2, epochs=1, width=32, channels=(8, 8, 8))
            slow = dataclasses.replace(task, **{"action_repeat": 5, **budget.fields})
            return Preset(slow, tiny, budget.steps, instances=4, eval_episodes=8, ppo=small)


def _changed(holder: Any, changes: Mapping[str, Any], where: str) -> Any:
    """A record with some fields changed; ValueError names the known ones."""
    known = {field.name for field in dataclasses.fields(holder)}
    unknown = sorted(set(changes) - known)
    if unknown:
        raise ValueError(f"{where}: there is no {unknown[0]!r} to change (known: {', '.join(sorted(known))}).")
    return dataclasses.replace(holder, **changes)


def with_layout(preset: Preset, layout: str, looks: str | None = None, vehicle: str | Path | None = None) -> Preset:
    """The same training of a vehicle in worlds of this layout and these looks; None keeps the preset's looks.

    The mirror shows no more other worlds than there are, and what always looks the same is not drawn anew.
    """
    task = dataclasses.replace(preset.task, layout=layout)  # an unknown one is refused here
    looks = preset.looks if looks is None else looks
    env = make_env(task, vehicle, looks=looks)[0]
    worlds, redraw = min(preset.learner.mirror, mirror_worlds(env)), preset.learner.redraw and can_redraw(env)
    learner = dataclasses.replace(preset.learner, mirror=worlds, redraw=redraw)
    return dataclasses.replace(preset, task=task, looks=looks, learner=learner)


def with_repeat(preset: Preset, repeat: int) -> Preset:
    """The same training with a decision every `repeat` control periods.

    Control periods, updates and the horizon in seconds stay what they are; what counts decisions is scaled. A batch has
    as many steps as before, in sequences of about the same time, so that learning begins as early.
    """
    task = dataclasses.replace(preset.task, action_repeat=repeat)  # a number below 1 is refused here
    factor = repeat / preset.task.action_repeat
    learner = preset.learner
    length = max(8, round(learner.batch_length / factor))
    learner = dataclasses.replace(
        learner,
        train_ratio=learner.train_ratio * factor,
        horizon=learner.horizon / factor,
        learning_starts=round(learner.learning_starts / factor),
        batch_length=length,
        batch_size=max(1, round(learner.replayed_per_update / length)),
    )
    batches = preset.ppo.minibatches
    unit = batches // math.gcd(batches, preset.instances)  # of steps that all instances together can split
    rollout = unit * max(1, round(preset.ppo.rollout / factor / unit))
    baseline = dataclasses.replace(preset.ppo, discount=preset.ppo.discount**factor, rollout=rollout)
    return dataclasses.replace(
        preset,
        task=task,
        learner=learner,
        ppo=baseline if factor != 1.0 else preset.ppo,
        total_steps=round(preset.total_steps / factor),
        eval_every=max(1, round(preset.eval_every / factor)),
    )


def with_settings(learner: Any, settings: Sequence[str]) -> Any:
    """The learner's configuration with some settings changed, each given as NAME=VALUE with a value as in JSON.

    ValueError says what is wrong with one.
    """
    known = {field.name for field in dataclasses.fields(learner)}
    changes = {}
    for text in settings:
        name, _, value = text.partition("=")
        if name in changes:
            raise ValueError(f"{text!r}: {name} is given twice. Leave one out.")
        if name not in known:
            raise ValueError(f"{text!r} changes no setting of the learner; these are: {', '.join(sorted(known))}.")
        try:
            found = json.loads(value)
        except (ValueError, RecursionError) as error:
            raise ValueError(f"{text!r}: give NAME=VALUE, the value as in JSON: 0.1, true or [1, 2].") from error
        changes[name] = tuple(found) if isinstance(found, list) else found
        if not _alike(changes[name], getattr(learner, name)):
            raise ValueError(f"{text!r}: {name} is {getattr(learner, name)!r} by default; give a finite value like it.")
    return dataclasses.replace(learner, **changes)


def _alike(value: Any, default: Any) -> bool:
    """Whether a setting has the type of its default; numbers must be finite."""
    if isinstance(default, tuple):
        same = isinstance(value, tuple) and all(isinstance(one, (int, float, str)) for one in value)
        return same and (not default or all(_alike(one, default[0]) for one in value))
    if isinstance(default, (bool, str)):
        return isinstance(value, type(default))
    if isinstance(default, int):
        return isinstance(value, int)
    return isinstance(value, (int, float)) and math.isfinite(value)


def to_transition(step: TimeStep, people: People | None) -> Transition:
    """A time step as a learner reads it: its metrics are of the episode so far, and learners log the last ones."""
    metrics = {name: value for name, value in step.metrics.items() if name not in POSE_METRICS}
    if people is not None:
        metrics["bumped"] = people.held.sum(-1).astype(jnp.float32)
    ended = step.terminated | step.truncated
    return Transition(step.obs, step.reward, step.first, ended, step.terminated, metrics)


def functional_env(
    batch: BatchEnv, safety: Safety | None = None, shaped: bool = True, targets: bool = False, redraw: bool = False,
    from_outline: bool = False,
) -> FunctionalEnv:  # fmt: skip
    """The learner's view of a batch of chairs, with left and right as its mirror.

    Args:
        batch: the chairs.
        safety: limits the commands and, if `shaped`, takes its penalties off the reward; None asks nothing.
        shaped: False leaves the reward the task's own, as evaluations must.
        targets: show what only the simulator knows too, as TRUTH beside "camera"; it is no input of a policy.
        redraw: images can be drawn anew, in other looks; the mirror then shows the images that it is given.
        from_outline: the targets' free distances begin at the vehicle's outline, not at its middle.

    Raises:
        ValueError: a collision monitor is asked for, and nothing scans.
    """
    safety = safety or Safety()
    limiter = limiter_of(safety, batch.env)
    memory = jax.tree.map(lambda one: jnp.tile(one, (batch.count, 1)), limiter.memory() if limiter else {})
    monitored = bool(memory)  # then what was seen last, and before that, is part of the state
    task = batch.env.task
    seconds = batch.env.model.config.control_dt * task.action_repeat

    def emit(state: Any, step: TimeStep) -> Transition:
        transition = to_transition(step, state.env.scene.people)
        if not targets:
            return transition
        known = jax.vmap(lambda one: privileged.truth(batch.env, one, from_outline))(state.env)
        seen: Any = step.obs if batch.env.sensors else {"camera": step.obs}
        return dataclasses.replace(transition, obs={**seen, TRUTH: known})

    def reset(key: jax.Array) -> tuple[Any, Transition]:
        state, step = batch.reset(key)
        return (state, step.obs, memory) if monitored else state, emit(state, step)

    def step(state: Any, action: jax.Array) -> tuple[Any, Transition]:
        state, seen, scans = state if monitored else (state, None, memory)
        before = state.env.command
        if limiter is not None:
            action, scans = jax.vmap(limiter.limited)(action, before, seen, scans)
        state, step = batch.step(state, action)
        if shaped and (safety.clearance_gain or safety.change_gain):
            span = jnp.array([task.v_max - task.v_min, 2.0 * task.omega_max]) / 2.0
            change = (state.env.command - before) / span
            near = step.metrics["clearance"]
            lost = jax.vmap(lambda distance, moved: penalty(safety, distance, moved, seconds))(near, change)
            step = dataclasses.replace(step, reward=step.reward - jnp.where(step.first, 0.0, lost))
        if monitored:
            scans = jax.tree.map(lambda one: jnp.where(step.first[:, None], 0.0, one), scans)
            return (state, step.obs, scans), emit(state, step)
        return state, emit(state, step)

    shape = with_truth(obs_shape_of(batch.env)) if targets else obs_shape_of(batch.env)
    again = redraw_of(batch) if redraw else None
    mirror = mirror_of(batch, paints=again is None)
    return FunctionalEnv(batch.count, shape, 2, reset, step, mirror, again)


def learned_env(preset: Preset, batch: BatchEnv) -> FunctionalEnv:
    """What a preset's world model learns from: `functional_env` with the preset's safety and targets."""
    known, redraw = TRUTH in preset.learner.decode_only, preset.learner.redraw
    return functional_env(batch, preset.safety, targets=known, redraw=redraw, from_outline=preset.from_outline)


def with_truth(shape: Any) -> dict[str, tuple[int, ...]]:
    """Shapes by name of what a learner sees, and of TRUTH."""
    return {**(shape if isinstance(shape, dict) else {"camera": shape}), TRUTH: (privileged.SIZE,)}


def obs_shape_of(env: Env) -> Any:
    """Shapes of what a learner sees: (H, W, 3) of the image, or those of the sensors by name.

    Raises:
        ValueError: a sensor shows what no learner reads.
    """
    if not env.sensors:
        return (env.height, env.width, 3)
    shapes = {}
    for name, sensor in env.sensors:
        reading = sensor.reading(env)
        rank = 3 if np.dtype(reading.dtype) == np.uint8 else 1
        if len(reading.shape) != rank or name == TRUTH:
            raise ValueError(f"observation {name!r}: learners read bytes (H, W, C) and vectors (D,), not "
                             f"{np.dtype(reading.dtype)} {reading.shape}. Change the sensor (Depth has as_bytes).")
        shapes[name] = reading.shape
    return shapes


def redraw_of(batch: BatchEnv) -> Redraw | None:
    """How a batch's images are drawn anew in other looks; None where they always look the same, or sensors observe."""
    if not can_redraw(batch.env):
        return None

    def keep(state: Any, obs: Any) -> Any:
        instances = state[0] if isinstance(state, tuple) else state  # a collision monitor's memory is beside it
        return unpainted(instances.env), obs.get(TRUTH) if isinstance(obs, dict) else None

    def draw(kept: Any, key: jax.Array) -> Any:
        moment, known = kept
        image = observe(batch.env, repainted(batch.env, moment, key))
        return image if known is None else {"camera": image, TRUTH: known}

    return Redraw(keep, draw)


def can_redraw(env: Env) -> bool:
    """Whether the images of an environment can be drawn anew in other looks."""
    return env.repaints and not env.sensors


def mirror_of(batch: BatchEnv, paints: bool = True) -> Mirror | None:
    """Left and right exchanged. A vehicle that pulls to one side breaks the symmetry by as much as it pulls.

    Where looks are drawn at random, each of its worlds has its own, every second one with left and right as they are:
    what is learned from one drive is seen in several. Sensors are mirrored in one world; None where one of them cannot
    be.
    """
    sensors, most = dict(batch.env.sensors), mirror_worlds(batch.env)
    if not most:
        return None
    if sensors:
        mirrors: dict[str, Any] = {name: sensor.mirrored for name, sensor in sensors.items()}
        mirrors[TRUTH] = privileged.mirrored
        return Mirror(
            lambda state, obs, worlds: {name: mirrors[name](value)[None] for name, value in obs.items()},
            lambda action, worlds: (action * jnp.array([1.0, -1.0]))[None],
        )
    paints = paints and batch.env.repaints

    def turned(plain: jax.Array, mirrored: jax.Array) -> jax.Array:
        """Every second of the worlds (K, ...) as it is."""
        every_second = jnp.arange(plain.shape[0]) % 2 == 1
        return jnp.where(every_second.reshape(-1, *[1] * (plain.ndim - 1)), plain, mirrored)

    def other_obs(state: Any, obs: Any, worlds: int) -> Any:
        known = isinstance(obs, dict)
        image = batch.observe_repainted(state, worlds) if paints else (obs["camera"] if known else obs)[None]
        image = turned(image, image[..., ::-1, :])
        if not known:
            return image
        vector = jnp.broadcast_to(obs[TRUTH], (worlds, *obs[TRUTH].shape))
        return {"camera": image, TRUTH: turned(vector, privileged.mirrored(vector))}

    def other_action(action: jax.Array, worlds: int) -> jax.Array:
        action = jnp.broadcast_to(action, (worlds, *action.shape))
        return turned(action, action * jnp.array([1.0, -1.0]))

    return Mirror(other_obs, other_action, worlds=most if paints else 1)


def mirror_worlds(env: Env) -> int:
    """Other worlds that the mirror of an environment shows at most; 0 where it has none.

    What the vehicle's camera sees has a mirror where it looks along the vehicle's middle.
    """
    through_it = [one for _, one in env.sensors if one.visual and getattr(one, "mount", None) is None]
    if is_aside(env.model.spec.camera) and (through_it or not env.sensors):
        return 0
    if env.sensors:
        return int(all(sensor.mirrored is not None for _, sensor in env.sensors))
    return PAINTS if env.repaints else 1


def check_learner(preset: Preset, learner: str, batch: BatchEnv) -> None:
    """Raise ValueError where a preset's learner, "dreamer" or "ppo", does not suit what it would train on."""
    if learner == "dreamer":
        check_fit(learned_env(preset, batch), preset.learner, preset.total_steps)
    else:
        ppo.check_fit(functional_env(batch, preset.safety), preset.ppo)
    _, carry = (dreamer_policy if learner == "dreamer" else ppo_policy)(preset, batch.env)
    taken = {"action", *(f"{way}_{name}" for name in carry for way in ("carry", "next"))}
    for name in taken & {name for name, _ in batch.env.sensors}:
        raise ValueError(f"observation {name!r}: the exported policy has another tensor of this name, and ONNX wants "
                         "each once. Rename the observation.")


def make_training_env(preset: Preset, vehicle: str | Path | None, devices: tuple = ()) -> BatchEnv:
    """A preset's chairs, of a vehicle file or built-in vehicle, as it trains them; split over `devices`."""
    env, params = make_env(preset.task, vehicle, exploring_starts=preset.exploring_starts, looks=preset.looks)
    variations = variations_of(preset.vary, vehicle)
    for one in variations:
        if one.relative:
            check_factor(f"vary {one.name}={one.low:g}x:{one.high:g}x", params, one.name)
    return make_batch(env, params, preset.instances, preset.spread, devices, preset.second_tries, variations)


def make_evaluation_env(
    task: Task, vehicle: str | Path | None, instances: int, looks: str | None = None, devices: tuple = ()
) -> BatchEnv:
    """`instances` chairs of a vehicle file or built-in vehicle in a task: each as the file says, from the start."""
    env, params = make_env(task, vehicle, exploring_starts=0.0, looks=looks)
    return make_batch(env, params, instances, 0.0, devices, 0.0)


def variations_of(texts: Sequence[str], vehicle: str | Path | None) -> tuple[Variation, ...]:
    """What is drawn in each episode: NAME=LOW:HIGH of one parameter, or "fit" for all intervals of the vehicle file.

    Raises:
        ValueError: a text that is neither, a vehicle without intervals, or an interval beyond what a parameter may be.
    """
    found: list[Variation] = []
    for text in texts:
        if text != "fit":
            found.append(read_variation(text))
            continue
        intervals = load_intervals(vehicle) if vehicle is not None and Path(vehicle).is_file() else {}
        if not intervals:
            raise ValueError(f"vary 'fit': {vehicle} has no intervals. Give a file that sysid.fit wrote, or ranges "
                             "such as body.mass=0.9x:1.1x.")
        for name, (low, high) in intervals.items():
            check_parameter(f"{vehicle}: {name}.interval", name, (low, high), relative=False)
            found.append(Variation(name, low, high))
    names = [text.partition("=")[0] for text in texts]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"vary {' '.join(texts)}: {name} is given twice. Leave one out.")
    return tuple(found)


def dreamer_policy(preset: Preset, env: Env) -> tuple[Step, dict[str, Any]]:
    """The agent as the step of one instance, limits included, and its first carry; for what `env` shows."""
    learner, seconds = preset.learner, env.model.config.control_dt * preset.task.action_repeat
    step: Step = lambda params, carry, image: agents.policy_step(learner, params, carry, image)  # noqa: E731
    carry = agents.policy_carry(learner, 2)
    if env.rich and TRUTH in learner.decode_only:
        shape = with_truth(obs_shape_of(env))

        def believe(params: Any, carry: Any) -> jax.Array:
            return privileged.UNIT * agents.believed(params, carry, shape, TRUTH)[..., :4]

        step, carry = watched(step, carry, seconds, believe)
    return limited_policy(limiter_of(preset.safety, env), step, carry)


def ppo_policy(preset: Preset, env: Env) -> tuple[Step, dict[str, Any]]:
    """The same of the model-free baseline."""
    step: Step = lambda params, carry, seen: ppo.policy_step(preset.ppo, params, carry, seen)  # noqa: E731
    return limited_policy(limiter_of(preset.safety, env), step, ppo.policy_carry(preset.ppo, obs_shape_of(env)))


def step_driver(step: Step, weights: Any, carry: dict[str, Any], period: int) -> Driver:
    """A policy step as a driver of evaluations."""

    def act(weights: Any, memory: Any, state: State, image: jax.Array, key: jax.Array) -> tuple[Any, jax.Array]:
        return step(weights, memory, image)  # or the values of the sensors by name

    return Driver("policy", lambda state, key: carry, act, period, weights=weights)

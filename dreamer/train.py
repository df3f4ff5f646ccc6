"""The host's side of a training run: dispatch iterations, log, evaluate, checkpoint, resume."""

from __future__ import annotations

import functools
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, wait
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ParamSpec, Protocol

import jax
import jax.numpy as jnp
from filelock import FileLock, Timeout
from jax.sharding import Mesh

from dreamer.config import DreamerConfig
from dreamer.evaluate import evaluate
from dreamer.experience import pretrain
from dreamer.experience.iteration import (
    TrainState,
    check_fit,
    compile_init,
    compile_iteration,
    init_state,
    lower_iteration,
    train_iteration,
)
from dreamer.model.agent import AgentState
from dreamer.refusals import as_seeds, check_duration, check_kind, whole
from dreamer.training import checkpoint, parallel, seeds
from dreamer.training.first_state import check_seed, first_state, fits, save_state
from dreamer.training.metrics_log import Log, Meter, MetricsFn, evaluated, headline, named_figures
from dreamer.training.programs import Place, Programs, compiled, in_thread
from dreamer.training.progress import Progress
from dreamer.types import FunctionalEnv, Params

__all__ = ["TrainingOptions", "TrainResult", "TrainState", "evaluate", "init_state", "train", "train_iteration"]

EvalFn = Callable[[Params, int], dict[str, float]]
StopFn = Callable[[dict[str, float]], bool]
P = ParamSpec("P")
COMPILING = "compiling the training: usually 1 to 2 minutes, seconds where its program is kept of an earlier run"
AGREE_EVERY = 16
"""Iterations between the moments at which several processes agree on the clock."""


@dataclass(frozen=True)
class TrainResult:
    """What a finished run leaves behind; the files in `out` hold the rest."""

    out: Path
    """Folder of the run."""
    agent: AgentState
    """Trained agent."""
    env_steps: int
    """Control steps summed over instances."""
    updates: int
    """Gradient steps of the whole agent."""
    wall_s: float
    """Time of the run [s], all its parts together, compilation included."""
    last_metrics: dict[str, float]
    """The last logged line."""


def alone(function: Callable[P, TrainResult]) -> Callable[P, TrainResult]:
    """A training that holds its folder `out`, its third argument, until it ends; a kill leaves no lock behind."""

    @functools.wraps(function)
    def held(*args: P.args, **named: P.kwargs) -> TrainResult:
        out = Path(named["out"] if "out" in named else args[2])  # type: ignore[arg-type]
        if not parallel.is_first_process():
            return function(*args, **named)
        out.mkdir(parents=True, exist_ok=True)
        try:
            with FileLock(out / ".training.lock", timeout=0):
                return function(*args, **named)
        except Timeout:
            raise ValueError(f"{out}: another process trains there. Wait for its end or give another folder.") from None

    return held


@dataclass(frozen=True)
class TrainingOptions:
    """How often a training logs, saves and evaluates, and who watches it."""

    eval_fn: EvalFn | None = None
    """(params, env_steps) -> figures, logged as eval/..."""
    eval_ahead: Callable[[Params], Any] | None = None
    """Called once in a thread after the first iteration: the same evaluation, say, so that it is compiled beside the
    training. Evaluations that are due before it is done are made after it, with the parameters of their time. Training
    goes on meanwhile, and lines are logged in order. Not with several devices. It begins so late since two programs
    that are compiled side by side take longer than one after the other."""
    eval_every: int = 10_000
    """Control steps between evaluations; one more happens at the end."""
    checkpoint_every_s: float | None = None
    """Time between checkpoints [s]; one more is written at the end. None: a minute, or as much more as makes them a
    twentieth of the run's time."""
    log_every_s: float = 5.0
    """Time between log lines [s]."""
    resume: bool = True
    """Go on from the newest checkpoint, if there is one; otherwise start anew and overwrite."""
    progress: bool = True
    """Show a bar on stderr."""
    on_metrics: MetricsFn | None = None
    """Called with every logged line."""
    stop: StopFn | None = None
    """Called with every logged line that holds an evaluation; True ends the run there. With several processes it must
    come to the same answer in each."""
    time_limit_s: float | None = None
    """End after the call has taken so long [s], as if interrupted; a later call goes on."""
    devices: Sequence[jax.Device] = ()
    """Over which instances and batches are split, those of all processes; none takes the first one."""
    tensorboard: bool = False
    """Write the logged lines to OUT/tensorboard too."""
    kept: Programs | None = None
    """Where compiled programs are kept for later runs with the same environment and configuration. For one seed on one
    device with the replay in its memory; other trainings leave it unused."""
    announce: Callable[[str], None] = lambda text: None
    """Gets a line when something begins that takes long: compilation, the training, the last checkpoint."""

    def __post_init__(self) -> None:
        whole("TrainingOptions.eval_every", self.eval_every, 1)
        for name in ("checkpoint_every_s", "log_every_s", "time_limit_s"):
            value = getattr(self, name)
            if value is not None or name == "log_every_s":
                check_duration(f"TrainingOptions.{name}", value)


def train(
    env: FunctionalEnv,
    config: DreamerConfig,
    out: Path | str,
    total_steps: int,
    seed: int | Sequence[int],
    options: TrainingOptions = TrainingOptions(),  # noqa: B008
) -> TrainResult:
    """Train until `total_steps` control steps, summed over instances, are done, or until `options.stop` says so.

    `out` receives config.json, metrics.jsonl (one line per log) and checkpoints/. A run that is killed and started
    again goes on from its last checkpoint as if nothing had happened. One process at a time trains in a folder.

    Where the configuration asks for pretraining, it comes first. Its lines have `env_steps` 0, say in `pretrain_steps`
    and `pretrain_updates` how far it is, and all their figures are named pretrain/...

    Args:
        env: vector environment.
        config: hyperparameters.
        out: folder of the run.
        total_steps: when to stop; a resumed run may get more.
        seed: of everything random. Several make one program of as many runs: steps then count those of one run,
            figures are means over the runs, and parameters have a seed axis in front.
        options: intervals, evaluation, callbacks and devices.

    Raises:
        ImportError: tensorboard is asked for and tensorboardX is not installed.
        ValueError: environment and configuration do not fit, the checkpoint does not belong to them or to the seed, a
            replay in the host's memory is asked for with several seeds or devices, or another process trains there.
    """
    check_kind("env", env, FunctionalEnv, "dreamer.from_gym makes one of a Gymnasium environment.")
    check_kind("config", config, DreamerConfig, "dreamer.preset('cpu') is one.")
    check_kind("options", options, TrainingOptions, "Give TrainingOptions(...).")
    check_fit(env, config, total_steps)
    return _train(env, config, Path(out), int(total_steps), as_seeds(seed), options)


@alone
def _train(
    env: FunctionalEnv, config: DreamerConfig, out: Path, total_steps: int, seed: int | list[int],
    options: TrainingOptions,
) -> TrainResult:  # fmt: skip
    """`train` with checked arguments."""
    check_seed(out, seed, options.resume)
    mesh = parallel.make_mesh(options.devices, env.num_envs, config.batch_size) if options.devices else None
    if mesh is not None and not isinstance(seed, int):
        raise ValueError(f"seed = {seed}: several seeds run in one program on one device. Give one, or no devices.")
    run = _Run(env, config, out, total_steps, options)
    run.begin(seed, mesh)
    carry_out(run)
    return run.result()


class Run(Protocol):
    """A training that has begun."""

    def go_on(self) -> None:
        """Iterate to the end."""

    def interrupted(self) -> None:
        """Keep what is done."""

    def close(self) -> None:
        """End what shows and logs it."""


def carry_out(run: Run) -> None:
    """Bring a run to its end; Ctrl-C keeps what is done and goes on to the caller."""
    try:
        run.go_on()
    except KeyboardInterrupt:
        run.interrupted()
        raise
    finally:
        run.close()


class _Run:
    """One call of `train`: the state, what is counted, and what waits to be logged."""

    def __init__(
        self, env: FunctionalEnv, config: DreamerConfig, out: Path, total_steps: int, options: TrainingOptions
    ) -> None:
        self.env, self.config, self.out, self.total_steps, self.options = env, config, out, total_steps, options
        self._waiting: list[tuple[dict[str, Any], Params | None]] = []
        self._ready: Future | None = None
        self._iterations = 0
        self._stopped = False

    def begin(self, seed: int | Sequence[int], mesh: Mesh | None) -> None:
        """Restore or make the state, and compile the program of an iteration."""
        options, self._began = self.options, time.monotonic()
        options.announce("preparing the training: first worlds and parameters")
        self._several = not isinstance(seed, int)
        alone = not self._several and mesh is None and self._on_device()
        self._place = Place(mesh, options.kept if alone else None)
        early = self._compiled_ahead(seed) if alone and isinstance(seed, int) else None
        self.state, self._wall_before = first_state(self.env, self.config, self.out, seed, options.resume, self._place)
        self.env_steps = int(self.state.env_steps)
        self._done = pretrain.counters(self.state)
        place = pretrain.position(self.config, {"env_steps": self.env_steps, **self._done})
        self._counted = place >= 0  # all pretraining is done
        self._log = Log(self.out / "metrics.jsonl", self.config, place, options.on_metrics, options.tensorboard)

        self._ahead = options.eval_ahead if mesh is None else None
        options.announce(COMPILING)
        step = train_iteration if self._counted else pretrain.pretrain_iteration
        self._iterate = self._program(step) if early is None else early.result()
        options.announce(f"training; its program was ready after {time.monotonic() - self._began:.0f} s")
        self._bar = Progress(self.total_steps, self.env_steps, options.progress and parallel.is_first_process())
        self._meter = Meter()
        self._logged_at = time.monotonic()
        self._pace = checkpoint.Pace(options.checkpoint_every_s)
        self._evaluated = self.env_steps // options.eval_every

    def _program(self, step: Any) -> Any:
        """The compiled `step`, state -> (state, metrics), for the state that there is."""
        if self._several:
            return seeds.compile_iterations(self.env, self.config, self.state, step)
        if self._place.mesh is not None:
            return compile_iteration(self.env, self.config, self.state, self._place.mesh, step)

        def lower() -> jax.stages.Lowered:
            return lower_iteration(self.env, self.config, self.state, step=step)

        return compiled(step.__name__, lower, self._place.kept)

    def _compiled_ahead(self, seed: int) -> Future | None:
        """The program of an iteration, read or compiled while the first state is made.

        None where that state comes first: one to go on from may be refused.
        """
        name, kept, config = train_iteration.__name__, self._place.kept, replace(self.config, replay_memory="device")
        if self.config.pretrain_steps:
            return None

        def lower() -> jax.stages.Lowered:
            return lower_iteration(self.env, config, jax.eval_shape(compile_init(self.env, config, seed)))

        if kept is not None and name in kept:
            return in_thread(compiled, name, lower, kept)
        if self.options.resume and checkpoint.complete(self.out / "checkpoints"):
            return None
        lowered = lower()  # in this thread: the first state needs some of what is traced here
        return in_thread(compiled, name, lambda: lowered, kept)

    def _on_device(self) -> bool:
        """Whether the replay's observations fit into the device's memory, and may be there."""
        where = self.config.replay_memory
        return where == "device" or (where == "auto" and fits(self.env, self.config))

    def go_on(self) -> None:
        """Iterate to the end."""
        self._make_up_evaluation()
        while (self.env_steps < self.total_steps or not self._counted) and not self._stopped:
            begins = self._step()
            now = time.monotonic()
            finished = (self._counted or begins) and self.env_steps >= self.total_steps
            self._log_where_due(now, finished, begins)
            self._save_where_due(now, finished)
            if begins:
                self._counted = True
                over = finished or self._stopped
                self._iterate = self._iterate if over else self._program(train_iteration)

    def interrupted(self) -> None:
        """Keep what is done."""
        if jax.process_count() == 1 and checkpoint.is_whole(self.state):  # others may not be there to take part
            try:
                self._write_waiting(at_once=True)
            finally:  # interrupted again, say
                self._save()

    def close(self) -> None:
        """End the bar and the log."""
        self._bar.close()
        self._log.close()

    def result(self) -> TrainResult:
        """What the run leaves behind."""
        updates = int(self.state.agent.updates) if self._counted else 0
        return TrainResult(self.out, self.state.agent, self.env_steps, updates, self._wall_s(), self._log.last)

    def _wall_s(self) -> float:
        return self._wall_before + time.monotonic() - self._began

    def _make_up_evaluation(self) -> None:
        """Evaluate where a run was interrupted between a step and its evaluation."""
        every, last = self.options.eval_every, self._log.evaluated_at
        missing = self.env_steps // every > last // every or self.env_steps >= self.total_steps > last
        if self.options.eval_fn is not None and self._counted and self.env_steps and parallel.agree(missing):
            self._stopped = self._write_log(evaluated=True, at_once=True)

    def _step(self) -> bool:
        """Dispatch one iteration; return whether it was the last one of the pretraining."""
        self.state, metrics = self._iterate(self.state)
        begins = False
        if self._counted:
            steps = self.env.num_envs * self.config.steps_per_iter
            self.env_steps += steps
        else:
            before, self._done = self._done, pretrain.counters(self.state)
            begins = pretrain.position(self.config, {"env_steps": 0, **self._done}) == 0
            steps = self._done["pretrain_steps"] - before["pretrain_steps"]
        self._meter.add(metrics, steps)
        self._meter.wait_for_previous()
        self._iterations += 1
        if self._iterations == 1:
            jax.block_until_ready(metrics)
            self.options.announce(f"first step after {time.monotonic() - self._began:.0f} s")
            if self._ahead is not None:
                self._ready = in_thread(self._ahead, copied(self.state.agent.acting))
        return begins

    def _log_where_due(self, now: float, finished: bool, begins: bool) -> None:
        passed = self.env_steps // self.options.eval_every > self._evaluated
        evaluate_now = self.options.eval_fn is not None and (finished or passed)
        if finished or begins or evaluate_now or now - self._logged_at >= self.options.log_every_s:
            self._stopped = self._write_log(evaluate_now, at_once=finished or begins)
            self._logged_at, self._evaluated = time.monotonic(), self.env_steps // self.options.eval_every

    def _save_where_due(self, now: float, finished: bool) -> None:
        limit = self.options.time_limit_s
        due = self._pace.due()
        if jax.process_count() > 1:
            due = self._iterations % AGREE_EVERY == 0 and parallel.agree(due)
        self._stopped = self._stopped or (limit is not None and parallel.agree(now - self._began > limit))
        if finished or self._stopped or due:
            # A run that goes on from here has no older lines.
            self._stopped = self._write_waiting(at_once=True) or self._stopped
            jax.block_until_ready(self.state)
            with self._pace:
                self._save()

    def _save(self) -> None:
        save_state(self.out, self.state, self.config, self._wall_s())

    def _write_log(self, evaluated: bool, at_once: bool) -> bool:
        """Log a line, and whether the run is to stop after an evaluation; `at_once`: no line may wait any longer."""
        updates = int(self.state.agent.updates) if self._counted else 0
        line = {"env_steps": self.env_steps, "updates": updates, "wall_s": self._wall_s()}
        figures = self._meter.read(self.config)
        line |= self._done
        line |= figures if self._counted else {f"pretrain/{name}": value for name, value in figures.items()}
        params = None
        if evaluated and jax.process_count() > 1:
            params = jax.device_get(self.state.agent.acting)  # they evaluate side by side, each on its own device
        elif evaluated:
            params = copied(self.state.agent.acting)  # the next iteration donates its own
        self._waiting.append((line, params))
        self._bar.show(self.env_steps, headline(line))
        return self._write_waiting(at_once)

    def _write_waiting(self, at_once: bool) -> bool:
        """Write the lines whose evaluation can be made now; return whether one of them ends the run."""
        stops = False
        while self._waiting:
            line, params = self._waiting[0]
            if params is not None and self.options.eval_fn is not None:
                if self._ready is not None and not (at_once or self._ready.done()):
                    break
                if self._ready is not None:
                    wait([self._ready])
                figures = named_figures(self.options.eval_fn(params, line["env_steps"]))
                line |= {f"eval/{name}": value for name, value in figures.items()}
                self._bar.note(evaluated(figures))
            self._log.write(line)
            self._waiting.pop(0)  # interrupted just before, the line is written twice and read once
            stop = self.options.stop
            stops = stops or (params is not None and stop is not None and stop(line))
        return stops


@jax.jit
def copied(params: Params) -> Params:
    """Arrays of their own; one program copies them all."""
    return jax.tree.map(jnp.copy, params)


if __name__ == "__main__":
    print("dreamer.train is a function for programs: train(env, config, out, total_steps, seed), see docs/dreamer.md.\n"
          "The command that trains the vehicle is python -m whill_mjx.train --help.")  # fmt: skip
    sys.exit(0 if {"-h", "--help"} & set(sys.argv[1:]) else 2)

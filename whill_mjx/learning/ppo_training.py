"""The host's side of a PPO training: dispatch, evaluate, log in the same words as the other learner, and resume."""

from __future__ import annotations

import time
from concurrent.futures import wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from dreamer.train import COMPILING, TrainingOptions, carry_out, copied
from dreamer.training import checkpoint
from dreamer.training.metrics_log import text_of
from dreamer.training.programs import compiled, in_thread
from dreamer.training.progress import Progress
from whill_mjx.io.folders import write_whole
from whill_mjx.io.reading import read_lines
from whill_mjx.learning.ppo import PpoConfig, PpoState, init_state, iterate

PROGRAM = "ppo_iterate"
"""Name under which the program of an iteration is kept."""
SHOWN = ("success", "return")
"""Figures of an evaluation in the progress bar."""


@dataclass(frozen=True)
class Length:
    """How far a run goes, in environment steps summed over instances."""

    total: int
    """Rounded up to whole rollouts; a resumed run must get the same, since its learning rate spans them."""
    last: int | None = None
    """Where an earlier start of this run was stopped; None goes all the way."""


def train_ppo(
    env: Any,
    config: PpoConfig,
    out: Path,
    length: Length,
    seed: int,
    options: TrainingOptions = TrainingOptions(),  # noqa: B008
) -> tuple[Any, int, int, float]:
    """Train to the end of `length`, or until `options.stop` says so.

    A run that was interrupted goes on from its last checkpoint in `out`, as if nothing had happened.

    Args:
        env: vector environment.
        config: hyperparameters.
        out: folder that gets metrics.jsonl and checkpoints/.
        length: of the run.
        seed: of everything random.
        options: intervals, evaluation and callbacks, as for the other learner. A line is logged at each evaluation.

    Returns:
        Parameters, environment steps, gradient steps and time [s].
    """
    out.mkdir(parents=True, exist_ok=True)
    run = _Run(env, config, out, length, options)
    run.begin(seed)
    carry_out(run)
    return run.state.params, run.env_steps, run.updates, run.wall_s()


class _Run:
    """One call of `train_ppo`: the state, what is counted, and when the next evaluation is due."""

    def __init__(self, env: Any, config: PpoConfig, out: Path, length: Length, options: TrainingOptions) -> None:
        self.env, self.config, self.out, self.options = env, config, out, options
        self.each, self.updates_each = env.num_envs * config.rollout, config.epochs * config.minibatches
        self.iterations = -(-length.total // self.each)
        self.last = self.iterations if length.last is None else min(self.iterations, -(-length.last // self.each))

    def begin(self, seed: int) -> None:
        """Restore or make the state, and prepare the program of an iteration."""
        options, self.began = self.options, time.monotonic()
        options.announce("preparing the training: first worlds and parameters")
        total = np.int32(self.iterations)
        program = jax.jit(lambda state, total: iterate(self.env, self.config, total, state), donate_argnums=0)
        init = jax.jit(lambda seed: init_state(self.env, self.config, seed))
        kept, given = options.kept, np.int32(seed)

        def lower() -> jax.stages.Lowered:
            return program.lower(jax.eval_shape(init, given), total)

        lowered = None if kept is not None and PROGRAM in kept else lower()
        early = in_thread(compiled, PROGRAM, lambda: lowered or lower(), kept)  # while the first state is made
        first = compiled("ppo_init", lambda: init.lower(given), kept)(given)
        self.state, self.wall_before = _first_state(first, self.config, self.out)
        self.done = int(self.state.updates)
        self.logged = self.env_steps // options.eval_every
        _keep_lines(self.out / "metrics.jsonl", self.env_steps)
        options.announce(COMPILING)
        self.ready: list[Any] = []
        ready = early.result()
        self.run = lambda state: ready(state, total)
        options.announce(f"training; its program was ready after {time.monotonic() - self.began:.0f} s")
        self.pace = checkpoint.Pace(options.checkpoint_every_s)
        self.bar = Progress(self.iterations * self.each, self.env_steps, options.progress)

    @property
    def env_steps(self) -> int:
        """Control steps so far, summed over instances."""
        return self.done * self.each

    @property
    def updates(self) -> int:
        """Gradient steps so far."""
        return self.done * self.updates_each

    def wall_s(self) -> float:
        """Time of the run [s], all its parts together."""
        return self.wall_before + time.monotonic() - self.began

    def go_on(self) -> None:
        """Iterate to the end."""
        stopped, running = False, None
        while self.done < self.last and not stopped:
            self.state, metrics = self.run(self.state)
            self.done += 1
            if self.options.progress:
                jax.block_until_ready(running)  # the device stays at most one iteration behind the bar
                self.bar.show(self.env_steps, {})
            if running is None:
                jax.block_until_ready(metrics)
                self.options.announce(f"first step after {time.monotonic() - self.began:.0f} s")
                if self.options.eval_ahead is not None:
                    self.ready = [in_thread(self.options.eval_ahead, copied(self.state.params))]
            running = metrics
            if self._due(self.done):
                line = self._evaluated(metrics)
                self.bar.note({name: f"{line[f'eval/{name}']:.3g}" for name in SHOWN if f"eval/{name}" in line})
                self.logged = self.env_steps // self.options.eval_every
                stopped = self.options.stop is not None and self.options.stop(line)
            if self.done == self.last or stopped or self.pace.due():
                jax.block_until_ready(self.state)
                with self.pace:
                    self._save()

    def interrupted(self) -> None:
        """Keep what is done; an evaluation that is due would be missing from the run that goes on from here."""
        if checkpoint.is_whole(self.state) and not self._due(int(self.state.updates)):
            self._save()

    def close(self) -> None:
        """End the bar."""
        self.bar.close()

    def _due(self, done: int) -> bool:
        return done == self.last or done * self.each // self.options.eval_every > self.logged

    def _save(self) -> None:
        steps = int(self.state.updates) * self.each
        moment = checkpoint.Moment(steps, self.wall_s())
        checkpoint.save(self.out / "checkpoints", self.state, self.config, moment)

    def _evaluated(self, metrics: dict[str, Any]) -> dict[str, float]:
        """The line of an evaluation, written to the log."""
        line = _line(jax.device_get(metrics), self.env_steps, self.updates)
        line["wall_s"] = self.wall_s()
        if self.options.eval_fn is not None:
            wait(self.ready)
            figures = self.options.eval_fn(self.state.params, self.env_steps)
            line |= {f"eval/{name}": value for name, value in figures.items()}
        with (self.out / "metrics.jsonl").open("a") as file:
            file.write(text_of(line))
        if self.options.on_metrics is not None:
            self.options.on_metrics(line)
        return line


def _first_state(state: PpoState, config: PpoConfig, out: Path) -> tuple[PpoState, float]:
    """State to start from, a new one unless there is a checkpoint, and the time [s] already spent."""
    restored = checkpoint.restore(out / "checkpoints", state, config)
    return (state, 0.0) if restored is None else (restored[0], float(restored[1]["wall_s"]))


def _keep_lines(path: Path, env_steps: int) -> None:
    """Drop the lines of a log that a resumed run is about to write again, and one that a kill has cut off."""
    kept = [text for text, line in read_lines(path) if line["env_steps"] <= env_steps]
    write_whole(path, "".join(text + "\n" for text in kept))


def _line(metrics: dict[str, Any], env_steps: int, updates: int) -> dict[str, float]:
    """Sums over ended episodes as means."""
    line: dict[str, float] = {"env_steps": env_steps, "updates": updates}
    episodes = float(metrics["episodes"])
    for name, value in metrics.items():
        if not name.startswith("episode/"):
            line[name] = float(value)
        elif episodes:
            renamed = "episode/return" if name == "episode/episode_return" else name
            line[renamed] = float(value) / episodes
    return line

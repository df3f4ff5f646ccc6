"""Seconds that a user waits, cold and with kept programs: `python -m benchmarks.speed --parts first_step ppo env`.

Each figure is of fresh processes. The first one finds an empty folder of compiled programs, the next ones find what it
has left there; they train with other seeds.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import jax

from benchmarks.harness import figure, record
from whill_mjx.io.command_line import COUNT, run
from whill_mjx.io.compiled import FOLDER, KEPT_S, LEAST_S
from whill_mjx.io.reading import read_lines

FIRST = re.compile(r"first step after")
DONE = 0.99
GIVEN = dict(os.environ)
ENV = """
import time
began = time.time()
from whill_mjx import WhillEnv, share_results
share_results()
def first():
    since = time.perf_counter()
    env = WhillEnv("corridor")
    env.reset(seed=0)
    env.step(env.action_space.sample())
    return time.perf_counter() - since
first()
print(time.time() - began, first())
"""
CLAIM = "Seconds from the start of a command to its first result, with and without kept programs"


@dataclass(frozen=True)
class Options:
    """Options of the benchmark."""

    parts: tuple[Literal["first_step", "ppo", "course", "env"], ...] = ("first_step", "env")
    """first_step: until a training has made its first step; ppo: until an evaluation inside the run has 99 % of
    successes; course: the whole training with the paper's budget; env: the first step of a Gymnasium environment."""
    preset: str = "auto"
    """Of the trainings of first_step and course."""
    vehicle: str = "whill_cr_ramp"
    """Vehicle of the trainings."""
    warm: Annotated[int, COUNT] = 2
    """Runs with kept programs."""
    limit_s: Annotated[float, COUNT] = 600.0
    """Most time of a run."""


def train(options: Options, folder: Path, seed: int, words: list[str], over: Callable[[Path, str], bool]) -> float:
    """Seconds from the start of a training command until `over(RUN, line of stderr)`; the command is then stopped."""
    out = folder / f"run_{'_'.join(words[1::2])}_{seed}"
    command = [sys.executable, "-m", "whill_mjx.train", "--out", str(out), "--vehicle", options.vehicle,
               "--seed", str(seed), *words]
    began = time.perf_counter()
    child = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True, env=_told(folder))
    assert child.stderr is not None
    said = []
    for line in child.stderr:
        said.append(line)
        seconds = time.perf_counter() - began
        if over(out, line):
            child.send_signal(signal.SIGINT)
            child.wait()
            print(f"{' '.join(words)}, seed {seed}: {seconds:.1f} s", flush=True)
            return seconds
        if seconds > options.limit_s:
            child.kill()
            break
    raise SystemExit(f"{' '.join(command)}: did not get there. It said last:\n{''.join(said[-20:])}")


def _told(folder: Path) -> dict[str, str]:
    """The environment of a process that keeps its programs in `folder`."""
    kept = {FOLDER.upper(): str(folder / "compiled"), LEAST_S.upper(): str(KEPT_S), "PYTHONUNBUFFERED": "1"}
    return {**GIVEN, **kept}


def first_step(out: Path, line: str) -> bool:
    """Whether the training has made its first step."""
    return bool(FIRST.search(line))


def succeeded(out: Path, line: str) -> bool:
    """Whether an evaluation inside the run has reached `DONE`."""
    path = out / "metrics.jsonl"
    return path.exists() and any(one.get("eval/success", 0.0) >= DONE for _, one in read_lines(path))


def trained(out: Path, line: str) -> bool:
    """Whether the training is over."""
    return "preparing the final evaluation" in line


def environment(options: Options, folder: Path, seed: int) -> tuple[float, float]:
    """Seconds from the start of a process to an environment's first step, and those of a further environment."""
    answer = subprocess.run([sys.executable, "-c", ENV], capture_output=True, text=True, env=_told(folder), check=True)
    first, further = map(float, answer.stdout.split())
    print(f"WhillEnv: {first:.1f} s, a further one {further:.3f} s", flush=True)
    return first, further


def measure(options: Options, part: str, folder: Path) -> dict[str, Any]:
    """Figures of one part."""
    if part == "env":
        runs = [environment(options, folder, seed) for seed in range(1 + options.warm)]
        return {"env_first_step_cold_s": figure([runs[0][0]], "s"),
                "env_first_step_warm_s": figure([one[0] for one in runs[1:]], "s"),
                "env_further_step_s": figure([one[1] for one in runs], "s")}  # fmt: skip
    found: dict[str, Any] = {}
    plans: dict[str, tuple[str, list[str], Callable[[Path, str], bool]]] = {
        "first_step": ("first_step", ["--preset", options.preset], first_step),
        "ppo": ("ppo_99", ["--preset", "wallclock", "--learner", "ppo"], succeeded),
        "course": ("course", ["--preset", options.preset], trained),
    }
    name, words, over = plans[part]
    seconds = [train(options, folder, seed, words, over) for seed in range(1 + options.warm)]
    found[f"{name}_cold_s"] = figure(seconds[:1], "s")
    found[f"{name}_warm_s"] = figure(seconds[1:], "s")
    return found


def main(options: Options) -> None:
    """Measure each part with a folder of its own."""
    os.environ["XLA_PYTHON_CLIENT_PREALLOCATE"] = "false"  # this process only names the device
    for part in options.parts:
        folder = Path(tempfile.mkdtemp(prefix="speed_"))
        try:
            figures = measure(options, part, folder)
        finally:
            shutil.rmtree(folder, ignore_errors=True)
        before = "cpu_" if jax.devices()[0].platform == "cpu" else ""
        path = record("speed", CLAIM, {f"{before}{name}": one for name, one in figures.items()})
        print(path, {name: round(one["value"], 3) for name, one in figures.items()}, flush=True)


if __name__ == "__main__":
    run(Options, main, __doc__, positional=False)

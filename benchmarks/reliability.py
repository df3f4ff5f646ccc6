"""Measures what docs/reliability.md promises: damaged files, mistaken commands, kills and Ctrl-C.

    python -m benchmarks.reliability --parts files options        # minutes; --damaged 2000 takes an hour
    python -m benchmarks.reliability --parts kills ctrl_c         # hours: each command is killed --kills times

Damaged files and mistaken commands are those of the tests, more of them. Kills and Ctrl-C meet the commands as users
start them, at random moments. A run is lost work where its newest step is older than a minute, different where its
results are not those of a run left alone, and half written where a file with its final name cannot be read.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from benchmarks.harness import RESULTS, figure, record
from bridge.options import Parser, whole
from whill_mjx.io.command_line import guarded

CLAIM = "No file, mistake, kill or full disk ends in a traceback, lost work or half-written results"
ROOT = Path(__file__).parents[1]
PARTS = ("files", "options", "kills", "ctrl_c")
CHAIR = "sysid/data/chair"
COMMANDS = {
    "fit": ["sysid.fit", CHAIR],
    "close_loop": ["sysid.close_loop", CHAIR, "--refit-nulls", "100"],
    "train": ["whill_mjx.train", "--preset", "smoke", "--vehicle", "whill_cr_ramp", "--steps", "6000",
              "--episodes", "2", "--no-planner", "--videos", "0", "--checkpoint-every-s", "20"],
}  # fmt: skip
"""Runs of about five minutes on two cores."""
RESULT = {"fit": "vehicle.toml", "close_loop": "vehicle.toml", "train": "policy/weights.npz"}
"""File whose bits are compared."""
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
MINUTE = 60.0
Figures = dict[str, dict[str, Any]]


def tested(words: list[str], **environment: str) -> tuple[int, list[str]]:
    """How many cases tests have, and the messages of those that fail."""
    with tempfile.TemporaryDirectory() as folder:
        found = Path(folder) / "found.xml"
        subprocess.run([sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", f"--junitxml={found}", *words],
                       cwd=ROOT, env={**os.environ, **environment}, stdout=subprocess.DEVNULL)  # fmt: skip
        cases = list(ElementTree.parse(found).iter("testcase"))
    failed = [part.get("message", "") for case in cases for part in case if part.tag in ("failure", "error")]
    return sum(all(part.tag != "skipped" for part in case) for case in cases), failed


def damaged_files(count: int) -> Figures:
    """Readers that let out another exception, hang or need too much, of `count` damaged files each."""
    rooms = ("whill_mjx/test_damaged_files.py", "bridge/test_damaged_policy_files.py")
    apart = ("sysid/test_damaged_logs.py",), ("dreamer/test_damaged_policies.py",)  # each room has a conftest
    cases, failed = 0, list[str]()
    for room in (rooms, *apart):
        more, messages = tested([f"tests/{path}" for path in room], DAMAGED_FILES=str(count))
        cases, failed = cases + more, failed + messages
    hangs = [one for one in failed if "SECONDS" in one or "process_time" in one]
    memory = [one for one in failed if "BYTES" in one or "_peak" in one]
    about = {"files_per_reader": count, "readers": cases}
    return {"fuzz_undocumented": {**figure([float(len(failed) - len(hangs) - len(memory))], "count"), **about},
            "fuzz_hangs": {**figure([float(len(hangs))], "count"), **about},
            "fuzz_memory": {**figure([float(len(memory))], "count"), **about}}


def mistaken_commands() -> Figures:
    """Command lines with a mistake that end otherwise than with one line and exit code 2."""
    cases, failed = tested(["tests/test_mistakes.py", "tests/whill_mjx/test_mistaken_commands.py"])
    return {"option_tracebacks": {**figure([float(len(failed))], "count"), "command_lines": cases}}


def started(name: str, out: Path) -> subprocess.Popen[str]:
    """A command at work in a folder."""
    return subprocess.Popen([sys.executable, "-m", *COMMANDS[name], "--out", str(out)], cwd=ROOT, text=True,
                            stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
                            env={**os.environ, "PYTHONPATH": str(ROOT)})  # fmt: skip


def half_written(out: Path) -> list[Path]:
    """Files with their final names that cannot be read."""
    readers: dict[str, Callable[[Path], Any]] = {
        ".json": lambda path: json.loads(path.read_text()), ".toml": lambda path: tomllib.loads(path.read_text()),
        ".npz": lambda path: [np.load(path)[name] for name in np.load(path).files]}
    broken = []
    for path in out.rglob("*"):
        if path.suffix in readers and not any(part.startswith(".") for part in path.relative_to(out).parts):
            try:
                readers[path.suffix](path)
            except Exception:
                broken.append(path)
    return broken


def newest(out: Path) -> float:
    """When the newest file of a run was written; 0 where there is none."""
    return max((path.stat().st_mtime for path in out.rglob("*") if path.is_file()), default=0.0)


def kill_again_and_again(name: str, kills: int, folder: Path, seed: int = 0) -> dict[str, int]:
    """What `kills` kills of one run do, each signal in turn, and how long the run takes when left alone."""
    chosen, straight, broken = random.Random(seed), folder / "straight", folder / "broken"
    began = time.monotonic()
    child = started(name, straight)
    said = child.communicate()[1]
    if child.returncode:
        raise RuntimeError(f"{name} ended with {child.returncode}: {said.strip().splitlines()[-1:]}")
    seconds = time.monotonic() - began
    found = {"lost": 0, "half_written": 0, "different": 0, "seconds": round(seconds), "kills": 0}
    for number in (SIGNALS[k % len(SIGNALS)] for k in range(kills)):
        child, begun = started(name, broken), time.time()
        try:
            child.communicate(timeout=chosen.uniform(1.0, 3 * seconds / kills + 20.0))
            break  # it has ended by itself
        except subprocess.TimeoutExpired:
            found["lost"] += time.time() - max(newest(broken), begun) > MINUTE
            child.send_signal(number)
            child.communicate()
            found["kills"] += 1
            found["half_written"] += len(half_written(broken))
    child = started(name, broken)
    child.communicate()
    same = child.returncode == 0 and (broken / RESULT[name]).read_bytes() == (straight / RESULT[name]).read_bytes()
    found["different"] += not same
    print(f"{name}: {found}", flush=True)
    return found


def killed_runs(names: list[str], kills: int) -> Figures:
    """Kills of all commands, summed."""
    with tempfile.TemporaryDirectory() as folder:
        found = {name: kill_again_and_again(name, kills, Path(folder) / name) for name in names}
    about = {"kills": sum(one["kills"] for one in found.values()),
             "seconds": {name: one["seconds"] for name, one in found.items()}}
    return {f"kills_{what}": {**figure([float(sum(one[what] for one in found.values()))], "count"), **about}
            for what in ("lost", "different", "half_written")}


def interrupted(names: list[str], count: int, seed: int = 0) -> Figures:
    """Seconds from Ctrl-C at random moments to the end of the process, at its 95th percentile over `count` each."""
    chosen, seconds, wrong = random.Random(seed), [], 0
    for name in names:
        for _ in range(count):
            with tempfile.TemporaryDirectory() as folder:
                child = started(name, Path(folder) / "run")
                time.sleep(chosen.uniform(0.5, 40.0))
                began = time.monotonic()
                child.send_signal(signal.SIGINT)
                said = child.communicate()[1]
                seconds.append(time.monotonic() - began)
                wrong += child.returncode != 130 or "Traceback" in said
                print(f"{name}: {seconds[-1]:.2f} s, exit code {child.returncode}", flush=True)
    late = figure(seconds, "s")
    return {"ctrl_c_p95_s": {**late, "value": float(np.quantile(seconds, 0.95))},
            "ctrl_c_wrong_ends": {**figure([float(wrong)], "count"), "interrupts": len(seconds)}}


def main(arguments: list[str] | None = None) -> None:
    """Measure and record."""
    parser = Parser(prog="python -m benchmarks.reliability", description=__doc__,
                    formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--damaged", type=whole(), default=2000, help="damaged files for each reader")
    parser.add_argument("--kills", type=whole(), default=30, help="of each command")
    parser.add_argument("--interrupts", type=whole(), default=20, help="of each command")
    parser.add_argument("--commands", nargs="+", choices=tuple(COMMANDS), default=list(COMMANDS))
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of reliability.json")
    given = parser.parse_args(arguments)
    parts: dict[str, Callable[[], Figures]] = {
        "files": lambda: damaged_files(given.damaged), "options": mistaken_commands,
        "kills": lambda: killed_runs(given.commands, given.kills),
        "ctrl_c": lambda: interrupted(given.commands, given.interrupts)}
    for part in given.parts:
        print(record("reliability", CLAIM, parts[part](), given.out), flush=True)


if __name__ == "__main__":
    with guarded():
        main()

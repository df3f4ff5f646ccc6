"""Measures what docs/reliability.md promises: damaged files, mistaken commands, kills and Ctrl-C.

    python -m benchmarks.reliability --parts files --rooms sysid  # half an hour of one core; bridge: several hours
    python -m benchmarks.reliability --parts options              # minutes
    python -m benchmarks.reliability --parts alone kills --commands fit --kills 10 --seed 1  # 20 minutes on two cores
    python -m benchmarks.reliability --parts ctrl_c               # an hour

Damaged files and mistaken commands are those of the tests, more of them. Kills and Ctrl-C meet the commands as users
start them, at random moments. A run is lost work where it computed for more than a minute since its newest step,
different where its results are not those of a run left alone, and half written where a file with its final name cannot
be read. The run left alone is watched: the longest time in which it saves nothing is the most that any kill can cost.
Both are processor time, which does not depend on what else the computer does. Compiled programs are saves too: the next
run reads them from the user's cache, which is empty before the first run here.

What was measured is kept in --keep: a benchmark that is stopped goes on there. Figures are those of all rooms, commands
and seeds that it holds, each with its commit, so parts may run side by side on machines of one kind. Work divides by
seed: two times `--parts files --damaged 1000`, with --seed 0 and 1, are 2,000 files for each reader.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import itertools
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from benchmarks.harness import RESULTS, device_name, figure, provenance, record
from bridge.nodes.options import Parser, whole
from whill_mjx.io.command_line import guarded
from whill_mjx.io.folders import write_whole
from whill_mjx.io.reading import read_json

CLAIM = "No file, mistake, kill or full disk ends in a traceback, lost work or half-written results"
ROOT = Path(__file__).parents[1]
PARTS = ("files", "options", "alone", "kills", "ctrl_c")
CHAIR = "sysid/data/chair"
COMMANDS = {
    "fit": ["sysid.fit", CHAIR, "--starts", "4"],
    "close_loop": ["sysid.close_loop", CHAIR, "--refit-nulls", "2"],
    "train": ["whill_mjx.train", "--preset", "smoke", "--vehicle", "whill_cr_ramp", "--steps", "50000",
              "--episodes", "2", "--no-planner", "--videos", "0", "--checkpoint-every-s", "20"],
}  # fmt: skip
"""Runs of five to eight minutes on two cores: one that is killed ten times and then ends takes twelve minutes."""
QUICK = {
    "fit": ["sysid.fit", CHAIR, "--quick"],
    "close_loop": ["sysid.close_loop", CHAIR, "--quick"],
    "train": ["whill_mjx.train", "--preset", "smoke", "--vehicle", "whill_cr_ramp", "--steps", "800",
              "--episodes", "2", "--no-planner", "--videos", "0", "--checkpoint-every-s", "5"],
}  # fmt: skip
"""The same of about a minute."""
ROOMS = {
    "whill_mjx": ["whill_mjx/test_damaged_files.py"], "sysid": ["sysid/test_damaged_logs.py"],
    "inputs": ["bridge/test_damaged_inputs.py"], "bridge": ["bridge/test_damaged_policy_files.py"],
    "dreamer": ["dreamer/test_damaged_policies.py", "dreamer/test_damaged_checkpoints.py"],
}  # fmt: skip
"""Tests of readers, each room in a process."""
RESULT = {"fit": "vehicle.toml", "close_loop": "vehicle.toml", "train": "policy/weights.npz"}
"""File whose bits are compared."""
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
NO_SAVES = (".lock", "run.json", "stderr")
"""Files that a run does not go on from, beside its logs (.jsonl)."""
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


class Kept:
    """What was measured of this commit, a JSON file each, and the folders of the runs."""

    def __init__(self, folder: Path, runs: Path):
        self.folder, self.runs, self._commit = folder, runs, provenance()["commit"]

    def read(self, name: str, any_commit: bool = False) -> dict[str, Any]:
        """What is known; empty where nothing is, or it is of another commit."""
        path = self.folder / f"{name}.json"
        found = read_json(path, "missing.", "Remove it, and measure again.") if path.exists() else {}
        return found if any_commit or found.get("commit") == self._commit else {}

    def all(self, beginning: str) -> list[dict[str, Any]]:
        """What is known under names that begin so, of any commit."""
        return [self.read(path.stem, any_commit=True) for path in sorted(self.folder.glob(f"{beginning}*.json"))]

    def write(self, name: str, found: dict[str, Any]) -> None:
        """Keep it."""
        write_whole(self.folder / f"{name}.json", json.dumps({**found, "commit": self._commit}, indent=1) + "\n")


def damaged_room(room: str, count: int, jobs: int) -> dict[str, Any]:
    """What the tests of a room say of `count` damaged files for each reader, spread over `jobs` processes.

    Each process draws files of its own: hypothesis seeds itself where DAMAGED_FILES is given.
    """
    paths, each = [f"tests/{path}" for path in ROOMS[room]], str(-(-count // jobs))
    with ThreadPoolExecutor(jobs) as pool:
        parts = list(pool.map(lambda _: tested(paths, DAMAGED_FILES=each), range(jobs)))
    failed = [one for _, messages in parts for one in messages]
    return {"count": count, "readers": parts[0][0], "failed": failed, "device": device_name()}


def damaged_files(rooms: list[str], count: int, jobs: int, seed: int, kept: Kept) -> None:
    """Try `count` damaged files on each reader of some rooms, where fewer are kept under this seed."""
    for room in rooms:
        if kept.read(f"files_{room}_{seed}").get("count", 0) < count:
            found = damaged_room(room, count, jobs)
            kept.write(f"files_{room}_{seed}", found)
            said = [one[:300] for one in found["failed"]]
            print(f"{room}: {found['readers']} readers, {len(said)} failed {said}", flush=True)


def damaged_figures(kept: Kept) -> Figures:
    """Readers that let out another exception, hang or need too much, of all rooms and seeds that are kept."""
    known = {room: found for room in ROOMS if (found := kept.all(f"files_{room}"))}
    if not known:
        return {}
    every = [one for found in known.values() for one in found]
    failed = [message for one in every for message in one["failed"]]
    hangs = [one for one in failed if "SECONDS" in one or "process_time" in one]
    memory = [one for one in failed if "BYTES" in one or "_peak" in one or "MemoryError" in one]
    about = {"files_per_reader": {room: sum(one["count"] for one in found) for room, found in known.items()},
             "commits": {room: " ".join(sorted({one["commit"] for one in found})) for room, found in known.items()},
             "readers": sum(found[0]["readers"] for found in known.values())}
    counts = {"undocumented": len(failed) - len(hangs) - len(memory), "hangs": len(hangs), "memory": len(memory)}
    return {f"fuzz_{name}": {**figure([float(number)], "count", every[0]["device"]), **about}
            for name, number in counts.items()}


def mistaken_commands() -> Figures:
    """Command lines with a mistake that end otherwise than with one line and exit code 2."""
    cases, failed = tested(["tests/test_mistakes.py", "tests/whill_mjx/test_mistaken_commands.py"])
    return {"option_tracebacks": {**figure([float(len(failed))], "count"), "command_lines": cases}}


class Started(subprocess.Popen[str]):
    """A command at work in a folder, with a user's cache beside it."""

    def __init__(self, words: list[str], out: Path):
        path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
        self._said = tempfile.TemporaryFile("w+")
        self.saves = (out, out.parent / "cache")
        environment = {**os.environ, "PYTHONPATH": path, "XDG_CACHE_HOME": str(self.saves[1].absolute())}
        super().__init__([sys.executable, "-m", *words, "--out", str(out)], cwd=ROOT, text=True,
                         stdout=subprocess.DEVNULL, stderr=self._said, env=environment)

    def said(self) -> str:
        """Wait for the end; what it wrote to stderr."""
        self.wait()
        self._said.seek(0)
        return self._said.read()


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


def newest(folders: Iterable[Path]) -> float:
    """When a run last saved what it goes on from, or a result, in these folders; 0 where it never did."""
    times = [0.0]
    for path in itertools.chain.from_iterable(folder.rglob("*") for folder in folders):
        if path.name not in NO_SAVES and path.suffix != ".jsonl":
            with contextlib.suppress(FileNotFoundError):  # removed meanwhile
                times.append(path.stat().st_mtime)
    return max(times)


class Watch:
    """How long a run computes without saving anything [s of processor time]."""

    def __init__(self, child: Started):
        self._child = child
        self._saved_at, self._used, self.longest = newest(child.saves), 0.0, 0.0

    def unsaved(self) -> float:
        """Since the newest step; to be asked often."""
        with contextlib.suppress(FileNotFoundError, IndexError):  # it has ended
            words = Path(f"/proc/{self._child.pid}/stat").read_text().rpartition(")")[2].split()
            used = sum(map(int, words[11:15])) / os.sysconf("SC_CLK_TCK")
            if (saved_at := newest(self._child.saves)) > self._saved_at:
                self._saved_at, self._used = saved_at, used
            self.longest = max(self.longest, used - self._used)
            return used - self._used
        return 0.0


def left_alone(name: str, words: list[str], kept: Kept) -> None:
    """Keep how long a run takes when nobody ends it [s], for how long it computed without saving, and its bits."""
    out = kept.runs / f"{name}_left"
    shutil.rmtree(out, ignore_errors=True)
    began, child = time.time(), Started(words, out)
    watch = Watch(child)
    while child.poll() is None:
        time.sleep(0.2)
        watch.unsaved()
    said = child.said()
    if child.returncode:
        raise RuntimeError(f"{name} ended with {child.returncode}: {said.strip().splitlines()[-1:]}")
    found = {"words": words, "seconds": round(time.time() - began), "unsaved_s": round(watch.longest, 1),
             "bits": digest(name, out), "device": device_name()}  # fmt: skip
    kept.write(f"alone_{name}", found)
    print(f"{name}: {found}", flush=True)


def digest(name: str, out: Path) -> str:
    """Hash of a run's result."""
    return hashlib.sha256((out / RESULT[name]).read_bytes()).hexdigest()


def kill_once(name: str, words: list[str], out: Path, found: dict[str, Any], longest: float) -> None:
    """Start a run or go on with it, end it at a random moment within `longest` seconds, and count what went wrong."""
    number = SIGNALS[found["kills"] % len(SIGNALS)]
    chosen = random.Random(f"{found['seed']} {found['kills']} {len(found['bits'])}")
    child, until = Started(words, out), time.monotonic() + chosen.uniform(1.0, longest)
    watch = Watch(child)
    while child.poll() is None and time.monotonic() < until:
        time.sleep(0.2)
        watch.unsaved()
    if child.poll() is None:
        found["lost"] += watch.unsaved() > MINUTE
        child.send_signal(number)
        said = child.said()
        found["kills"] += 1
        found["half_written"] += len(half_written(out))
        if "Traceback" in said or child.returncode not in (-number, 130, 0):
            found["wrong_ends"].append(f"exit code {child.returncode}: {said[-1000:]}")
    else:
        settle(name, out, found, child.returncode, child.said())


def settle(name: str, out: Path, found: dict[str, Any], code: int, said: str) -> None:
    """Keep the bits of a run that came to its end, and begin anew.

    Raises:
        RuntimeError: it failed before it had made its folder, so no kill can be measured.
    """
    if code and not out.exists():
        raise RuntimeError(f"{name} ended with {code}: {said.strip().splitlines()[-1:]}")
    found["bits"].append(digest(name, out) if code == 0 else f"exit code {code}: {said[-300:]}")
    shutil.rmtree(out)


def kill_again_and_again(name: str, words: list[str], kills: int, seed: int, kept: Kept) -> None:
    """Keep what `kills` kills of one run do, each signal in turn, and the bits in which it ends."""
    label = f"kills_{name}_{seed}"
    found, out = kept.read(label), kept.runs / f"{name}_{seed}"
    if found.get("words") != words:
        shutil.rmtree(out, ignore_errors=True)
        found = {"words": words, "seed": seed, "lost": 0, "half_written": 0, "wrong_ends": [], "kills": 0, "bits": []}
    while found["kills"] < kills:
        kill_once(name, words, out, found, 600.0 / kills + 5.0)
        kept.write(label, found)
        print(f"{name}: {found['kills']} of {kills} kills", flush=True)
    if out.exists() or not found["bits"]:
        child = Started(words, out)
        said = child.said()
        settle(name, out, found, child.returncode, said)
    kept.write(label, {**found, "device": device_name()})
    print(f"{name}: {found}", flush=True)


def killed_figures(kept: Kept) -> Figures:
    """Sums over all kills, and over the bits of those runs that came to their end beside another of the same command.

    What a kill cost is known at once; a run that was not taken to its end has no bits to compare.
    """
    alone = {name: found for name in COMMANDS if (found := kept.read(f"alone_{name}", any_commit=True))}
    runs = {name: kills for name in COMMANDS if (kills := kept.all(f"kills_{name}_"))}
    every = [one for found in runs.values() for one in found]
    if not every:
        return {}
    compared = {name: _same_bits(found, alone.get(name)) for name, found in runs.items()}
    about = {"kills": sum(one["kills"] for one in every),
             "kills_of": {name: sum(one["kills"] for one in found) for name, found in runs.items()},
             "ended": sum(len(same) for same in compared.values()),
             "commits": sorted({one["commit"] for one in every}),
             "seconds": {name: found["seconds"] for name, found in alone.items()}}  # fmt: skip
    counts = {"lost": sum(one["lost"] for one in every), "half_written": sum(one["half_written"] for one in every),
              "wrong_ends": sum(len(one["wrong_ends"]) for one in every),
              "different": sum(not same for found in compared.values() for same in found)}
    device = next((one["device"] for one in (*alone.values(), *every) if "device" in one), device_name())
    figures = {f"kills_{what}": {**figure([float(count)], "count", device), **about} for what, count in counts.items()}
    if not alone:
        return figures
    unsaved = [found["unsaved_s"] for found in alone.values()]
    longest = figure(unsaved, "s of processor time that a run computed without saving, at most", device)
    return {**figures, "kills_unsaved_s": {**longest, "value": max(unsaved), **about}}


def _same_bits(found: list[dict[str, Any]], alone: dict[str, Any] | None) -> list[bool]:
    """Whether each run that came to its end has the bits of the one that was left alone, or else of the first of the
    same command and commit: one that was killed at other moments."""
    ends: dict[tuple[str, str], list[str]] = {}
    for one in (*([{**alone, "bits": [alone["bits"]]}] if alone else []), *found):
        ends.setdefault((" ".join(one["words"]), one["commit"]), []).extend(one["bits"])
    return [bits == every[0] for every in ends.values() for bits in every[1:]]


def interrupted(name: str, words: list[str], count: int, seed: int, kept: Kept) -> None:
    """Keep the seconds from Ctrl-C to the end of the process, `count` times at random moments, and wrong ends."""
    chosen = random.Random(seed)
    found: dict[str, Any] = {"seconds": [], "wrong_ends": [], "device": device_name()}
    for _ in range(count):
        with tempfile.TemporaryDirectory() as folder:
            child = Started(words, Path(folder) / "run")
            time.sleep(chosen.uniform(0.5, 40.0))
            began = time.monotonic()
            child.send_signal(signal.SIGINT)
            said = child.said()
            found["seconds"].append(time.monotonic() - began)
            if child.returncode != 130 or "Traceback" in said:
                found["wrong_ends"].append(f"exit code {child.returncode}: {said[-1000:]}")
        kept.write(f"ctrl_c_{name}_{seed}", found)
        print(f"{name}: {found['seconds'][-1]:.2f} s, exit code {child.returncode}", flush=True)


def interrupted_figures(kept: Kept) -> Figures:
    """The 95th percentile over all interrupts of all commands and seeds."""
    if not (known := kept.all("ctrl_c_")):
        return {}
    seconds = [one for found in known for one in found["seconds"]]
    about = {"interrupts": len(seconds), "commits": sorted({found["commit"] for found in known})}
    wrong, device = sum(len(found["wrong_ends"]) for found in known), known[0]["device"]
    return {"ctrl_c_p95_s": {**figure(seconds, "s", device), "value": float(np.quantile(seconds, 0.95)), **about},
            "ctrl_c_wrong_ends": {**figure([float(wrong)], "count", device), **about}}


def main(arguments: list[str] | None = None) -> None:
    """Measure and record."""
    parser = Parser(prog="python -m benchmarks.reliability", description=__doc__,
                    formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="+", choices=(*PARTS, "kept"), default=PARTS,
                        help="kept: measure nothing, and record what --keep holds")
    parser.add_argument("--damaged", type=whole(), default=2000, help="damaged files for each reader")
    parser.add_argument("--rooms", nargs="+", choices=tuple(ROOMS), default=list(ROOMS), help="readers of files")
    parser.add_argument("--jobs", type=whole(), default=len(os.sched_getaffinity(0)), help="processes that read files")
    parser.add_argument("--kills", type=whole(0), default=30, help="of each command")
    parser.add_argument("--interrupts", type=whole(), default=20, help="of each command")
    parser.add_argument("--commands", nargs="+", choices=tuple(COMMANDS), default=list(COMMANDS))
    parser.add_argument("--seed", type=whole(0), default=0,
                        help="of the moments of kills and of Ctrl-C; with files, the name of this share of them")
    parser.add_argument("--quick", action="store_true", help="kill runs of a minute instead of five")
    parser.add_argument("--keep", type=Path, default=Path("runs/reliability"), help="folder to go on in")
    parser.add_argument("--runs", type=Path, help="folder of the runs themselves; by default that of --keep")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of reliability.json")
    given = parser.parse_args(arguments)
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:  # in the background of a script; the commands need it
        signal.signal(signal.SIGINT, signal.default_int_handler)
    kept = Kept(given.keep, given.runs or given.keep)
    commands = {name: (QUICK if given.quick else COMMANDS)[name] for name in given.commands}
    parts: dict[str, Callable[[str, list[str]], None]] = {
        "alone": lambda name, words: left_alone(name, words, kept),
        "kills": lambda name, words: kill_again_and_again(name, words, given.kills, given.seed, kept),
        "ctrl_c": lambda name, words: interrupted(name, words, given.interrupts, given.seed, kept)}
    figures: Figures = {}
    for part in given.parts:
        if part == "files":
            damaged_files(given.rooms, given.damaged, given.jobs, given.seed, kept)
        elif part == "options":
            figures |= mistaken_commands()
        elif part in parts:
            for name, words in commands.items():
                parts[part](name, words)
        figures |= {**killed_figures(kept), **damaged_figures(kept), **interrupted_figures(kept)}
        if figures:
            print(record("reliability", CLAIM, figures, given.out), flush=True)


if __name__ == "__main__":
    with guarded():
        main()

"""Commands that are ended at random moments, again and again, and what they must leave."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable
from pathlib import Path
from random import Random

import numpy as np

ROOT = Path(__file__).parents[1]
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)


class Process(subprocess.Popen):
    """`python -m MODULE WORDS` as users start it, with stderr in a file, once it has taken its signals over."""

    def __init__(self, module: str, words: list[str], said: Path):
        with said.open("w") as file:
            super().__init__([sys.executable, "-m", module, *words], cwd=ROOT, stdout=subprocess.DEVNULL, stderr=file,
                             env={**os.environ, "PYTHONPATH": str(ROOT)})  # fmt: skip
        while self.poll() is None and not catches(self.pid, signal.SIGTERM):
            time.sleep(0.01)


def catches(pid: int, number: int) -> bool:
    """Whether a process has a handler for a signal, as the operating system has it."""
    try:
        status = Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return False
    (mask,) = (line.split()[1] for line in status.splitlines() if line.startswith("SigCgt"))
    return bool(int(mask, 16) >> (number - 1) & 1)


def written_at(path: Path) -> int:
    """When a file was written [ns], 0 where there is none."""
    return path.stat().st_mtime_ns if path.exists() else 0


def left_alone(child, said: Path, progress: Callable[[], int]) -> tuple[int, float]:
    """Largest progress and seconds of a command that nobody ends."""
    began, most = time.monotonic(), 0
    while (code := child.poll()) is None:
        most = max(most, progress())
        time.sleep(0.02)
    assert code == 0, said.read_text()
    return most, time.monotonic() - began


def killed_again_and_again(start, last: Path, kills: int, progress, most: int, seconds: float, said: Path) -> None:
    """Start a command by `start()` and end it at a random moment, `kills` times with each signal; `most` and `seconds`
    are its progress and its time when it is left alone, `last` is a file that it writes at the end of its work."""
    random = Random(4)
    signals = [number for number in SIGNALS for _ in range(kills)]
    random.shuffle(signals)
    for index, number in enumerate(signals):
        found = written_at(last)
        child, wanted = start(), (index + 1) * most // (len(signals) + 1)
        if index % 3 == 0:
            time.sleep(random.uniform(0.0, seconds / 3))  # some fall into its start
        while index % 3 and child.poll() is None and progress() < wanted:
            time.sleep(0.005)
        before = progress()
        if (code := child.poll()) is None:
            child.send_signal(number)
            code = child.wait()
        told = said.read_text()
        assert code in ((-number, 0) if number == signal.SIGKILL else (130, 0)), told
        done = code == 0 or written_at(last) != found  # then it removes its steps, and may be killed meanwhile
        assert "Traceback" not in told and (done or progress() >= before)
        assert code <= 0 or told.rstrip().endswith(f"({signal.Signals(number).name})"), told
        check_whole(last.parent)


def check_whole(out: Path) -> None:
    """Every file with a final name can be read."""
    for path in (one for one in out.rglob("[!.]*") if one.is_file()):
        if path.suffix == ".json":
            json.loads(path.read_text())
        elif path.suffix == ".toml":
            tomllib.loads(path.read_text())
        elif path.suffix == ".npz":
            with np.load(path) as archive:
                assert [archive[name] for name in archive.files]

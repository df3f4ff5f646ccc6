"""Starts commands in processes of their own that have their imports behind them, so that many can be killed.

    starter = Warm("sysid.fit"); child = starter.start("sysid.fit", words, said); child.send_signal(...); child.wait()

A helper process imports the modules once. For each command it forks a process that does the rest as `python -m MODULE`
would: it listens for signals, reads its words, works and ends.
"""

from __future__ import annotations

import importlib
import json
import os
import resource
import signal
import subprocess
import sys
import traceback
from pathlib import Path

ROOT = Path(__file__).parents[1]
SIGNALS = {signal.SIGINT, signal.SIGTERM}


class Child:
    """A command that was started."""

    def __init__(self, starter: Warm, pid: int, said: Path):
        self._starter, self.pid, self.said = starter, pid, said
        self._code: int | None = None  # an ended process can be asked once

    def poll(self, how: str = "poll") -> int | None:
        """Exit code, negative for a signal; None while it works."""
        self._code = self._starter.ask({how: self.pid}) if self._code is None else self._code
        return self._code

    def wait(self) -> int | None:
        """Wait for its end, and return its exit code."""
        return self.poll("wait")

    def send_signal(self, number: int) -> None:
        """Send it a signal; it is not reaped before it is asked for, so the number is its own."""
        os.kill(self.pid, number)


class Warm:
    """The helper process, as a context."""

    def __init__(self, *modules: str):
        self._process = subprocess.Popen([sys.executable, __file__, *modules], stdin=subprocess.PIPE,
                                         stdout=subprocess.PIPE, text=True)  # fmt: skip

    def __enter__(self) -> Warm:
        return self

    def __exit__(self, *words: object) -> None:
        self._process.stdin.close()
        self._process.wait()
        self._process.stdout.close()

    def start(self, module: str, words: list[str], said: Path, largest: int | None = None) -> Child:
        """Start `python -m MODULE WORDS`, with stderr into `said`; no file may grow beyond `largest` bytes."""
        said.write_text("")
        return Child(self, self.ask({"start": module, "words": words, "said": str(said), "largest": largest}), said)

    def ask(self, request: dict) -> int | None:
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        return json.loads(self._process.stdout.readline())


def run(request: dict) -> None:
    """The forked process."""
    from whill_mjx.io.command_line import listen

    null = os.open(os.devnull, os.O_RDWR)
    os.dup2(null, 0)
    os.dup2(null, 1)
    os.dup2(os.open(request["said"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644), 2)
    if request["largest"] is not None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (request["largest"], resource.RLIM_INFINITY))
    sys.argv = [request["start"], *request["words"]]
    for number in SIGNALS:  # a signal that comes after the work, when the command listens no more, changes nothing
        signal.signal(number, lambda *_: None)
    listen()
    signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
    code = 0
    try:
        importlib.import_module(request["start"]).cli()
    except SystemExit as ended:
        code = ended.code if isinstance(ended.code, int) else int(ended.code is not None)
    except BaseException:
        traceback.print_exc()
        code = 1
    sys.stderr.flush()
    os._exit(code)


def main() -> None:
    """Serve requests, a line each."""
    for module in sys.argv[1:]:
        importlib.import_module(module)
    for line in sys.stdin:
        request = json.loads(line)
        if "start" in request:
            signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)  # until the child listens
            answer = os.fork()
            if answer == 0:
                run(request)
            signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
        else:
            pid, status = os.waitpid(request.get("poll") or request["wait"], os.WNOHANG if "poll" in request else 0)
            answer = os.waitstatus_to_exitcode(status) if pid else None
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    import warnings

    warnings.filterwarnings("ignore", "os.fork", RuntimeWarning)  # JAX has not started yet
    main()

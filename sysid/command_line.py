"""What the commands of this package share beyond `whill_mjx.io.command_line`: kept programs, progress of long work."""

from __future__ import annotations

import hashlib
import os
import platform
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sysid.replay.model_files import steps_mjx
from sysid.search.result import Progress
from whill_mjx.io import command_line
from whill_mjx.io.heartbeat import Heartbeat

_heartbeats: list[Heartbeat] = []
"""That of the command which runs in this process; none where the package is used from Python."""


def run(options: type, main: Callable[[Any], Any], description: str | None, **more: Any) -> None:
    """`whill_mjx.io.command_line.run` with compiled programs kept for later runs.

    XLA shares results unless the command steps a user's robot (`--model`), on which it may abort then.
    """

    def cached(chosen: Any) -> None:
        keep_compiled()
        with Heartbeat() as heartbeat:  # progress bars tick while something long is computed
            _heartbeats.append(heartbeat)
            try:
                main(chosen)
            finally:
                _heartbeats.remove(heartbeat)

    command_line.run(options, cached, description, **more,
                     shares=lambda chosen: not steps_mjx(getattr(chosen, "model", None)))


def stage(text: str) -> None:
    """Say what a command begins now, where no bar shows it; its time is shown until the next bar or stage."""
    for heartbeat in _heartbeats:
        heartbeat.stage(text)


def progress_bar(total: int, what: str = "fit", unit: str = "eval") -> tuple[Progress, Callable[[], None]]:
    """A bar with rate and remaining time, and the function that closes it."""
    from tqdm import tqdm

    bar: Any = tqdm(total=total, desc=what, unit=unit, dynamic_ncols=True)

    def advance(count: int, remark: str) -> None:
        bar.set_postfix_str(remark, refresh=count == 0)
        bar.update(min(count, max(bar.total - bar.n, 0)))

    def close() -> None:
        if sys.exc_info()[0] is None and bar.n:  # the total is the most that there may be to do
            bar.total = bar.n
        bar.close()

    return advance, close


def keep_compiled() -> None:
    """Keep what XLA compiles for later runs, in the user's cache folder, unless JAX was given another folder
    (JAX_COMPILATION_CACHE_DIR) or none (JAX_ENABLE_COMPILATION_CACHE=false), or where that cannot be written.

    Each kind of processor has a folder of its own: a home may be shared by several.
    """
    import jax

    if jax.config.values["jax_compilation_cache_dir"] is not None:
        return
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    folder = Path(home) / "whill_mjx" / f"compiled-{_processor()}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    if os.access(folder, os.W_OK):
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


def _processor() -> str:
    """What stands for the instructions that this machine's processor has."""
    try:
        text = Path("/proc/cpuinfo").read_text()
    except OSError:
        text = platform.processor()
    about = [line for line in text.splitlines() if line.startswith(("flags", "Features", "model name"))]
    return hashlib.sha256(f"{platform.machine()} {about[:2] or text}".encode()).hexdigest()[:12]

"""Programs that XLA has compiled, kept in a folder for later runs. Commands ask for it; importing a package never does.

JAX reads and writes the folder; here it is chosen and kept within bounds. JAX_COMPILATION_CACHE_DIR names another
folder, which is then the user's own affair, and JAX_ENABLE_COMPILATION_CACHE=false keeps nothing.
"""

from __future__ import annotations

import hashlib
import os
import platform
import sys
import warnings
import zlib
from pathlib import Path

FOLDER, LEAST_S = "jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs"
KEPT_S = 0.05
"""Programs that compile faster are not kept [s]."""
MOST_BYTES = 2_000_000_000
"""Size of the folder at the start of a command; the programs that were unused for longest make room."""
CHECKED = ".checked"
"""Empty file: what is older was found whole."""
ZLIB = b"\x78"
"""First byte of zlib's format."""


def keep_compiled() -> None:
    """Keep what XLA compiles in this process, and in those that it starts, in the user's cache folder.

    Nothing changes where JAX has a folder already, or where this one cannot be written. A damaged entry, a full disk or
    another process that writes the same entry cost a compilation, no more.
    """
    warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache entry")
    given = sys.modules["jax"].config.values[FOLDER] if "jax" in sys.modules else None
    if given is not None or FOLDER.upper() in os.environ:
        return
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    folder = Path(home) / "whill_mjx" / f"compiled-{_processor()}"  # a home may be shared by several processors
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tidy(folder)
    except OSError:
        return
    if os.access(folder, os.W_OK | os.X_OK):
        _tell(FOLDER, str(folder))
        _tell(LEAST_S, KEPT_S)


def tidy(folder: Path, most: int = MOST_BYTES) -> None:
    """Remove what a full disk or a kill has cut off, and the longest unused entries beyond `most` bytes.

    Other processes may read and write meanwhile: what is taken from them they compile again.
    """
    checked = folder / CHECKED
    since = checked.stat().st_mtime if checked.exists() else 0.0
    checked.touch()
    found = []
    for path in folder.rglob("*"):
        try:
            about = path.stat()
            if not path.is_file() or path == checked:
                continue
            if about.st_mtime >= since and not _whole(path):
                path.unlink()
                continue
        except OSError:
            continue  # gone by now
        found.append((max(about.st_atime, about.st_mtime), about.st_size, path))
    size = sum(one[1] for one in found)
    for _, bytes_, path in sorted(found):
        if size <= most:
            break
        path.unlink(missing_ok=True)
        size -= bytes_


def _whole(path: Path) -> bool:
    """Whether an entry can be unpacked; one in another format than zlib's is left to JAX."""
    data = path.read_bytes()
    if not data:
        return False
    try:
        return data[:1] != ZLIB or bool(zlib.decompress(data))
    except zlib.error:
        return False


def _tell(name: str, value: str | float) -> None:
    """Set an option of JAX, which need not be imported yet, here and in processes that are started."""
    os.environ[name.upper()] = str(value)
    if "jax" in sys.modules:
        sys.modules["jax"].config.update(name, value)


def _processor() -> str:
    """What stands for the instructions that this machine's processor has."""
    try:
        text = Path("/proc/cpuinfo").read_text()
    except OSError:
        text = platform.processor()
    about = [line for line in text.splitlines() if line.startswith(("flags", "Features", "model name"))]
    return hashlib.sha256(f"{platform.machine()} {about[:2] or text}".encode()).hexdigest()[:12]

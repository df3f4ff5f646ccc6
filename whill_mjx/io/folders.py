"""Folders and files that a command writes: whole or not at all, by one process at a time, and never over another's.

    with claim_folder(out, "whill_mjx.train", OUTPUTS) as claim:  # place, lock, files of others
        claim.settle({"seed": 0, ...})                            # another run's folder is refused
        ...

The lock is the operating system's: it ends with the process that holds it, however that ends.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import socket
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from typing import Any

from whill_mjx.io.command_line import WRITING, OptionError
from whill_mjx.io.reading import read_json

RUN_FILE = "run.json"
"""Kind and identity of what a folder holds, written once."""
LOCK_FILE = ".lock"
PARTIAL = ".partial-"  # begins the name of a folder that a command has not finished
NOTE = ".{}.written"
"""Name of the note of a single file: a line for each content that a command gave it. While it has one of them, it may
be replaced. Lines are only appended, so that processes that write at once keep each other's."""
SHOWN = 6
"""Differences between two runs that an error names."""
LEAST_FREE = 4_000_000
"""Bytes that must be free where results are written."""
RESULTS = ("report.html", "report.json", "vehicle.toml", "dataset.toml", "policy.json", "policy", "evaluation.json",
           "metrics.jsonl", "checkpoints", "trials")  # fmt: skip
"""Names of results of this project's commands: a folder that has one belongs to somebody."""

_checked: set[Path] = set()
"""Files that this process may replace: their notes are made before they get their names."""


class FolderRefused(OptionError):
    """A folder that this command must not write to; nothing in it was touched."""


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A path to write, of the same ending, that becomes `path` when the block ends well and vanishes otherwise.

    A file that `check_file` has let pass is noted before it gets its name: a kill in between leaves both in order. An
    OSError of the block names `path`.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.tmp{path.suffix}")
    try:
        yield temporary
        with temporary.open("rb") as file:
            os.fsync(file.fileno())
        if path.absolute() in _checked:
            _note(path, _checksum(temporary))
        with WRITING:
            os.replace(temporary, path)
    except BaseException as error:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.strerror:
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file, whole or not at all: it gets its name when all of it is on the disk.

    A text may hold names of files that are not UTF-8; what cannot be written of them becomes a question mark.
    """
    with whole_file(path) as temporary:
        temporary.write_bytes(content.encode(errors="replace") if isinstance(content, str) else content)


def check_file(option: str, path: Path, instead: str = "choose another name") -> None:
    """Raise FolderRefused where a file cannot be written at `path`, or is there and not as a command wrote it.

    `instead`: what the caller may do about a file that is not replaced.
    """
    check_place(option, path)
    if path.is_dir():
        raise FolderRefused(f"{option} {path}: is a folder. Give the name of a file.")
    if path.exists() and not (path.is_file() and _is_noted(path)):
        raise FolderRefused(f"{option} {path}: exists already, and is not as a command of this project wrote it (or an "
                            f"earlier version did, or its note {NOTE.format(path.name)} was lost). It is not replaced: "
                            f"{instead}, or remove it.")
    _checked.add(path.absolute())


def note_written(*paths: Path) -> None:
    """Remember files that were written, so that the same command may replace them while nobody has changed them.

    Only a file that was not written by `whole_file` after `check_file` needs this.
    """
    for path in paths:
        with suppress(OSError):  # a file that is gone again
            _note(path, _checksum(path))


def _note(path: Path, checksum: str) -> None:
    """Note a content of a file; where this cannot be written, the file counts as somebody's."""
    with suppress(OSError):
        note = path.with_name(NOTE.format(path.name))
        if not note.exists() or checksum.encode() not in note.read_bytes():
            with note.open("ab") as file:
                file.write(f"{checksum}\n".encode())


def _is_noted(path: Path) -> bool:
    """Whether a file has a content that a command gave it."""
    try:
        return _checksum(path).encode() in path.with_name(NOTE.format(path.name)).read_bytes()
    except OSError:
        return False


def _checksum(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def check_place(option: str, path: Path, least_free: int = LEAST_FREE) -> None:
    """Raise FolderRefused where nothing could be written at `path`, which need not exist; nothing is created."""
    try:
        _check_place(option, path, least_free)
    except OSError as error:  # a name that is too long, a loop of links
        raise FolderRefused(f"{option} {path}: {error.strerror or error}. Choose another place.") from None


def _check_place(option: str, path: Path, least_free: int) -> None:
    for place in (path.absolute(), *path.absolute().parents):
        if place.name == "trials" and (place.parent / "dataset.toml").exists():
            raise FolderRefused(f"{option} {path}: lies among the trials of {place.parent}. Choose another place.")
    above = path.absolute()
    while not above.exists() and above != above.parent:
        if above.is_symlink():
            raise FolderRefused(f"{option} {path}: {above} is a link to nothing. Choose another place.")
        above = above.parent
    if not above.is_dir():
        if above == path.absolute():
            above = above.parent  # a file that is replaced
        else:
            raise FolderRefused(f"{option} {path}: {above} is a file, not a folder. Choose another place.")
    if not os.access(above, os.W_OK | os.X_OK):
        raise FolderRefused(f"{option} {path}: {above} cannot be written. Choose a place that you may write.")
    free = shutil.disk_usage(above).free
    if free < least_free:
        raise FolderRefused(f"{option} {path}: only {free / 1e6:.1f} MB are free there and at least "
                            f"{least_free / 1e6:.0f} MB are needed. Free some space or choose another place.")


class Claim:
    """A folder that this process holds."""

    def __init__(self, out: Path, kind: str, found: dict[str, Any] | None) -> None:
        """Remember what the folder holds; use `claim_folder`."""
        self.out, self._kind, self._found = out, kind, found

    @property
    def identity(self) -> dict[str, Any] | None:
        """The identity of the run that the folder holds; None for a new one."""
        return None if self._found is None else self._found["identity"]

    def settle(self, identity: Mapping[str, Any], begun: bool = True, **more: Any) -> None:
        """Write the identity once, with more tables beside it; raise FolderRefused where the folder holds another.

        Args:
            identity: name -> JSON value of everything that changes the result. A name that the folder's identity lacks
                is not compared: it is newer than the run.
            begun: whether the folder holds any work yet; before, another identity replaces its own.
            more: tables to write beside the identity.
        """
        identity = json.loads(json.dumps(identity, default=str))
        if self.identity is not None and (begun or self.identity == identity):
            there = self.identity
            differs = [f"{name} is {_short(there[name])} there and {_short(value)} here"
                       for name, value in identity.items() if name in there and there[name] != value]
            if differs:
                more_of_them = f"; and {len(differs) - SHOWN} more" if len(differs) > SHOWN else ""
                raise FolderRefused(f"--out {self.out}: holds another run: {'; '.join(differs[:SHOWN])}{more_of_them}. "
                                    "Choose another --out, or give the old values to go on.")
            return
        self._found = {"kind": self._kind, "identity": identity}
        write_whole(self.out / RUN_FILE, json.dumps({**self._found, **more}, indent=1) + "\n")


@contextmanager
def claim_folder(out: Path, kind: str, outputs: Iterable[str] = (), least_free: int = LEAST_FREE) -> Iterator[Claim]:
    """Hold a folder, which is made if it is new, until the block ends.

    Args:
        out: the folder, as given by --out.
        kind: the command that writes it, such as "whill_mjx.train".
        outputs: names that the command writes. A folder without an identity that has one of them, or any other result
            of this project's commands, is somebody else's.
        least_free: bytes that must be free.

    Raises:
        FolderRefused: it is no folder, cannot be written, is held by another process, or belongs to others.
    """
    check_place("--out", out, least_free)
    if out.exists() and not out.is_dir():
        raise FolderRefused(f"--out {out}: is a file, not a folder. Choose another place.")
    found = read_identity(out, kind)
    if found is None:
        taken = [name for name in dict.fromkeys((*outputs, *RESULTS)) if (out / name).exists()]
        if taken:
            raise FolderRefused(f"--out {out}: holds {taken[0]} of something else, which is not replaced. "
                                "Choose another --out.")
    out.mkdir(parents=True, exist_ok=True)
    with lock_folder(out):
        yield Claim(out, kind, read_identity(out, kind))


@contextmanager
def lock_folder(out: Path, option: str = "--out") -> Iterator[None]:
    """Keep others from writing to a folder until the block ends, and remove what a killed process left half-written.

    Raises:
        FolderRefused: another process writes there.
    """
    from filelock import FileLock, Timeout

    lock = FileLock(out / LOCK_FILE, timeout=0)
    try:
        lock.acquire()
    except Timeout:
        raise FolderRefused(f"{option} {out}: {_owner(out)} writes there. Wait for its end or choose another one."
                            ) from None  # fmt: skip
    try:
        me = {"pid": os.getpid(), "host": socket.gethostname(), "since": datetime.now().isoformat(timespec="seconds")}
        (out / LOCK_FILE).write_text(json.dumps(me) + "\n")
        for leftover in out.glob(".*.tmp*"):
            leftover.unlink(missing_ok=True)
        yield
    finally:
        lock.release()


def read_identity(out: Path, kind: str) -> dict[str, Any] | None:
    """Kind and identity of a folder, None where it has none; raises FolderRefused for those of another command."""
    path = out / RUN_FILE
    if not path.exists():
        return None
    try:
        found = read_json(path, "missing.", "")
        there, identity = found["kind"], dict(found["identity"])
    except (ValueError, OSError, KeyError, TypeError):
        raise FolderRefused(f"--out {out}: {path} does not say which run this is: it is damaged, or of an earlier "
                            "version. Choose another --out.") from None
    if there != kind:
        raise FolderRefused(f"--out {out}: holds results of {_short(there)}, not of {kind}. Choose another --out.")
    return {"kind": there, "identity": identity}


@contextmanager
def new_folder(out: Path) -> Iterator[Path]:
    """A folder to fill, which becomes `out` when the block ends well and vanishes otherwise. `out` must not exist.

    What an earlier process on this machine left when it was killed is removed.
    """
    if out.exists():
        raise FolderRefused(f"--out {out}: exists already and is not replaced. Choose another --out.")
    check_place("--out", out)
    partial = unfinished(out.parent, out.name)
    try:
        partial.mkdir(parents=True)
        yield partial
        with WRITING:
            os.replace(partial, out)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def unfinished(folder: Path, name: str = "") -> Path:
    """A place in `folder` for what this process has not finished; those of processes that were killed are removed."""
    stem = f".{name}.partial-{socket.gethostname()}-" if name else f"{PARTIAL}{socket.gethostname()}-"
    for leftover in folder.glob(f"{stem}*"):
        if not _runs(leftover.name.removeprefix(stem)):
            shutil.rmtree(leftover, ignore_errors=True)
    return folder / f"{stem}{os.getpid()}"


def _runs(pid: str) -> bool:
    """Whether there is such a process; what is no number counts as one, to be left alone."""
    try:
        os.kill(int(pid), 0)
    except ProcessLookupError:
        return False
    except (ValueError, OverflowError, OSError):
        return True
    return True


def _owner(out: Path) -> str:
    """The process that holds a folder, in words."""
    try:
        owner = json.loads((out / LOCK_FILE).read_text())
        return f"process {owner['pid']} on {owner['host']}, since {owner['since']},"
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return "another process"


def _short(value: Any) -> str:
    """A value as text of a readable length."""
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= 60 else text[:57] + "..."

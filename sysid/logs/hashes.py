"""Which data a log was read from."""

import hashlib
from pathlib import Path

from whill_mjx.io.folders import RUN_FILE


def hash_files(folder: Path) -> str:
    """SHA-256 over names and contents of all data files of a dataset."""
    digest = hashlib.sha256()
    results = {path.parent for path in folder.rglob(RUN_FILE)}  # of commands that were given a place in here
    for path in sorted(folder.rglob("*")):
        unfinished = any(part.startswith(".") for part in path.relative_to(folder).parts)  # of a killed conversion
        if unfinished or not results.isdisjoint(path.parents):
            continue
        if path.suffix in (".toml", ".csv", ".npz", ".gz") and path.is_file():
            digest.update(str(path.relative_to(folder)).encode() + b"\0")
            with path.open("rb") as file:
                while part := file.read(1 << 20):
                    digest.update(part)
    return digest.hexdigest()

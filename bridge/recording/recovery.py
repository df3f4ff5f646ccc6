"""Recordings of killed recorders: found in their hidden folders, and made trials."""

import os
from pathlib import Path

from bridge.recording.mcap_file import mend
from bridge.recording.trial_writer import MCAP, PARTIAL


def recover(dataset: Path) -> list[Path]:
    """Give the recordings of killed recorders their place as trials; return their folders.

    Raises:
        ValueError: a trial of that name exists already, or two recordings have one name; then none is touched.
    """
    places: dict[Path, Path] = {}
    for partial in sorted(dataset.glob(".*.partial-*")):
        match = PARTIAL.fullmatch(partial.name)
        if match is None or is_running(int(match["process"])):
            continue
        folder = dataset / "trials" / match["trial"]
        if folder.exists() or folder in places:
            raise ValueError(f"{partial}: cannot become {folder}, which exists already. Rename one of them.")
        places[folder] = partial
    for folder, partial in places.items():
        folder.parent.mkdir(parents=True, exist_ok=True)
        for path in partial.glob("*.csv"):
            drop_torn_row(path)
        for path in partial.glob(MCAP):
            mend(path)
        os.replace(partial, folder)
    return list(places)


def drop_torn_row(path: Path) -> None:
    """Cut a row off that a killed recorder had only begun; every whole row ends with a line feed."""
    content = path.read_bytes()
    whole = content[: content.rfind(b"\n") + 1]
    if len(whole) < len(content):
        temporary = path.with_name(f".{path.name}.tmp")
        temporary.write_bytes(whole)
        os.replace(temporary, path)


def is_running(process: int) -> bool:
    """Return whether a process of this number exists on this computer."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):  # somebody else's, or no number that a process can have: left alone
        return True
    return True

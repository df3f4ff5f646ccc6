"""Merges result files made on another machine into benchmarks/results: `python -m benchmarks.merge FILE.json ...`.

A figure replaces one of the same name only if it was made on the same day or later.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

from benchmarks.harness import RESULTS


def merge(source: Path, results: Path = RESULTS) -> Path:
    """Put the figures of `source` into the file of the same name in `results`; returns that file."""
    target = results / source.name
    content = json.loads(source.read_text())
    if target.exists():
        old = json.loads(target.read_text())
        for name, entry in old["figures"].items():
            new = content["figures"].get(name)
            if new is None or new.get("date", "") < entry.get("date", ""):
                content["figures"][name] = entry
    temporary = target.with_suffix(".tmp")
    temporary.write_text(json.dumps(content, indent=1) + "\n")
    os.replace(temporary, target)
    return target


if __name__ == "__main__":
    for argument in sys.argv[1:]:
        print(merge(Path(argument)))

"""Merges result files made on another machine into benchmarks/results: `python -m benchmarks.merge FILE.json ...`.

A figure replaces one of the same name only if it was made on the same day or later. `--only NAME ...` takes no other.
"""

from __future__ import annotations

import json
import os
from collections.abc import Collection
from pathlib import Path

from benchmarks.harness import RESULTS
from bridge.nodes.options import Parser
from whill_mjx.io.command_line import guarded
from whill_mjx.io.reading import read_json


def merge(source: Path, results: Path = RESULTS, only: Collection[str] = ()) -> Path:
    """Put the figures of `source` (those named, if any) into the file of the same name in `results`; returns that file.

    Raises:
        ValueError: `source` has no figure of a name asked for.
    """
    target = results / source.name
    content = read_json(source, "no such file. Give a result file.", "Give a result file of a benchmark.")
    if not isinstance(content.get("figures"), dict):
        raise ValueError(f"{source}: has no figures. Give a result file of a benchmark.")
    for name, entry in content["figures"].items():
        if not isinstance(entry, dict) or "value" not in entry:
            raise ValueError(f"{source}: figure {name!r} has no value. Give a result file as a benchmark wrote it.")
    if missing := sorted(set(only) - set(content["figures"])):
        raise ValueError(f"{source} has no figure {', '.join(missing)}; it has {', '.join(content['figures'])}.")
    if only:
        content["figures"] = {name: content["figures"][name] for name in only}
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
    with guarded():
        parser = Parser(prog="python -m benchmarks.merge", description=__doc__)
        parser.add_argument("files", type=Path, nargs="+", metavar="FILE")
        parser.add_argument("--only", nargs="+", default=(), metavar="NAME")
        given = parser.parse_args()
        for file in given.files:
            print(merge(file, only=given.only))

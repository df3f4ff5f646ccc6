"""Renews constraints.txt: `python .ci/constraints.py FREEZE_311 FREEZE_312...`, outputs of `pip freeze`.

A file's name ends in its Python version, such as freeze-3.11. Packages with one version everywhere get a plain line;
others one line per range of Python versions.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

HEAD = "# Locked versions for Python {versions}, made with `make constraints`. Names and versions only.\n"


def read(path: Path) -> tuple[str, dict[str, str]]:
    """Python version, and version by package; what was installed from a file is left out."""
    version = re.search(r"(3\.\d+)$", path.name)
    if version is None:
        sys.exit(f"{path}: its name must end in a Python version, such as freeze-3.12.")
    lines = (line.strip() for line in path.read_text().splitlines())
    return version[1], dict(line.split("==", 1) for line in lines if "==" in line and not line.startswith(("#", "-e")))


def merged(frozen: dict[str, dict[str, str]]) -> str:
    """The content of constraints.txt.

    Args:
        frozen: Python version -> package -> version.
    """
    order = sorted(frozen, key=lambda version: tuple(map(int, version.split("."))))
    lines = []
    for name in sorted({name for one in frozen.values() for name in one}, key=str.lower):
        found = {version: frozen[version][name] for version in order if name in frozen[version]}
        if len(set(found.values())) == 1:
            lines.append(f"{name}=={next(iter(found.values()))}")
            continue
        groups: list[list[str]] = []
        for version in found:  # neighbours with one version of the package
            if groups and found[groups[-1][-1]] == found[version]:
                groups[-1].append(version)
            else:
                groups.append([version])
        for k, group in enumerate(groups):
            low = f"python_version >= '{group[0]}'" if k else ""
            high = f"python_version < '{groups[k + 1][0]}'" if k + 1 < len(groups) else ""
            lines.append(f"{name}=={found[group[0]]}; {' and '.join(filter(None, (low, high)))}")
    versions = ", ".join(order[:-1]) + f" and {order[-1]}" if len(order) > 1 else order[0]
    return HEAD.format(versions=versions) + "\n".join(lines) + "\n"


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    Path("constraints.txt").write_text(merged(dict(read(Path(name)) for name in sys.argv[1:])))

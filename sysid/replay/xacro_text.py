"""Expands a xacro file in a process of its own: `python xacro_text.py FILE SECONDS`. What stands in it may never end.

Prints the text, or, with exit code 1, what is wrong. `$(find PACKAGE)` also looks in the folders around the file.
"""

from __future__ import annotations

import resource
import sys
from pathlib import Path

PARENTS = 4  # folders above the file in which packages are looked for
SECONDS, BYTES = 10, 1_500_000_000  # processor time and memory; an arm with all its macros takes a second


def around(folder: Path) -> list[Path]:
    """A folder and those above it in which packages are looked for."""
    return [folder, *list(folder.parents)[:PARENTS]]


def package_folders(folder: Path, package: str) -> list[Path]:
    """Folders of that name, among those around a file, the nearest first."""
    found = []
    for place in around(folder):
        found += [one for one in (place / package, place) if one.name == package and one.is_dir()]
    return found


def expand(path: Path) -> str:
    """The text; errors are those of xacro, which have no common class."""
    import xacro
    from xacro import substitution_args

    installed, folder = substitution_args._eval_find, path.resolve().parent

    def find(package: str) -> str:
        try:
            return str(installed(package))
        except Exception:  # of ROS where it is not sourced, or lacks the package
            for place in package_folders(folder, package):
                return str(place)
            raise ValueError(f"package {package!r} is neither installed nor a folder around the file") from None

    substitution_args._eval_find = find
    return str(xacro.process_file(str(path)).toxml())


def main() -> int:
    """Expand within the limits."""
    seconds = int(sys.argv[2])
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
    resource.setrlimit(resource.RLIMIT_AS, (BYTES, BYTES))
    try:
        text, code = expand(Path(sys.argv[1])), 0
    except BaseException as error:
        text, code = " ".join(str(error).split()) or type(error).__name__, 1
    sys.stdout.buffer.write(text.encode("utf-8", errors="replace"))
    return code


if __name__ == "__main__":
    sys.exit(main())

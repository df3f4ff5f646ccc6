"""Expands a xacro file in a process of its own: `python xacro_text.py FILE SECONDS`. What stands in it may never end.

Prints the text, or, with exit code 1, what is wrong. `$(find PACKAGE)` also looks in the folders around the file.
Files that other packages would include, and their macros, are left out; the error stream has a line for each,
and for each file that was included.
"""

from __future__ import annotations

import re
import resource
import sys
from pathlib import Path
from typing import Any

LEFT_OUT = "left out: "  # begins a line of what was left out
INCLUDED = "included: "  # begins a line with a file that was read
PARENTS = 4  # folders above the file in which packages are looked for
SECONDS, BYTES = 10, 1_500_000_000  # processor time and memory; an arm with all its macros takes a second


def around(folder: Path) -> list[Path]:
    """A folder and those above it in which packages are looked for."""
    return [folder, *list(folder.parents)[:PARENTS]]


def package_folders(folder: Path, package: str) -> list[Path]:
    """Folders of that name, among those around a file, the nearest first."""
    found = []
    for place in around(folder):
        found += [one for one in (place / package, place) if one.is_dir() and package in (one.name, _stated_name(one))]
    return found


def _stated_name(folder: Path) -> str:
    """Name of the package of a folder by its package.xml: a checkout may be called otherwise."""
    try:
        found = re.search(r"<name>\s*([\w.-]+)\s*</name>", (folder / "package.xml").read_text(errors="replace"))
    except OSError:
        return ""
    return found[1] if found else ""


def expand(path: Path, left_out: list[str]) -> str:
    """The text; what is left out is added to a list. Errors are those of xacro, which have no common class."""
    import xacro
    from xacro import substitution_args

    installed, folder = substitution_args._eval_find, path.resolve().parent
    include, call = xacro.process_include, xacro.handle_macro_call

    def find(package: str) -> str:
        try:
            return str(installed(package))
        except Exception:  # of ROS where it is not sourced, or lacks the package
            return next(map(str, package_folders(folder, package)), f"package://{package}")

    def included(element: Any, macros: Any, symbols: Any, evaluate: Any) -> None:
        name = str(xacro.eval_text(element.getAttribute("filename"), symbols))
        if not name.startswith("package://"):
            include(element, macros, symbols, evaluate)
            return
        left_out.append(f"{name} is not found: what it includes is left out")
        xacro.replace_node(element, by=None)

    def called(node: Any, macros: Any, symbols: Any) -> bool:
        try:
            return bool(call(node, macros, symbols))
        except xacro.XacroException as error:
            if not left_out or f"unknown macro name: {node.tagName}" not in str(error):
                raise
        left_out.append(f"macro {node.tagName} is left out with its file")
        xacro.replace_node(node, by=None)
        return True

    substitution_args._eval_find, xacro.process_include, xacro.handle_macro_call = find, included, called
    return str(xacro.process_file(str(path)).toxml())


def main() -> int:
    """Expand within the limits."""
    seconds, left_out = int(sys.argv[2]), list[str]()
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
    resource.setrlimit(resource.RLIMIT_AS, (BYTES, BYTES))
    try:
        text, code = expand(Path(sys.argv[1]), left_out), 0
        sys.stderr.writelines(f"{LEFT_OUT}{one}\n" for one in left_out)
        sys.stderr.writelines(f"{INCLUDED}{one}\n" for one in sys.modules["xacro"].all_includes)
    except BaseException as error:
        said = " ".join(str(error).split()) or type(error).__name__
        text, code = "; ".join([said, *left_out]), 1
    sys.stdout.buffer.write(text.encode("utf-8", errors="replace"))
    return code


if __name__ == "__main__":
    sys.exit(main())

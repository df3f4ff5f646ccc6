"""Lists of a package's commands, as `python -m PACKAGE` shows them."""

from __future__ import annotations

import ast
import sys
from collections.abc import Sequence
from pathlib import Path

from whill_mjx.io.command_line import OptionError, guarded


def first_line(folder: Path, name: str) -> str:
    """The first line of a command's docstring, without what follows a colon."""
    file = folder / f"{name}.py"
    source = (file if file.exists() else folder / name / "__main__.py").read_text(encoding="utf-8")
    return (ast.get_docstring(ast.parse(source)) or "").splitlines()[0].split(": `")[0].rstrip(".")


def list_commands(folder: Path, commands: Sequence[str], width: int) -> None:
    """Print the commands of the package in a folder, a line each. Words are refused: they would do nothing."""
    with guarded():
        for word in sys.argv[1:]:
            if word not in ("-h", "--help"):
                known = word.removeprefix(f"{folder.name}.").replace("-", "_")
                remedy = "Leave it out for the list"
                if known in commands:
                    remedy = f"Type python -m {folder.name}.{known}"
                raise OptionError(f"python -m {folder.name}: {word}: takes no words. {remedy}.")
        for name in commands:
            print(f"python -m {folder.name}.{name:<{width}} {first_line(folder, name)}")
        print("Each has --help.")

"""Lists the commands of this package, a line each: `python -m whill_mjx`."""

from __future__ import annotations

import ast
from pathlib import Path

from whill_mjx.io.command_line import guarded, refuse_words

COMMANDS = ("train", "evaluate", "drive", "look", "view", "maps", "export_mjcf", "export_python")


def first_line(name: str) -> str:
    """The first line of a command's docstring, without what follows a colon."""
    source = (Path(__file__).parent / f"{name}.py").read_text(encoding="utf-8")
    return (ast.get_docstring(ast.parse(source)) or "").splitlines()[0].split(": `")[0].rstrip(".")


def main() -> None:
    """Print the list; refuse words."""
    refuse_words("whill_mjx", COMMANDS)
    for name in COMMANDS:
        print(f"python -m whill_mjx.{name:<14} {first_line(name)}")
    print("Each has --help.")


if __name__ == "__main__":
    with guarded():
        main()

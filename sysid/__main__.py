"""Lists the commands of this package, a line each: `python -m sysid`."""

from __future__ import annotations

import ast
from pathlib import Path

from whill_mjx.io.command_line import guarded, refuse_words

COMMANDS = ("inspect", "convert", "fit", "close_loop", "design", "paper", "searches", "report", "verdict")


def first_line(name: str) -> str:
    """The first line of a command's docstring, without what follows a colon."""
    here = Path(__file__).parent
    file = here / f"{name}.py"
    source = (file if file.exists() else here / name / "__main__.py").read_text(encoding="utf-8")
    return (ast.get_docstring(ast.parse(source)) or "").splitlines()[0].split(": `")[0].rstrip(".")


def main() -> None:
    """Print the list; refuse words."""
    refuse_words("sysid", COMMANDS)
    for name in COMMANDS:
        print(f"python -m sysid.{name:<12} {first_line(name)}")
    print("Each has --help.")


if __name__ == "__main__":
    with guarded():
        main()

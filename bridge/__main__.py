"""Lists the commands of this package, a line each: `python -m bridge`."""

from __future__ import annotations

import ast
import os
import sys
from pathlib import Path

from bridge import COMMANDS


def first_line(name: str) -> str:
    """The first line of a command's docstring, without what follows a colon."""
    source = (Path(__file__).parent / f"{name}.py").read_text(encoding="utf-8")
    return (ast.get_docstring(ast.parse(source)) or "").splitlines()[0].split(": `")[0].rstrip(".")


def main() -> None:
    """Print the list; refuse words, which would do nothing."""
    if words := [word for word in sys.argv[1:] if word not in ("-h", "--help")]:
        known = words[0].removeprefix("bridge.").replace("-", "_")
        remedy = f"Type python -m bridge.{known}" if known in COMMANDS else "Leave it out for the list of commands"
        print(f"python -m bridge: {words[0]}: takes no words. {remedy}.", file=sys.stderr)
        raise SystemExit(2)
    for name in COMMANDS:
        print(f"python -m bridge.{name:<12} {first_line(name)}")
    print("Each has --help.")


if __name__ == "__main__":
    try:
        main()
        sys.stdout.flush()
    except BrokenPipeError:  # nobody reads on, as `| head` does not
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(141) from None

"""Lists the commands of this package, a line each: `python -m whill_mjx`."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from whill_mjx.io import command_list

COMMANDS = ("train", "evaluate", "drive", "look", "view", "maps", "export_mjcf", "export_python")
first_line = partial(command_list.first_line, Path(__file__).parent)

if __name__ == "__main__":
    command_list.list_commands(Path(__file__).parent, COMMANDS, 14)

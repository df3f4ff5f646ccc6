"""Parse every command of ours that pages show, by its own parser: `python tests/parse_commands.py PAGE...`.

Nothing is run: a parser that is content ends the command. What it refuses is printed, a line each.
"""

from __future__ import annotations

import argparse
import contextlib
import re
import runpy
import shlex
import sys
import tempfile
from pathlib import Path

import tyro

OURS = re.compile(r"python -m (?:whill_mjx|sysid|dreamer|bridge|benchmarks)\.[\w.]*\w(?: [^`|]*)?")
FILES = re.compile(r"no such|does not exist|its folder is missing")
"""Refusals of a file of the reader's, who has it."""


class Parsed(BaseException):
    """The parser is content."""


def content(parse):
    """A parser that ends the command where it would return."""

    def parsed(*words, **options):
        parse(*words, **options)
        raise Parsed

    return parsed


def commands(text):
    """Commands with words after the module's name; a name alone is a mention."""
    for line in re.sub("<!--.*?-->", "", text.replace("\\\n", " ")).splitlines():
        for found in OURS.findall(line):
            words = shlex.split(re.split(r" (?:&|#|>|;)|;", found)[0].rstrip(".,;: "))
            if len(words) > 3 and not any("$" in word for word in words):
                yield [word for word in words if word != "..."]


def refusal(words):
    """What the command's parser says against these words, or nothing."""
    sys.argv = words[2:]
    with tempfile.TemporaryFile("w+") as said:  # a file of the system: rclpy asks stderr for its number
        try:
            with contextlib.redirect_stderr(said), contextlib.redirect_stdout(said):
                runpy.run_module(words[2], run_name="__main__", alter_sys=True)
        except Parsed:
            return ""
        except SystemExit as end:
            said.seek(0)
            text = said.read().strip()
            return "" if not end.code or FILES.search(text) else text.splitlines()[-1]
        except ImportError as error:
            return str(error)
    return "it does not parse its words"


if __name__ == "__main__":
    pages = [Path(name) for name in sys.argv[1:]]
    argparse.ArgumentParser.parse_args = content(argparse.ArgumentParser.parse_args)
    tyro.cli = content(tyro.cli)
    seen = set()
    for page in pages:
        for words in commands(page.read_text()):
            if tuple(words) not in seen and (why := refusal(words)):
                print(f"{page}: {' '.join(words)}: {why}")
            seen.add(tuple(words))
    print(len(seen), "commands")

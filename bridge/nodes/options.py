"""Command lines of this package: a mistake ends with one line and exit code 2, and numbers have ranges."""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import signal
import sys
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any, NoReturn

from bridge.nodes import signals
from bridge.nodes.exits import Exit


def ends_at_ctrl_c(main: Callable[[list[str] | None], int]) -> Callable[..., int]:
    """Let a command's `main` return `Exit.STOPPED` after one line where a signal ends it before its node runs."""

    @wraps(main)
    def guarded(arguments: list[str] | None = None) -> int:
        try:
            with signals.heard(interrupt=True) as heard:
                try:
                    return main(arguments)
                except BaseException as error:  # an import may make an ImportError of it
                    if not (heard or isinstance(error, KeyboardInterrupt)):
                        raise
                    which = signals.name_of(heard[0]) if heard else "SIGINT"
        finally:
            if getattr(signal.getsignal(signal.SIGINT), "__module__", "") == "bridge":  # that of a command's start
                signal.signal(signal.SIGINT, signal.SIG_DFL)  # it is over, and its words would be false
        name = getattr(main.__globals__.get("__spec__"), "name", "bridge")
        print(f"{name}: stopped ({which})", file=sys.stderr)
        return Exit.STOPPED

    return guarded


NEGATIVE = re.compile(r"-(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$|-inf$")
"""Words that are numbers below zero, and no options."""


class WithDefaults(argparse.HelpFormatter):
    """A form of --help that shows each default which the text itself does not name."""

    def _get_help_string(self, action: argparse.Action) -> str:
        text, default = action.help or "", action.default
        values = default if isinstance(default, tuple | list) else (default,)
        said = "default" in text or isinstance(default, bool) or default is argparse.SUPPRESS
        if said or not values or any(value is None or value in ("", math.inf) for value in values):
            return text
        return f"{text} (default: {' '.join(str(value).replace('%', '%%') for value in values)})"


class LeftOut(str):
    """An option that keeps its default, as a ROS parameter that is false says; the parser refuses a name it lacks."""


class Parser(argparse.ArgumentParser):
    """An `argparse.ArgumentParser` whose complaint is one line, without the usage; it takes no empty words.

    Options are written out: an abbreviation would not be seen to be given twice, or to win over a ROS parameter.
    """

    def __init__(self, *, formatter_class: type[argparse.HelpFormatter] = WithDefaults, **more: Any) -> None:
        """As argparse's, with `prog` as complaints name it: a module such as `bridge.drive`, or what is typed."""
        super().__init__(formatter_class=formatter_class, allow_abbrev=False, **more)
        self._negative_number_matcher = NEGATIVE  # argparse's own takes -1e-05 and -inf for options

    def _get_formatter(self) -> argparse.HelpFormatter:
        typed = self.prog if self.prog.startswith("python") else f"python -m {self.prog}"
        return self.formatter_class(prog=typed)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Refuse an empty word, which as a path would be the folder that the command is called in; a path whose ~ the
        shell has left as it is; and an option that is given again, where only the last one would count."""
        words = sys.argv[1:] if args is None else list(args)
        left_out = [word for word in words if isinstance(word, LeftOut)]
        if missing := [word for word in left_out if word not in self._option_string_actions]:
            self.error(f"unrecognized arguments: {' '.join(missing)}")
        words = [word for word in words if not isinstance(word, LeftOut)]
        repeatable = {name for one in self._actions if isinstance(one, argparse._AppendAction)
                      for name in one.option_strings}
        names = [word.partition("=")[0] for word in words if word.startswith("--") and word != "--"]
        if again := [name for name in names if names.count(name) > 1 and name not in repeatable]:
            self.error(f"{again[0]}: is given twice. Leave one out")
        for before, word in zip(["", *words], words, strict=False):
            name = word.partition("=")[0] if "=" in word else before
            if word.rpartition("=")[2].startswith("~/") and not name.endswith(("-topic", "-state")):  # a private name
                self.error(f"{word}: the shell has not put your home folder in place of ~. Write it out")
            if not word.strip() or word.startswith("--") and word.endswith("="):
                self.error(f"{before or word or 'the first word'}: an empty word, as of an unset variable. "
                           "Give a value")
        return super().parse_known_args(words, namespace)

    def error(self, message: str) -> NoReturn:
        """Say what is wrong and end with code 2."""
        print(f"{self.prog}: {' '.join(message.split()).rstrip('.')}. See --help.", file=sys.stderr)
        raise SystemExit(int(Exit.REFUSED))


def in_range(
    low: float = -math.inf, high: float = math.inf, kind: type[int] | type[float] = float, infinite: bool = False,
    above: bool = False,
) -> Callable[[str], float]:
    """A type for `add_argument`: a number from `low` to `high`, finite unless `infinite` is set.

    Args:
        low, high: ends of the range.
        kind: int for whole numbers.
        infinite: allow inf.
        above: leave `low` out, as of an age that nothing keeps at zero.
    """

    def read(text: str) -> float:
        try:
            value = kind(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{text!r} is not a {'whole ' if kind is int else ''}number") from None
        if not low <= value <= high or above and value == low or not (infinite or math.isfinite(value)):
            ends = [("above" if above else "at least", low), ("at most", high)]
            rule = " and ".join(f"{word} {end:g}" for word, end in ends if math.isfinite(end))
            raise argparse.ArgumentTypeError(f"{text} must be {rule or 'finite'}")
        return value

    return read


TOPIC = re.compile(r"(~/|/)?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")


def topic_name(text: str) -> str:
    """A type for `add_argument`: the name of a topic as ROS allows it, relative or absolute."""
    if text and not TOPIC.fullmatch(text):  # a default may be none
        raise argparse.ArgumentTypeError(f"{text!r} is no name of a topic. Letters, digits, '_' and '/' make one, like "
                                         "whill/odom")
    return text


def said(error: BaseException) -> str:
    """Return what went wrong with a file or an option in one line, without the number of the system's error."""
    if isinstance(error, OSError) and error.strerror and error.filename is not None:
        return f"{error.filename}: {error.strerror}. Choose another place"
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return " ".join(str(error).split())


def result_file(*keys: str) -> Callable[[str], Path]:
    """A type for `add_argument`: a JSON file that is written in the end, in a folder that exists.

    A file that is there is replaced only where it is an earlier one of its kind: an object with these keys and no more.
    """

    def read(text: str) -> Path:
        path = Path(text)
        if path.is_dir():
            raise argparse.ArgumentTypeError(f"{text} is a folder. Give the name of a file")
        if not os.access(path.absolute().parent, os.W_OK | os.X_OK):
            raise argparse.ArgumentTypeError(f"{text}: its folder is missing or cannot be written. Choose another "
                                             "place")
        if path.exists() and not _is_result(path, keys):
            raise argparse.ArgumentTypeError(f"{text}: exists already, and is no earlier result of this command "
                                             f"({', '.join(keys)}). Choose another name, or remove it")
        return path

    return read


def _is_result(path: Path, keys: tuple[str, ...]) -> bool:
    """Return whether a file holds a JSON object with these keys and no others."""
    try:
        found = json.loads(path.read_bytes()) if path.is_file() else None
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(found, dict) and set(found) == set(keys)


def whole(low: int = 1, high: int = 1_000_000_000) -> Callable[[str], float]:
    """A type for `add_argument`: a whole number from `low` to `high`."""
    return in_range(low, high, int)

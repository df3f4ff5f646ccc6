"""What all commands share: options in their ranges, errors as one line, and an end within two seconds when asked for.

Exit codes: 0 done; 1 a file or the machine is at fault; 2 the command is, and nothing was touched; 130 stopped by a
signal; 141 nobody reads the output any more.
"""

from __future__ import annotations

import dataclasses
import errno
import io
import logging
import math
import os
import re
import select
import signal
import sys
import threading
import typing
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, redirect_stderr
from dataclasses import dataclass
from types import FrameType
from typing import Any

from whill_mjx.io.compiled import keep_compiled
from whill_mjx.io.garbage import search_seldom
from whill_mjx.processor import keep_results_apart, share_results

GRACE_S = 1.2
"""Time from a signal to the end of the process, whatever it computes meanwhile."""
SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
SWALLOWING = "jax._src.xla_bridge"
"""Logger of what starts JAX's devices, which catches any exception of a plugin and logs its traceback."""
STOPPED = "stopped; every file is whole or absent. Give the same command again."
DONE, FAILED, REFUSED, INTERRUPTED, UNREAD = 0, 1, 2, 130, 141
FRAME = " \t-─━│┃╭╮╰╯"
"""Of the boxes that tyro draws."""
REMEDIES = {
    errno.ENOSPC: "Free some space or choose another place.",
    errno.EDQUOT: "Free some space or choose another place.",
    errno.EFBIG: "The limit on file sizes is reached; raise it or choose another place.",
    errno.EACCES: "Choose a place that you may read and write.",
    errno.EPERM: "Choose a place that you may read and write.",
    errno.EROFS: "Choose a place that can be written.",
    errno.EISDIR: "Give a file, not a folder.",
    errno.ENOTDIR: "A part of the path is a file; choose another place.",
    errno.EEXIST: "Choose another place.",
    errno.ENAMETOOLONG: "Choose a shorter name.",
    errno.ENOENT: "Correct the path.",
}

NO_NUMBER = re.compile(r"Error parsing (\S+): .*?(?:with base 10|string to float): '([^']*)'")
"""tyro's words for an option that takes a number, and the word that is none."""

WRITING = threading.RLock()
"""Held while a file or a folder gets its final name; the process does not end meanwhile."""


class OptionError(ValueError):
    """A command that cannot be meant: it names the option, its value, the rule and the remedy."""


@dataclass(frozen=True)
class Range:
    """Where a numeric option must lie; for `typing.Annotated`. Every number must be finite, with or without a range."""

    low: float = -math.inf
    high: float = math.inf
    above: bool = False
    """The lower limit itself is excluded."""
    below: bool = False
    """The upper limit itself is excluded."""

    def holds(self, value: float) -> bool:
        """Whether a value lies within."""
        if not math.isfinite(value):
            return False
        low = self.low < value if self.above else self.low <= value
        return low and (value < self.high if self.below else value <= self.high)

    def __str__(self) -> str:
        low = f"{'above' if self.above else 'at least'} {self.low}" if math.isfinite(self.low) else ""
        high = f"{'below' if self.below else 'at most'} {self.high}" if math.isfinite(self.high) else ""
        return " and ".join(part for part in (low, high) if part) or "a finite number"


@dataclass(frozen=True)
class With:
    """An option that has an effect only beside another one; for `typing.Annotated`."""

    option: str
    """Name of the other field."""
    values: tuple[Any, ...] = ()
    """Those of its values that serve; none: any that is not empty, false or None."""

    def serves(self, options: Any) -> bool:
        """Whether the other option is as it must be."""
        value = getattr(options, self.option)
        return value in self.values if self.values else bool(value)

    def __str__(self) -> str:
        values = " or ".join(map(str, self.values))
        return f"--{self.option.replace('_', '-')} {values}".strip()


COUNT = Range(1, 10**12)
"""At least one of something, and no more than 64 bits count."""
NOT_NEGATIVE = Range(0)
POSITIVE = Range(0, above=True)
SHARE = Range(0, 1)
SEED = Range(0, 2_000_000_000)
"""Seeds are added to others in 32 bits."""
PHYSICS_DT = Range(1e-4, 0.05)
"""Physics steps [s] at which the drive's controller and the wheels' slip are stable."""


def check_range(option: str, value: Any, allowed: Range, default: Any = None) -> None:
    """Raise OptionError unless the number, or every number of the sequence, lies within; None and text pass."""
    for number in value if isinstance(value, (tuple, list)) else (value,):
        if isinstance(number, bool) or not isinstance(number, (int, float)) or allowed.holds(number):
            continue
        hint = "" if default in (None, ()) else f" for {default}"
        raise OptionError(f"{option} {number}: must be {allowed}. Correct it, or leave the option out{hint}.")


def check_known(option: str, value: str, known: Iterable[str]) -> None:
    """Raise OptionError, with all known names, for another one."""
    names = list(known)
    if value not in names:
        raise OptionError(f"{option} {value}: unknown (known: {', '.join(names)}). Correct the name.")


def check_once(option: str, values: Sequence[Any]) -> None:
    """Raise OptionError where one of the values is there twice."""
    for index, value in enumerate(values):
        if value in values[:index]:
            raise OptionError(f"{option} {value}: is given twice. Leave one out.")


@contextmanager
def refusing() -> Iterator[None]:
    """Turn a ValueError or FileNotFoundError of the block into OptionError: nothing was touched yet."""
    try:
        yield
    except OptionError:
        raise
    except (ValueError, FileNotFoundError) as error:
        raise OptionError(one_line(error)) from error


def check_options(options: Any, prefix: str = "") -> None:
    """Raise OptionError for the first number of an options dataclass that is not finite or not in its `Range`, and for
    an option without effect (`With`)."""
    hints = typing.get_type_hints(type(options), include_extras=True)
    for field in dataclasses.fields(options):
        value, hint = getattr(options, field.name), hints[field.name]
        name, marks = prefix + field.name.replace("_", "-"), getattr(hint, "__metadata__", ())
        if dataclasses.is_dataclass(value):
            check_options(value, f"{name}.")
        else:
            if _is_list(hint.__origin__ if marks else hint):
                check_once(f"--{name}", value)
            allowed = next((mark for mark in marks if isinstance(mark, Range)), Range())
            check_range(f"--{name}", value, allowed, _default(field))
        for mark in marks:
            if isinstance(mark, With) and value != _default(field) and not mark.serves(options):
                raise OptionError(f"--{name}: has an effect only with {mark}. Add that, or leave this out.")


def _default(field: dataclasses.Field[Any]) -> Any:
    """The default of an option; None where it has none."""
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return None if field.default is dataclasses.MISSING else field.default


def run(
    options: type, main: Callable[[Any], Any], description: str | None, *, stopped: str = STOPPED,
    positional: bool = True, args: list[str] | None = None,
) -> None:  # fmt: skip
    """Read `options` from the command line, check them and call `main`; what goes wrong ends with one line.

    What XLA compiles is kept for later runs (`whill_mjx.io.compiled`).

    Args:
        options: dataclass of the options; numbers may be Annotated with a `Range`. Its `shares_results`, if it has one,
            says whether the command may use `share_results`; JAX must not have started before.
        main: gets the options.
        description: the command's help.
        stopped: the line after a signal, which says how to go on.
        positional: options without a default are given without their names.
        args: words instead of those of the command line.
    """
    with guarded(stopped):
        chosen = _parsed(options, description, positional, args)
        check_options(chosen)
        (share_results if getattr(chosen, "shares_results", True) else keep_results_apart)()
        keep_compiled()
        search_seldom()
        main(chosen)


@contextmanager
def guarded(stopped: str = STOPPED) -> Iterator[None]:
    """End the process with one line and its exit code where the block goes wrong, or a signal comes.

    Args:
        stopped: the line after a signal, which says how to go on.
    """
    listen()
    _State.stopped = stopped
    if isinstance(sys.stdout, io.TextIOWrapper):  # names of files that are not UTF-8, signs that a terminal lacks
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        _State.working = True  # from here on a signal is caught below
        yield
        sys.stdout.flush()
    except KeyboardInterrupt:
        leave(stopped)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # else Python complains about it at its end
        raise SystemExit(UNREAD) from None
    except OptionError as error:
        _end(REFUSED, error)
    except (ValueError, OSError, MemoryError) as error:
        _end(FAILED, error)
    except RuntimeError as error:
        if "RESOURCE_EXHAUSTED" not in str(error):  # XLA's word for a device without memory
            raise
        _end(FAILED, MemoryError())
    finally:
        _State.working = False
        _stop_listening()


def starts(module: str) -> bool:
    """Whether this process was started for a module, given as its `__name__`: by `python -m`, or as its console script,
    whose name is that of the module, such as sysid-close-loop. A command asks before its slow imports."""
    package, _, name = module.partition(".")
    script = f"{package.removesuffix('_mjx')}-{name}".replace("_", "-")
    return module == "__main__" or os.path.basename(sys.argv[0] if sys.argv else "") == script


def program() -> str:
    """This command as it is typed: `python -m MODULE`, or the name of the console script."""
    spec = getattr(sys.modules.get("__main__"), "__spec__", None)
    return f"python -m {spec.name.removesuffix('.__main__')}" if spec else os.path.basename(sys.argv[0])


def _join_lines_of_help(options: type) -> None:
    """Let --help wrap a field's docstring as one text. tyro takes an indented line of it for a new paragraph."""
    import tyro
    from docstring_parser import parse_from_object

    texts = {one.arg_name: one.description or "" for one in parse_from_object(options).params}
    for name, hint in typing.get_type_hints(options, include_extras=True).items():
        marks = getattr(hint, "__metadata__", ())
        if dataclasses.is_dataclass(inner := hint.__origin__ if marks else hint):
            _join_lines_of_help(typing.cast(type, inner))
        elif "\n" in texts.get(name, ""):
            options.__annotations__[name] = typing.Annotated[hint, tyro.conf.arg(help=" ".join(texts[name].split()))]


def _parsed(options: type, description: str | None, positional: bool, args: list[str] | None) -> Any:
    """The options of the command line; what tyro finds wrong in them becomes one line."""
    import tyro

    words = sys.argv[1:] if args is None else args
    _join_lines_of_help(options)
    check_words(words)
    check_lists(options, words)
    config = (tyro.conf.PositionalRequiredArgs,) if positional else ()
    with redirect_stderr(io.StringIO()) as complaint:
        try:
            return tyro.cli(options, prog=program(), description=description, config=config, args=args)
        except SystemExit as ended:
            if ended.code in (0, None):
                raise
    lines = [line.strip(FRAME) for line in complaint.getvalue().splitlines()]
    text = " ".join(line for line in lines[1:] if line).split("For full helptext")[0].strip()
    if number := NO_NUMBER.match(text):
        kind = "whole number, in digits alone" if "int()" in text else "number"
        raise OptionError(f"{number[1]} {number[2]}: must be a {kind}. Correct it. See --help.")
    if text.startswith("Error parsing"):
        text = text.split("Argument helptext:")[0].strip()
    raise OptionError(f"{text.rstrip('.')}. See --help.")


def check_words(words: Sequence[str]) -> None:
    """Refuse an empty word, which as a path would be the folder that the command is called in; a path whose ~ the shell
    has left as it is; and an option that is given again: only the last one would count.

    Raises:
        OptionError: the option before the word, or the option itself.
    """
    seen: set[str] = set()
    for before, word in zip(["", *words], words, strict=False):
        name, equals, value = word.partition("=") if word.startswith("--") else ("", "", word)
        option = name or (before if before.startswith("--") else "the command line")
        if not word.strip() or equals and not value.strip():
            raise OptionError(f"{option}: an empty word, as of a shell variable that is not set. Give a value.")
        if value.startswith("~/"):
            raise OptionError(f"{option} {value}: the shell has not put your home folder in place of ~. Write it out.")
        known = name.replace("_", "-").replace("--no-", "--", 1)
        if known in seen:
            raise OptionError(f"{name}: is given twice. Leave one out; several values go behind one {name}.")
        seen |= {known} - {"", "--"}


def check_lists(options: type, words: Sequence[str]) -> None:
    """Refuse an option that takes any number of values and has none, as of a shell variable that is not set.

    Raises:
        OptionError: the option.
    """
    hints = typing.get_type_hints(options)
    lists = {f"--{name}".replace("_", "-") for name, hint in hints.items() if _is_list(hint)}
    for word, after in zip(words, [*words[1:], "--"], strict=False):
        if word.replace("_", "-") in lists and after.startswith("--"):
            raise OptionError(f"{word}: none is given. Give a value, or leave the option out.")


def _is_list(hint: Any) -> bool:
    """Whether an option of this type takes any number of values."""
    return typing.get_origin(hint) is tuple and typing.get_args(hint)[-1] is Ellipsis


def one_line(error: BaseException) -> str:
    """An error as one line: what is wrong, where, and what to do; notes of the error follow."""
    text = str(error)
    if isinstance(error, OSError) and error.strerror:
        place = f"{error.filename}: " if error.filename is not None else ""
        text = f"{place}{error.strerror}. {REMEDIES.get(error.errno or 0, 'Try again or choose another place.')}"
    elif isinstance(error, MemoryError):
        text = "out of memory. Ask for less at a time."
    notes = [note for note in getattr(error, "__notes__", ()) if not note.startswith("----")]  # of JAX, on its frames
    return " ".join(" ".join([text, *notes]).split())


def _end(code: int, error: BaseException) -> None:
    line = f"error: {one_line(error)}"
    print(line, file=sys.stderr, flush=True)
    ended = SystemExit(line)
    ended.code = code
    raise ended from None


class _State:
    """Of this process: signals are the process's own."""

    working = False
    """`run` has begun; before, a signal ends the imports at once."""
    stopped = "stopped before the work began."
    signal = "no signal"
    """Name of the one that stopped the work."""
    before: dict[int, Any] = {}
    """Handlers that were there before."""
    hook: Callable[[Any], Any] = sys.__unraisablehook__
    """For exceptions that cannot be raised, as it was before."""
    wakeup: tuple[int, int] | None = None
    held: Any = None
    """Mask of signals before a fork that is under way."""
    leaving = threading.Lock()


def listen() -> None:
    """Let a signal end this process with one line and exit code 130, also while no Python code runs.

    The handler raises KeyboardInterrupt, so that the work can keep what it has. A thread, woken by the operating system
    itself, ends the process after `GRACE_S`, or at a second signal. A command calls this before its slow imports.
    """
    if _State.wakeup is not None or threading.current_thread() is not threading.main_thread():
        return
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    for number in SIGNALS:
        before = signal.getsignal(number)
        if before == signal.SIG_IGN:
            continue  # of nohup, or of a job that a script put into the background: Ctrl-C is not meant for it
        _State.before[number] = before
        signal.signal(number, _interrupt)
    signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    _State.wakeup = reader, writer
    _State.hook, sys.unraisablehook = sys.unraisablehook, _unraisable
    logging.getLogger(SWALLOWING).addFilter(_is_news)
    threading.Thread(target=_watch, args=(reader,), daemon=True, name="signals").start()


def _interrupt(number: int, frame: FrameType | None) -> None:
    _State.signal = signal.Signals(number).name
    if not _State.working:
        leave(_State.stopped)
    raise KeyboardInterrupt


def _is_news(record: logging.LogRecord) -> bool:
    """Whether a library logs anything but an interrupt that it caught: then the watching thread ends the process."""
    return not (record.exc_info and record.exc_info[0] is KeyboardInterrupt)


def _unraisable(what: Any) -> None:
    """Show an exception that Python cannot raise, such as one in a callback of its garbage collection; an interrupt is
    no news: the watching thread ends the process."""
    if what.exc_type is not KeyboardInterrupt:
        _State.hook(what)


def _watch(reader: int) -> None:
    """End the process some time after the first signal that comes through the pipe; 0 ends the watch."""
    while (number := (os.read(reader, 1) or b"\0")[0]) not in SIGNALS:
        if number == 0:
            os.close(reader)
            return
    _State.signal = signal.Signals(number).name
    select.select([reader], [], [], GRACE_S)
    WRITING.acquire(timeout=0.2)
    leave(_State.stopped, flush=False)


def leave(line: str, flush: bool = True) -> None:
    """Print the line with the name of the signal, and end the process with exit code 130; no thread is waited for."""
    if not _State.leaving.acquire(blocking=False):
        threading.Event().wait()  # the other thread ends the process
    if flush:
        try:
            sys.stdout.flush()
            sys.stderr.flush()
        except (OSError, ValueError):
            pass  # nobody reads them
    if "multiprocessing" in sys.modules:
        for child in sys.modules["multiprocessing"].active_children():
            child.kill()
    begin = "" if flush else "\n"  # a bar may stand on the line of the cursor
    try:
        os.write(2, f"{begin}{line} ({_State.signal})\n".encode())
    finally:
        os._exit(INTERRUPTED)


def _stop_listening() -> None:
    """Give the signals back: `run` may be one call of several in a process, as in tests."""
    if _State.wakeup is None:
        return
    _, writer = _State.wakeup
    signal.set_wakeup_fd(-1)
    sys.unraisablehook = _State.hook
    for number, before in _State.before.items():
        signal.signal(number, before)
    os.write(writer, b"\0")
    os.close(writer)
    _State.before, _State.wakeup = {}, None


def _hold_signals() -> None:
    """Before a fork: a signal to the child must not come through the pipe that it shares with this process."""
    if _State.wakeup is not None:
        _State.held = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)


def _let_signals_come() -> None:
    if _State.held is not None:
        held, _State.held = _State.held, None
        signal.pthread_sigmask(signal.SIG_SETMASK, held)


def _forget() -> None:
    """A forked child has handlers of its own."""
    if _State.wakeup is not None:
        signal.set_wakeup_fd(-1)
        for number in _State.before:
            signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
        _State.before, _State.wakeup = {}, None
    _let_signals_come()


os.register_at_fork(before=_hold_signals, after_in_parent=_let_signals_come, after_in_child=_forget)

"""What all commands share: options in their ranges, errors as one line, and an end soon after a signal."""

from __future__ import annotations

import io
import signal
import subprocess
import sys
import textwrap
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import pytest

from whill_mjx.io import command_line
from whill_mjx.io.command_line import COUNT, SHARE, OptionError, Range, check_known, check_options, run

pytestmark = pytest.mark.quick


@dataclass(frozen=True)
class Levels:
    position: Annotated[float, Range(0)] = 0.1


@dataclass(frozen=True)
class Options:
    steps: Annotated[int | None, COUNT] = None
    share: Annotated[float, SHARE] = 0.5
    lr: float = 1e-3
    seeds: tuple[int, ...] = (0,)
    name: str = "a"
    levels: Levels = field(default_factory=Levels)


@pytest.mark.parametrize("words, told", [
    (["--steps", "0"], r"--steps 0: must be at least 1 "),
    (["--share", "1.5"], r"--share 1\.5: must be at least 0 and at most 1\. .* for 0\.5\."),
    (["--lr", "nan"], "--lr nan: must be a finite number"),
    (["--lr", "-inf"], "--lr -inf: must be a finite number"),
    (["--levels.position", "nan"], r"--levels\.position nan: must be at least 0"),
])  # fmt: skip
def test_a_number_out_of_its_range_ends_with_one_line_and_code_2(words, told, capsys):
    with pytest.raises(SystemExit, match=told) as ended:
        run(Options, lambda options: pytest.fail("begun"), None, args=words)
    assert ended.value.code == command_line.REFUSED
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize("words, told", [
    (["--steps", "many"], "--steps"), (["--nope", "1"], "--nope"), (["--share"], "--share"),
    (["--steps", "1.5"], "--steps"),
])  # fmt: skip
def test_words_that_are_no_options_end_with_one_line_and_code_2(words, told, capsys):
    with pytest.raises(SystemExit) as ended:
        run(Options, lambda options: pytest.fail("begun"), None, args=words)
    line = capsys.readouterr().err
    assert ended.value.code == command_line.REFUSED and line.count("\n") == 1
    assert line.startswith("error: ") and told in line and line.endswith("See --help.\n")


def test_help_is_printed_as_it_is(capsys):
    with pytest.raises(SystemExit) as ended:
        run(Options, lambda options: pytest.fail("begun"), "What it does.", args=["--help"])
    printed = capsys.readouterr()
    assert ended.value.code == 0 and "What it does." in printed.out and "--levels.position" in printed.out


def test_numbers_in_their_ranges_pass_and_so_does_a_number_that_is_left_out():
    check_options(Options())
    check_options(Options(steps=1, share=1.0, seeds=(3, 4)))
    with pytest.raises(OptionError, match="--seeds nan"):
        check_options(Options(seeds=(1, float("nan"))))


def test_an_unknown_name_is_refused_with_the_known_ones():
    with pytest.raises(OptionError, match=r"--scene nope: unknown \(known: a, b\)"):
        check_known("--scene", "nope", ("a", "b"))
    check_known("--scene", "b", ("a", "b"))


@pytest.mark.parametrize("error, line", [
    (ValueError("file x: bad\nvalue"), "error: file x: bad value"),
    (OSError(28, "No space left on device", "out/report.json"),
     "error: out/report.json: No space left on device. Free some space or choose another place."),
    (NotADirectoryError(20, "Not a directory", "a/b"),
     "error: a/b: Not a directory. A part of the path is a file; choose another place."),
    (FileNotFoundError("no such log"), "error: no such log"),
    (RuntimeError("RESOURCE_EXHAUSTED: 9 GB"), "error: out of memory. Ask for less at a time."),
])  # fmt: skip
def test_what_goes_wrong_outside_the_program_ends_with_one_line_and_code_1(error, line, capsys):
    def fail(options):
        raise error

    with pytest.raises(SystemExit) as ended:
        run(Options, fail, None, args=[])
    assert ended.value.code == command_line.FAILED and capsys.readouterr().err == line + "\n"


def test_what_was_kept_is_part_of_the_line(capsys):
    def fail(options):
        error = OSError(28, "No space left on device", "x")
        error.add_note("The fit is in memory.json.")
        raise error

    with pytest.raises(SystemExit, match="place. The fit is in memory.json.$"):
        run(Options, fail, None, args=[])


def test_a_fault_of_the_program_keeps_its_traceback():
    def fail(options):
        raise KeyError("x")

    with pytest.raises(KeyError):
        run(Options, fail, None, args=[])


def started(body, first="", before=(), **options):
    """A process that runs this as its command's `main`, when it has said that it has begun.

    `first` comes before its imports; `before` are the words of a program that starts it.
    """
    text = textwrap.dedent(first) + textwrap.dedent("""
        import sys, time
        from dataclasses import dataclass
        from whill_mjx.io.command_line import run
        @dataclass
        class Options:
            pass
        def main(options):
        {body}
        if __name__ == "__main__":
            run(Options, main, None, stopped="stopped; go on so.", args=[])
        """).format(body=textwrap.indent(textwrap.dedent(body), "    "))  # fmt: skip
    words = [*before, "-c", text] if before else [sys.executable, "-c", text]
    child = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
                             cwd=Path(__file__).parents[2], **options)  # fmt: skip
    assert child.stdout.readline() == "begun\n", child.stderr.read()
    return child


def ended(child, number):
    """Exit code and stderr of a process after a signal."""
    child.send_signal(number)
    _, text = child.communicate(timeout=60)
    return child.returncode, text.strip()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_work_with_one_line_and_what_it_cleans_up_is_done(number, tmp_path):
    child = started(f"""
        try:
            print("begun", flush=True); time.sleep(60)
        finally:
            open({str(tmp_path / "kept")!r}, "w").close()
        """, first="""
        from whill_mjx.io import command_line
        command_line.GRACE_S = 60.0  # a paused process would otherwise be ended before it has cleaned up
        """)  # fmt: skip
    assert ended(child, number) == (130, f"stopped; go on so. ({signal.Signals(number).name})")
    assert (tmp_path / "kept").exists()


COMPILES = """
    import jax, jax.numpy as jnp
    def long(x):
        for i in range(3000):
            x = jnp.sin(x) @ jnp.cos(x + i)
        return x
    lowered = jax.jit(long).lower(jnp.ones((8, 8)))
    print("begun", flush=True)
    lowered.compile()
    open("{after}", "w").close()
"""
SWALLOWS = """
    print("begun", flush=True)
    for _ in range(2):
        try:
            time.sleep(60)
        except KeyboardInterrupt:
            pass
    open("{after}", "w").close()
"""


LOGS = """
    import logging
    print("begun", flush=True)
    try:  # as JAX does where it looks for its plugins
        time.sleep(60)
    except BaseException:
        logging.getLogger("jax._src.xla_bridge").exception("a plugin failed")
    time.sleep(60)
    open("{after}", "w").close()
"""


COLLECTS = """
    import gc
    gc.callbacks.append(lambda phase, about: time.sleep(0.2))
    print("begun", flush=True)
    for _ in range(100):
        gc.collect()
    open("{after}", "w").close()
"""


@pytest.mark.parametrize("body", [COMPILES, SWALLOWS, LOGS, COLLECTS], ids=[
    "XLA compiles", "the work swallows the interrupt", "a library logs the interrupt", "Python collects garbage"])
def test_a_signal_ends_the_process_where_no_handler_can(body, tmp_path):
    after = tmp_path / "after"
    assert ended(started(body.format(after=after)), signal.SIGINT) == (130, "stopped; go on so. (SIGINT)")
    assert not after.exists()


def test_a_signal_just_before_the_work_ends_with_one_line_too():
    child = started("pass", first="""
        import io, sys, time
        class Slow(io.TextIOWrapper):
            def reconfigure(self, **options):
                if "errors" in options:
                    print("begun", flush=True); time.sleep(60)
        sys.stdout = Slow(sys.stdout.detach(), write_through=True)
        """ + "\n")
    assert ended(child, signal.SIGINT) == (130, "stopped; go on so. (SIGINT)")


def test_a_signal_that_is_ignored_stays_so(tmp_path):
    """As of nohup, and of a job in the background of a script, which Ctrl-C is not meant for."""
    after = tmp_path / "after"
    body = f"""
        print("begun", flush=True); sys.stdin.readline()
        open({str(after)!r}, "w").close()
        """
    ignoring = [sys.executable, "-c", "import os, signal, sys\n"
                "for number in (signal.SIGINT, signal.SIGHUP):\n    signal.signal(number, signal.SIG_IGN)\n"
                "os.execv(sys.executable, [sys.executable, *sys.argv[1:]])"]  # fmt: skip
    child = started(body, before=ignoring, stdin=subprocess.PIPE)
    child.send_signal(signal.SIGINT)
    child.send_signal(signal.SIGHUP)
    assert child.communicate("\n", timeout=60)[1] == "" and child.returncode == 0 and after.exists()


def test_a_signal_to_a_forked_child_ends_the_child_alone():
    child = started("""
        import os, signal
        pid = os.fork()
        if pid == 0:
            time.sleep(60)
        print("begun", os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == -signal.SIGTERM, sep="\\n", flush=True)
        """, first="""
        import os, signal, warnings
        warnings.simplefilter("ignore", DeprecationWarning)  # Python 3.12 advises against a fork among threads
        os.register_at_fork(after_in_child=lambda: os.kill(os.getpid(), signal.SIGTERM))  # it comes before all else
        """)  # fmt: skip
    assert child.stdout.read() == "True\n" and child.wait() == 0 and not child.stderr.read()


def test_output_that_nobody_reads_ends_the_command_quietly():
    child = started("""
        print("begun", flush=True)
        time.sleep(0.2)
        for _ in range(100000):
            print("x" * 100)
        """)
    child.stdout.close()
    assert child.stderr.read() == "" and child.wait() == command_line.UNREAD


def test_what_the_terminal_cannot_show_does_not_end_the_work(monkeypatch):
    shown = io.BytesIO()
    monkeypatch.setattr("sys.stdout", io.TextIOWrapper(shown, encoding="ascii"))
    run(Options, lambda options: print("\u65e5 caf\udce9"), None, args=[])
    assert shown.getvalue() == b"\\u65e5 caf\\udce9\n"

"""The tutorials of docs/tutorials: run their code, or write them as notebooks.

    python -m benchmarks.tutorials run [--out FOLDER]      all in a row, as they are written, in a folder of their own
    python -m benchmarks.tutorials run --notebooks         the same as Jupyter notebooks (needs jupytext and nbclient)
    python -m benchmarks.tutorials run --record            writes the seconds of each, and those that all cores together
                                                           computed, to benchmarks/results/people.json
    python -m benchmarks.tutorials notebooks --out FOLDER  Jupyter notebooks of the same pages (needs jupytext)

A block ```python or ```sh of a page is run, any other is only shown. A comment before a block changes it in tests:

    <!-- in tests: --episodes 100 => --episodes 4 -->
    <!-- in make test: left out -->
    <!-- in tests: left out -->
"""

from __future__ import annotations

import argparse
import contextlib
import os
import re
import runpy
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bridge.nodes.options import Parser
from whill_mjx.io.command_line import guarded

ROOT = Path(__file__).parent.parent
TUTORIALS = ROOT / "docs" / "tutorials"
NUMBERED = "[0-9]_*.md"
BLOCK = re.compile(r"((?:^<!--.*?-->\n)*)^```(python|sh)\n(.*?)^```$", re.DOTALL | re.MULTILINE)

LEFT_OUT = "in tests: left out"
CLAIM = "A newcomer gets results soon, and the tutorials run as they are written"

KERNEL = """---
jupyter:
  kernelspec: {name: python3, display_name: Python 3, language: python}
---

"""
"""Head of a notebook's text: else jupytext takes the language of most blocks, which may be sh."""


@dataclass(frozen=True)
class Block:
    """One block of code of a page."""

    language: str
    """python or sh."""
    code: str
    line: int
    """Of the page, where the code begins."""
    changes: tuple[tuple[str, str], ...] = ()
    """Texts that tests replace: (old, new)."""
    quick: bool = True
    """Whether the quick run of the tests has it."""
    tested: bool = True
    """Whether tests have it; it may need a robot, or a file of the reader's."""

    @property
    def in_tests(self) -> str:
        """The code with the sizes of a test."""
        code = self.code
        for old, new in self.changes:
            code = code.replace(old, new)
        return code


def blocks(page: Path) -> list[Block]:
    """The blocks of a page that are run, in their order.

    Raises:
        ValueError: a comment that is no change, or a change of a text that its block does not have.
    """
    text, found = page.read_text(encoding="utf-8"), []
    for match in BLOCK.finditer(text):
        comments = re.findall(r"<!-- *(.*?) *-->", match[1])
        changes = [
            tuple(comment.removeprefix("in tests: ").split(" => "))
            for comment in comments
            if comment.startswith("in tests: ") and comment != LEFT_OUT
        ]
        line = text[: match.start(3)].count("\n") + 1
        for change in changes:
            if len(change) != 2 or change[0] not in match[3]:
                raise ValueError(f"{page.name}, line {line}: the block has no {change[0]!r}. Correct the comment.")
        found.append(
            Block(
                match[2],
                match[3],
                line,
                tuple((old, new) for old, new in changes),
                "in make test: left out" not in comments,
                LEFT_OUT not in comments,
            )
        )
    return found


@contextlib.contextmanager
def workplace(folder: Path) -> Iterator[Path]:
    """Be in a folder that has the shipped data at its usual place, as a clone of the repository has."""
    (folder / "sysid").mkdir(parents=True, exist_ok=True)
    (folder / "runs").mkdir(exist_ok=True)
    if not (folder / "sysid" / "data").exists():
        (folder / "sysid" / "data").symlink_to(ROOT / "sysid" / "data")
    with contextlib.chdir(folder):
        yield folder


def run_page(page: Path, tests: bool = False, quick: bool = False) -> None:
    """Run the blocks of a page in the current folder; the Python blocks share their names.

    Args:
        page: a Markdown file.
        tests: with the sizes of a test.
        quick: leave out what the quick run does not have, and run our commands in this process.

    Raises:
        RuntimeError: a block failed; the message names page and line.
    """
    names: dict[str, Any] = {"__name__": "__main__"}
    for block in blocks(page):
        if quick and not block.quick or tests and not block.tested:
            continue
        code = block.in_tests if tests else block.code
        where = f"{page.name}, line {block.line}"
        try:
            if block.language == "python":
                exec(compile("\n" * (block.line - 1) + code, str(page), "exec", dont_inherit=True), names)
            elif quick:
                for line in code.replace("\\\n", " ").splitlines():
                    run_here(line)
            else:
                run_shell(code)
        except Exception as error:
            raise RuntimeError(f"{where}: {type(error).__name__}: {error}") from error


def run_here(line: str) -> None:
    """Run `python -m MODULE ARGUMENTS` in this process, which has imported and compiled much already."""
    words = shlex.split(line, comments=True)
    if not words:
        return
    if words[:2] != ["python", "-m"]:
        raise ValueError(f"{line!r}: the quick run knows only python -m MODULE.")
    arguments, sys.argv = sys.argv, words[2:]
    try:
        runpy.run_module(words[2], run_name="__main__", alter_sys=True)
    except SystemExit as end:
        if end.code:
            raise RuntimeError(f"{line!r} ended with {end.code}.") from None
    finally:
        sys.argv = arguments


def surroundings() -> dict[str, str]:
    """The environment in which `python` is this Python with this repository."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    python_path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep)
    return {**os.environ, "PATH": path, "PYTHONPATH": python_path, "VIRTUAL_ENV": sys.prefix}


def run_shell(code: str) -> None:
    """Run lines in bash with this Python and this repository; the first that fails ends them, and nothing stays."""
    command = ["bash", "-e", "-o", "pipefail", "-c", code]
    process = subprocess.Popen(command, env=surroundings(), start_new_session=True)
    try:
        status = process.wait()
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGTERM)  # what the lines left running in the background
    if status:
        raise RuntimeError(f"bash ended with {status}.")


def pages() -> list[Path]:
    """The tutorials in their order."""
    return sorted(TUTORIALS.glob(NUMBERED))


def notebook_text(page: Path, tests: bool = False) -> str:
    """A page as jupytext reads it: without comments for tests, with pictures and links from where it lies."""
    text = page.read_text(encoding="utf-8")
    for block in blocks(page) if tests else ():
        text = text.replace(block.code, block.in_tests)
    text = re.sub(r"^<!-- in .*?-->\n", "", text, flags=re.MULTILINE)
    text = re.sub(r"^```sh\n", "```sh\nset -e\n", text, flags=re.MULTILINE)  # else only a cell's last line can fail
    parts = re.split(r"(^```.*?^```)", text, flags=re.DOTALL | re.MULTILINE)

    def moved(match: re.Match[str]) -> str:
        target = match[2]
        if "://" in target or target.startswith("#"):
            return match[0]
        name, mark, anchor = target.partition("#")
        if re.match(r"\d_", name):
            return f"[{match[1]}]({name.removesuffix('.md')}.ipynb{mark}{anchor})"
        place = os.path.relpath((page.parent / name).resolve(), ROOT)
        return f"[{match[1]}](../../{place}{mark}{anchor})"

    text = "".join(
        part if part.startswith("```") else re.sub(r"\[([^\]]*)\]\(([^)\s]+)\)", moved, part) for part in parts
    )
    home = "```python\n%cd ../..\n```\n"  # the pages count from the root of the repository
    title, _, rest = text.partition("\n")
    return f"{KERNEL}{title}\n\n{home}{rest}"


def write_notebooks(out: Path) -> list[Path]:
    """Write the tutorials as notebooks, two folders below the root of the repository.

    Raises:
        ModuleNotFoundError: jupytext is not installed.
    """
    import jupytext

    out.mkdir(parents=True, exist_ok=True)
    written = []
    for page in pages():
        notebook = jupytext.reads(notebook_text(page), fmt="md")
        path = out / f"{page.stem}.ipynb"
        jupytext.write(notebook, path)
        written.append(path)
    return written


def run_notebook(page: Path, tests: bool = False) -> None:
    """Run a page as a notebook in a kernel of its own, two folders below the current one.

    Raises:
        ModuleNotFoundError: jupytext, nbclient or ipykernel is not installed.
        RuntimeError: a cell failed.
    """
    import ipykernel  # noqa: F401  (the kernel that nbclient starts)
    import jupytext
    import nbclient

    folder = Path("build/notebooks")
    folder.mkdir(parents=True, exist_ok=True)
    notebook = jupytext.reads(notebook_text(page, tests), fmt="md")
    client = nbclient.NotebookClient(notebook, timeout=None, resources={"metadata": {"path": str(folder)}})
    try:
        client.execute(env=surroundings())
    except nbclient.exceptions.CellExecutionError as error:
        raise RuntimeError(f"{page.name} as a notebook: {error}") from error
    jupytext.write(notebook, folder / f"{page.stem}.ipynb")


def computed() -> float:
    """Seconds for which the cores worked for this process and for those that it started and that have ended."""
    return sum(os.times()[:4])


def run_all(given: argparse.Namespace) -> None:
    """Run the pages in a row. The figures of each, such as notebook_2_s and notebook_2_cpu_s [s], are recorded as soon
    as it has ended: a later page that fails takes none away."""
    kind = "notebook" if given.notebooks else "tutorial"
    for page in pages():
        number = page.name[0]
        if number in given.pages:
            print(f"== {page.name}", flush=True)
            began, before = time.perf_counter(), computed()
            (run_notebook if given.notebooks else run_page)(page, tests=given.tests)
            taken, cores = time.perf_counter() - began, computed() - before
            print(f"== {page.name}: {taken:.0f} s, {cores:.0f} s of all cores together", flush=True)
            if given.record:
                print(write_figures({f"{kind}_{number}_s": taken, f"{kind}_{number}_cpu_s": cores}), flush=True)


def write_figures(seconds: dict[str, float]) -> Path:
    """Record how long each page took."""
    from benchmarks.harness import figure, record

    return record("people", CLAIM, {name: figure([taken], "s") for name, taken in seconds.items()})


def main() -> None:
    """Run the tutorials or write notebooks."""
    parser = Parser(
        prog="python -m benchmarks.tutorials", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    kinds = parser.add_subparsers(dest="kind", required=True)
    run = kinds.add_parser("run", help="run all in a row")
    run.add_argument("--out", type=Path, help="folder to run them in; default: one that is deleted afterwards")
    run.add_argument("--tests", action="store_true", help="with the sizes of the tests")
    run.add_argument("--pages", nargs="+", choices=list("123456"), default=list("123456"), help="numbers of tutorials")
    run.add_argument("--notebooks", action="store_true", help="as Jupyter notebooks")
    run.add_argument("--record", action="store_true", help="write the seconds to benchmarks/results/people.json")
    notebooks = kinds.add_parser("notebooks", help="write them as notebooks")
    notebooks.add_argument("--out", type=Path, default=ROOT / "build" / "notebooks", help="folder of the notebooks")
    given = parser.parse_args()
    try:
        if given.kind == "notebooks":
            print("\n".join(map(str, write_notebooks(given.out))))
            return
        with tempfile.TemporaryDirectory() as own, workplace((given.out or Path(own)).absolute()):
            run_all(given)
    except ModuleNotFoundError as error:
        parser.error(f"{error.name} is not installed. Install it: pip install -c constraints.txt -e '.[docs]'.")


if __name__ == "__main__":
    with guarded():
        main()

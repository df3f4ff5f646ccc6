"""How easily the code is entered: import circles and floors, files, long functions, and time against another version.

    python -m benchmarks.house                                  # what the sources alone show
    python -m benchmarks.house --against CHECKOUT --lowered     # which compiled programs are the same, letter by letter
    python -m benchmarks.house --against CHECKOUT --times fit loop   # medians of both, where programs differ

A floor is a step of the longest chain of imports inside a package, circles counted as one file. Imports inside
functions and for type checking count.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from benchmarks.harness import figure, record
from benchmarks.import_graph import circles, floors, import_graph
from benchmarks.prose import sentences
from bridge.nodes.options import Parser, whole
from whill_mjx.io.command_line import guarded

ROOT = Path(__file__).parents[1]
PACKAGES = ("whill_mjx", "sysid", "dreamer", "bridge")
CLAIM = "a stranger finds the room in a minute"
TIMED = ("physics", "environment", "learner", "fit", "loop")
LONG, MANY = 60, 6  # lines of a function, and arguments, beyond which it counts


@dataclass(frozen=True)
class Function:
    """A function and its size."""

    path: Path
    name: str
    lines: int
    arguments: int


def functions(root: Path = ROOT) -> Iterator[Function]:
    """All functions of packages and benchmarks."""
    for package in (*PACKAGES, "benchmarks"):
        for path in sorted((root / package).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                    given = node.args
                    named = [one for one in (*given.posonlyargs, *given.args, *given.kwonlyargs)
                             if one.arg not in ("self", "cls")]
                    extra = (given.vararg is not None) + (given.kwarg is not None)
                    lines = (node.end_lineno or node.lineno) - node.lineno + 1
                    yield Function(path.relative_to(root), node.name, lines, len(named) + extra)


def pages(root: Path = ROOT) -> list[Path]:
    """README and the documents."""
    return [root / "README.md", *sorted((root / "docs").rglob("*.md"))]


def dialect(root: Path = ROOT) -> int:
    """Occurrences of "tell", "tells" and "told" in packages, benchmarks and documents."""
    files = [path for package in (*PACKAGES, "benchmarks") for path in (root / package).rglob("*.py")]
    files += [path for path in pages(root) if path.name != "README.md"]
    return sum(len(re.findall(r"\b(?:tells?|told)\b", path.read_text())) for path in files)


def files_naming(effect: str, root: Path = ROOT) -> int:
    """Files of the packages that name an effect in code, its own included."""
    found = 0
    for package in PACKAGES:
        for path in (root / package).rglob("*.py"):
            tree = ast.parse(path.read_text())
            found += path.stem == effect or any(
                isinstance(node, ast.Constant) and node.value == effect
                or isinstance(node, ast.ImportFrom) and (node.module or "").endswith(f".{effect}")
                for node in ast.walk(tree))
    return found


def files_of_new_effect(root: Path = ROOT) -> int:
    """Files that the effect from outside needs which tests simulate, fit and name: its own, and what names it here."""
    text = (root / "tests/sysid/outside_effect.py").read_text()
    [name] = re.findall(r'^    name = "(\w+)"', text, re.MULTILINE)
    return 1 + files_naming(name, root)


def from_sources(root: Path = ROOT) -> dict[str, dict]:
    """Figures that the sources alone show."""
    graph = import_graph(root, (*PACKAGES, "benchmarks"))
    every = list(functions(root))
    long = [one for one in every if one.lines > LONG]
    many = [one for one in every if one.arguments > MANY]
    spoken = [one for page in pages(root) for one in sentences(page.read_text())]
    lines = sum(len(path.read_text().splitlines()) for path in (root / "sysid").rglob("*.py"))
    top = {package: len(list((root / package).glob("*.py"))) for package in PACKAGES}
    counts: dict[str, tuple[float, str]] = {
        "import_circles": (len(circles(graph)), "count"),
        **{f"import_floors_{package}": (floors(graph, package), "count") for package in PACKAGES},
        **{f"files_top_{package}": (number, "count") for package, number in top.items()},
        "files_per_new_effect": (files_of_new_effect(root), "count"),
        "functions_over_60": (len(long), "count"), "functions_over_6_arguments": (len(many), "count"),
        "lines_sysid": (lines, "count"), "names_sysid": (public_names(root / "sysid"), "count"),
        "sentences_over_35_words": (sum(len(one.split()) > 35 for one in spoken), "count"),
        "tell_and_told": (dialect(root), "count"),
        "readme_lines": (len((root / "README.md").read_text().splitlines()), "count"),
        "benchmarks_page_kb": ((root / "benchmarks/README.md").stat().st_size / 1e3, "kB"),
    }
    for one in sorted(long, key=lambda one: -one.lines):
        print(f"{one.lines} lines: {one.path} {one.name}")
    for one in sorted(many, key=lambda one: -one.arguments):
        print(f"{one.arguments} arguments: {one.path} {one.name}")
    return {name: figure([value], unit, "counted") for name, (value, unit) in counts.items()}


def public_names(package: Path) -> int:
    """Functions, classes and constants at the top of files, but for those that begin with an underscore."""
    names = 0
    for path in package.rglob("*.py"):
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                names += not node.name.startswith("_")
            elif isinstance(node, ast.Assign | ast.AnnAssign):
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                names += sum(isinstance(one, ast.Name) and not one.id.startswith("_") for one in targets)
    return names


def _run(tree: Path, *arguments: str) -> dict:
    """What `benchmarks.house_programs` of this tree writes about the packages of another."""
    script = Path(__file__).with_name("house_programs.py")
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "found.json"
        path = os.pathsep.join([str(tree), *filter(None, [os.environ.get("PYTHONPATH")])])
        environment = {**os.environ, "PYTHONPATH": path}
        subprocess.run([sys.executable, "-P", str(script), "--out", str(out), *arguments], check=True, cwd=tree,
                       env=environment)
        found: dict = json.loads(out.read_text())
    return found


def compare_programs(other: Path) -> dict[str, dict]:
    """1 for each compiled program whose text is the same in both trees, else 0."""
    mine, theirs = (_run(tree, "--lowered") for tree in (ROOT, other))
    for name in mine:
        print(f"{name}: {'the same' if mine[name] == theirs.get(name) else 'another'} lowered program")
    return {f"same_program_{name}": figure([float(mine[name] == theirs.get(name))], "1 if so", "lowered")
            for name in mine}


def compare_times(other: Path, programs: list[str], rounds: int) -> dict[str, dict]:
    """Medians of this tree's seconds over the other's, each tree in a process of its own, one after the other."""
    ratios: dict[str, list[float]] = {}
    for number in range(rounds):
        mine, theirs = (_run(tree, "--times", *programs) for tree in (ROOT, other))
        for name, taken in mine.items():
            ratios.setdefault(name, []).append(median(taken) / median(theirs[name]))
        print(f"round {number + 1} of {rounds}: "
              + ", ".join(f"{name} {each[-1]:.3f}" for name, each in ratios.items()), flush=True)
    return {f"time_ratio_{name}": figure(each, "ratio") for name, each in ratios.items()}


def main() -> None:
    """Count, compare and record."""
    parser = Parser(
        prog="python -m benchmarks.house", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--against", type=Path, help="another checkout of the project")
    parser.add_argument("--lowered", action="store_true", help="compare lowered programs with it")
    parser.add_argument("--times", nargs="*", choices=TIMED, default=[],
                        help="programs whose seconds are compared with it")
    parser.add_argument("--rounds", type=whole(), default=1, help="of timing both trees, five calls a program each")
    options = parser.parse_args()
    if (options.lowered or options.times) and options.against is None:
        parser.error("--lowered and --times need --against CHECKOUT")
    figures = from_sources()
    if options.lowered:
        figures |= compare_programs(options.against.resolve())
    if options.times:
        figures |= compare_times(options.against.resolve(), options.times, options.rounds)
    for name, one in figures.items():
        print(f"{name}: {one['value']:g} {one['unit']}")
    record("house", CLAIM, figures)


if __name__ == "__main__":
    with guarded():
        main()

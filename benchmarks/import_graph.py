"""The imports between files as a graph: its circles, and its floors."""

from __future__ import annotations

import ast
from collections.abc import Sequence
from pathlib import Path

Graph = dict[str, set[str]]


def import_graph(root: Path, packages: Sequence[str]) -> Graph:
    """Dotted name of each module -> the modules of these packages that it imports, anywhere in it."""
    paths = {_dotted(path.relative_to(root)): path for package in packages for path in (root / package).rglob("*.py")}
    return {name: _imported(name, path, paths) - {name} for name, path in paths.items()}


def _dotted(path: Path) -> str:
    return ".".join(path.with_suffix("").parts).removesuffix(".__init__")


def _imported(name: str, path: Path, known: dict[str, Path]) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parts = name.split(".") if path.name == "__init__.py" else name.split(".")[:-1]
                base = ".".join([*parts[: len(parts) + 1 - node.level], *([base] if base else [])])
            for alias in node.names:
                inside = f"{base}.{alias.name}"
                found.add(inside if inside in known else base)
    return found & set(known)


def circles(graph: Graph) -> list[list[str]]:
    """Groups of modules that import one another (strongly connected components of two at least; Tarjan 1972)."""
    return [group for group in _components(graph) if len(group) > 1]


def floors(graph: Graph, package: str) -> int:
    """Length of the longest chain of imports inside a package, a circle counted as one module."""
    inside = {name: {one for one in used if one.split(".")[0] == package}
              for name, used in graph.items() if name.split(".")[0] == package}
    level: dict[str, int] = {}
    for group in _components(inside):  # what a group imports comes before it
        below = [level[one] for name in group for one in inside[name] if one not in group]
        level |= dict.fromkeys(group, 1 + max(below, default=0))
    return max(level.values(), default=0)


def _components(graph: Graph) -> list[list[str]]:
    """Strongly connected components, each after those that it imports."""
    order: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(name: str) -> None:
        order[name] = low[name] = len(order)
        stack.append(name)
        for other in sorted(graph[name]):
            if other not in order:
                visit(other)
                low[name] = min(low[name], low[other])
            elif other in stack:
                low[name] = min(low[name], order[other])
        if low[name] == order[name]:
            at = stack.index(name)
            found.append(sorted(stack[at:]))
            del stack[at:]

    for name in sorted(graph):
        if name not in order:
            visit(name)
    return found

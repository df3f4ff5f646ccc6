"""One claim that recorded figures support: a table of the page."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

Row = tuple[str, ...]


@dataclass(frozen=True)
class Claim:
    """One table of the page."""

    room: str
    """Heading above the claims of one subject."""
    title: str
    stem: str
    """Result file: benchmarks/results/STEM.json."""
    text: str
    """What was measured, and how to read it."""
    head: Row
    rows: tuple[Row, ...] | Callable[[dict[str, Any]], list[Row]]
    """Rows of cells, or a function of the file's content that makes them."""
    pictures: tuple[str, ...] = ()

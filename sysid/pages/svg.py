"""Charts of the pages; they are drawn by `whill_mjx.io.svg`, which all pages share."""

from whill_mjx.io.svg import (
    COLOURS,
    PALETTE,
    Line,
    bar_chart,
    interval_bar,
    line_chart,
    replay_line,
)

__all__ = ["COLOURS", "PALETTE", "Line", "bar_chart", "interval_bar", "line_chart", "replay_line"]

"""What the commands of this package share: reading options, ending on bad input, showing the progress of long work."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

from sysid.result import Progress


def run(options: type, main: Callable[[Any], Any], description: str | None) -> None:
    """Read `options` from the command line and call `main`: errors in the input end with one line, not a traceback."""
    import tyro

    chosen: Any = tyro.cli(options, description=description, config=(tyro.conf.PositionalRequiredArgs,))
    try:
        main(chosen)
    except (ValueError, FileNotFoundError) as error:
        sys.exit(f"error: {error}")


def progress_bar(total: int, what: str = "fit", unit: str = "eval") -> tuple[Progress, Callable[[], None]]:
    """A bar with rate and remaining time, and the function that closes it."""
    from tqdm import tqdm

    bar: Any = tqdm(total=total, desc=what, unit=unit)

    def advance(count: int, remark: str) -> None:
        bar.set_postfix_str(remark, refresh=False)
        bar.update(min(count, max(bar.total - bar.n, 0)))

    return advance, bar.close

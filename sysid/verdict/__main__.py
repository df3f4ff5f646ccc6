"""Judge drives again from the evidence that was kept of them: no drives and no simulator are needed.

    python -m sysid.verdict runs/loop/evidence.json
    python -m sysid.verdict runs/*/evidence.json --share 0.7
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from sysid.verdict.posterior import Thresholds, posterior, read
from whill_mjx.io.command_line import Range, refusing, run


@dataclass(frozen=True)
class Options:
    """Options of the command."""

    files: tuple[Path, ...]
    """Files evidence.json that sysid.close_loop wrote."""
    alpha: Annotated[float, Range(0, 1, above=True)] = Thresholds.alpha
    """Prior odds of an effect, and p-value below which it is more than chance."""
    share: Annotated[float, Range(0, 1)] = Thresholds.share
    """Share of what can be explained that something unknown is held to explain."""


def main(options: Options) -> None:
    """Print the verdict on each file, and the posterior weights."""
    priors = Thresholds(options.alpha, share=options.share)
    with refusing():
        if not options.files:
            raise ValueError("FILE: none given. Give evidence.json of a run of sysid.close_loop.")
        found = [(path, posterior(read(path), priors)) for path in options.files]
    for path, one in found:
        print(f"{path}: {one.verdict} - {one.reason}")
        for name, weight in sorted(one.weights.items(), key=lambda each: -each[1]):
            print(f"    {weight:7.2%}  {name}")


if __name__ == "__main__":
    run(Options, main, __doc__)

"""A command of a second whose work is done in steps: folder, signals and resuming are the real ones.

    python tests/whill_mjx/tiny_steps.py --out RUN --seed 0
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

from whill_mjx.io.command_line import listen, run

if __name__ == "__main__":
    listen()

import numpy as np

from whill_mjx.io.folders import claim_folder, whole_file
from whill_mjx.io.steps import keep_steps, step

ROUNDS = 40


@dataclass(frozen=True)
class Options:
    out: Path
    seed: int = 0
    pause: float = 0.02


def work(seed, pause=0.0):
    """A walk whose every step depends on the ones before."""
    state = np.full(3, float(seed))
    for number in range(ROUNDS):
        def compute(state=state, number=number):
            time.sleep(pause)
            return [np.sin(state * (number + 1)) + step("inner", lambda: [np.cos(state)], state)[0]]

        (state,) = step("walk", compute, state)
    return state


def main(options):
    """Walk, and leave where it ended."""
    with claim_folder(options.out, "tiny_steps", ("result.npy", "steps")) as claim:
        claim.settle({"seed": options.seed})
        with keep_steps(options.out / "steps", {"seed": options.seed}):
            state = work(options.seed, options.pause)
            with whole_file(options.out / "result.npy") as path:
                np.save(path, state)


def cli():
    """Command line."""
    run(Options, main, __doc__, positional=False)


if __name__ == "__main__":
    cli()

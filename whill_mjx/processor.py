"""Asks XLA to share work between results on a processor.

A physics step has some four thousand operations and sixty results. XLA's fusion for processors gives each result a loop
of its own, in which everything that leads to it is computed again: 24,000 operations a step. Its fusion of several
results into one loop is off by default, and no option of a single `jax.jit` turns it on; with it a step has 2,500.
"""

from __future__ import annotations

import os

OPTION = "xla_cpu_use_multi_output_fusion"
FLAG = "--xla_backend_extra_options"


def share_results() -> None:
    """Ask for it in XLA_FLAGS, unless these name other such options already.

    XLA reads them when a process compiles its first program: afterwards this changes nothing. Accelerators and versions
    that do not know the option ignore it.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if FLAG not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {FLAG}={OPTION}".strip()

"""An effect that nobody declared: which one and how large, drawn by a number."""

from __future__ import annotations

import json

import numpy as np

from benchmarks.harness import RESULTS
from benchmarks.plant.effects import EFFECTS

TIMES = (3.0, 5.0)
"""Range of the drawn size, as multiples of the one that the closed loop notices on four of five days of nine
manoeuvres (undeclared.json)."""


def draw_effect(number: int, name: str | None = None) -> dict[str, float]:
    """Size by name of one effect of the catalogue, or one that an effect of the catalogue covers.

    Args:
        number: seed of the draw.
        name: of the effect, where only its size is drawn.
    """
    names = sorted(one for one, entry in EFFECTS.items() if entry.can_be_named)
    shuffled = np.random.default_rng(7).permutation(names)  # neighbouring numbers draw different effects
    name = name or str(shuffled[number % len(names)])
    times = float(np.random.default_rng([number, 7]).uniform(*TIMES))
    noticed = json.loads((RESULTS / "undeclared.json").read_text())["sizes"]
    size = noticed[name]["value"] if name in noticed else EFFECTS[name].base
    return {name: min(times * size, EFFECTS[name].most)}

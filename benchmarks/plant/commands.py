"""Nine manoeuvres as messages (T, 3) t, v, omega every 0.1 s; levels and the random drive depend on the seed.

Each starts with a second of standstill and ends with one or two.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np

PERIOD = 0.1  # s
Messages = Mapping[str, np.ndarray]


def _table(length: float, command: Callable[[float], tuple[float, float]], end: float) -> np.ndarray:
    """Messages over `length` [s]: standstill before 1 s and from `end` on."""
    t = np.arange(round(length / PERIOD)) * PERIOD
    rows = [command(float(time)) if 1.0 - 1e-6 <= time < end - 1e-6 else (0.0, 0.0) for time in t]
    return np.column_stack([t, np.round(rows, 4)])


def nine(seed: int) -> dict[str, np.ndarray]:
    """The nine manoeuvres of one dataset."""
    random = np.random.default_rng([seed, 9])

    def level(low: float, high: float) -> float:
        return float(random.uniform(low, high))

    tables = {}
    v = level(0.72, 0.9)
    tables["straight"] = _table(22, lambda t: (v, 0.0), 19)
    turn = level(0.62, 0.74)
    tables["turn"] = _table(22, lambda t: (0.0, turn if t < 11 - 1e-6 else 0.0 if t < 12 - 1e-6 else -turn), 20)
    circle = level(0.57, 0.67)
    tables["circle"] = _table(22, lambda t: (circle, circle / 1.2), 20)
    curve = level(0.55, 0.68)
    tables["s_curve"] = _table(22, lambda t: (curve, curve * math.sin(0.8 * (t - 1))), 20)
    eight = level(0.5, 0.6)
    lap = 2 * math.pi / eight
    tables["figure_eight"] = _table(30, lambda t: (eight, eight if (t - 1) % (2 * lap) < lap else -eight), 28)
    go = level(0.62, 0.78)
    tables["stop_and_go"] = _table(22, lambda t: (go if (t - 1 + 1e-6) % 5 < 2.5 else 0.0, 0.0), 20)
    creep = level(0.22, 0.26)
    tables["creep"] = _table(22, lambda t: (0.03 + (creep - 0.03) * (t - 1) / 19, 0.0), 20)
    steps = np.column_stack([random.uniform(-0.3, 0.9, 14), random.uniform(-0.8, 0.8, 14)])
    tables["random"] = _table(22, lambda t: tuple(steps[int((t + 1e-6) // 1.5)]), 20)
    back = level(0.43, 0.47)
    tables["reverse"] = _table(22, lambda t: (back if (t + 1e-6) % 8 < 4 else -back, 0.25), 20)
    return tables

"""The table of effects: base size, unit, functional form."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from benchmarks.plant.base import Effect
from benchmarks.plant.chair import NOMINAL_RADIUS, Chair


@dataclass(frozen=True)
class Entry:
    """One effect of the table."""

    make: type[Effect]
    base: float
    """A plausible small size; tests and studies use multiples of it."""
    unit: str
    form: str
    """Functional form, in words and symbols; s is the size."""


class CommandDelay(Effect):
    def messages(self, messages: np.ndarray) -> np.ndarray:
        late = self.size * (1 + 0.2 * self.random.uniform(-1, 1, len(messages)))
        arrival = np.maximum.accumulate(messages[:, 0] + late)  # the line keeps the order
        return np.column_stack([arrival, messages[:, 1:]])


class WheelRadiusDifference(Effect):
    @staticmethod
    def change(chair: Chair, size: float) -> Chair:
        left, right = chair.radius
        return replace(chair, radius=(left + NOMINAL_RADIUS * size / 2, right - NOMINAL_RADIUS * size / 2))


class Slope(Effect):
    @staticmethod
    def change(chair: Chair, size: float) -> Chair:
        return replace(chair, rise=(chair.rise[0] + float(np.sin(size)), chair.rise[1]))


EFFECTS: dict[str, Entry] = {
    "command_delay": Entry(CommandDelay, 0.06, "s", "each message is s (1 +- 0.2) late, in order"),
    "wheel_radius_difference": Entry(
        WheelRadiusDifference, 0.006, "-", "left tyre larger by s/2, right one smaller by s/2, of the nominal radius"
    ),
    "slope": Entry(Slope, 0.02, "rad", "gravity tilted: the floor rises by s towards +x of the room"),
}

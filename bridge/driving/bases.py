"""What the bridge must know of a base: the range of its commands, and how it is left alone after a stop."""

import math
from dataclasses import dataclass

WHILL_SPEED_UNITS = 900.0
"""The WHILL's speed word per m/s: one unit is 0.004 km/h."""
WHILL_TURN_UNITS = 446.4
"""The WHILL's turn word per rad/s: the speed difference over its tread of 0.496 m, in the same unit."""


@dataclass(frozen=True)
class Base:
    """One kind of vehicle below the command topic."""

    name: str
    hold_zeros: bool
    """True: the base has no time-out of its own, so zeros are repeated for as long as the bridge stands.
    False: the base stops by itself, and each packet would take it from its rider, so the bridge falls silent."""
    low: tuple[float, float] = (-math.inf, -math.inf)
    """Smallest command the base takes: v [m/s], omega [rad/s]."""
    high: tuple[float, float] = (math.inf, math.inf)
    """Largest command the base takes."""
    expiry: float = math.inf
    """Seconds after which the base forgets a command."""


WHILL = Base("whill", hold_zeros=False, low=(-500 / WHILL_SPEED_UNITS, -750 / WHILL_TURN_UNITS),
             high=(1500 / WHILL_SPEED_UNITS, 750 / WHILL_TURN_UNITS), expiry=0.2)
"""WHILL Model CR and CR2: a command expires after 200 ms, and each velocity packet disables the joystick."""
GENERIC = Base("generic", hold_zeros=True)
"""A base of unknown behaviour: assume that it keeps the last command for ever."""
BASES = {base.name: base for base in (WHILL, GENERIC)}

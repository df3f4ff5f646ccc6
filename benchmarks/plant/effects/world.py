"""Effects that are built into the chair or the floor."""

from __future__ import annotations

import math
from dataclasses import replace

from benchmarks.plant.base import Effect
from benchmarks.plant.chair import Chair


class WheelRadiusDifference(Effect):
    """Left tyre larger by s / 2 and right tyre smaller by s / 2, of the nominal radius."""

    @staticmethod
    def change(chair: Chair, size: float) -> Chair:
        (left, right), more = chair.radius, chair.nominal.radius * size / 2
        return replace(chair, radius=(left + more, right - more))


class TrackWidth(Effect):
    """Drive wheels apart by s more than nominal, of the nominal track."""

    @staticmethod
    def change(chair: Chair, size: float) -> Chair:
        return replace(chair, track=chair.track + chair.nominal.track * size)


class PayloadShift(Effect):
    """A box of mass s, 0.12 m ahead of the axle, 0.14 m to the left and 0.3 m above it: a body of its own."""

    @staticmethod
    def change(chair: Chair, size: float) -> Chair:
        return replace(chair, payload=size)


class Slope(Effect):
    """Gravity tilted: the floor rises by the angle s towards +x of the room."""

    @staticmethod
    def change(chair: Chair, size: float) -> Chair:
        return replace(chair, rise=(chair.rise[0] + math.sin(size), chair.rise[1]))


class TractionLimit(Effect):
    """The tyres' friction coefficient is lower by s on this floor; what exceeds the contact's cone slides."""

    @staticmethod
    def change(chair: Chair, size: float) -> Chair:
        return replace(chair, friction=max(0.02, chair.friction - size))

"""Wheels between the outer axles of a skid drive."""

from __future__ import annotations

from dataclasses import replace

import jax
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.vehicle.types import World, parameter


@struct.dataclass
class MiddleWheels(Effect):
    """N_m = k (N_r + N_f) on driven wheels midway between both axles, whose wheels keep N_i - k (N_r + N_f) / 2.

    Six wheels have k = 1/3. In a turn the outer wheels slide across too, and those in the middle along alone: they push
    with their whole friction, however little they slide, and hold the point about which the vehicle turns. Loads change
    evenly from the rear to the front, as under a stiff frame. Wheels of one side turn at one speed. A differential
    drive has no such wheels: no effect there.
    """

    name = "middle_wheels"
    typical = {"share": (0.3, 0.5)}
    source = "geometry: 1/3 for six wheels, 1/2 for tracks on five wheels each"
    share: jax.Array = parameter("-", 0.0, 0.9, 0.0, "share of the load on wheels in the middle, k")

    def world(self, memory: tuple[()], world: World) -> tuple[tuple[()], World]:
        """World for a vehicle on three axles."""
        return memory, replace(world, middle=self.share)

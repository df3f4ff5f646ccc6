"""Several maps as one world: they lie side by side, so that one compiled program knows them all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from whill_mjx.world.maps.grid import FARTHEST
from whill_mjx.world.maps.places import Places
from whill_mjx.world.maps.playable import MapScene
from whill_mjx.world.maps.walls import map_walls
from whill_mjx.world.maps.ways import POINTS, WAYS, Ways, draw_ways
from whill_mjx.world.scene import MapWalls

GAP = 30.0
"""Distance between two maps, beyond the reach of scans [m]."""


@dataclass(frozen=True, eq=False)
class MapGroup:
    """Maps side by side, with the walls and places of all."""

    parts: tuple[MapScene, ...]
    shifts: np.ndarray
    """(K, 2) m by which each map was moved; the first stays."""
    walls: MapWalls
    places: Places

    def ways(self, clear: float, within: float) -> Ways:
        """Where people walk in all maps; arguments as of `draw_ways`."""
        drawn = [draw_ways(one.grid, one.space, one.places.start, clear, within) for one in self.parts]
        return Ways(
            points=np.concatenate([one.points + shift for one, shift in zip(drawn, self.shifts, strict=True)])
            .astype(np.float32),
            length=np.concatenate([one.length for one in drawn]),
            start=np.concatenate([one.start + shift for one, shift in zip(drawn, self.shifts, strict=True)])
            .astype(np.float32),
            near=np.concatenate([np.where(one.near >= 0, one.near + number * WAYS * POINTS, -1)
                                 for number, one in enumerate(drawn)]).astype(np.int32),
        )  # fmt: skip


def side_by_side(scenes: Sequence[MapScene]) -> MapGroup:
    """A group of at least one map in a row along x; a single one stays as it is.

    Raises:
        ValueError: the row is too long.
    """
    first = scenes[0]
    if len(scenes) == 1:
        return MapGroup((first,), np.zeros((1, 2)), first.walls, first.places)
    low, high = _span(first)
    shifts = [np.zeros(2)]
    for scene in scenes[1:]:
        own_low, own_high = _span(scene)
        beside = own_low[1] <= high[1] and low[1] <= own_high[1]
        shifts.append(np.array([high[0] + GAP - own_low[0], 0.0 if beside else low[1] - own_low[1]]))
        low, high = np.minimum(low, own_low + shifts[-1]), np.maximum(high, own_high + shifts[-1])
    if (far := float(np.abs([low, high]).max())) > FARTHEST:
        raise ValueError(f"{len(scenes)} maps side by side reach {far:.0f} m from zero; poses are in single precision, "
                         f"so they may reach {FARTHEST:g} m. Name fewer maps.")
    pairs = list(zip(scenes, shifts, strict=True))
    walls = map_walls(np.concatenate([one.walls.segments + shift for one, shift in pairs]), first.walls.keep,
                      first.walls.height, max(one.walls.within for one in scenes))  # fmt: skip
    places = Places(
        start=np.concatenate([one.places.start + np.append(shift, 0.0) for one, shift in pairs]),
        goal=np.concatenate([one.places.goal + shift for one, shift in pairs]),
        way=np.concatenate([one.places.way for one in scenes]),
    )
    return MapGroup(tuple(scenes), np.stack(shifts), walls, places)


def _span(scene: MapScene) -> tuple[np.ndarray, np.ndarray]:
    """Least and largest x, y [m] of a map's walls."""
    points = scene.walls.segments.reshape(-1, 2)
    return points.min(0), points.max(0)

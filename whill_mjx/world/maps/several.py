"""Several maps as one world: they lie side by side in rows around zero, so that one compiled program knows them all.

Near zero, because poses are in single precision. Walls enclose the space of each map, so no ray leads to another one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from whill_mjx.world.maps.grid import FARTHEST
from whill_mjx.world.maps.places import Places
from whill_mjx.world.maps.playable import MapScene
from whill_mjx.world.maps.walls import map_walls
from whill_mjx.world.maps.ways import POINTS, WAYS, Ways, draw_ways
from whill_mjx.world.scene import MapWalls

GAP = 10.0
"""Distance between two maps, beyond what people and vehicles notice of walls [m]."""


@dataclass(frozen=True, eq=False)
class MapGroup:
    """Maps side by side, with the walls and places of all."""

    parts: tuple[MapScene, ...]
    shifts: np.ndarray
    """(K, 2) m by which each map was moved; a map alone stays."""
    walls: MapWalls
    places: Places

    def ways(self, clear: float, within: float) -> Ways:
        """Where people walk in all maps; arguments as of `draw_ways`."""
        drawn = [draw_ways(one.grid, one.space, one.places.start, clear, within) for one in self.parts]
        return Ways(
            points=np.concatenate([one.points + shift for one, shift in zip(drawn, self.shifts, strict=True)])
            .astype(np.float32),
            start=np.concatenate([one.start + shift for one, shift in zip(drawn, self.shifts, strict=True)])
            .astype(np.float32),
            near=np.concatenate([np.where(one.near >= 0, one.near + number * WAYS * POINTS, -1)
                                 for number, one in enumerate(drawn)]).astype(np.int32),
        )  # fmt: skip


def side_by_side(scenes: Sequence[MapScene]) -> MapGroup:
    """A group of at least one map in rows, as many rows as maps in a row; a single one stays as it is.

    Raises:
        ValueError: together they are too large.
    """
    first = scenes[0]
    if len(scenes) == 1:
        return MapGroup((first,), np.zeros((1, 2)), first.walls, first.places)
    shifts, far = _laid_out(np.array([_span(scene) for scene in scenes]))
    if far > FARTHEST:
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
    return MapGroup(tuple(scenes), shifts, walls, places)


def _laid_out(spans: np.ndarray) -> tuple[np.ndarray, float]:
    """How far (K, 2) maps are moved [m], and the largest coordinate of all then [m].

    `spans` (K, 2, 2) holds the least and the largest x, y [m] of each map.
    """
    columns = math.ceil(math.sqrt(len(spans)))
    corners, row = [], 0.0
    for begin in range(0, len(spans), columns):
        sizes = spans[begin : begin + columns, 1] - spans[begin : begin + columns, 0]
        lefts = np.cumsum([0.0, *(sizes[:-1, 0] + GAP)])
        corners.append(np.column_stack([lefts, np.full(len(lefts), row)]))
        row += sizes[:, 1].max() + GAP
    low = np.concatenate(corners)
    high = low + spans[:, 1] - spans[:, 0]
    shifts = low - spans[:, 0] - high.max(0) / 2
    return shifts, float(np.abs(spans + shifts[:, None]).max())


def _span(scene: MapScene) -> tuple[np.ndarray, np.ndarray]:
    """Least and largest x, y [m] of a map's walls."""
    points = scene.walls.segments.reshape(-1, 2).astype(float)
    return points.min(0), points.max(0)

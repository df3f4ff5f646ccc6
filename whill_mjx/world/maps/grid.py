"""Occupancy grids: what is free, unknown and occupied, and the borders of the free space.

World frame: that of the map's file, x and y in m; a map that lies far from its zero is moved to it (`brought_near`).
The origin's yaw turns the grid about its lower left corner, as map_server defines it. Everything here is the host's
work, in numpy.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

FREE, UNKNOWN, OCCUPIED = 0, 1, 2
STAYS, FARTHEST = 1000.0, 4096.0
"""Coordinates up to which a map stays where its file has it, and beyond which nothing drives [m]. Poses are in single
precision: `docs/maps.md` says what a drive loses there."""


@dataclass(frozen=True, eq=False)
class GridMap:
    """Occupancy grid."""

    cells: np.ndarray
    """(rows, columns) uint8 of FREE, UNKNOWN and OCCUPIED; row 0 is at the bottom, where y begins."""
    resolution: float
    """Edge of a cell [m]."""
    origin: tuple[float, float, float]
    """x [m], y [m], yaw [rad] of the lower left corner of the grid."""
    occupancy: np.ndarray | None = None
    """(rows, columns) int8: the values of nav2's OccupancyGrid, 0 to 100 and -1 for unknown; None of made grids."""
    shift: tuple[float, float] = (0.0, 0.0)
    """Whole metres x, y that were taken off the file's coordinates; added to a place, they give the file's own."""
    notes: tuple[str, ...] = ()
    """How the file's coordinates were understood, and what of it is left out."""
    remedy: str = "Check the resolution."
    """What to do about the map where a vehicle finds no room in it; it depends on the kind of the file."""

    def to_world(self, points: np.ndarray) -> np.ndarray:
        """World coordinates (..., 2) of points (..., 2) in the grid's own frame [m]."""
        x, y, yaw = self.origin
        cos, sin = math.cos(yaw), math.sin(yaw)
        return points @ np.array([[cos, sin], [-sin, cos]]) + np.array([x, y])

    def farthest(self) -> float:
        """Largest coordinate of a corner, whatever its sign [m]."""
        return float(np.abs(self._corners()).max())

    def brought_near(self) -> GridMap:
        """The grid with its middle within a metre of zero where a corner lies beyond `STAYS`, else as it is."""
        if self.farthest() <= STAYS:
            return self
        x, y = (float(one) for one in np.rint(self._corners().mean(0)))
        origin = (self.origin[0] - x, self.origin[1] - y, self.origin[2])
        return replace(self, origin=origin, shift=(self.shift[0] + x, self.shift[1] + y))

    def _corners(self) -> np.ndarray:
        rows, columns = self.cells.shape
        return self.to_world(np.array([[0, 0], [columns, 0], [0, rows], [columns, rows]]) * self.resolution)

    def free_points(self) -> np.ndarray:
        """(F, 2) world coordinates of the centres of all free cells."""
        rows, columns = np.nonzero(self.cells == FREE)
        return self.to_world((np.stack([columns, rows], -1) + 0.5) * self.resolution)


def wall_segments(grid: GridMap) -> np.ndarray:
    """Borders of the free space as straight segments (S, 2, 2), world coordinates [m].

    Edges between a free cell and one that is not, each run along a row or a column joined to one segment. The free
    space lies to the left of the way from a segment's first point to its second.
    """
    free = np.pad(grid.cells == FREE, 1)
    segments: list[np.ndarray] = []
    for transposed in (False, True):
        field = free.T if transposed else free
        for side in (1, -1):
            # Free cells whose neighbour in the row before (side 1) or after (side -1) is not free.
            border = field & ~np.roll(field, side, axis=0)
            starts = np.argwhere(border & ~np.roll(border, 1, axis=1))
            ends = np.argwhere(border & ~np.roll(border, -1, axis=1))
            line = starts[:, 0] - 1 + (side < 0)  # the padding of one cell taken off
            first, last = starts[:, 1] - 1, ends[:, 1]
            run = np.stack([np.stack([first, line], -1), np.stack([last, line], -1)], 1).astype(float)
            run = run[..., ::-1] if transposed else run
            segments.append(run[:, ::-1] if (side < 0) != transposed else run)
    return grid.to_world(np.concatenate(segments) * grid.resolution)

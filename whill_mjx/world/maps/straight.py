"""Straight walls of a map: its free space without the streaks of lasers, its outline as closed loops, long segments.

A laser leaves free streaks through windows and unknown specks on the floor, each a cell or two wide. What is narrower
than `NARROW` cells goes to its surroundings; occupied cells stay.
"""

from __future__ import annotations

from collections import defaultdict

import numpy as np

from whill_mjx.world.maps.grid import FREE, OCCUPIED, GridMap, wall_segments

NARROW = 3
"""Cells: a streak or speck has to be this wide to count."""
DEVIATION = 1.42
"""Cells: largest distance of the outline of cells from its straight wall. The corners of the cells along a straight
line lie in a band of sqrt(2) cells at most, whatever its direction."""


def open_space(grid: GridMap) -> np.ndarray:
    """(rows, columns) bool: the free space without narrow streaks, and with narrow unknown specks."""
    from scipy.ndimage import binary_closing, binary_opening

    square = np.ones((NARROW, NARROW), bool)
    padded = np.pad(grid.cells == FREE, NARROW)
    solid = np.pad(grid.cells == OCCUPIED, NARROW)
    filled = padded | (binary_closing(padded, square) & ~solid)
    return binary_opening(filled, square)[NARROW:-NARROW, NARROW:-NARROW]


def connected(space: np.ndarray, wide: np.ndarray) -> np.ndarray:
    """(rows, columns) bool: the parts of `space` that hold the largest connected part of `wide`."""
    from scipy.ndimage import label

    parts, count = label(wide)
    if not count:
        return np.zeros_like(space)
    largest = 1 + np.argmax(np.bincount(parts.ravel())[1:])
    pieces, _ = label(space)
    return np.isin(pieces, np.unique(pieces[(parts == largest) & space]))


def outline(space: np.ndarray) -> list[np.ndarray]:
    """Closed loops (n, 2) of corners x, y [cells] around the space, which lies to their left.

    Where two cells of the space meet at a corner only, the loop turns left: it does not lead through.
    """
    cells = np.where(space, FREE, OCCUPIED).astype(np.uint8)
    edges = np.rint(wall_segments(GridMap(cells, 1.0, (0.0, 0.0, 0.0)))).astype(int)
    leaving: dict[tuple[int, int], list[int]] = defaultdict(list)
    for number, (start, _) in enumerate(edges):
        leaving[start[0], start[1]].append(number)
    way = np.sign(edges[:, 1] - edges[:, 0])
    used = np.zeros(len(edges), bool)
    loops = []
    for first in range(len(edges)):
        if used[first]:
            continue
        loop, number = [], first
        while not used[number]:
            used[number] = True
            loop.append(edges[number, 0])
            nexts = leaving[edges[number, 1][0], edges[number, 1][1]]
            left = [one for one in nexts if way[number, 0] * way[one, 1] - way[number, 1] * way[one, 0] > 0]
            number = (left or nexts)[0]
        loops.append(np.array(loop))
    return loops


def straight_walls(grid: GridMap, space: np.ndarray) -> np.ndarray:
    """Walls (S, 2, 2) around the space, world coordinates [m]; the space lies to the left of each.

    Each loop is thinned out by the rule of Douglas and Peucker, so that no corner that it loses lies more than
    `DEVIATION` cells off. A loop that would have fewer than three corners stays as it is.
    """
    import cv2

    segments = []
    for loop in outline(space):
        thin = cv2.approxPolyDP(loop.astype(np.int32)[:, None], DEVIATION, True)[:, 0]
        corners = thin if len(thin) >= 3 else loop
        segments.append(np.stack([corners, np.roll(corners, -1, 0)], 1))
    if not segments:
        return np.zeros((0, 2, 2))
    return grid.to_world(np.concatenate(segments) * grid.resolution)

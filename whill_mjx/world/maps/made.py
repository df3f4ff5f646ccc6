"""Floor plans that nobody has to own: rooms with doors and some furniture, drawn from a seed."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from whill_mjx.world.maps.grid import FREE, OCCUPIED, GridMap

CELL = 0.05
"""Edge of a cell [m]."""
SIZE = (24.0, 16.0)
"""Length and width of a plan [m]."""
WALL = 3
"""Thickness of a wall [cells]."""
SMALLEST = 4.5
"""Least side of a room [m]."""
DOOR = (1.1, 1.9)
"""Least and largest width of a door [m]."""
FURNITURE = (0.4, 1.0)
"""Least and largest side of a piece of furniture [m]."""
CLEAR = 1.3
"""Its least distance from walls, so that a vehicle gets round it [m]."""
TRIES = 20
Room = tuple[int, int, int, int]  # first and last row, first and last column; the last are outside


def made_plan(seed: int) -> GridMap:
    """The floor plan of a seed: a rectangle that walls with doors cut again and again into rooms."""
    rng = np.random.default_rng(seed)
    rows, columns = (round(side / CELL) for side in SIZE[::-1])
    cells = np.full((rows, columns), OCCUPIED, np.uint8)
    whole = (WALL, rows - WALL, WALL, columns - WALL)
    cells[WALL : rows - WALL, WALL : columns - WALL] = FREE
    for room in list(_divided(cells, whole, rng)):
        _furnish(cells, room, rng)
    return GridMap(cells, CELL, (0.0, 0.0, 0.0), remedy="Take another seed.")


def _divided(cells: np.ndarray, room: Room, rng: np.random.Generator) -> Iterator[Room]:
    """The rooms into which walls cut one; the walls are drawn into the cells."""
    top, bottom, left, right = room
    least, across = round(SMALLEST / CELL), bottom - top > right - left
    view = cells.T if across else cells  # the wall runs along the first axis of the view
    low, high, first, last = (left, right, top, bottom) if across else (top, bottom, left, right)
    places = np.arange(first + least, last - least - WALL)
    for _ in range(TRIES if len(places) else 0):
        place = int(rng.choice(places))
        ends = view[[low - 1, high], :][:, place - least // 4 : place + WALL + least // 4]
        if (ends == OCCUPIED).all():  # it ends at walls, not at their doors
            break
    else:
        yield room
        return
    width = round(rng.uniform(*DOOR) / CELL)
    door = int(rng.integers(low + WALL, high - width - WALL))
    view[low:high, place : place + WALL] = OCCUPIED
    view[door : door + width, place : place + WALL] = FREE
    for start, end in ((first, place), (place + WALL, last)):
        yield from _divided(cells, (start, end, left, right) if across else (top, bottom, start, end), rng)


def _furnish(cells: np.ndarray, room: Room, rng: np.random.Generator) -> None:
    """Put up to two pieces of furniture into a room."""
    top, bottom, left, right = room
    clear = round(CLEAR / CELL)
    for _ in range(rng.integers(0, 3)):
        height, width = (round(side / CELL) for side in rng.uniform(*FURNITURE, 2))
        if bottom - top > 2 * clear + height and right - left > 2 * clear + width:
            row = rng.integers(top + clear, bottom - clear - height)
            column = rng.integers(left + clear, right - clear - width)
            cells[row : row + height, column : column + width] = OCCUPIED

"""A map scene from above, as a PNG of any size."""

from __future__ import annotations

import numpy as np

from whill_mjx.world.maps.grid import OCCUPIED
from whill_mjx.world.maps.playable import MapScene

OUTSIDE, SPACE, SOLID = (225, 225, 225), (255, 255, 255), (190, 180, 175)  # blue, green, red
WALL, START, GOAL, WAY = (60, 50, 40), (60, 160, 40), (230, 60, 20), (210, 200, 120)
EXAMPLES = 12
"""Pairs of start and goal that are drawn."""


def from_above(made: MapScene, pixels: int = 1200) -> bytes:
    """PNG in the grid's own frame, its y upwards: space white, occupied cells grey, walls dark.

    Some starts are green, their goals blue.
    """
    import cv2

    grid = made.grid
    rows, columns = grid.cells.shape
    scale = pixels / max(rows, columns)
    cells = np.full((rows, columns, 3), OUTSIDE, np.uint8)
    cells[grid.cells == OCCUPIED] = SOLID
    cells[made.space] = SPACE
    size = max(1, round(columns * scale)), max(1, round(rows * scale))
    image = cv2.resize(cells[::-1], size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_NEAREST)

    def place(points: np.ndarray) -> np.ndarray:
        x, y, yaw = grid.origin
        off = np.asarray(points)[..., :2] - np.array([x, y])
        cos, sin = np.cos(yaw), np.sin(yaw)
        along, across = off[..., 0] * cos + off[..., 1] * sin, off[..., 1] * cos - off[..., 0] * sin
        return np.stack([along, rows * grid.resolution - across], -1) / grid.resolution * scale

    def draw(points: np.ndarray, colour: tuple[int, int, int], thick: int = 1) -> None:
        lines = np.rint(place(points) * 16).astype(np.int32)
        cv2.polylines(image, list(lines), False, colour, thick, cv2.LINE_AA, shift=4)

    places = made.places
    chosen = np.linspace(0, len(places.way) - 1, EXAMPLES).astype(int)
    draw(np.stack([places.start[chosen, :2], places.goal[chosen]], 1), WAY)
    draw(made.walls.segments, WALL)
    radius = max(3, pixels // 250)
    for points, colour in ((places.start[chosen, :2], START), (places.goal[chosen], GOAL)):
        for point in np.rint(place(points)).astype(int):
            cv2.circle(image, (int(point[0]), int(point[1])), radius, colour, -1, cv2.LINE_AA)
    ok, data = cv2.imencode(".png", image)
    assert ok
    return data.tobytes()

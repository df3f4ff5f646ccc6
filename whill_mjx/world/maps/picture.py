"""A map scene from above, as a PNG of any size."""

from __future__ import annotations

import numpy as np

from whill_mjx.world.maps.grid import OCCUPIED
from whill_mjx.world.maps.playable import MapScene

OUTSIDE, SPACE, SOLID = (225, 225, 225), (255, 255, 255), (190, 180, 175)  # blue, green, red
WALL, START, GOAL, WAY = (60, 50, 40), (60, 160, 40), (230, 60, 20), (210, 200, 120)
EXAMPLES = 12
"""Pairs of start and goal that are drawn."""
LEGEND = 28
"""Height of the legend [pixels]."""
BARS = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0)
"""Lengths of the bar that shows the scale [m]."""


def from_above(made: MapScene, pixels: int = 1200) -> bytes:
    """PNG in the grid's own frame, its y upwards: space white, occupied cells grey, walls dark.

    Some starts are green, their goals blue. A legend with the scale is below the map.
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
    ok, data = cv2.imencode(".png", np.vstack([image, _legend(size[0], scale / grid.resolution)]))
    assert ok
    return data.tobytes()


def _legend(width: int, metre: float) -> np.ndarray:
    """Strip (LEGEND, width, 3) below the map: a bar of a round length, and what the colours mean; `metre` in pixels."""
    import cv2

    strip = np.full((LEGEND, width, 3), 255, np.uint8)
    length = max((one for one in BARS if one * metre <= width / 5), default=BARS[0])
    end, middle = 10 + round(length * metre), LEGEND // 2
    cv2.line(strip, (10, middle), (end, middle), WALL, 3)
    x = end + 8
    entries = ((f"{length:g} m", None), ("start", START), ("goal", GOAL), ("a pair; its way leads around walls", WAY))
    for word, colour in entries:
        if colour is not None:
            cv2.circle(strip, (x + 6, middle), 5, colour, -1, cv2.LINE_AA)
            x += 16
        cv2.putText(strip, word, (x, middle + 5), cv2.FONT_HERSHEY_SIMPLEX, 0.45, WALL, 1, cv2.LINE_AA)
        x += cv2.getTextSize(word, cv2.FONT_HERSHEY_SIMPLEX, 0.45, 1)[0][0] + 20
    return strip

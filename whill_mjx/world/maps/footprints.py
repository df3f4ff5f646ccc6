"""Footprints of buildings from OpenStreetMap (.osm) and CityGML (.gml) as an occupancy grid.

World frame: x east, y north, in m from the middle of all footprints; of projected coordinates, from the whole metre
next to it. The grid's shift or its notes state where that is. Everything outside of a footprint is free, up to
`MARGIN` around them. Bridges and roads are passed over: a deck overhead is no wall, and a road is free anyway.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np

from whill_mjx.io.reading import MB, read_bytes
from whill_mjx.world.maps.citygml import name_of, read_city
from whill_mjx.world.maps.coordinates import LATITUDE_LONGITUDE, to_world
from whill_mjx.world.maps.grid import FREE, OCCUPIED, GridMap
from whill_mjx.world.maps.osm import read_osm

XML_BYTES = 60 * MB
MARGIN = 10.0
"""Free ground around all footprints [m]."""
MAX_CELLS = 50 * MB
REMEDY = "Take smaller cells (--cell of python -m whill_mjx.maps)."


def load_footprints(path: str | Path, resolution: float = 0.1, scale: float = 1.0) -> GridMap:
    """Occupancy grid of the buildings of a file: OCCUPIED within a footprint, FREE around.

    Args:
        path: OSM XML or CityGML.
        resolution: edge of a cell [m].
        scale: metres per unit of projected CityGML; 1 for what its coordinate system says.

    Raises:
        ValueError: no such file, no XML, no building in it, or too large; names file and remedy.
    """
    path = Path(path)
    try:
        data = read_bytes(path, XML_BYTES, "does not exist. Give an OSM or CityGML file.")
    except FileNotFoundError as error:
        raise ValueError(str(error)) from None
    if b"<!ENTITY" in data:
        raise ValueError(f"{path}: declares XML entities, which no map needs. Remove them.")
    try:
        root = ET.fromstring(data)
    except (ET.ParseError, ValueError, LookupError) as error:
        raise ValueError(f"{path}: is no XML ({error}). Give an OSM or CityGML file.") from None
    try:
        outlines, shift, notes = _outlines(root, scale)
        cells, origin = _drawn(outlines, resolution)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    return GridMap(cells, resolution, origin, shift=shift, notes=tuple(notes), remedy=REMEDY)


def _outlines(root: ET.Element, scale: float) -> tuple[list[list[np.ndarray]], tuple[float, float], list[str]]:
    """Rings (n, 2) [m] of every building, the outer ones first, the shift of them all, and notes."""
    kind = name_of(root)
    if kind == "osm":
        (outlines, notes), system, name = read_osm(root), LATITUDE_LONGITUDE, "OpenStreetMap"
    elif kind == "CityModel":
        outlines, system, name, notes = read_city(root)
    else:
        raise ValueError(f"holds <{kind}>; only OSM XML (<osm>) and CityGML (<CityModel>) are read.")
    if not outlines:
        what = sorted({name_of(one[0]) for one in root if name_of(one) == "cityObjectMember" and len(one)})
        found = f" (found {', '.join(what)})" if what else ""
        left = f" ({'; '.join(notes)})" if notes else ""
        raise ValueError(f"has no building with a footprint{found}{left}. Choose another part of the map.")
    rings = [ring for one in outlines for ring in one]
    world = to_world(np.concatenate(rings), system, name, scale)
    pieces = iter(np.split(world.places, np.cumsum([len(ring) for ring in rings])[:-1]))
    return [[next(pieces) for _ in one] for one in outlines], world.shift, [*world.notes, *notes]


def _drawn(outlines: list[list[np.ndarray]], resolution: float) -> tuple[np.ndarray, tuple[float, float, float]]:
    """Cells with the outlines in them, and their origin: a ring inside another of its outline is a courtyard."""
    import cv2

    corners = np.concatenate([ring for rings in outlines for ring in rings])
    low, high = corners.min(0) - MARGIN, corners.max(0) + MARGIN
    width, height = np.ceil((high - low) / resolution)
    if not width * height <= MAX_CELLS:
        raise ValueError(
            f"spans {high[0] - low[0]:.4g} x {high[1] - low[1]:.4g} m, over {MAX_CELLS} cells of "
            f"{resolution:g} m. Cut the file or take larger cells."
        )
    cells = np.zeros((int(height), int(width)), np.uint8)
    for rings in outlines:
        # Corners of cells lie at whole numbers; fillPoly counts from the centres of pixels, in 1/256 of them.
        places = [(ring - low) / resolution - 0.5 for ring in rings]
        first = np.floor(np.min([place.min(0) for place in places], axis=0)).astype(int) - 1
        last = np.ceil(np.max([place.max(0) for place in places], axis=0)).astype(int) + 2
        part = cells[first[1] : last[1], first[0] : last[0]]
        layer = np.zeros_like(part)
        cv2.fillPoly(layer, [np.rint((place - first) * 256).astype(np.int32) for place in places], 1, shift=8)
        part |= layer
    return np.where(cells > 0, OCCUPIED, FREE).astype(np.uint8), (float(low[0]), float(low[1]), 0.0)

"""Footprints of buildings from OpenStreetMap (.osm) and CityGML (.gml) as an occupancy grid.

World frame: x east, y north, in m from the middle of all footprints. Everything outside of a footprint is free, up to
`MARGIN` around them. Bridges and roads are passed over: a deck overhead is no wall, and a road is free anyway.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np

from whill_mjx.io.reading import LONGEST_REASON, MB, read_bytes
from whill_mjx.world.maps.grid import FREE, OCCUPIED, GridMap

XML_BYTES = 60 * MB
MARGIN = 10.0
"""Free ground around all footprints [m]."""
MAX_CELLS = 50 * MB
EARTH = 6_378_137.0, 6.694_379_990_14e-3
"""Equatorial radius [m] and squared eccentricity of WGS84."""
GEOGRAPHIC = ("4326", "4979", "4258", "4612", "6667", "6668", "6697")
"""EPSG codes whose coordinates are latitude, longitude and, of some, height."""
GROUND = ("lod0FootPrint", "lod0RoofEdge", "GroundSurface")
"""Surfaces of a CityGML building that are its footprint; the first kind that there is."""
STANDING = ("Building", "BuildingPart", "CityFurniture")
Ring = np.ndarray


def load_footprints(path: str | Path, resolution: float = 0.1) -> GridMap:
    """Occupancy grid of the buildings of a file: OCCUPIED within a footprint, FREE around.

    Args:
        path: OSM XML or CityGML.
        resolution: edge of a cell [m].

    Raises:
        ValueError: no such file, no XML, no building in it, or too large; names file and remedy.
    """
    import cv2

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
    kind = _name(root)
    if kind not in ("osm", "CityModel"):
        raise ValueError(f"{path}: holds <{kind}>; only OSM XML (<osm>) and CityGML (<CityModel>) are read.")
    try:
        buildings = _osm(root) if kind == "osm" else _city(root)
    except (TypeError, ValueError, KeyError) as error:
        reason = str(error)[:LONGEST_REASON]
        raise ValueError(f"{path}: has a coordinate that cannot be read ({reason}). Export it again.") from None
    if not buildings:
        what = sorted({_name(one[0]) for one in root if _name(one) == "cityObjectMember" and len(one)})
        found = f" (found {', '.join(what)})" if what else ""
        raise ValueError(f"{path}: has no building with a footprint{found}. Choose another part of the map.")
    corners = np.concatenate([ring for rings in buildings for ring in rings])
    if not np.isfinite(corners).all():
        raise ValueError(f"{path}: has a coordinate that is no finite number. Export it again.")
    low, high = corners.min(0) - MARGIN, corners.max(0) + MARGIN
    width, height = np.ceil((high - low) / resolution)
    if not width * height <= MAX_CELLS:
        raise ValueError(
            f"{path}: spans {high[0] - low[0]:.4g} x {high[1] - low[1]:.4g} m, over {MAX_CELLS} cells of "
            f"{resolution:g} m. Cut the file or take larger cells."
        )
    cells = np.zeros((int(height), int(width)), np.uint8)
    for rings in buildings:
        # Corners of cells lie at whole numbers; fillPoly counts from the centres of pixels, in 1/256 of them.
        places = [(ring - low) / resolution - 0.5 for ring in rings]
        first = np.floor(np.min([place.min(0) for place in places], axis=0)).astype(int) - 1
        last = np.ceil(np.max([place.max(0) for place in places], axis=0)).astype(int) + 2
        part = cells[first[1] : last[1], first[0] : last[0]]
        layer = np.zeros_like(part)
        cv2.fillPoly(layer, [np.rint((place - first) * 256).astype(np.int32) for place in places], 1, shift=8)
        part |= layer  # of this building alone: a ring inside another is a courtyard
    return GridMap(np.where(cells > 0, OCCUPIED, FREE).astype(np.uint8), resolution, (low[0], low[1], 0.0))


def metres(degrees: np.ndarray) -> np.ndarray:
    """East and north (n, 2) [m] of latitude and longitude (n, 2) [degrees], on the plane that touches their middle."""
    middle = np.deg2rad((degrees.min(0) + degrees.max(0)) / 2)
    radius, squared = EARTH
    curved = 1.0 - squared * math.sin(middle[0]) ** 2
    east, north = radius / math.sqrt(curved), radius * (1.0 - squared) / curved**1.5
    off = np.deg2rad(degrees) - middle
    return np.column_stack([off[:, 1] * east * math.cos(middle[0]), off[:, 0] * north])


def _name(element: ET.Element) -> str:
    return element.tag.rpartition("}")[2]


def _osm(root: ET.Element) -> list[list[Ring]]:
    """Rings of every building, the outer ones first; a building is a closed way or a multipolygon."""
    places = {
        node.get("id"): (float(node.get("lat", "nan")), float(node.get("lon", "nan")))
        for node in root.iter("node")
        if node.get("visible") != "false" and node.get("lat")
    }
    ways = {
        way.get("id"): [place for one in way.iter("nd") if (place := places.get(one.get("ref")))]
        for way in root.iter("way")
        if way.get("visible") != "false"
    }
    chosen: list[list[list[tuple[float, float]]]] = []
    for way in root.iter("way"):
        ring = ways.get(way.get("id"), [])
        if _is_building(way) and len(ring) > 3 and ring[0] == ring[-1]:
            chosen.append([ring])
    for relation in root.iter("relation"):
        if _is_building(relation):
            parts = [ways[one.get("ref")] for one in relation.iter("member") if one.get("ref") in ways]
            rings = _joined(parts)
            if rings:
                chosen.append(rings)
    return _in_metres([[np.array(ring) for ring in rings] for rings in chosen], metres)


def _is_building(element: ET.Element) -> bool:
    tags = {tag.get("k"): tag.get("v") for tag in element.iter("tag")}
    below = tags.get("location") == "underground" or (tags.get("layer") or "0").startswith("-")
    return tags.get("building", "no") not in ("no", "roof") and not below


def _joined(parts: list[list]) -> list[list]:
    """Closed rings of pieces that meet at their ends."""
    rings, parts = [], [list(part) for part in parts if len(part) > 1]
    while parts:
        ring = parts.pop()
        while ring[0] != ring[-1]:
            for index, part in enumerate(parts):
                if ring[-1] in (part[0], part[-1]):
                    part = parts.pop(index)
                    ring += (part if part[0] == ring[-1] else part[::-1])[1:]
                    break
            else:
                break
        if len(ring) > 3 and ring[0] == ring[-1]:
            rings.append(ring)
    return rings


def _city(root: ET.Element) -> list[list[Ring]]:
    """Rings of every building and piece of street furniture of a CityGML file."""
    system = next((one.get("srsName", "") for one in root.iter() if one.get("srsName")), "")
    geographic = any(system.rstrip("/").endswith(code) for code in GEOGRAPHIC)
    chosen = []
    for thing in root.iter():
        if _name(thing) not in STANDING:
            continue
        if any(_name(one) == "BuildingPart" for one in thing.iter() if one is not thing):
            continue  # its parts stand for it
        for wanted in (*GROUND, None):
            surfaces = [thing] if wanted is None else [one for one in thing.iter() if _name(one) == wanted]
            polygons = [one for surface in surfaces for one in surface.iter() if _name(one) == "Polygon"]
            if polygons:  # without a ground surface, the shadow of all surfaces
                chosen += [_rings(polygon) for polygon in polygons]
                break
    return _in_metres([rings for rings in chosen if rings], metres if geographic else lambda places: places)


def _rings(polygon: ET.Element) -> list[Ring]:
    rings = []
    for ring in polygon.iter():
        if _name(ring) != "LinearRing":
            continue
        lists = [one for one in ring if _name(one) == "posList"]
        size = int((lists[0].get("srsDimension") if lists else None) or 3)
        if size not in (2, 3):
            raise ValueError(f"points of {size} numbers")
        numbers = [
            float(word)
            for one in (lists or [one for one in ring if _name(one) == "pos"])
            for word in (one.text or "").split()
        ]
        if len(numbers) % size:
            raise ValueError(f"{len(numbers)} numbers in points of {size}")
        rings.append(np.array(numbers).reshape(-1, size)[:, :2])
    return [ring for ring in rings if len(ring) > 2]


def _in_metres(buildings: list[list[Ring]], convert) -> list[list[Ring]]:
    """The rings after `convert`, which sees the corners of all at once."""
    rings = [ring for one in buildings for ring in one]
    if not rings:
        return []
    flat = convert(np.concatenate(rings))
    pieces = iter(np.split(flat, np.cumsum([len(ring) for ring in rings])[:-1]))
    return [[next(pieces) for _ in one] for one in buildings]

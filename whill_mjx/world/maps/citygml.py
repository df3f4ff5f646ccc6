"""Outlines of the buildings and the street furniture of CityGML."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from typing import NamedTuple

import numpy as np

from whill_mjx.io.reading import LONGEST_REASON
from whill_mjx.world.maps.coordinates import System, read_numbers, system_of, unreadable

STANDING = ("Building", "BuildingPart", "CityFurniture")
GROUND = ("lod0FootPrint", "lod0RoofEdge", "GroundSurface")
"""Surfaces that are the footprint of a thing; the first kind that it has. Without them, the shadow of all surfaces."""
SURFACES = ("Polygon", "PolygonPatch", "Triangle", "Rectangle")
TEMPLATE = ("relativeGMLGeometry", "relativeGeometry")
INNER = ("interior", "innerBoundaryIs")
MOST_PLACED = 5_000_000
"""Elements that templates may place: a small file can place a large one any number of times."""


class Outline(NamedTuple):
    """Rings (n, 2) of a polygon."""

    outer: list[np.ndarray]
    inner: list[np.ndarray]


class Placement(NamedTuple):
    """Where an implicit geometry puts its template."""

    matrix: np.ndarray
    """(3, 4): turns, scales and moves the template."""
    reference: np.ndarray
    """(2,) place of the template's origin, in the coordinate system."""


class Around(NamedTuple):
    """What the elements around an element say about it."""

    srs: str
    size: str | None = None
    """Numbers of a point, as srsDimension states."""
    thing: dict[str | None, list[Outline]] | None = None
    """Outlines by the kind of ground surface; None outside of what stands."""
    ground: str | None = None
    outline: Outline | None = None
    is_inner: bool = False
    placement: Placement | None = None


def name_of(element: ET.Element) -> str:
    """Name of an element without its namespace."""
    return element.tag.rpartition("}")[2]


def read_city(root: ET.Element) -> tuple[list[list[np.ndarray]], System, str, list[str]]:
    """Rings (n, 2) of every outline, the outer ones first, their coordinate system, its name, and notes.

    A building and each of its parts stand for themselves: the main body may be in either.

    Raises:
        ValueError: a coordinate cannot be read, or two kinds of coordinate systems are mixed.
    """
    first = next((one.get("srsName", "") for one in root.iter() if one.get("srsName")), "")
    ids = {value: one for one in root.iter() for key, value in one.items() if key.rpartition("}")[2] == "id"}
    things: list[dict[str | None, list[Outline]]] = []
    systems: dict[System, str] = {}
    absent = placed = 0
    stack = [(root, Around(first))]
    while stack:
        element, around = stack.pop()
        name, around = name_of(element), _inherit(element, around)
        placed += around.placement is not None
        if placed > MOST_PLACED:
            raise ValueError(f"places over {MOST_PLACED} elements by templates. Cut the file.")
        if name in STANDING:
            things.append({})
            around = around._replace(thing=things[-1], ground=None)
        elif name in GROUND:
            around = around._replace(ground=name)
        elif around.thing is None:
            pass
        elif name in SURFACES:
            outline = Outline([], [])
            around.thing.setdefault(around.ground, []).append(outline)
            around = around._replace(outline=outline, is_inner=False)
        elif name in INNER:
            around = around._replace(is_inner=True)
        elif name == "LinearRing" and around.outline is not None:
            points = _points(element, around)
            if len(points) > 2:
                (around.outline.inner if around.is_inner else around.outline.outer).append(_at(points, around))
                systems.setdefault(system_of(around.srs), _one_line(around.srs))
            continue
        elif name == "ImplicitGeometry":
            template, placement = _template(element, ids), _placement(element, around)
            if around.placement is None and template is not None and placement is not None:
                stack.append((template, around._replace(placement=placement, size=None)))
            else:
                absent += 1
            continue
        stack += [(child, around) for child in element]
    if len(systems) > 1:
        raise ValueError(f"mixes coordinate systems ({', '.join(systems.values())}). Reproject all of it to one.")
    notes = [f"implicit geometries: {absent} left out, whose template or place is not in the file"] if absent else []
    return _chosen(things), *next(iter(systems.items()), (System(), _one_line(first))), notes


def _one_line(srs: str) -> str:
    return " ".join(srs.split())[:LONGEST_REASON] or "a file without srsName"


def _chosen(things: list[dict[str | None, list[Outline]]]) -> list[list[np.ndarray]]:
    """The footprint of each thing, or its shadow. A hole without a border around it is none."""
    chosen = []
    for thing in things:
        drawn = {kind: [[*one.outer, *one.inner] for one in some if one.outer] for kind, some in thing.items()}
        kind = next((kind for kind in GROUND if drawn.get(kind)), None)
        chosen += drawn[kind] if kind else [one for some in drawn.values() for one in some]
    return chosen


def _inherit(element: ET.Element, around: Around) -> Around:
    """`around` with what the element says itself, or for all of a feature the envelope in its boundedBy."""
    srs = element.get("srsName")
    for child in element if srs is None else ():
        if name_of(child) == "boundedBy":
            srs = next((one.get("srsName") for one in child if name_of(one) == "Envelope"), srs)
    size = element.get("srsDimension")
    if around.placement is not None:
        srs = None  # a template has coordinates of its own
    return around._replace(srs=srs or around.srs, size=size or around.size) if srs or size else around


def _points(ring: ET.Element, around: Around) -> np.ndarray:
    """Points (n, 3) of a ring; the height of flat ones is 0.

    Where no srsDimension stands on the ring or around it, a ring has the dimension in which it is closed.
    """
    lists = [one for one in ring if name_of(one) == "posList"]
    if lists:
        numbers = [number for one in lists for number in read_numbers(one.text)]
        stated = lists[0].get("srsDimension") or around.size
    else:
        places = _single_points(ring)
        numbers = [number for place in places for number in place]
        stated = str(len(places[0])) if places else None
        if len({len(place) for place in places}) > 1:
            raise unreadable("points of different lengths in one ring")
    closed = (size for size in (3, 2) if len(numbers) % size == 0 and numbers[:size] == numbers[-size:])
    if stated not in (None, "2", "3"):
        raise unreadable(f"points of {stated} numbers")
    size = int(stated) if stated else next(closed, 3)
    if len(numbers) % size:
        raise unreadable(f"{len(numbers)} numbers in points of {size}")
    points = np.zeros((len(numbers) // size, 3))
    points[:, :size] = np.reshape(numbers, (-1, size))
    return points


def _single_points(element: ET.Element) -> list[list[float]]:
    """Points of the `pos` of an element, or of the `coordinates` of older files: "1,2,3 4,5,6"."""
    texts: list[str | None] = []
    for one in element.iter():
        if name_of(one) == "pos":
            texts.append(one.text)
        elif name_of(one) == "coordinates":
            texts += [word.replace(",", " ") for word in (one.text or "").split()]
    return [read_numbers(text) for text in texts]


def _at(points: np.ndarray, around: Around) -> np.ndarray:
    """Places (n, 2) of the points (n, 3) of a ring, which may be one of a template."""
    if around.placement is None:
        return points[:, :2]
    matrix, reference = around.placement
    return system_of(around.srs).beside(reference, (points @ matrix[:, :3].T + matrix[:, 3])[:, :2])


def _template(element: ET.Element, ids: dict[str, ET.Element]) -> ET.Element | None:
    """Geometry of an implicit geometry, in itself or elsewhere in the file."""
    for one in element:
        if name_of(one) in TEMPLATE:
            link = next((value for key, value in one.items() if key.rpartition("}")[2] == "href"), None)
            return one if link is None else ids.get(link.removeprefix("#"))
    return None


def _placement(element: ET.Element, around: Around) -> Placement | None:
    """Placement of an implicit geometry; None without a reference point."""
    matrix, reference = np.eye(4), None
    for one in element:
        if name_of(one) == "transformationMatrix":
            numbers = read_numbers(one.text)
            if len(numbers) != 16:
                raise unreadable(f"a transformationMatrix of {len(numbers)} numbers")
            matrix = np.array(numbers).reshape(4, 4)
        elif name_of(one) == "referencePoint":
            reference = next((np.array(place[:2]) for place in _single_points(one) if len(place) > 1), None)
    return None if reference is None else Placement(matrix[:3], reference)

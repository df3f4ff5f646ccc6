"""Outlines of the buildings of OpenStreetMap XML: closed ways, and relations of ways."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET

import numpy as np

from whill_mjx.world.maps.coordinates import read_numbers, unreadable
from whill_mjx.world.maps.surfaces import HEADROOM

OUTER, INNER = ("outer", "outline", ""), "inner"
"""Roles of the ways around a building, and around its courtyards; others, such as `part`, are no border of it."""
FEET, STOREY = 0.3048, 3.0  # m
Place = tuple[float, float]


def read_osm(root: ET.Element) -> tuple[list[list[np.ndarray]], list[str]]:
    """Rings (n, 2) of latitude and longitude of every building, the outer one first, and notes on what is missing."""
    ways, short = _read_ways(root)
    chosen: list[list[np.ndarray]] = []
    cut: list[str] = []
    drawn: list[str] = []  # without some of their corners
    pieces: set[str | None] = set()  # ways of relations, whose outlines stand for them
    for relation in filter(_is_building, root.iter("relation")):
        roles, called = _roles(relation), f"relation {relation.get('id')}"
        outlines, whole = _outlines(roles, ways)
        chosen += outlines
        pieces |= set(roles)
        cut += [] if whole else [called]
        borders = {ref for ref, role in roles.items() if role in (*OUTER, INNER)}
        drawn += [called] if outlines and short & borders else []
    around = {_corners(outline[0]) for outline in chosen}  # a way that has the tags of its relation, too
    for way in filter(_is_building, root.iter("way")):
        name = way.get("id")
        if _is_closed(ring := ways.get(name, [])):
            if frozenset(ring) not in around:
                chosen.append([np.array(ring)])
                drawn += [f"way {name}"] if name in short else []
        elif name in ways and name not in pieces:
            cut.append(f"way {name}")
    notes = {"borders of buildings that are not whole in the file, left out": cut,
             "borders of buildings with corners that are not in the file, drawn without them": drawn}  # fmt: skip
    return chosen, [f"{what}: {_named(names)}" for what, names in notes.items() if names]


def _read_ways(root: ET.Element) -> tuple[dict[str | None, list[Place]], set[str | None]]:
    """Corners of every way by its id, and the ways of which some corners are not in the file."""
    places = {
        node.get("id"): _place(node)
        for node in root.iter("node")
        if _is_there(node) and node.get("lat")
    }
    ways, short = {}, set()
    for way in root.iter("way"):
        if _is_there(way):
            corners = [places.get(one.get("ref")) for one in way.iter("nd")]
            ways[way.get("id")] = [place for place in corners if place]
            if None in corners:
                short.add(way.get("id"))
    return ways, short


def _corners(ring: np.ndarray) -> frozenset[Place]:
    return frozenset((float(a), float(b)) for a, b in ring)


def _named(names: list[str]) -> str:
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")


def _place(node: ET.Element) -> Place:
    numbers = read_numbers(f"{node.get('lat')} {node.get('lon', 'nan')}")
    if len(numbers) != 2:
        raise unreadable(f"node {node.get('id')}")
    return numbers[0], numbers[1]


def _is_there(element: ET.Element) -> bool:
    """Whether nobody has deleted it, on the server or in the editor that wrote the file."""
    return element.get("visible") != "false" and element.get("action") != "delete"


def _is_building(element: ET.Element) -> bool:
    tags = {tag.get("k"): tag.get("v") for tag in element.iter("tag")}
    below = tags.get("location") == "underground" or (tags.get("layer") or "0").startswith("-")
    above = _begins_at(tags.get("min_height"), tags.get("building:min_level")) > HEADROOM  # a vehicle passes under it
    return tags.get("building", "no") not in ("no", "roof") and not below and not above and _is_there(element)


def _begins_at(height: str | None, level: str | None) -> float:
    """Height above the ground [m] at which a building begins, by its tags; 0 where they do not say so."""
    if found := re.match(r"(\d+(?:\.\d+)?) *(m|'|ft|$)", height or ""):
        return float(found[1]) * (FEET if found[2] in ("'", "ft") else 1.0)
    return STOREY * float(level) if level and level.isdecimal() else 0.0


def _is_closed(ring: list[Place]) -> bool:
    return len(ring) > 3 and ring[0] == ring[-1]


def _roles(relation: ET.Element) -> dict[str | None, str]:
    """Role of each way of a relation."""
    return {one.get("ref"): one.get("role", "") for one in relation.iter("member") if one.get("type") == "way"}


def _outlines(
    roles: dict[str | None, str], ways: dict[str | None, list[Place]]
) -> tuple[list[list[np.ndarray]], bool]:
    """Outer rings of a relation, each with its courtyards, and whether no piece of an outer ring was left over."""
    outer, whole = _joined([ways.get(ref, []) for ref, role in roles.items() if role in OUTER])
    inner, _ = _joined([ways.get(ref, []) for ref, role in roles.items() if role == INNER])
    if not any(roles.values()):  # as old data has it: a ring within another one is its courtyard
        inner = [ring for ring in outer if any(_is_around(other, ring) for other in outer)]
        outer = [ring for ring in outer if not any(ring is one for one in inner)]
    outlines = [[ring] for ring in sorted(outer, key=_area)]
    for ring in inner:  # of the smallest outer ring around it; without such a ring it is nothing
        next((one for one in outlines if _is_around(one[0], ring)), []).append(ring)
    return outlines, whole


def _joined(parts: list[list[Place]]) -> tuple[list[np.ndarray], bool]:
    """Closed rings (n, 2) of pieces that meet at their ends, and whether no piece is missing or left over."""
    rings, whole, parts = [], all(len(part) > 1 for part in parts), [list(part) for part in parts if len(part) > 1]
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
        if _is_closed(ring):
            rings.append(np.array(ring))
        else:
            whole = False
    return rings, whole


def _area(ring: np.ndarray) -> float:
    x, y = (ring - ring[0]).T
    return abs(float(x[:-1] @ y[1:] - x[1:] @ y[:-1])) / 2


def _crossings(ring: np.ndarray, height: float) -> np.ndarray:
    """Sorted first coordinates at which a ring crosses a second coordinate."""
    a, b = ring[:-1], ring[1:]
    met = (a[:, 1] > height) != (b[:, 1] > height)
    a, b = a[met], b[met]
    return np.sort(a[:, 0] + (height - a[:, 1]) / (b[:, 1] - a[:, 1]) * (b[:, 0] - a[:, 0]))


def _inner_point(ring: np.ndarray) -> tuple[float, float]:
    """A point inside of a ring, off its border: a corner may lie on the ring around it."""
    heights = np.unique(ring[:, 1])
    height = float(heights[:2].mean())
    met = _crossings(ring, height)
    return (float(met[:2].mean()) if len(met) else float(ring[0, 0])), height


def _is_around(ring: np.ndarray, other: np.ndarray) -> bool:
    """Whether a ring is larger than another one that lies in it."""
    return _area(ring) > _area(other) and _is_within(_inner_point(other), ring)


def _is_within(point: tuple[float, float], ring: np.ndarray) -> bool:
    return int((_crossings(ring, point[1]) > point[0]).sum()) % 2 == 1

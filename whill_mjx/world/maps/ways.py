"""Ways on which people walk in a map, and which of them lead past a place."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from whill_mjx.world.maps.grid import GridMap
from whill_mjx.world.maps.places import WayGraph, way_graph
from whill_mjx.world.people.crowd import RADIUS, Crowd, People, people_on
from whill_mjx.world.people.law import BUFFER
from whill_mjx.world.people.places import chosen_apart

WAYS, POINTS, SPACING = 128, 16, 1.5
"""Ways of a map, points of each, and the largest distance of two along the way [m]."""
PASSING = RADIUS + BUFFER
"""Clearance that people need on their way: no wall turns them aside [m]."""
LISTED = 48
"""Points listed for each start."""


@dataclass(frozen=True, eq=False)
class Ways:
    """Shortest ways between far places. Static, and shared by all instances."""

    points: np.ndarray
    """(R, W, 2) m, each in sight of the next; a shorter way leads to and fro."""
    start: np.ndarray
    """(Q, 2) m, the vehicle's starts."""
    near: np.ndarray
    """(Q, LISTED) int32, way * W + point of what is near each start; -1 is none."""


def draw_ways(
    grid: GridMap, space: np.ndarray, starts: np.ndarray, clear: float, within: float, seed: int = 0
) -> Ways:
    """Ways of up to POINTS points between random places of a space, and those near the starts (Q, 2) [m].

    The places are those from which people get to a start.

    Args:
        grid, space: of the map.
        starts: of the vehicle.
        clear, within: least and greatest distance of a listed point from the start [m].
        seed: of the draw.
    """
    from scipy.sparse.csgraph import connected_components, dijkstra
    from scipy.spatial import cKDTree

    graph = way_graph(grid, space, PASSING)
    _, part = connected_components(graph.links, directed=False)
    rng = np.random.default_rng(seed)
    longest = SPACING * (POINTS - 1)
    rows, length = [], []
    beside = cKDTree(graph.points).query(starts[:, :2])[1]
    for origin in rng.choice(np.flatnonzero(np.isin(part, part[beside])), WAYS):
        far, before = dijkstra(graph.links, directed=False, indices=origin, return_predecessors=True, limit=longest)
        reached = np.flatnonzero(np.isfinite(far))
        place = rng.choice(reached[far[reached] >= 0.5 * far[reached].max()])
        way = [place]
        while before[way[-1]] >= 0:
            way.append(before[way[-1]])
        chosen = _turning_points(graph, np.asarray(way), far)
        rows.append(graph.points[np.pad(chosen, (0, POINTS - len(chosen)), mode="reflect")])
        length.append(len(chosen))
    ways = np.stack(rows)
    real = np.arange(POINTS) < np.asarray(length)[:, None]
    places, flat = ways[real], np.flatnonzero(real)
    near = np.full((len(starts), LISTED), -1, np.int32)
    for number, start in enumerate(starts[:, :2]):
        distance = np.hypot(*(places - start).T)
        fits = np.flatnonzero((distance >= clear) & (distance <= within))
        listed = rng.permutation(fits)[:LISTED]
        near[number, : len(listed)] = flat[listed]
    return Ways(ways.astype(np.float32), starts[:, :2].astype(np.float32), near)


def _turning_points(graph: WayGraph, way: np.ndarray, far: np.ndarray) -> np.ndarray:
    """Up to POINTS points of a way (n,), at most SPACING apart along it, of which each sees the next.

    A line of sight has the room of a person, RADIUS. `far` (P,) is the distance of each point along the way [m].
    """
    chosen = [0]
    while chosen[-1] < len(way) - 1 and len(chosen) < POINTS:
        here = chosen[-1]
        ahead = here + 1 + np.flatnonzero(far[way[here]] - far[way[here + 1 :]] <= SPACING)
        seen = [one for one in ahead if _sees(graph, way[here], way[one])]
        chosen.append(int(max(seen, default=here + 1)))
    return way[chosen]


def _sees(graph: WayGraph, one: int, other: int) -> bool:
    a, b = graph.cells[one], graph.cells[other]
    between = np.rint(np.linspace(a, b, np.abs(b - a).max() + 1)).astype(int)
    return bool((graph.clear[tuple(between.T)] >= RADIUS).all())


def people_near(key: jax.Array, ways: Ways, start: jax.Array, crowd: Crowd) -> People:
    """People on the ways near the vehicle's start (3,), who walk to and fro; those without a place are not there."""
    order_key, key = jax.random.split(key)
    which = jnp.argmin(jnp.sum((jnp.asarray(ways.start) - start[:2]) ** 2, -1))
    listed = jax.random.permutation(order_key, jnp.asarray(ways.near)[which])
    flat = jnp.maximum(listed, 0)
    way, point = flat // POINTS, flat % POINTS
    points = jnp.asarray(ways.points)
    chosen, there = chosen_apart(points[way, point], listed >= 0, crowd.count)
    return people_on(key, crowd, points[way[chosen]], point[chosen], there)

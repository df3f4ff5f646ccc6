"""Where an episode in a map may start and end: places that a vehicle can stand at, with a way between them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from whill_mjx.world.maps.grid import GridMap
from whill_mjx.world.maps.walls import NEAR

STEP = 0.2
"""Distance of neighbouring points of the graph of ways, about [m]."""
AHEAD = 5
"""Points of the way over which a start's direction is taken."""
ASIDE, TURNING = 0.17, 0.05
"""Room on each side of a vehicle on its way, and around its farthest corner where it turns on the spot [m]."""
SEEN = 0.63
"""Distance from its border at which a vehicle notices walls at least [m]."""


class NoRoom(ValueError):
    """A vehicle finds no room in a map: the map is wrong, or too much is asked of it."""


@dataclass(frozen=True)
class Reach:
    """What a vehicle needs of a map [m]; the defaults are a WHILL Model CR's, `reach_of` gives those of others."""

    passing: float = 0.45
    """Clearance on the way: half the vehicle's width and some room."""
    standing: float = 0.95
    """Clearance at start and goal: the farthest corner of a WHILL Model CR from its driven axle, and some room."""
    nearest: float = 3.0
    """Shortest way from start to goal."""
    farthest: float = 12.0
    """Longest way from start to goal."""
    near: float = NEAR
    """How far from the middle of its body walls matter: those that it meets in one step, or whose distance is read."""


def reach_of(spec: Any, moves: float = 0.0, **lengths: float) -> Reach:
    """What a vehicle needs of a map, by its size, in whole centimetres.

    Args:
        spec: sizes of the vehicle (`whill_mjx.vehicle.specs.VehicleSpec`).
        moves: how far its body's middle moves in one control period at most [m] (`farthest_move`).
        lengths: `nearest` and `farthest` of `Reach`.
    """
    side, half = spec.body_width / 2, math.hypot(spec.body_length, spec.body_width) / 2
    corner = math.hypot(abs(spec.reference_x) + spec.body_length / 2, side)  # from the driven axle, on which it turns
    passing, standing, near = (math.ceil(100 * one - 1e-6) / 100
                               for one in (side + ASIDE, corner + TURNING, half + max(SEEN, moves)))  # fmt: skip
    return Reach(passing=passing, standing=standing, near=max(near, NEAR), **lengths)  # people look up walls too


def farthest_move(spec: Any, speed: float, yaw_rate: float, duration: float) -> float:
    """How far [m] the middle of a body moves at most in a time [s], at a speed [m/s] and a yaw rate [rad/s]."""
    return duration * (abs(speed) + abs(yaw_rate * spec.reference_x))


@dataclass(frozen=True, eq=False)
class Places:
    """Q pairs of start and goal in one map."""

    start: np.ndarray
    """(Q, 3) x [m], y [m], and yaw [rad] along the way."""
    goal: np.ndarray
    """(Q, 2) x, y [m]."""
    way: np.ndarray
    """(Q,) length of the way [m]."""


def clearances(space: np.ndarray, resolution: float) -> np.ndarray:
    """(rows, columns) m: distance of each cell's centre from the border of the space; 0 outside."""
    from scipy.ndimage import distance_transform_edt

    padded = np.pad(space, 1)
    return np.where(space, distance_transform_edt(padded)[1:-1, 1:-1] - 0.5, 0.0) * resolution


class WayGraph(NamedTuple):
    """Ways in a map as a graph of points about `STEP` apart with enough clearance to pass."""

    clear: np.ndarray
    """(rows, columns) m: clearance of all cells."""
    cells: np.ndarray
    """(P, 2) row and column of each point."""
    points: np.ndarray
    """(P, 2) m, in the world."""
    links: Any
    """(P, P) m: distances between neighbours (scipy, sparse); each is there once."""


def way_graph(grid: GridMap, space: np.ndarray, passing: float) -> WayGraph:
    """Graph of the points of a space that have a clearance `passing` [m]."""
    from scipy.sparse import coo_array

    clear = clearances(space, grid.resolution)
    stride = max(1, round(STEP / grid.resolution))
    coarse = clear[stride // 2 :: stride, stride // 2 :: stride]
    rows, columns = np.nonzero(coarse >= passing)
    number = np.full(np.add(coarse.shape, 1), -1)
    number[rows, columns] = np.arange(len(rows))
    tails, heads, lengths = [], [], []
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
        other = number[rows + down, columns + right]
        linked = other >= 0
        tails.append(number[rows, columns][linked])
        heads.append(other[linked])
        lengths.append(np.full(linked.sum(), np.hypot(down, right) * stride * grid.resolution))
    count = len(rows)
    tail, head, length = (np.concatenate(parts) for parts in (tails, heads, lengths))
    cells = np.stack([rows, columns], -1) * stride + stride // 2
    points = grid.to_world((cells[:, ::-1] + 0.5) * grid.resolution)
    return WayGraph(clear, cells, points, coo_array((length, (tail, head)), (count, count)).tocsr())


def draw_places(
    grid: GridMap, space: np.ndarray, reach: Reach, goals: int = 64, each: int = 32, seed: int = 0
) -> Places:
    """Pairs with a way of the asked length between them: `each` starts for each of `goals` goals.

    Raises:
        NoRoom: the map has no such pair; names the largest clearance and the length of the longest way.
    """
    from scipy.sparse.csgraph import dijkstra

    clear, cells, points, links = way_graph(grid, space, reach.passing)
    standing = np.flatnonzero(clear[tuple(cells.T)] >= reach.standing)
    rng = np.random.default_rng(seed)
    starts, ends, ways = [], [], []
    longest = 0.0
    for goal in rng.permutation(standing)[:goals]:
        distance, before = dijkstra(  # a goal sees no farther than it needs to: a city has a million points
            links, directed=False, indices=goal, return_predecessors=True, limit=reach.farthest
        )
        far = distance[standing]
        longest = max(longest, float(far[np.isfinite(far)].max()))
        fits = standing[(far >= reach.nearest) & (far <= reach.farthest)]
        if not len(fits):
            continue
        chosen = rng.choice(fits, each)
        ahead = chosen
        for _ in range(AHEAD):
            ahead = np.where(before[ahead] >= 0, before[ahead], ahead)
        way = points[ahead] - points[chosen]
        starts.append(np.column_stack([points[chosen], np.arctan2(way[:, 1], way[:, 0])]))
        ends.append(np.repeat(points[goal][None], each, 0))
        ways.append(distance[chosen])
    if not starts:
        raise NoRoom(
            f"the map has no start and goal {reach.nearest:g} to {reach.farthest:g} m apart: its widest place has "
            f"{clear.max():.2f} m of clearance where {reach.standing:g} m are needed, its longest way is "
            f"{longest:.1f} m. {grid.remedy}"
        )
    return Places(np.concatenate(starts), np.concatenate(ends), np.concatenate(ways))

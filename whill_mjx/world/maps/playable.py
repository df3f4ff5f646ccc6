"""A map as a world to drive in: walls, starts and goals; each episode draws one pair."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from whill_mjx.world.maps.footprints import load_footprints
from whill_mjx.world.maps.grid import FARTHEST, GridMap
from whill_mjx.world.maps.made import made_plan
from whill_mjx.world.maps.nav2 import NAV2, load_map
from whill_mjx.world.maps.places import NoRoom, Places, Reach, clearances, draw_places
from whill_mjx.world.maps.straight import connected, open_space, straight_walls
from whill_mjx.world.maps.surfaces import CLOUDS, MESHES, load_surfaces
from whill_mjx.world.maps.walls import SHOWN, map_walls
from whill_mjx.world.scene import BLUE, WALL, MapWalls, Marker, Scene, default_looks, no_boxes

MARKER_HALF, MARKER_HEIGHT = 0.3, 1.05
"""Half edge of the goal's square, and the height of its centre [m]."""
TURNED = 0.3
"""Largest angle of a start off its way [rad]."""


@dataclass(frozen=True, eq=False)
class MapScene:
    """What a map became: its space, walls and places."""

    grid: GridMap
    space: np.ndarray
    """(rows, columns) bool: what a vehicle can reach or see."""
    walls: MapWalls
    places: Places


def read_map(path: str | Path, cell: float = 0.1, scale: float = 1.0) -> GridMap:
    """Occupancy grid of a map of any known kind, by the ending of its name.

    "made:7" is the floor plan of seed 7. Footprints, point clouds and meshes get cells of `cell` [m]; `scale` is metres
    per unit of point clouds, meshes and projected CityGML. A map that lies far from its zero is moved there
    (`GridMap.shift`).
    """
    return _read(path, cell, scale).brought_near()


def _read(path: str | Path, cell: float, scale: float) -> GridMap:
    if (seed := _seed(path)) is not None:
        return made_plan(seed)
    ending = Path(path).suffix.lower()
    if ending in (*CLOUDS, *MESHES):
        return load_surfaces(path, cell, scale)
    if ending in (".osm", ".gml", ".xml"):
        return load_footprints(path, cell, scale)
    if ending in NAV2:
        return load_map(path)
    raise ValueError(f"{path}: unknown kind of map (known: .yaml of nav2, .osm, .gml, "
                     f"{', '.join(dict.fromkeys((*CLOUDS, *MESHES)))}). Give one of them, or made:SEED.")


def _seed(path: str | Path) -> int | None:
    """Seed of a floor plan of ours; None for a file."""
    made, _, seed = str(path).partition("made:")
    return int(seed) if not made and seed.isdecimal() else None


def has_cells(path: str | Path) -> bool:
    """Whether a map comes with cells of its own: `cell` and `scale` of `read_map` have no effect on it."""
    return _seed(path) is not None or Path(path).suffix.lower() in NAV2


def make_map_scene(grid: GridMap, reach: Reach | None = None, keep: int = SHOWN, seed: int = 0) -> MapScene:
    """Walls and places of a grid.

    Args:
        grid: from `load_map` or `load_footprints`.
        reach: what the vehicle needs (`reach_of`); None takes a WHILL Model CR.
        keep: walls that an image shows at most.
        seed: of the places.

    Raises:
        ValueError: it reaches too far from zero.
        NoRoom: no place is wide enough, or no two are the asked distance apart.
    """
    reach = reach or Reach()
    if (far := grid.farthest()) > FARTHEST:
        raise ValueError(f"the map's corners lie {far:.0f} m from zero; poses are in single precision, so a map may "
                         f"reach {FARTHEST:g} m. Cut it into smaller ones"
                         f"{', or take grid.brought_near()' if grid.brought_near().farthest() <= FARTHEST else ''}.")
    space = open_space(grid)
    clear = clearances(space, grid.resolution)
    space = connected(space, clear >= reach.passing)
    if not space.any():
        raise NoRoom(
            f"the map's widest place has {clear.max():.2f} m of clearance, and the vehicle needs "
            f"{reach.passing:g} m. {grid.remedy}"
        )
    places = draw_places(grid, space, reach, seed=seed)
    return MapScene(grid, space, map_walls(straight_walls(grid, space), keep, near=reach.near), places)


def map_scene_sampler(made: Any) -> Callable[[jax.Array], tuple[Scene, jax.Array]]:
    """Function of a key that draws the scene and the start (3,) [m, m, rad] of an episode; pure, of one instance.

    `made` is a `MapScene`, or a group of them (`whill_mjx.world.maps.several`).
    """
    starts, goals = made.places.start.astype(np.float32), made.places.goal.astype(np.float32)

    def sample(key: jax.Array) -> tuple[Scene, jax.Array]:
        start, goal = jnp.asarray(starts), jnp.asarray(goals)
        which, turn = jax.random.split(key)
        pair = jax.random.randint(which, (), 0, start.shape[0])
        begin = start[pair].at[2].add(jax.random.uniform(turn, minval=-TURNED, maxval=TURNED))
        position = jnp.append(goal[pair], MARKER_HEIGHT)
        faces = jnp.arctan2(goal[pair, 1] - begin[1], goal[pair, 0] - begin[0])
        half = jnp.array([0.02, MARKER_HALF, MARKER_HALF])
        marker = Marker(position, half, faces, jnp.array(BLUE))
        boxes = no_boxes(made.walls.keep)
        boxes = dataclasses.replace(boxes, colour=jnp.broadcast_to(jnp.array(WALL), boxes.colour.shape))
        return Scene(boxes, marker, default_looks(), walls=made.walls), begin

    return sample

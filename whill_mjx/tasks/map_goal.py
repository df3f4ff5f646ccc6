"""A goal in a real map, some metres away, with a way to it."""

from __future__ import annotations

import dataclasses
import hashlib
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, ClassVar

import jax

from whill_mjx.io.fields import Field, shown
from whill_mjx.sensors.commands import Commands
from whill_mjx.sensors.goal import Goal
from whill_mjx.sensors.lidar import Lidar
from whill_mjx.tasks.base import Task, World
from whill_mjx.vehicle.config import VehicleConfig
from whill_mjx.vehicle.specs import VehicleSpec
from whill_mjx.world.maps import GridMap, Reach, make_map_scene, map_scene_sampler, reach_of, read_map
from whill_mjx.world.maps.places import NoRoom, farthest_move
from whill_mjx.world.maps.several import MapGroup, side_by_side
from whill_mjx.world.maps.ways import Ways, people_near
from whill_mjx.world.people.crowd import Crowd, People

APART = 0.5
"""Least distance of people at the start from where the vehicle turns on the spot [m]."""


@dataclass(frozen=True)
class MapGoal(Task):
    """Drive to a point in a map. Start and goal are drawn anew for each episode; walls are seen, scanned and hit."""

    name: ClassVar[str] = "map_goal"
    rising: ClassVar[tuple[str, ...]] = ("nearest", "farthest")
    ranges: ClassVar[tuple[Field, ...]] = (
        Field("nearest", "m", 0.0, 1e4), Field("farthest", "m", 0.01, 1e4),
        Field("passing", "m", 0.0, 100.0), Field("standing", "m", 0.0, 100.0), Field("near", "m", 0.0, 100.0),
    )  # fmt: skip
    walls: ClassVar[int] = 0

    v_min: float = 0.0
    v_max: float = 0.8
    omega_max: float = 1.0
    max_steps: int = 400
    goal_radius: float = 0.5
    smoothness_gain: float = 0.1
    map: str = ""
    """nav2 map (.yaml), OpenStreetMap (.osm), CityGML (.gml), point cloud, mesh, or made:SEED for a floor plan of ours;
    several with commas between them are drawn from in turn."""
    nearest: float = 3.0
    """Shortest way to a goal [m]."""
    farthest: float = 12.0
    """Longest way to a goal [m]."""
    passing: float = 0.0
    """Clearance on the way [m]; 0 takes what the width of the vehicle needs."""
    standing: float = 0.0
    """Clearance at start and goal [m]; 0 takes what the vehicle needs to turn on the spot."""
    near: float = 0.0
    """Least distance from the vehicle's middle within which walls are met [m]; the size of the vehicle may raise it."""

    def __post_init__(self) -> None:
        if isinstance(self.map, os.PathLike):
            object.__setattr__(self, "map", os.fspath(self.map))  # a path becomes its text
        if not isinstance(self.map, str):
            raise ValueError(f"task: map is {shown(self.map)}; it must be a path, or several in one text with commas "
                             "between them. Give a file, or made:SEED for a floor plan of ours.")
        super().__post_init__()

    def for_vehicle(self, spec: VehicleSpec) -> MapGoal:
        """With the clearances that a vehicle of this size needs, where the fields leave them open."""
        moves = farthest_move(spec, max(abs(self.v_min), abs(self.v_max)), self.omega_max, VehicleConfig().control_dt)
        needed = reach_of(spec, moves)
        return dataclasses.replace(
            self, passing=self.passing or needed.passing, standing=self.standing or needed.standing,
            near=max(self.near, needed.near),
        )  # fmt: skip

    @property
    def reach(self) -> Reach:
        """What the vehicle needs of the map: a WHILL Model CR where none is given."""
        chair = Reach()
        return Reach(self.passing or chair.passing, self.standing or chair.standing, self.nearest, self.farthest,
                     self.near or chair.near)

    def sample_world(self, key: jax.Array) -> World:
        """One of the map's pairs of start and goal; always the same in a fixed layout."""
        sample = _sampler(self.map, self.reach)
        scene, start = sample(key if self.randomised else jax.random.key(0))
        return World(scene, start)

    def checksum(self) -> str | None:
        """Of the maps as they are read."""
        found = hashlib.sha256()
        for grid in _grids(self.map):
            found.update(repr((grid.cells.shape, grid.resolution, grid.origin)).encode() + grid.cells.tobytes())
        return found.hexdigest()

    def populate(self, key: jax.Array, world: World) -> People:
        """People on ways of the map that lead past the start."""
        ways = _ways(self.map, self.reach, self.people_within)
        return people_near(key, ways, world.start, self.crowd)

    def observations(self) -> Mapping[str, Any]:
        return {"goal": Goal(), "lidar": Lidar(rays=90, reach=8.0, z=0.3), "commands": Commands(1)}


@lru_cache(maxsize=8)
def _grids(paths: str) -> list[GridMap]:
    """The maps that are named, commas between them; ValueError says which one cannot be had."""
    if not all(names := [path.strip() for path in paths.split(",")]):
        raise ValueError(f"map is {paths!r}: a name is missing. Give a file, or made:SEED for a floor plan of ours.")
    return [read_map(name) for name in names]


@lru_cache(maxsize=8)
def _made(paths: str, reach: Reach) -> MapGroup:
    scenes = []
    for name, grid in zip(paths.split(","), _grids(paths), strict=True):
        try:
            scenes.append(make_map_scene(grid, reach))
        except NoRoom as error:
            raise ValueError(f"map {name.strip()}: {error} Where the map is right, lower the task's fields: passing is "
                             f"{reach.passing:g} m (0 takes what the vehicle's body_width needs), standing "
                             f"{reach.standing:g} m (0 takes what body_length and body_width need), and nearest "
                             f"{reach.nearest:g} m.") from None  # fmt: skip
        except ValueError as error:
            raise ValueError(f"map {name.strip()}: {error}") from None
    return side_by_side(scenes)


@lru_cache(maxsize=8)
def _sampler(paths: str, reach: Reach) -> Callable[[jax.Array], tuple[Any, jax.Array]]:
    return map_scene_sampler(_made(paths, reach))


@lru_cache(maxsize=8)
def _ways(paths: str, reach: Reach, within: float) -> Ways:
    clear = max(Crowd().clear, reach.standing + APART)
    return _made(paths, reach).ways(clear, within)

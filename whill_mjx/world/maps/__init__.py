"""Maps of real places as worlds to drive in.

images      image files as grey levels
nav2        nav2's YAML and image as an occupancy grid, by nav2's rule
footprints  buildings of OpenStreetMap and CityGML as an occupancy grid
osm         outlines of buildings of OpenStreetMap
citygml     outlines of buildings and street furniture of CityGML
coordinates coordinate systems of both, and their places in metres
surfaces    point clouds and meshes as an occupancy grid
grid        occupancy grid, borders of the free space
straight    long straight walls from the borders of cells
field       distance to the nearest thing
walls       which walls rays meet and a camera sees
made        floor plans of a seed
places      starts and goals with a way between them
ways        where people walk
playable    all that as the world of an episode
several     maps side by side in one world
"""

from whill_mjx.world.maps.field import DistanceField, distance_at, distance_field, map_clearance
from whill_mjx.world.maps.footprints import load_footprints
from whill_mjx.world.maps.grid import FREE, OCCUPIED, UNKNOWN, GridMap, wall_segments
from whill_mjx.world.maps.nav2 import load_map
from whill_mjx.world.maps.places import Places, Reach, reach_of
from whill_mjx.world.maps.playable import MapScene, make_map_scene, map_scene_sampler, read_map
from whill_mjx.world.maps.walls import cast, nearest_walls, shown

__all__ = [
    "FREE",
    "OCCUPIED",
    "UNKNOWN",
    "DistanceField",
    "GridMap",
    "MapScene",
    "Places",
    "Reach",
    "cast",
    "distance_at",
    "distance_field",
    "load_footprints",
    "load_map",
    "make_map_scene",
    "map_clearance",
    "map_scene_sampler",
    "nearest_walls",
    "read_map",
    "reach_of",
    "shown",
    "wall_segments",
]

"""Maps of real places as worlds to drive in.

    images      image files as grey levels
    nav2        nav2's YAML and image as an occupancy grid, by nav2's rule
    grid        occupancy grid, borders of the free space
    field       distance to the nearest thing
    walls       walls as boxes
"""

from whill_mjx.world.maps.field import DistanceField, distance_at, distance_field, map_clearance
from whill_mjx.world.maps.grid import FREE, OCCUPIED, UNKNOWN, GridMap, wall_segments
from whill_mjx.world.maps.nav2 import load_map
from whill_mjx.world.maps.walls import nearest_walls

__all__ = [
    "FREE",
    "OCCUPIED",
    "UNKNOWN",
    "DistanceField",
    "GridMap",
    "distance_at",
    "distance_field",
    "load_map",
    "map_clearance",
    "nearest_walls",
    "wall_segments",
]

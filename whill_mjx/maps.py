"""Turn a map into a scene and draw it from above: `python -m whill_mjx.maps FILE --out scene`."""

from __future__ import annotations

import io
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from whill_mjx.io.command_line import POSITIVE, OptionError, Range, listen, refusing, run, starts

if starts(__name__):
    listen()

import numpy as np

from whill_mjx.io.folders import check_file, note_written, write_whole
from whill_mjx.vehicle.vehicle_file import load_vehicle
from whill_mjx.world.maps import MapScene, Reach, make_map_scene, reach_of, read_map, wall_segments
from whill_mjx.world.maps.nav2 import NAV2, as_nav2
from whill_mjx.world.maps.picture import from_above
from whill_mjx.world.maps.places import NoRoom
from whill_mjx.world.maps.playable import has_cells


@dataclass(frozen=True)
class Import:
    """Options of the command."""

    file: Path
    """nav2 map (.yaml), OpenStreetMap (.osm), CityGML (.gml), point cloud (.ply, .pcd, .npy) or mesh of a building
    (.stl, .glb, .gltf, .obj, .ply)."""
    out: Path = Path("scene")
    """Name of what is written: OUT.png, the map from above, and OUT.npz, its walls, starts and goals; of all but a nav2
    map also OUT.yaml and OUT.pgm, a nav2 map that tasks read."""
    cell: Annotated[float, Range(0.02, 1.0)] = 0.1
    """Edge of a cell of footprints, point clouds and meshes [m]."""
    scale: Annotated[float, Range(1e-6, 1e3)] = 1.0
    """Metres per unit of a point cloud, a mesh or projected CityGML; 0.001 for millimetres, 0.3048 for feet."""
    vehicle: str = "whill_cr_ramp"
    """Built-in vehicle (docs/howto/vehicle.md lists them), or a vehicle file: its size says which ways are wide enough,
    and where it can turn."""
    width: Annotated[float | None, POSITIVE] = None
    """Narrowest passage that the vehicle uses [m]; by default what its width needs."""
    pixels: Annotated[int, Range(100, 8000)] = 1200
    """Longer side of the picture."""


def main(options: Import) -> None:
    """Write picture, scene and map, and print what was found."""
    endings = (".png", ".npz") if options.file.suffix.lower() in NAV2 else (".png", ".npz", ".pgm", ".yaml")
    outs = [Path(f"{options.out}{ending}") for ending in endings]
    with refusing():
        for path in outs:
            check_file("--out", path)
        _check_effect(options)
        name, reach = _needed(options)
        grid = read_map(options.file, options.cell, options.scale)
        try:
            made = make_map_scene(grid, reach)
        except NoRoom as error:
            width = "what it needs" if options.width is None else f"{options.width:g} m"
            raise ValueError(f"{options.file}: {error} Where the map is right, ask for less: --vehicle is "
                             f"{options.vehicle}, and --width is {width}.") from None  # fmt: skip
        except ValueError as error:
            raise ValueError(f"{options.file}: {error}") from None
    size = np.array(grid.cells.shape[::-1]) * grid.resolution
    steps, places = len(wall_segments(grid)), made.places
    print(f"{options.file}: {size[0]:.1f} x {size[1]:.1f} m in cells of {grid.resolution:g} m")
    if grid.shift != (0.0, 0.0):
        print("moved to zero: add {:.0f}, {:.0f} m to x, y of the scene for those of the file".format(*grid.shift))
    print(f"clearance for {name}: {reach.passing:g} m on the way, {reach.standing:g} m at start and goal")
    print(f"free and within reach: {made.space.sum() * grid.resolution**2:.0f} m2")
    for note in grid.notes:
        print(note)
    print(f"walls: {len(made.walls.segments)} straight ones, from {steps} edges of cells")
    print(f"starts and goals: {len(places.way)} pairs, {places.way.min():.1f} to {places.way.max():.1f} m apart")
    _write(made, outs, options.pixels)
    print(", ".join(map(str, outs)))


def _write(made: MapScene, outs: Sequence[Path], pixels: int) -> None:
    """Write the picture, the arrays and, where two more files are named, the image and the YAML file of a nav2 map."""
    buffer, places, grid = io.BytesIO(), made.places, made.grid
    np.savez_compressed(buffer, walls=made.walls.segments, start=places.start, goal=places.goal, way=places.way,
                        shift=grid.shift)  # fmt: skip
    contents: list[str | bytes] = [from_above(made, pixels), buffer.getvalue()]
    if len(outs) > len(contents):
        text, image = as_nav2(grid, outs[2].name)
        contents += [image, text]
    for path, content in zip(outs, contents, strict=True):
        write_whole(path, content)
        note_written(path)


def _check_effect(options: Import) -> None:
    """Refuse an option that has no effect on a map of this kind."""
    for name in ("cell", "scale"):
        if has_cells(options.file) and getattr(options, name) != getattr(Import, name):
            raise OptionError(f"--{name}: has no effect on {options.file}, which has cells of its own. Leave it out.")


def _needed(options: Import) -> tuple[str, Reach]:
    """Name of the vehicle, and what it needs of a map."""
    spec = load_vehicle(options.vehicle)[0]
    reach = reach_of(spec)
    return spec.name, reach if options.width is None else replace(reach, passing=options.width / 2)


def cli() -> None:
    """Command line."""
    words = sys.argv[1:]
    run(Import, main, __doc__, args=words[1:] if words[:1] == ["import"] else words)  # "import" was once needed


if __name__ == "__main__":
    cli()

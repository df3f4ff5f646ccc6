"""Point clouds (.ply, .pcd, .npy) and meshes (.stl, .glb, .gltf, .obj, .ply) of a building as an occupancy grid.

A cell is OCCUPIED where something stands between `STEP` and `HEADROOM` above the floor, FREE where there is floor, and
UNKNOWN elsewhere. The floor is level. z points up, except in glTF, whose y does.
"""

from __future__ import annotations

import io
import json
import re
from pathlib import Path
from typing import Any

import numpy as np

from whill_mjx.io.reading import MB, read_bytes
from whill_mjx.world.maps.grid import FREE, OCCUPIED, UNKNOWN, GridMap

CLOUDS, MESHES = (".ply", ".pcd", ".npy"), (".stl", ".glb", ".gltf", ".obj", ".ply")
BYTES, MOST_POINTS, MAX_CELLS = 400 * MB, 50 * MB, 50 * MB
STEP, HEADROOM = 0.12, 1.5
"""Heights above the floor between which things are in the way [m]."""
LEVEL = 0.05
"""Edge of a bin of heights, when the floor is sought [m]."""
FLAT = 0.9
"""Least upward part of a face's normal that makes it a floor."""
TOUCH = 1e-3
"""What reaches less far into that band does not count: heights of a file are rounded [m]."""
HOLE = 0.5
"""Gaps of the floor that are closed: lines of a scanner lie so far apart [m]."""
MARGIN = 0.5
"""Around everything [m]."""
CONVERT = ("If it is not in metres, run python -m whill_mjx.maps {} --scale 0.001 --out NAME (0.001 for millimetres) "
           "and take NAME.yaml as the map.")
"""What to do about a file in another unit. Tasks read metres; the command writes a map that they read."""
REMEDY = "Check the unit, and take smaller cells (--scale and --cell of python -m whill_mjx.maps)."
"""What to do where a vehicle finds no room."""
TYPES = {("F", 4): "f4", ("F", 8): "f8", ("U", 1): "u1", ("U", 2): "u2", ("U", 4): "u4", ("I", 1): "i1", ("I", 2): "i2",
         ("I", 4): "i4", ("U", 8): "u8", ("I", 8): "i8"}  # fmt: skip

ZERO_CORNER = re.compile(rb"^f[ \t](?:[^#\n]*[ \t])?[+-]?0+(?:[/\s]|\Z)", re.MULTILINE)
"""A face of an .obj file, one of whose corners is 0."""


def load_surfaces(path: str | Path, resolution: float = 0.1, scale: float = 1.0) -> GridMap:
    """Occupancy grid of a point cloud or a mesh; one that lies far from zero is moved there (`GridMap.shift`).

    Args:
        path: file; its ending says of which kind.
        resolution: edge of a cell [m].
        scale: metres per unit of the file.

    Raises:
        ValueError: no such file, another kind of content, damaged, too large, or no floor in it; names file and remedy.
    """
    path = Path(path)
    try:
        data = read_bytes(path, BYTES, "does not exist. Give a point cloud or a mesh.")
    except FileNotFoundError as error:
        raise ValueError(str(error)) from None
    ending = path.suffix.lower()
    try:
        points, faces = _npy(data) if ending == ".npy" else _pcd(data) if ending == ".pcd" else _by_trimesh(path, data)
    except Exception as error:  # whatever a library says of a damaged file
        no_text = isinstance(error, ModuleNotFoundError) and error.name != "trimesh"  # it would guess an encoding
        reason = ["neither binary nor UTF-8"] if no_text else str(error).strip().splitlines()
        what = "damaged" if no_text else type(error).__name__
        raise ValueError(f"{path}: cannot be read as {ending} ({what}: "
                         f"{(reason or ['no reason given'])[0][:160].rstrip('.')}). Export it again.") from None
    points = np.asarray(points, float)[:, :3] * scale
    if faces is None:
        points = points[np.isfinite(points).all(1)]
    if len(points) < 10 or not np.isfinite(points).all():
        raise ValueError(f"{path}: has {len(points)} points, or some that are not finite. Give another file.")
    low, high = points[:, :2].min(0) - MARGIN, points[:, :2].max(0) + MARGIN
    size = high - low
    if len(points) > MOST_POINTS or np.prod(np.ceil(size / resolution)) > MAX_CELLS:
        raise ValueError(f"{path}: spans {size[0]:.0f} x {size[1]:.0f} m. {CONVERT.format(path)} Where it "
                         "is in metres, --cell takes larger cells in the same way.")
    columns, rows = np.ceil(size / resolution).astype(int)
    if faces is None:
        floor, solid = _of_cloud(points, low, (rows, columns), resolution)
    else:
        floor, solid = _of_mesh(points, faces, low, (rows, columns), resolution)
    if not (floor & ~solid).any():
        raise ValueError(f"{path}: has no level floor within {size[0]:.1f} x {size[1]:.1f} m. Turn it so that z points "
                         f"up. {CONVERT.format(path)}")
    cells = np.full((rows, columns), UNKNOWN, np.uint8)
    cells[floor] = FREE
    cells[solid] = OCCUPIED
    return GridMap(cells, resolution, (float(low[0]), float(low[1]), 0.0), remedy=REMEDY).brought_near()


def _npy(data: bytes) -> tuple[np.ndarray, None]:
    array = np.load(io.BytesIO(data), allow_pickle=False)
    real = np.issubdtype(array.dtype, np.integer) or np.issubdtype(array.dtype, np.floating)
    if array.ndim != 2 or array.shape[1] < 3 or not real:
        raise ValueError(f"an array of {array.dtype} of shape {array.shape}; (N, 3) real numbers are needed")
    return array, None


def _by_trimesh(path: Path, data: bytes) -> tuple[np.ndarray, np.ndarray | None]:
    """Corners and faces of a mesh, or the points of a cloud and None."""
    import trimesh

    kind = path.suffix.lower()[1:]
    _check_content(kind, data)
    # A .gltf and an .obj name other files beside them.
    if kind in ("gltf", "obj"):
        loaded: Any = _with_neighbours(path)
    else:
        loaded = trimesh.load(io.BytesIO(data), file_type=kind, process=False)
    parts = list(loaded.geometry.values()) if isinstance(loaded, trimesh.Scene) else [loaded]
    if not parts:
        raise ValueError("there is no geometry in it")
    for part in parts:  # before they become one mesh, in which a wrong corner may be another part's
        _check_corners(np.shape(part.vertices), getattr(part, "faces", None))
    if isinstance(loaded, trimesh.Scene):
        loaded = loaded.to_mesh()
    points = np.asarray(loaded.vertices, float)
    if kind in ("glb", "gltf"):  # y is up
        points = points[:, [0, 2, 1]] * np.array([1.0, -1.0, 1.0])
    faces = getattr(loaded, "faces", None)
    return points, None if faces is None or not len(faces) else np.asarray(faces)


def _with_neighbours(path: Path) -> Any:
    """What trimesh reads of a file that may name others beside it."""
    import trimesh

    try:
        return trimesh.load(path, process=False)
    except FileNotFoundError as error:
        raise ValueError(f"it names the file {error}, which is not beside it: put it there, or take one .glb") from None
    except IndexError as error:
        raise ValueError(f"a face has a corner that is not there: {error}") from None


def _check_content(kind: str, data: bytes) -> None:
    """ValueError for what trimesh accepts, or refuses for a misleading reason."""
    counted, there = int.from_bytes(data[80:84], "little"), (len(data) - 84) // 50
    text = b"\0" not in data
    if kind == "stl" and not text and counted > there:
        raise ValueError(f"it is cut short: its header counts {counted} triangles, and {max(there, 0)} are there")
    if kind == "stl" and text and data.lstrip().startswith(b"solid") and b"endsolid" not in data:
        raise ValueError("it is cut short: it does not end in a line endsolid")
    if kind == "glb" and (size := int.from_bytes(data[8:12], "little")) > len(data):
        raise ValueError(f"it is cut short: its header counts {size} bytes, and {len(data)} are there")
    if kind == "obj" and ZERO_CORNER.search(data):
        raise ValueError("a face has the corner 0, and the corners begin at 1")
    if kind == "gltf":
        json.loads(data)


def _check_corners(shape: tuple[int, ...], faces: Any) -> None:
    """ValueError where corners of this shape are no (N, 3), or a face (F, 3) names one that is not there."""
    if shape[1:] != (3,):
        raise ValueError(f"corners of shape {shape}; (N, 3) numbers are needed")
    corners = np.zeros(0, int) if faces is None else np.asarray(faces)
    wrong = corners[(corners < 0) | (corners >= shape[0])]
    if len(wrong):
        raise ValueError(f"a face has the corner {int(wrong[0])}, and the corners are 0 to {shape[0] - 1}")


def _pcd(data: bytes) -> tuple[np.ndarray, None]:
    """Points of a PCD file of version 0.7: ascii, binary or binary_compressed."""
    header, place = _pcd_header(data)
    counts = [int(word) for word in header.get("COUNT", ["1"] * len(header["FIELDS"]))]
    types = list(zip(header["TYPE"], map(int, header["SIZE"]), strict=True))
    for kind, size in types:
        if (kind, size) not in TYPES:
            known = ", ".join(f"{letter} {number}" for letter, number in TYPES)
            raise ValueError(f"a field has the type {kind} and the size {size} (known: {known})")
    kinds = [TYPES[one] for one in types]
    number = int(header["POINTS"][0])
    if not 0 <= number <= MOST_POINTS:
        raise ValueError(f"it announces {number} points")
    # Fields of padding share one name.
    names = [f"{index}_{name}" for index, name in enumerate(header["FIELDS"])]
    wanted = [names[header["FIELDS"].index(axis)] for axis in "xyz"]
    if header["DATA"][0] == "ascii":
        first = np.cumsum([0, *counts])
        columns = [int(first[names.index(name)]) for name in wanted]
        rows = np.loadtxt(io.BytesIO(data[place:]), ndmin=2, max_rows=number, usecols=columns)
        if len(rows) < number:
            raise ValueError(f"it is cut short: it announces {number} points, and {len(rows)} are there")
        return rows, None
    dtype = np.dtype([(name, kind, (count,)) for name, kind, count in zip(names, kinds, counts, strict=True)])
    if header["DATA"][0] == "binary":
        table = np.frombuffer(data, dtype, number, place)
        return np.stack([table[name][:, 0] for name in wanted], 1).astype(float), None
    packed, unpacked = np.frombuffer(data, "<u4", 2, place)
    raw = _lzf(data[place + 8 : place + 8 + packed], int(unpacked))
    found, place = {}, 0
    for name, kind, count in zip(names, kinds, counts, strict=True):  # field after field
        size = number * count * np.dtype(kind).itemsize
        found[name] = np.frombuffer(raw, kind, number * count, place).reshape(number, count)[:, 0]
        place += size
    return np.stack([found[name] for name in wanted], 1).astype(float), None


def _pcd_header(data: bytes) -> tuple[dict[str, list[str]], int]:
    """Words of each line by its first one, and the place at which the points begin."""
    header: dict[str, list[str]] = {}
    place = 0
    while "DATA" not in header:
        end = data.find(b"\n", place)
        if end < 0:
            raise ValueError("its header does not end in a line DATA")
        words = data[place:end].decode("ascii").split()
        place = end + 1
        if words and not words[0].startswith("#"):
            header[words[0]] = words[1:]
    missing = [name for name in ("FIELDS", "SIZE", "TYPE", "POINTS") if not header.get(name)]
    if missing:
        raise ValueError(f"its header has no line {' or '.join(missing)}")
    if not {"x", "y", "z"} <= set(header["FIELDS"]):
        raise ValueError(f"its fields are {', '.join(header['FIELDS'])}, and x, y and z are needed")
    return header, place


def _lzf(data: bytes, size: int) -> bytes:
    """Unpack LZF, as PCD files are packed."""
    if size > 1000 * MB:
        raise ValueError(f"it announces {size / MB:.0f} MB")
    out, place = bytearray(), 0
    while place < len(data):
        control = data[place]
        place += 1
        if control < 32:
            out += data[place : place + control + 1]
            place += control + 1
            continue
        length = control >> 5
        if length == 7:
            length += data[place]
            place += 1
        start = len(out) - ((control & 31) << 8) - data[place] - 1
        place += 1
        if start < 0:
            raise ValueError("its packed data are damaged")
        for index in range(start, start + length + 2):
            out.append(out[index])
    if len(out) != size:
        raise ValueError("its packed data are damaged")
    return bytes(out)


def _of_cloud(points: np.ndarray, low: np.ndarray, shape: Any, resolution: float) -> tuple[np.ndarray, np.ndarray]:
    """Cells (rows, columns) that are floor, and those in which something stands."""
    from scipy.ndimage import binary_closing

    column, row = ((points[:, :2] - low) / resolution).astype(int).T
    flat = row * shape[1] + column
    order = np.lexsort((points[:, 2], flat))
    first = order[np.flatnonzero(np.diff(flat[order], prepend=-1))]
    level = _most_common(points[first, 2], np.ones(len(first)))  # most cells have their lowest point on the floor
    above = points[:, 2] - level
    floor, solid = np.zeros(shape, bool), np.zeros(shape, bool)
    floor.ravel()[flat[np.abs(above) <= STEP]] = True
    solid.ravel()[flat[(above > STEP) & (above < HEADROOM)]] = True
    reach = max(1, round(HOLE / resolution / 2))
    disc = np.hypot(*np.mgrid[-reach : reach + 1, -reach : reach + 1]) <= reach + 0.5
    return binary_closing(np.pad(floor, reach), disc)[reach:-reach, reach:-reach], solid


def _of_mesh(
    points: np.ndarray, faces: np.ndarray, low: np.ndarray, shape: Any, resolution: float
) -> tuple[np.ndarray, np.ndarray]:
    """Cells (rows, columns) that are floor, and those in which something stands."""
    corners = points[faces]  # (F, 3, 3)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1) / 2
    up = normal[:, 2] > FLAT * 2 * np.maximum(area, 1e-12)
    floor, solid = np.zeros(shape, np.uint8), np.zeros(shape, np.uint8)
    if not up.any():
        return floor > 0, solid > 0
    level = _most_common(corners[up, :, 2].mean(1), area[up])
    ground = corners[up & (np.abs(corners[:, :, 2].mean(1) - level) <= STEP)]
    _fill(floor, ground[:, :, :2], low, resolution)
    _fill(solid, _between(corners, level + STEP + TOUCH, level + HEADROOM - TOUCH), low, resolution)
    return floor > 0, solid > 0


def _between(corners: np.ndarray, lower: float, upper: float) -> np.ndarray:
    """What two levels leave of triangles (F, 3, 3), from above: convex polygons (K, 6, 2) [m] with corners in order.

    Each edge gives both ends of what is left of it; an edge of which nothing is left repeats the corner before.
    """
    corners = corners[(corners[..., 2].max(1) >= lower) & (corners[..., 2].min(1) <= upper)]
    ends = np.roll(corners, -1, 1)
    start, rise = corners[..., 2], ends[..., 2] - corners[..., 2]
    level = np.abs(rise) < 1e-12
    shares = [np.where(level, 0.0, (height - start) / np.where(level, 1.0, rise)) for height in (lower, upper)]
    inside = (start >= lower) & (start <= upper)
    first = np.where(level, 0.0, np.clip(np.minimum(*shares), 0.0, None))
    last = np.where(level, inside, np.clip(np.maximum(*shares), None, 1.0))
    left = (first <= last) & (inside | ~level)  # (K, 3)
    way = (ends - corners)[..., :2]
    points = np.stack([corners[..., :2] + share[..., None] * way for share in (first, last)], 2)  # (K, 3, 2, 2)
    for edge in (0, 1, 2, 0, 1):
        points[:, edge] = np.where(left[:, edge, None, None], points[:, edge], points[:, edge - 1, 1:])
    return points[left.any(1)].reshape(-1, 6, 2)


def _fill(cells: np.ndarray, polygons: np.ndarray, low: np.ndarray, resolution: float) -> None:
    """Set the cells that convex polygons (K, N, 2) [m] cover or cross."""
    import cv2

    for polygon in np.rint(((polygons - low) / resolution - 0.5) * 256).astype(np.int32):
        cv2.fillConvexPoly(cells, polygon, 1, shift=8)


def _most_common(height: np.ndarray, weight: np.ndarray) -> float:
    """The lowest height [m] at which at least half as much lies as at the commonest one: ceilings are above."""
    bins, index = np.unique(np.floor(height / LEVEL), return_inverse=True)  # few, however far apart they lie
    amount = np.bincount(index, weight)
    pairs = np.union1d(bins, bins - 1)  # a floor may lie on the border of two bins

    def amount_in(wanted: np.ndarray) -> np.ndarray:
        place = np.searchsorted(bins, wanted).clip(max=len(bins) - 1)
        return np.where(bins[place] == wanted, amount[place], 0.0)

    both = amount_in(pairs) + amount_in(pairs + 1)
    first = pairs[np.argmax(both >= 0.5 * both.max())]
    chosen = np.isin(bins[index], (first, first + 1))
    return float(np.average(height[chosen], weights=weight[chosen]))

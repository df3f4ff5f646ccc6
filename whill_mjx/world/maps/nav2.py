"""nav2 maps: a YAML file and the image that it names, read as cells by the rule of nav2_map_server, and written.

The rule is that of `nav2_map_server` (map_io) since it compares with `>=` and `<=`: see docs/maps.md.
"""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np

from whill_mjx.io.fields import MAP, Field, check_table
from whill_mjx.io.reading import MB, read_text
from whill_mjx.world.maps.grid import FREE, OCCUPIED, UNKNOWN, GridMap
from whill_mjx.world.maps.images import read_levels

NAV2 = (".yaml", ".yml")
"""Endings of nav2 maps."""
YAML_BYTES = MB // 100  # a map file has 0.2 kB
REAL = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$")
FULL_TURN = 6.2832  # rad
LEVELS = np.array([254, 128, 0], np.uint8)
"""Grey levels that stand for FREE, UNKNOWN and OCCUPIED where a map is written."""
TRUE, FALSE = ("true", "yes", "on", "y"), ("false", "no", "off", "n")


def load_map(path: str | Path) -> GridMap:
    """Occupancy grid of a map_server YAML file; one that lies far from zero is moved there (`GridMap.shift`).

    Raises:
        ValueError: another ending, a field is missing or out of its range, or the image cannot be read; names file and
            remedy.
    """
    path = Path(path)
    if path.suffix.lower() not in NAV2:
        raise ValueError(f"{path}: load_map reads only nav2 maps ({', '.join(NAV2)}). Read other kinds with read_map, "
                         "or make them nav2 maps with python -m whill_mjx.maps.")
    table = check_table(str(path), MAP, read_map_yaml(path))
    occupied, free = table["occupied_thresh"], table["free_thresh"]
    if not free < occupied:
        raise ValueError(
            f"{path}: free_thresh is {free:g} and occupied_thresh {occupied:g}; the first must be less. "
            "Correct the file."
        )
    x, y, yaw = table["origin"]
    if abs(yaw) > FULL_TURN:
        raise ValueError(f"{path}: the yaw of origin is {yaw:g} rad, more than a full turn. Convert it to radians.")
    mode = table.get("mode", "trinary")
    levels, alpha = read_levels(path.parent / table["image"])
    occupancy = level_occupancy(mode, occupied, free, bool(table["negate"]))[levels]
    if alpha is not None and mode != "raw":
        occupancy[alpha < 255] = -1
    kinds = occupancy_kinds(occupied, free, raw=mode == "raw")
    occupancy = occupancy[::-1].copy()  # the last row of the image lies at the bottom
    remedy = "Check the resolution and the thresholds."
    return GridMap(kinds[occupancy], table["resolution"], (x, y, yaw), occupancy, remedy=remedy).brought_near()


def as_nav2(grid: GridMap, image: str) -> tuple[str, bytes]:
    """YAML text of a map whose image has the name `image`, and that image as PGM; read, both give the same cells."""
    x, y, yaw = (float(one) for one in grid.origin)
    text = (f"image: {json.dumps(image)}\nmode: trinary\nresolution: {float(grid.resolution)!r}\n"
            f"origin: [{x!r}, {y!r}, {yaw!r}]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n")  # fmt: skip
    rows, columns = grid.cells.shape
    return text, f"P5\n{columns} {rows}\n255\n".encode() + LEVELS[grid.cells[::-1]].tobytes()


def level_occupancy(mode: str, occupied: float, free: float, negate: bool) -> np.ndarray:
    """(256,) int8: nav2's occupancy of each grey level, 0 to 100 in percent and -1 for unknown."""
    levels = np.arange(256)
    if mode == "raw":
        return np.where(levels <= 100, levels, -1).astype(np.int8)
    # nav2 computes in single precision, so that a level right at a threshold falls on its side.
    darkness = levels.astype(np.float32) / np.float32(255)
    if not negate:
        darkness = np.float32(1) - darkness
    upper, lower = np.float32(occupied), np.float32(free)
    between = np.full(256, -1.0)
    if mode == "scale":
        share = (darkness - lower) / np.float32(occupied - free) * np.float32(100)
        between = np.sign(share) * np.floor(np.abs(share) + 0.5)  # halves away from zero
    return np.where(darkness <= lower, 0, np.where(darkness >= upper, 100, between)).astype(np.int8)


def occupancy_kinds(occupied: float, free: float, raw: bool) -> np.ndarray:
    """(256,) uint8: FREE, UNKNOWN or OCCUPIED of each occupancy in percent; negative ones count from the end.

    Raw values are probabilities, to which the thresholds apply; the other modes have applied them.
    """
    kinds = np.full(256, UNKNOWN, np.uint8)
    percent = np.arange(101)
    share = percent / 100.0 if raw else percent / 100.0 * (occupied - free) + free
    kinds[:101][share <= free] = FREE
    kinds[:101][share >= occupied] = OCCUPIED
    kinds[0], kinds[100] = FREE, OCCUPIED
    return kinds


def read_map_yaml(path: Path) -> dict[str, Any]:
    """The fields of a map file that `MAP` knows; nav2 passes over others.

    A scalar is taken for what its field needs, whether quoted or not, as nav2's own YAML library does.
    """
    import yaml

    try:
        text = read_text(path, YAML_BYTES, "does not exist. Give the YAML file of a map.")
    except FileNotFoundError as error:
        raise ValueError(str(error)) from None
    try:
        node = yaml.compose(text, Loader=yaml.SafeLoader)
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        mark = getattr(error, "problem_mark", None)
        place = f", line {mark.line + 1}" if mark else ""
        reason = " ".join(str(getattr(error, "problem", None) or "nested too deep or no text").split())
        raise ValueError(f"{path}{place}: is no YAML ({reason[:80]}). Correct the file.") from None
    if not isinstance(node, yaml.MappingNode):
        raise ValueError(
            f"{path}: has no fields; a map has image, resolution, origin, negate, occupied_thresh and "
            "free_thresh. Give the YAML file of a map."
        )
    fields = {field.name: field for field in MAP}
    table: dict[str, Any] = {}
    for key, value in node.value:
        name = key.value if isinstance(key, yaml.ScalarNode) else None
        if name not in fields:
            continue
        if name in table:
            raise ValueError(f"{path}: {name} is there twice. Remove one of the lines.")
        table[name] = _value(fields[name], value)
    return table


def _value(field: Field, node: Any) -> Any:
    """What a YAML node holds, as a field of this kind needs it."""
    import yaml

    if isinstance(node, yaml.SequenceNode):
        return [_value(field, one) for one in node.value[:100]]
    if not isinstance(node, yaml.ScalarNode):
        return {}
    text = node.value
    if field.name == "mode":
        return text.lower()
    if field.kind == "text":
        return text
    if field.kind == "whole" and text.lower() in TRUE + FALSE:
        return int(text.lower() in TRUE)
    if re.fullmatch(r"[-+]?\d{1,18}", text) and field.kind == "whole":
        return int(text)
    if REAL.match(text):
        return float(text)
    return math.nan if text.lower() in (".nan", "nan") else text

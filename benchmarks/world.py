"""Maps and contact: wrong pixels of the horizon, depth of contacts, and nav2's rule: `python -m benchmarks.world`.

The real maps are those of ../shared/data/maps.
"""

from __future__ import annotations

import dataclasses
import subprocess
import sys
import xml.etree.ElementTree as xml
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.harness import figure, record
from whill_mjx.io import command_line
from whill_mjx.world.collision import Obstacles, first_contact, from_above, poses_between, touches
from whill_mjx.world.maps import FREE, OCCUPIED, GridMap, distance_field, load_map, make_map_scene, map_scene_sampler
from whill_mjx.world.maps.walls import shown, wall_boxes
from whill_mjx.world.render import camera_rotation, pinhole, render_frame
from whill_mjx.world.scene import Footprint, box, no_boxes, stack_boxes
from whill_mjx.world.solids import person

MAPS = (
    "stata_basement/stata_basement",
    "willow_garage/willow-full",
    "fetch_office/3_1_16_localization",
    "fetch_office/9_16_15",
)
MOST = 2000
"""Walls of one of the images that together count as right; labels allow no more."""
SPEED, YAW_RATE, PERIOD = 1.67, 1.0, 0.1
HALF = 0.4925, 0.277
"""Half length and width of a WHILL Model CR [m]."""
SHRINK = 0.02
"""Distance of the rectangles inside a vehicle that look for what it stands over [m]."""
CLAIM = "Obstacle course with physics, camera image, reward and auto-reset"


@dataclass(frozen=True)
class Options:
    """Options of the benchmark."""

    parts: tuple[str, ...] = ("maps", "contact")
    """Of maps (wrong pixels), contact (penetration) and nav2 (maps against nav2's rule, cell by cell)."""
    maps: Path = Path("../shared/data/maps")
    """Folder of the real maps."""
    poses: int = 1000
    """Camera poses in each map."""
    tries: int = 100_000
    """Steps at full speed towards each kind of thing."""


def wrong_share(path: Path, poses: int) -> float:
    """Share of the horizon's pixels whose depth is off by more than 0.5 m against images of all walls."""
    made = make_map_scene(load_map(path))
    scene, _ = map_scene_sampler(made)(jax.random.key(0))
    segments = jnp.asarray(made.walls.segments)
    lens = pinhole(1.0, 64, 64)
    pitch = 0.1
    horizon = dataclasses.replace(lens, cy=0.5 + jnp.tan(pitch) * lens.fy, height=1)  # one row: the horizon

    def wrong(start):
        position, rotation = jnp.append(start[:2], 1.0), camera_rotation(start[2], pitch, 0.0)

        def depth(image):
            return render_frame(position, rotation, horizon, image).depth

        right = jnp.full((1, 64), jnp.inf)
        for first in range(0, len(segments), MOST):
            index = jnp.arange(first, min(first + MOST, len(segments)))
            part = wall_boxes(segments, index, jnp.ones(index.shape, bool), made.walls.height, (0.8, 0.8, 0.7))
            right = jnp.minimum(right, depth(dataclasses.replace(scene, boxes=part, walls=None)))
        seen = depth(shown(scene, position, rotation, lens))
        return jnp.mean((jnp.abs(seen - right) > 0.5) | (jnp.isfinite(seen) != jnp.isfinite(right)))

    rng = np.random.default_rng(0)
    starts = made.places.start[rng.integers(0, len(made.places.start), poses)]
    starts[:, 2] = rng.uniform(-np.pi, np.pi, poses)
    return float(np.mean(jax.jit(lambda starts: jax.lax.map(wrong, starts))(jnp.asarray(starts, jnp.float32))))


def obstacles(kind: str) -> Obstacles:
    """A thing around (2, 2)."""
    grey, nothing = (0.5, 0.5, 0.5), from_above(person(-90.0, -90.0))
    if kind == "wall":
        return Obstacles(stack_boxes([box(2.0, 2.0, 0.005, 3.0, 1.0, grey)]), nothing)
    if kind == "corner":
        return Obstacles(stack_boxes([box(2.0, 2.0, 0.5, 0.5, 1.0, grey, 0.6)]), nothing)
    if kind == "person":
        return Obstacles(no_boxes(1), from_above(person(2.0, 2.0)))
    cells = np.full((80, 80), FREE, np.uint8)
    cells[36:44, 40:44] = OCCUPIED
    return Obstacles(no_boxes(1), nothing, distance_field(GridMap(cells, 0.05, (0.0, 0.0, 0.0))))


def shrunk(vehicle: Footprint, by: jax.Array) -> Footprint:
    """The rectangle whose border lies `by` [m] inside the vehicle's."""
    return dataclasses.replace(vehicle, half_length=vehicle.half_length - by, half_width=vehicle.half_width - by)


def deepest(kind: str, tries: int) -> float:
    """Largest depth [m] of all poses up to where the vehicle stops, over random steps at full speed."""
    things = obstacles(kind)
    count = poses_between(SPEED, YAW_RATE, PERIOD, *HALF)

    def one(key):
        far, angle, yaw, speed, turn = jax.random.uniform(key, (5,), minval=-1.0)
        far = 0.65 + 0.35 * far
        half = [jnp.asarray(size) for size in HALF]
        x, y = 2.0 + far * jnp.cos(jnp.pi * angle), 2.0 + far * jnp.sin(jnp.pi * angle)
        before = Footprint(x, y, jnp.pi * yaw, half[0], half[1], jnp.asarray(0.9))
        reach, turn = SPEED * PERIOD * jnp.sign(speed), turn * YAW_RATE * PERIOD
        middle = before.yaw + turn / 2
        after = dataclasses.replace(
            before, x=x + reach * jnp.cos(middle), y=y + reach * jnp.sin(middle), yaw=before.yaw + turn
        )
        _, share = first_contact(before, after, things, count)

        def depth(part):
            part = part * share
            pose = dataclasses.replace(
                before, x=x + part * (after.x - x), y=y + part * (after.y - y), yaw=before.yaw + part * turn
            )

            def smaller(low_high, _):
                low, high = low_high
                shrink = (low + high) / 2
                hit = touches(shrunk(pose, shrink), things)
                return (jnp.where(hit, shrink, low), jnp.where(hit, high, shrink)), None

            (low, _), _ = jax.lax.scan(smaller, (jnp.zeros(()), jnp.asarray(0.2)), None, length=9)
            return low

        worst = jnp.max(jax.lax.map(depth, jnp.linspace(0.1, 1.0, 10)))
        # A thing that lies within the vehicle at first touches no border: only rectangles inside it find it.
        nested = jax.vmap(lambda shrink: touches(shrunk(before, shrink), things))
        return jnp.where(nested(jnp.arange(0.0, HALF[1], SHRINK)).any(), 0.0, worst)

    keys = jax.random.split(jax.random.key(1), tries)
    return float(jnp.max(jax.jit(lambda keys: jax.lax.map(one, keys, batch_size=1000))(keys)))


def wrong_pixels(options: Options) -> dict[str, Any]:
    """The largest share of the four maps."""
    shares = []
    for name in MAPS:
        shares.append(wrong_share(options.maps / f"{name}.yaml", options.poses))
        print(f"{name}: {100 * shares[-1]:.3f} % of the horizon's pixels are wrong", flush=True)
    return {"wrong_horizon_pixels": figure([max(shares)], "share")}


def penetration(options: Options) -> dict[str, Any]:
    """The largest depth of the four kinds of thing."""
    depths = []
    for kind in ("wall", "corner", "person", "field"):
        depths.append(deepest(kind, options.tries))
        print(f"{kind}: {1000 * depths[-1]:.2f} mm deep at most in {options.tries} tries", flush=True)
    return {"penetration_cm": figure([100 * max(depths)], "cm")}


def wrong_maps(options: Options) -> dict[str, Any]:
    """How many maps have a cell that nav2's rule gives another value: the tests of it, of real and of made maps."""
    with TemporaryDirectory() as folder:
        report = Path(folder) / "report.xml"
        tests = Path(__file__).parent.parent / "tests/whill_mjx/test_maps_nav2.py"
        subprocess.run([sys.executable, "-m", "pytest", "-q", str(tests), "-k", "has_the_cells_of_nav2",
                        f"--junit-xml={report}"], cwd=tests.parents[2])
        [suite] = xml.parse(report).getroot().iter("testsuite")
    tried = int(suite.attrib["tests"]) - int(suite.attrib["skipped"])
    wrong = int(suite.attrib["failures"]) + int(suite.attrib["errors"])
    if int(suite.attrib["skipped"]):
        raise SystemExit(f"{suite.attrib['skipped']} maps of ../shared/data/maps are not there. Put them there.")
    return {"nav2_cells_wrong": figure([float(wrong)], f"of {tried} maps, of which a cell is wrong")}


PARTS = {"maps": wrong_pixels, "contact": penetration, "nav2": wrong_maps}


def main(options: Options) -> None:
    """Measure and record."""
    for part in options.parts:
        if part not in PARTS:
            raise command_line.OptionError(f"--parts: unknown part {part!r} (known: {', '.join(PARTS)}). Correct it.")
    for part in options.parts:
        figures = PARTS[part](options)
        path = record("environment", CLAIM, figures)
        print(*(f"{name}: {one['value']:.5f} {one['unit']} -> {path}" for name, one in figures.items()), flush=True)


if __name__ == "__main__":
    command_line.run(Options, main, __doc__, positional=False)

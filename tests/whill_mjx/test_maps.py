"""Maps: a hand-made grid with known walls and distances, and real ones where they are at hand."""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from whill_mjx.world.maps import (
    FREE,
    OCCUPIED,
    UNKNOWN,
    GridMap,
    distance_at,
    distance_field,
    load_map,
    map_clearance,
    nearest_walls,
    wall_segments,
)
from whill_mjx.world.scene import Footprint, collides

pytestmark = pytest.mark.quick
SHARED = Path(__file__).parents[3] / "shared" / "data" / "maps"


def write(folder, pixels, **changes):
    """A map of grey pixels, the top row first, with a PGM that has a comment."""
    pixels = np.asarray(pixels, np.uint8)
    header = f"P5\n# made by hand\n{pixels.shape[1]} {pixels.shape[0]}\n255\n".encode()
    (folder / "map.pgm").write_bytes(header + pixels.tobytes())
    table = {"image": "map.pgm", "resolution": "0.5", "origin": "[1.0, 2.0, 0.0]", "negate": "0",
             "occupied_thresh": "0.65", "free_thresh": "0.196", **changes}
    path = folder / "map.yaml"
    path.write_text("".join(f"{key}: {value}  # told\n" for key, value in table.items() if value is not None))
    return path


def room(rows=8, columns=12, yaw=0.0):
    """A free room with a wall of one cell around it; cells of 0.5 m."""
    cells = np.full((rows, columns), OCCUPIED, np.uint8)
    cells[1:-1, 1:-1] = FREE
    return GridMap(cells, 0.5, (1.0, 2.0, yaw))


def test_pixels_become_cells_with_the_last_row_at_the_bottom(tmp_path):
    grid = load_map(write(tmp_path, [[0, 205, 254], [254, 254, 0]]))
    np.testing.assert_array_equal(grid.cells, [[FREE, FREE, OCCUPIED], [OCCUPIED, UNKNOWN, FREE]])
    np.testing.assert_allclose(grid.free_points(), [[1.25, 2.25], [1.75, 2.25], [2.25, 2.75]])
    turned = load_map(write(tmp_path, [[0, 205, 254], [254, 254, 0]], origin="[1.0, 2.0, 1.5707963]", negate="1"))
    np.testing.assert_array_equal(turned.cells[1], [FREE, OCCUPIED, OCCUPIED])
    np.testing.assert_allclose(turned.free_points()[-1], [0.25, 2.25], atol=1e-6)


@pytest.mark.parametrize(
    ("changes", "message"),
    [({"resolution": None}, "no field 'resolution'"), ({"resolution": "-1"}, "must be positive"),
     ({"origin": "[0, 0]"}, r"must be \[x, y, yaw\]"), ({"free_thresh": "0.9"}, "free_thresh"),
     ({"negate": "maybe"}, "0, 1, false or true"), ({"negate": "2"}, "one of 0, 1"),
     ({"resolution": "nan"}, "resolution is nan"),
     ({"origin": "0"}, r"must be \[x, y, yaw\]"), ({"image": "other.png"}, "is missing"),
     ({"mode": "gray"}, "trinary")],
)  # fmt: skip
def test_bad_map_files_are_refused(tmp_path, changes, message):
    with pytest.raises(ValueError, match=message):
        load_map(write(tmp_path, [[0, 254]], **changes))
    with pytest.raises(ValueError, match="does not exist"):
        load_map(tmp_path / "nothing.yaml")


@pytest.mark.parametrize(("data", "message"), [
    (b"", "is missing or no PGM"), (b"P5\n2 1\n255\n", "ends after 0 of 2"), (b"not an image", "no PGM"),
    (b"P5\n100000 100000\n255\n\0", "is 100000 x 100000 pixels; at most 50000000"),
    (b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\x7f\xff\xff\xff\x7f\xff\xff\xff\x08\0\0\0\0", "is 2147483647 x 2147483647 pixels"),
])  # fmt: skip
def test_empty_and_huge_images_are_refused(tmp_path, data, message):
    path = write(tmp_path, [[0, 254]])
    (tmp_path / "map.pgm").write_bytes(data)
    with pytest.raises(ValueError, match=f"map.pgm: .*{message}"):
        load_map(path)


def test_a_room_has_four_walls_with_the_free_space_on_their_left():
    segments = wall_segments(room())
    assert segments.shape == (4, 2, 2)
    corners = {tuple(np.round(point, 6)) for point in segments.reshape(-1, 2)}
    assert corners == {(1.5, 2.5), (6.5, 2.5), (1.5, 5.5), (6.5, 5.5)}
    way, inwards = segments[:, 1] - segments[:, 0], np.array([4.0, 4.0]) - segments[:, 0]
    assert (way[:, 0] * inwards[:, 1] - way[:, 1] * inwards[:, 0] > 0).all()
    pillar = room()
    pillar.cells[3:5, 5:7] = OCCUPIED
    assert len(wall_segments(pillar)) == 8


@pytest.mark.parametrize("yaw", [0.0, 3.14])
def test_distances_are_those_to_the_segments(yaw):
    grid = room(yaw=yaw)
    grid.cells[4, 6] = UNKNOWN
    segments, field = wall_segments(grid), distance_field(grid)
    points = grid.free_points()
    found = np.asarray(distance_at(field, jnp.asarray(points)))
    start, way = segments[:, 0], segments[:, 1] - segments[:, 0]
    share = np.clip(((points[:, None] - start) * way).sum(-1) / (way**2).sum(-1), 0, 1)
    exact = np.linalg.norm(points[:, None] - (start + share[..., None] * way), axis=-1).min(1)
    # Along rows and columns the field is exact; at corners it is measured to the centre of the corner's cell.
    assert np.abs(found - exact).max() < 0.11 and np.mean(np.abs(found - exact) < 1e-3) > 0.75
    assert (np.asarray(distance_at(field, jnp.array([[-90.0, 0.0], [90.0, 90.0]]))) == 0).all()


def test_clearance_and_nearest_walls_agree_with_each_other():
    """A chair of 1.0 x 0.5 m in a room of 5 x 3 m: distance to the right wall, and contact beyond it."""
    grid = room()
    field, segments = distance_field(grid), jnp.asarray(wall_segments(grid), jnp.float32)
    one = jnp.asarray

    def at(x, y):
        vehicle = Footprint(one(x), one(y), one(0.0), one(0.5), one(0.25), one(0.9))
        walls = nearest_walls(segments, x, y, 6)
        assert int(walls.mask.sum()) == 4
        return float(map_clearance(field, vehicle)), bool(collides(vehicle, walls))

    clear, touches = at(5.0, 4.0)
    assert clear == pytest.approx(1.0, abs=0.06) and not touches
    clear, touches = at(6.2, 4.0)
    assert clear == 0.0 and touches


@pytest.mark.skipif(not SHARED.is_dir(), reason="the maps of ../shared/data are not there")
@pytest.mark.parametrize(
    ("name", "free_m2"), [("stata_basement/stata_basement", 790), ("willow_garage/willow-full", 1390),
                          ("fetch_office/3_1_16_localization", 880)],
)  # fmt: skip
def test_real_maps_have_the_area_that_is_told_of_them_and_walls_around_it(name, free_m2):
    grid = load_map(SHARED / f"{name}.yaml")
    assert (grid.cells == FREE).sum() * grid.resolution**2 == pytest.approx(free_m2, rel=0.02)
    segments, field = wall_segments(grid), distance_field(grid)
    assert 100 < len(segments) < 60_000
    points = grid.free_points()[:: len(grid.free_points()) // 500]
    distance = np.asarray(jax.jit(distance_at)(field, jnp.asarray(points, jnp.float32)))
    assert (distance > 0.4 * grid.resolution).mean() > 0.97 and distance.max() < 20

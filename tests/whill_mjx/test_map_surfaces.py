"""Point clouds and meshes of buildings as maps."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from whill_mjx.maps import Import, main
from whill_mjx.tasks.map_goal import MapGoal
from whill_mjx.world.maps import FREE, OCCUPIED, UNKNOWN, read_map, surfaces
from whill_mjx.world.maps.surfaces import _lzf

pytestmark = pytest.mark.quick


def cloud_of_a_room(floor=-0.6):
    """A room of 6 x 4 m as a scanner 0.6 m above the floor sees it: rings on the floor, walls, ceiling, a pillar."""
    rng = np.random.default_rng(0)
    n = 40_000
    ground = np.column_stack([rng.uniform(0, 6, n), rng.uniform(0, 4, n), np.full(n, floor)])
    ground = ground[np.abs(np.hypot(ground[:, 0] - 3, ground[:, 1] - 2) % 0.35 - 0.1) < 0.06]
    along, high = rng.uniform(0, 6, n), rng.uniform(floor, floor + 2.5, n)
    walls = [np.column_stack([along, np.full(n, y), high]) for y in (0.1, 3.9)]
    walls += [np.column_stack([np.full(n, x), along * 4 / 6, high]) for x in (0.1, 5.9)]
    turn = rng.uniform(0, 2 * np.pi, n)
    pillar = np.column_stack([4.5 + 0.2 * np.cos(turn), 1.0 + 0.2 * np.sin(turn), high])
    ceiling = np.column_stack([along, rng.uniform(0, 4, n), np.full(n, floor + 2.5)])
    points = np.concatenate([ground, *walls, pillar, ceiling])
    return points + rng.normal(0, 0.005, points.shape)


def is_the_room(grid):
    """A cell of `grid` at places of the room."""

    def cell(x, y):
        column, row = ((np.array([x, y]) - grid.origin[:2]) / grid.resolution).astype(int)
        return grid.cells[row, column]

    assert cell(3.0, 2.0) == cell(1.0, 3.0) == cell(5.5, 0.5) == FREE
    for x, y in ((4.3, 1.0), (3.0, 0.1), (5.9, 2.0)):  # faces, which lie on borders of cells
        assert OCCUPIED in (cell(x + dx, y + dy) for dx in (-0.05, 0.05) for dy in (-0.05, 0.05))
    assert cell(-0.4, 2.0) != FREE and cell(3.0, 4.4) != FREE
    assert (grid.cells == FREE).sum() * grid.resolution**2 == pytest.approx(21.5, abs=2.5)
    return True


def as_pcd(points, kind):
    head = "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n"
    head += f"WIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(points)}\nDATA {kind}\n"
    rows = np.column_stack([points, np.ones(len(points))]).astype("<f4")
    if kind == "ascii":
        return head.encode() + "\n".join(" ".join(f"{value:.4f}" for value in row) for row in rows).encode()
    if kind == "binary":
        return head.encode() + rows.tobytes()
    raw = rows.T.tobytes()
    packed = b"".join(bytes([len(part) - 1]) + part for part in (raw[i : i + 32] for i in range(0, len(raw), 32)))
    return head.encode() + np.array([len(packed), len(raw)], "<u4").tobytes() + packed


@pytest.mark.parametrize("kind", ["npy", "ply", "ascii", "binary", "binary_compressed"])
def test_a_cloud_of_a_room_becomes_its_walls_and_its_floor(tmp_path, kind):
    points = cloud_of_a_room()
    file = tmp_path / f"room.{kind if kind in ('npy', 'ply') else 'pcd'}"
    if kind == "npy":
        np.save(file, points)
    elif kind == "ply":
        import trimesh

        trimesh.PointCloud(points).export(file)
    else:
        file.write_bytes(as_pcd(points[::3] if kind == "ascii" else points, kind))
    assert is_the_room(read_map(file))


@pytest.mark.parametrize("ending, scale", [("stl", 0.001), ("glb", 1.0), ("obj", 1.0), ("ply", 1.0)])
def test_a_mesh_of_a_room_becomes_its_walls_and_its_floor(tmp_path, ending, scale):
    import trimesh

    def solid(size, centre):
        part = trimesh.creation.box(size)
        part.apply_translation(centre)
        return part

    tall = 2.5
    parts = [
        solid((6, 4, 0.2), (3, 2, -0.1)),
        *[solid((6.2, 0.2, tall), (3, y, tall / 2)) for y in (0, 4)],
        *[solid((0.2, 4, tall), (x, 2, tall / 2)) for x in (0, 6)],
        solid((0.4, 0.4, tall), (4.5, 1, tall / 2)),
        solid((6, 4, 0.2), (3, 2, 2.6)),
        solid((1, 1, 0.2), (1.5, 1.5, 2.2)),  # hangs from the ceiling
    ]
    mesh = trimesh.util.concatenate(parts)
    mesh.apply_scale(1.0 / scale)
    if ending == "glb":  # y is up
        mesh.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0]))
    mesh.export(tmp_path / f"room.{ending}")
    assert is_the_room(read_map(tmp_path / f"room.{ending}", 0.1, scale))


def test_packed_bytes_are_unpacked():
    assert _lzf(bytes([2]) + b"abc" + bytes([(7 << 5), 3, 2]), 15) == b"abcabcabcabcabc"[:15]
    with pytest.raises(ValueError, match="damaged"):
        _lzf(bytes([2]) + b"abc", 5)


@pytest.mark.parametrize("name, content, message", [
    ("a.npy", b"\x93NUMPY", "Export it again"),
    ("a.pcd", b"VERSION 0.7\nFIELDS x y z\n", "header does not end in a line DATA"),
    ("a.pcd", b"SIZE 4 4\nTYPE F F\nPOINTS 1\nDATA ascii\n", "header has no line FIELDS"),
    ("a.pcd", b"FIELDS x y\nSIZE 4 4\nTYPE F F\nPOINTS 1\nDATA ascii\n1 1\n", "fields are x, y, and x, y and z"),
    ("a.pcd", b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS 20\nDATA ascii\n" + 12 * b"1 2 0\n",
     "cut short: it announces 20 points, and 12 are there"),
    ("a.stl", b"solid nothing", "Export it again"),
    ("a.glb", b"glTF....", "Export it again"),
    ("a.stl", bytes(80) + (60).to_bytes(4, "little") + bytes(50 * 59), "cut short: .* counts 60 triangles, and 59 are"),
    ("a.stl", b"solid room\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\n", "cut short: .* endsolid"),
    ("a.glb", b"glTF" + (2).to_bytes(4, "little") + (100).to_bytes(4, "little") + bytes(20), "100 bytes, and 32 are"),
    ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "a face has a corner that is not there"),
    ("a.gltf", b'{"asset": {"version": "2.0"}, "buffers": [{"uri": "room.bin", "byteLength": 4}]}',
     "room.bin, which is not beside it"),
    ("a.gltf", b"{VERSION", "JSON.* line 1 column 2"),
    ("a.pcd", b"FIELDS x y z\nTYPE F F Q\nSIZE 4 4 9\nPOINTS 1\nDATA binary\n", "type Q and the size 9 .known: F 4,"),
])  # fmt: skip
def test_a_damaged_file_is_refused_in_one_line(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=message) as caught:
        read_map(tmp_path / name)
    assert name in str(caught.value) and "\n" not in str(caught.value)


def test_millimetres_taken_for_metres_are_refused_with_a_remedy_that_works(tmp_path):
    np.save(tmp_path / "room.npy", 1000.0 * cloud_of_a_room() * np.array([2.0, 2.0, 1.0]))
    with pytest.raises(ValueError, match="--scale") as refused:
        MapGoal(map=str(tmp_path / "room.npy")).checksum()
    words = re.search(r"run python -m whill_mjx.maps (\S+) --scale (\S+) --out NAME", str(refused.value)).groups()
    main(Import(Path(words[0]), tmp_path / "a: #1", scale=float(words[1]), pixels=100))
    direct, converted = read_map(words[0], scale=0.001), read_map(tmp_path / "a: #1.yaml")
    np.testing.assert_array_equal(converted.cells, direct.cells)
    assert (converted.resolution, converted.origin) == (direct.resolution, direct.origin)
    assert set(np.unique(direct.cells)) == {FREE, UNKNOWN, OCCUPIED}
    task = MapGoal(map=str(tmp_path / "a: #1.yaml"))
    assert task.checksum() and task.sample_world(jax.random.key(0)).scene.walls.segments.shape[0] > 4


def test_the_command_imports_a_cloud(tmp_path):
    np.save(tmp_path / "room.npy", cloud_of_a_room() * np.array([2.0, 2.0, 1.0]))
    done = subprocess.run([sys.executable, "-m", "whill_mjx.maps", "import", "room.npy", "--out", "room"],
                          cwd=tmp_path, capture_output=True, text=True, check=True)  # fmt: skip
    assert "starts and goals" in done.stdout and (tmp_path / "room.png").stat().st_size > 1000


def rebuilt(tmp_path, *more, name="building.stl"):
    """Grid of a room of 8 x 6 m with further boxes, each of a size and a centre [m]."""
    import trimesh

    tall = 2.5
    room = [((8, 6, 0.2), (4, 3, -0.1)), *[((8.2, 0.2, tall), (4, y, tall / 2)) for y in (0, 6)],
            *[((0.2, 6, tall), (x, 3, tall / 2)) for x in (0, 8)]]  # fmt: skip
    parts = [trimesh.creation.box(size, trimesh.transformations.translation_matrix(at)) for size, at in (*room, *more)]
    trimesh.util.concatenate(parts).export(tmp_path / name)
    return read_map(tmp_path / name)


def kind_at(grid, x, y):
    column, row = ((np.array([x, y]) - grid.origin[:2]) / grid.resolution).astype(int)
    return grid.cells[row, column]


@pytest.mark.parametrize("low, high, kind", [
    (0.72, 0.75, OCCUPIED),  # a table
    (0.135, 0.165, OCCUPIED),  # a board
    (0.0, 0.16, OCCUPIED),  # a step too high
    (1.30, 1.32, OCCUPIED),
    (0.0, 0.11, FREE),  # a mat
    (1.52, 1.55, FREE),  # a lamp
])  # fmt: skip
def test_what_lies_level_between_step_and_headroom_is_in_the_way_everywhere(tmp_path, low, high, kind):
    grid = rebuilt(tmp_path, ((1.6, 1.2, high - low), (4.0, 3.0, (low + high) / 2)))
    for x, y in ((4.03, 3.03), (3.33, 2.53), (4.67, 3.47)):
        assert kind_at(grid, x, y) == kind
    assert kind_at(grid, 2.0, 2.0) == kind_at(grid, 4.03, 4.2) == FREE


def test_a_gentle_ramp_is_free_up_to_a_step_above_the_floor_and_in_the_way_beyond(tmp_path):
    import trimesh

    rebuilt(tmp_path)
    corners = [[3, 2, 0], [7, 2, 0.32], [7, 4, 0.32], [3, 4, 0]]  # 8 %: it comes to 0.12 m at x = 4.5
    strips = [trimesh.Trimesh([[x, 2, z], [x + 0.25, 2, z + 0.02], [x + 0.25, 4, z + 0.02], [x, 4, z]],
                              [[0, 1, 2], [0, 2, 3]])
              for x, z in ((3 + 0.25 * k, 0.02 * k) for k in range(16))]  # fmt: skip
    assert strips[-1].vertices[1].tolist() == pytest.approx(corners[1])
    trimesh.util.concatenate([trimesh.load(tmp_path / "building.stl"), *strips]).export(tmp_path / "ramp.stl")
    grid = read_map(tmp_path / "ramp.stl")
    assert all(kind_at(grid, x, 3.03) == FREE for x in np.arange(2.05, 4.4, 0.1))
    assert all(kind_at(grid, x, 3.03) == OCCUPIED for x in np.arange(4.65, 6.9, 0.1))


def test_a_face_between_two_levels_is_cut_to_its_part_there():
    corners = np.array([[[0.0, 0, 0], [4, 0, 2], [0, 4, 0]], [[0, 0, 5], [1, 0, 6], [0, 1, 7]]])
    (cut,) = surfaces._between(corners, 0.5, 1.5)  # the other one lies above
    x, y = cut.T
    assert x.min() == pytest.approx(1.0) and x.max() == pytest.approx(3.0)
    assert abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) / 2 == pytest.approx(4.0)  # 3 * 3 / 2 - 1 / 2


PLY = """ply
format ascii 1.0
element vertex 12
property float x
property float y
property float z
element face 2
property list uchar int vertex_indices
end_header
"""


@pytest.mark.parametrize("corner", [-1, 12, 4000])
def test_a_face_with_a_corner_that_is_not_there_is_refused(tmp_path, corner):
    file = tmp_path / "room.ply"
    file.write_text(PLY + "".join(f"{k % 4} {k // 4} 0\n" for k in range(12)) + f"3 0 1 4\n3 1 5 {corner}\n")
    with pytest.raises(ValueError, match=rf"room.ply.*corner {corner}, and the corners are 0 to 11\). Export it again"):
        read_map(file)


def test_a_part_of_a_scene_may_not_borrow_the_corners_of_another(tmp_path):
    import trimesh

    parts = trimesh.Scene([trimesh.creation.box((6, 4, 0.2)), trimesh.creation.box((1, 1, 1))])
    data = parts.export(file_type="glb")
    faces = np.asarray(parts.geometry["geometry_0"].faces, "<u4")
    wrong = faces.copy()
    wrong[3, 1] = 9  # of 8; the first part would take it from the second
    assert faces.tobytes() in data
    (tmp_path / "room.glb").write_bytes(data.replace(faces.tobytes(), wrong.tobytes()))
    with pytest.raises(ValueError, match=r"room.glb.*the corner 9, and the corners are 0 to 7"):
        read_map(tmp_path / "room.glb")


@pytest.mark.parametrize("face", ["0 1 2", "1 2 0", "1/1 0/1 2/1", "1 2 3 0", "3 00//1 2 # 5"])
def test_an_obj_face_with_the_corner_0_is_refused(tmp_path, face):
    file = tmp_path / "room.obj"
    file.write_text("".join(f"v {k % 4} {k // 4} 0\n" for k in range(12)) + f"f 1 2 10\nf {face}\n")
    with pytest.raises(ValueError, match=r"room.obj.*the corner 0, and the corners begin at 1\). Export it again"):
        read_map(file)


def test_a_cloud_of_complex_numbers_is_refused(tmp_path):
    np.save(tmp_path / "room.npy", cloud_of_a_room() + 1j)
    with pytest.raises(ValueError, match=r"room.npy.*array of complex128 .*real numbers are needed"):
        read_map(tmp_path / "room.npy")


@pytest.mark.parametrize("line", ["v 1 2", "v 1"])
def test_corners_that_lack_a_number_are_refused(tmp_path, line):
    file = tmp_path / "room.obj"
    file.write_text("".join(f"{line}\n" for _ in range(12)) + "f 1 2 3\n")
    with pytest.raises(ValueError, match=r"room.obj: cannot be read as .obj .*Export it again"):
        read_map(file)


@pytest.mark.parametrize("height", [-1e9, 1e9, -1e30])
def test_a_point_far_below_or_above_leaves_the_map_as_it_is(tmp_path, height):
    points = cloud_of_a_room()
    np.save(tmp_path / "room.npy", points)
    np.save(tmp_path / "struck.npy", np.vstack([points, [3.02, 2.02, height]]))
    plain, struck = (read_map(tmp_path / name) for name in ("room.npy", "struck.npy"))
    np.testing.assert_array_equal(struck.cells, plain.cells)

"""Point clouds and meshes of buildings as maps."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from whill_mjx.world.maps import FREE, OCCUPIED, read_map
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
    ("a.pcd", b"VERSION 0.7\nFIELDS x y z\n", "Export it again"),
    ("a.stl", b"solid nothing", "Export it again"),
    ("a.glb", b"glTF....", "Export it again"),
])  # fmt: skip
def test_a_damaged_file_is_refused_in_one_line(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=message) as caught:
        read_map(tmp_path / name)
    assert name in str(caught.value) and "\n" not in str(caught.value)


def test_millimetres_taken_for_metres_are_refused_with_the_remedy(tmp_path):
    np.save(tmp_path / "room.npy", 1000.0 * cloud_of_a_room())
    with pytest.raises(ValueError, match="--scale"):
        read_map(tmp_path / "room.npy")


def test_the_command_imports_a_cloud(tmp_path):
    np.save(tmp_path / "room.npy", cloud_of_a_room() * np.array([2.0, 2.0, 1.0]))
    done = subprocess.run([sys.executable, "-m", "whill_mjx.maps", "import", "room.npy", "--out", "room"],
                          cwd=tmp_path, capture_output=True, text=True, check=True)  # fmt: skip
    assert "starts and goals" in done.stdout and (tmp_path / "room.png").stat().st_size > 1000

"""README's pictures are drawn by a script."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from benchmarks import pictures

pytestmark = pytest.mark.quick


def test_a_film_moves_and_repeats_for_ever(tmp_path):
    frames = [np.full((32, 48, 3), shade, np.uint8) for shade in (0, 120, 240)]
    pictures.write_film(tmp_path / "film.webp", frames)
    film = Image.open(tmp_path / "film.webp")
    assert film.n_frames == 3 and film.size == (48, 32) and film.info["loop"] == 0


def test_a_frame_shows_the_policys_image_in_the_corner_of_the_large_one_beside_the_view_from_above():
    large = np.zeros((pictures.CAMERA, pictures.CAMERA, 3), np.uint8)
    small, above = np.full((64, 64, 3), 100, np.uint8), np.full((pictures.CAMERA, 144, 3), 50, np.uint8)
    frame = pictures._side_by_side(large, small, above)
    assert frame.shape == (pictures.CAMERA, pictures.CAMERA + 6 + 144, 3)
    assert (frame[4:68, pictures.CAMERA - 68 : pictures.CAMERA - 4] == 100).all()
    assert (frame[:, -144:] == 50).all()
    assert not large.any()


def test_the_nodes_of_the_bridge_are_drawn(tmp_path):
    pictures.ros(tmp_path / "ros2.png")
    assert Image.open(tmp_path / "ros2.png").width > 800

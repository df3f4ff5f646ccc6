"""Camera messages of every size and sort."""

import array

import numpy as np
import pytest

from bridge.image import ImageError, area_resize, to_rgb8

pytestmark = pytest.mark.quick
RED, BLUE = (255, 0, 0), (0, 0, 255)


@pytest.mark.parametrize("encoding, stored", [("rgb8", RED), ("bgr8", BLUE)])
@pytest.mark.parametrize("shape", [(64, 64), (720, 1280), (37, 61)])
def test_red_scene_is_red_in_either_encoding(encoding, stored, shape):
    data = np.tile(np.array(stored, np.uint8), (*shape, 1)).tobytes()
    image = to_rgb8(*shape, encoding, shape[1] * 3, data)
    assert image.shape == (64, 64, 3) and image.dtype == np.uint8 and image.flags.c_contiguous
    assert (image == RED).all()


def test_image_of_the_right_size_is_passed_on_unchanged():
    pixels = np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)
    assert (to_rgb8(64, 64, "rgb8", 192, array.array("B", pixels.tobytes())) == pixels).all()
    assert (to_rgb8(64, 64, "bgr8", 192, pixels.tobytes()) == pixels[:, :, ::-1]).all()


def test_padding_at_the_end_of_rows_is_ignored():
    pixels = np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)
    rows = np.full((64, 200), 7, np.uint8)
    rows[:, :192] = pixels.reshape(64, 192)
    assert (to_rgb8(64, 64, "rgb8", 200, rows.tobytes()) == pixels).all()


@pytest.mark.parametrize("shape", [(12, 20), (1, 1), (9, 7), (3, 50), (50, 3), (8, 8)])
def test_resizing_equals_the_mean_over_the_covered_area(shape):
    pixels = np.random.default_rng(1).integers(0, 256, (*shape, 3), np.uint8)
    dense = pixels.repeat(8, axis=0).repeat(8, axis=1)  # each output pixel then covers whole samples
    mean = dense.reshape(8, shape[0], 8, shape[1], 3).mean((1, 3))
    assert np.abs(area_resize(pixels, (8, 8)) - mean).max() <= 0.5 + 1e-4


def test_mean_brightness_of_a_large_camera_image_is_kept():
    pixels = np.random.default_rng(1).integers(0, 256, (720, 1280, 3), np.uint8)
    assert abs(area_resize(pixels, (64, 64)).mean() - pixels.mean()) < 0.05


def test_resizing_by_whole_numbers_is_the_block_mean():
    pixels = np.random.default_rng(2).integers(0, 256, (128, 192, 3), np.uint8)
    assert (area_resize(pixels, (64, 64)) == np.rint(pixels.reshape(64, 2, 64, 3, 3).mean((1, 3)))).all()


GOOD = dict(height=4, width=6, encoding="rgb8", step=18, data=bytes(72))


@pytest.mark.parametrize("change, named", [
    ({"encoding": "mono8"}, "mono8"), ({"encoding": "yuv422_yuy2"}, "yuv422_yuy2"), ({"encoding": ""}, "encoding ''"),
    ({"encoding": "bayer_rggb8"}, "bayer"), ({"step": 17}, "step 17"), ({"data": bytes(71)}, "71 bytes"),
    ({"data": bytes(73)}, "73 bytes"), ({"data": b""}, "0 bytes"), ({"height": 0, "data": b""}, "size 0 x 6"),
    ({"width": 0}, "size 4 x 0"), ({"height": 2**31}, "size"), ({"width": 2**31, "step": 2**33}, "size"),
    ({"step": 10**9}, "72 bytes"),
])
def test_message_that_contradicts_itself_is_refused_with_field_value_rule_and_remedy(change, named):
    with pytest.raises(ImageError, match=named) as refusal:
        to_rgb8(**{**GOOD, **change})
    assert str(refusal.value).count(". ") >= 1 and str(refusal.value).endswith(".")


def test_thousand_random_messages_give_an_image_or_a_refusal_and_nothing_else():
    rng = np.random.default_rng(3)
    images = 0
    for _ in range(1000):
        height, width = rng.integers(0, 20, 2)
        step = int(3 * width + rng.integers(-1, 3))
        data = bytes(max(0, int(height) * step + rng.integers(-1, 2)))
        try:
            images += to_rgb8(int(height), int(width), "rgb8", step, data, (8, 8)).shape == (8, 8, 3)
        except ImageError:
            continue
    assert 100 < images < 900

"""Camera messages of every size and sort."""

import array
import io

import numpy as np
import pytest

from bridge.sensing import image as image_module
from bridge.sensing.image import (
    CHANNELS,
    ImageError,
    RawImage,
    area_resize,
    compressed_to_rgb8,
    pillow_decoder,
    to_rgb8,
)

pytestmark = pytest.mark.quick
RED, BLUE = (255, 0, 0), (0, 0, 255)


@pytest.mark.parametrize("encoding, stored", [("rgb8", RED), ("bgr8", BLUE)])
@pytest.mark.parametrize("shape", [(64, 64), (720, 1280), (37, 61)])
def test_red_scene_is_red_in_either_encoding(encoding, stored, shape):
    data = np.tile(np.array(stored, np.uint8), (*shape, 1)).tobytes()
    image = to_rgb8(RawImage(*shape, encoding, shape[1] * 3, data))
    assert image.shape == (64, 64, 3) and image.dtype == np.uint8 and image.flags.c_contiguous
    assert (image == RED).all()


def test_image_of_the_right_size_is_passed_on_unchanged():
    pixels = np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)
    assert (to_rgb8(RawImage(64, 64, "rgb8", 192, array.array("B", pixels.tobytes()))) == pixels).all()
    assert (to_rgb8(RawImage(64, 64, "bgr8", 192, pixels.tobytes())) == pixels[:, :, ::-1]).all()


def test_padding_at_the_end_of_rows_is_ignored():
    pixels = np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)
    rows = np.full((64, 200), 7, np.uint8)
    rows[:, :192] = pixels.reshape(64, 192)
    assert (to_rgb8(RawImage(64, 64, "rgb8", 200, rows.tobytes())) == pixels).all()


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
    ({"encoding": "16UC1"}, "16UC1"), ({"encoding": "mono16"}, "mono16"), ({"encoding": ""}, "encoding ''"),
    ({"encoding": "rgba8", "step": 23}, "24 bytes"), ({"encoding": "yuv422", "width": 5}, "must be even"),
    ({"crop": (0, 0, 5, 6)}, "within the image of 4 x 6"), ({"crop": (-1, 0, 2, 2)}, "within"),
    ({"encoding": "yuyv", "crop": (0, 1, 2, 2)}, "left must be even"),
    ({"encoding": "bayer_rggb8"}, "bayer"), ({"step": 17}, "step 17"), ({"data": bytes(71)}, "71 bytes"),
    ({"data": bytes(73)}, "73 bytes"), ({"data": b""}, "0 bytes"), ({"height": 0, "data": b""}, "size 0 x 6"),
    ({"width": 0}, "size 4 x 0"), ({"height": 2**31}, "size"), ({"width": 2**31, "step": 2**33}, "size"),
    ({"step": 10**9}, "72 bytes"),
])
def test_message_that_contradicts_itself_is_refused_with_field_value_rule_and_remedy(change, named):
    with pytest.raises(ImageError, match=named) as refusal:
        fields = {**GOOD, **change}
        crop = fields.pop("crop", None)
        to_rgb8(RawImage(**fields), crop=crop)
    assert str(refusal.value).count(". ") >= 1 and str(refusal.value).endswith(".")


def test_thousand_random_messages_give_an_image_or_a_refusal_and_nothing_else():
    rng = np.random.default_rng(3)
    images = 0
    for _ in range(1000):
        height, width = rng.integers(0, 20, 2)
        step = int(3 * width + rng.integers(-1, 3))
        data = bytes(max(0, int(height) * step + rng.integers(-1, 2)))
        try:
            images += to_rgb8(RawImage(int(height), int(width), "rgb8", step, data), (8, 8)).shape == (8, 8, 3)
        except ImageError:
            continue
    assert 100 < images < 900


def encode(pixels, encoding):
    """The bytes of an rgb image in an encoding; OpenCV is the reference for YUV."""
    cv2 = pytest.importorskip("cv2")
    alpha = np.dstack([pixels, np.full(pixels.shape[:2], 77, np.uint8)])
    if encoding in ("rgb8", "bgr8"):
        return pixels if encoding == "rgb8" else pixels[:, :, ::-1]
    if encoding in ("rgba8", "bgra8"):
        return alpha if encoding == "rgba8" else alpha[:, :, [2, 1, 0, 3]]
    if encoding == "mono8":
        return cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
    code = cv2.COLOR_RGB2YUV_UYVY if encoding in ("yuv422", "uyvy") else cv2.COLOR_RGB2YUV_YUY2
    return cv2.cvtColor(pixels, code)


@pytest.mark.parametrize("shape", [(64, 64), (480, 640), (37, 62)])
@pytest.mark.parametrize("encoding", CHANNELS)
def test_one_scene_looks_the_same_in_every_encoding(encoding, shape):
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    scene = np.stack([60 + 120 * rows / shape[0], 60 + 120 * columns / shape[1], 200 - 90 * rows / shape[0]], axis=-1)
    pixels = np.rint(scene).astype(np.uint8)
    stored = np.ascontiguousarray(encode(pixels, encoding))
    got = to_rgb8(RawImage(*shape, encoding, shape[1] * CHANNELS[encoding], stored.tobytes()))
    want = area_resize(pixels, (64, 64)).astype(float)
    if encoding == "mono8":
        want = np.repeat(want @ np.array([[0.299], [0.587], [0.114]]), 3, axis=2)
    tolerance = 0 if CHANNELS[encoding] >= 3 else 2.5  # YUV and grey are rounded to eight bits when they are stored
    assert np.abs(got - want).max() <= tolerance


@pytest.mark.parametrize("encoding", ["yuv422", "yuv422_yuy2"])
@pytest.mark.parametrize("colour", [(255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 255), (0, 0, 0)])
def test_pure_colours_survive_yuv(encoding, colour):
    pixels = np.tile(np.array(colour, np.uint8), (8, 8, 1))
    got = to_rgb8(RawImage(8, 8, encoding, 16, encode(pixels, encoding).tobytes()), (4, 4))
    assert np.abs(got.astype(int) - colour).max() <= 3


def test_crop_is_what_the_policy_sees():
    pixels = np.random.default_rng(4).integers(0, 256, (100, 120, 3), np.uint8)
    got = to_rgb8(RawImage(100, 120, "rgb8", 360, pixels.tobytes()), (64, 64), (10, 20, 80, 90))
    assert (got == area_resize(pixels[10:90, 20:110], (64, 64))).all()


def compressed(pixels, kind="PNG", **options):
    image = pytest.importorskip("PIL.Image")
    buffer = io.BytesIO()
    image.fromarray(pixels).save(buffer, kind, **options)
    return buffer.getvalue()


def gradient(height=48, width=80):
    rows, columns = np.mgrid[:height, :width]
    return np.stack([rows * 4, columns * 3, 200 - rows * 2], axis=-1).astype(np.uint8)


@pytest.mark.parametrize("decoder", ["opencv", "pillow"])
def test_png_is_read_to_the_bit_and_jpeg_as_any_viewer_shows_it(decoder, monkeypatch):
    if decoder == "pillow":
        monkeypatch.setattr(image_module, "decoder", pillow_decoder)
    else:
        pytest.importorskip("cv2")
    pixels = gradient()
    assert (compressed_to_rgb8(compressed(pixels), (48, 80)) == pixels).all()
    shown = compressed_to_rgb8(compressed(pixels, "JPEG", quality=95), (48, 80))
    assert np.abs(shown.astype(int) - pixels).mean() < 2
    assert compressed_to_rgb8(compressed(pixels), (24, 40), (0, 0, 48, 80)).shape == (24, 40, 3)


@pytest.mark.parametrize("decoder", ["opencv", "pillow"])
@pytest.mark.parametrize("kind", ["PNG", "JPEG"])
def test_compressed_image_that_is_cut_off_anywhere_is_refused(kind, decoder, monkeypatch):
    if decoder == "pillow":
        monkeypatch.setattr(image_module, "decoder", pillow_decoder)
    whole = compressed(gradient(), kind)
    for end in (0, 1, 10, 30, len(whole) // 2, len(whole) - 20):
        with pytest.raises(ImageError, match="compressed image"):
            compressed_to_rgb8(whole[:end])


@pytest.mark.parametrize("data, named", [
    (b"GIF89a" + bytes(50), "47494638"), (b"\x89PNG\r\n\x1a\n" + bytes(8) + b"\xff" * 8 + b"\x08", "image size"),
])
def test_other_kinds_and_impossible_sizes_are_refused_before_decoding(data, named):
    with pytest.raises(ImageError, match=named):
        compressed_to_rgb8(data)


def test_depth_image_in_a_png_is_refused():
    depth = compressed(np.full((8, 8), 4000, np.uint16))
    with pytest.raises(ImageError, match="16 bits"):
        compressed_to_rgb8(depth)

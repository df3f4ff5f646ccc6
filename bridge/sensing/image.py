"""Turns a camera message into the image a policy was trained on; pure numpy, no ROS.

rclpy hands over messages whose data does not match their size, so every field is checked before it is used. Only the
declared encodings are read; any other is refused rather than guessed.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from io import BytesIO

import numpy as np

CHANNELS = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4, "mono8": 1, "yuv422": 2, "uyvy": 2, "yuv422_yuy2": 2,
            "yuyv": 2}
"""Bytes per pixel of each encoding that is read; yuv422 and uyvy store U Y V Y, yuv422_yuy2 and yuyv store Y U Y V."""
MAX_SIDE = 8192
"""Largest width or height [pixels] that is believed."""
YUV_TO_RGB = np.array([[1.164384, 0.0, 1.596027], [1.164384, -0.391762, -0.812968], [1.164384, 2.017232, 0.0]],
                      np.float32)
"""ITU-R BT.601, luma from 16 to 235: red, green, blue from Y - 16, U - 128, V - 128."""
ROWS, COLUMNS = 2, 8
"""Rows and columns of a result that are averaged in one product. More of them share fewer pixels: most of the product
is by zero. The rows take most of the time, and fewer columns make too many products."""
ALONE = 2**18
"""Multiplications of a matrix product up to which OpenBLAS takes no second thread. The threads of larger ones wait for
each other: they doubled the time from an image of 1280x720 to its command."""
IMAGE_ENDS = (b"\xff\xd9", b"IEND\xaeB`\x82")
"""Last bytes of a JPEG and of a PNG."""

Crop = tuple[int, int, int, int]
"""Top row, left column, rows and columns of the part of the image that the policy sees."""


class ImageError(ValueError):
    """The message does not describe a usable image; the frame is to be dropped."""


@dataclass(frozen=True)
class RawImage:
    """The fields of sensor_msgs/Image that count; where one is asked for, such a message serves as well."""

    height: int
    """Rows."""
    width: int
    """Columns."""
    encoding: str
    """One of CHANNELS."""
    step: int
    """Bytes of one row, at least the pixels' own."""
    data: object
    """The bytes: `bytes`, `array.array` or anything else with the buffer protocol."""


def to_rgb8(image: RawImage, size: tuple[int, int] = (64, 64), crop: Crop | None = None) -> np.ndarray:
    """Return the image (H, W, 3) uint8 in red, green, blue order, resized by area averaging.

    Args:
        image: the message.
        size: rows and columns of the result.
        crop: the part of the image to use; None: all of it.

    Raises:
        ImageError: naming the field, its value, the rule and the remedy.
    """
    height, width, encoding, step = image.height, image.width, image.encoding, image.step
    if encoding not in CHANNELS:
        raise ImageError(f"image encoding {encoding!r}: only {', '.join(CHANNELS)} are read. Set the camera to one of "
                         "them.")
    if not (1 <= height <= MAX_SIDE and 1 <= width <= MAX_SIDE):
        raise ImageError(f"image size {height} x {width}: both must be from 1 to {MAX_SIDE}. Check the camera.")
    channels = CHANNELS[encoding]
    if step < channels * width:
        raise ImageError(f"image step {step}: a row of {width} pixels has {channels * width} bytes. Correct the "
                         "publisher.")
    buffer = np.frombuffer(image.data, np.uint8)  # type: ignore[call-overload]  # any buffer
    if buffer.size != height * step:
        raise ImageError(f"image data of {buffer.size} bytes: {height} rows of {step} bytes are {height * step}. "
                         "Correct the publisher.")
    pixels = buffer.reshape(height, step)[:, : channels * width].reshape(height, width, channels)
    pixels = crop_image(pixels, crop)
    if channels == 2 and crop is not None and crop[1] % 2:
        raise ImageError(f"crop {crop}: 4:2:2 stores pixels in pairs, so left must be even. Correct --crop.")
    if channels == 2:
        return yuv422_to_rgb8(pixels, encoding in ("yuv422", "uyvy"), size)
    if channels == 1:
        return np.repeat(area_resize(pixels, size), 3, axis=2)
    small = area_resize(pixels[:, :, :3], size)  # alpha has no part
    return np.ascontiguousarray(small[:, :, ::-1] if encoding.startswith("bgr") else small)


def compressed_to_rgb8(data: bytes, size: tuple[int, int] = (64, 64), crop: Crop | None = None) -> np.ndarray:
    """Return a JPEG or PNG as `to_rgb8` returns an image; it needs Pillow or OpenCV.

    Raises:
        ImageError: the data is no whole image of one of the two kinds, or no decoder is installed.
    """
    height, width = compressed_size(data)
    if not (1 <= height <= MAX_SIDE and 1 <= width <= MAX_SIDE):
        raise ImageError(f"image size {height} x {width}: both must be from 1 to {MAX_SIDE}. Check the camera.")
    if not data.rstrip(b"\0").endswith(IMAGE_ENDS):  # decoders would fill up with grey
        raise ImageError(f"compressed image of {len(data)} bytes: its end is missing. Correct the publisher.")
    try:
        pixels = decoder()(data)
    except (OSError, ValueError, SyntaxError) as error:  # what Pillow raises on damaged files
        raise ImageError(f"compressed image of {len(data)} bytes: {error}. Correct the publisher.") from error
    return area_resize(crop_image(pixels, crop), size)


def compressed_size(data: bytes) -> tuple[int, int]:
    """Return rows and columns that the header of a JPEG or PNG states, before anything is decoded."""
    if data[:8] == b"\x89PNG\r\n\x1a\n" and len(data) >= 25:
        if data[24] > 8:
            raise ImageError(f"PNG of {data[24]} bits per colour: 8 are read; more is a depth image. Name a colour "
                             "camera.")
        return int.from_bytes(data[20:24], "big"), int.from_bytes(data[16:20], "big")
    at = 2
    while data[:2] == b"\xff\xd8" and at + 9 <= len(data) and data[at] == 0xFF:
        if data[at + 1] in (0xC0, 0xC1, 0xC2):  # start of frame
            return int.from_bytes(data[at + 5 : at + 7], "big"), int.from_bytes(data[at + 7 : at + 9], "big")
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    raise ImageError(f"compressed image that begins with {data[:4].hex()}: only whole JPEG and PNG are read. Set the "
                     "camera to one of them.")


@lru_cache(maxsize=1)
def decoder() -> Callable[[bytes], np.ndarray]:
    """Return the function that decodes JPEG and PNG to (H, W, 3) uint8 rgb: OpenCV's, else Pillow's; both agree."""
    try:
        import cv2
    except ImportError:
        return pillow_decoder()

    def with_opencv(data: bytes) -> np.ndarray:
        flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
        if image is None:
            raise ValueError("it is damaged")
        return np.ascontiguousarray(image[:, :, ::-1])

    return with_opencv


def pillow_decoder() -> Callable[[bytes], np.ndarray]:
    """Return the decoder of Pillow."""
    try:
        from PIL import Image
    except ImportError as error:
        raise ImageError("compressed image: no decoder is installed. Run `pip install pillow`, or publish raw "
                         "images.") from error

    def with_pillow(data: bytes) -> np.ndarray:
        with Image.open(BytesIO(data), formats=("JPEG", "PNG")) as image:
            return np.asarray(image.convert("RGB"))

    return with_pillow


def crop_image(image: np.ndarray, crop: Crop | None) -> np.ndarray:
    """Return the part of an image (H, W, C) that a crop names.

    Raises:
        ImageError: the crop does not lie within the image.
    """
    if crop is None:
        return image
    top, left, height, width = crop
    if not (top >= 0 and left >= 0 and height > 0 and width > 0
            and top + height <= image.shape[0] and left + width <= image.shape[1]):
        raise ImageError(f"crop {crop}: top, left, height, width must lie within the image of {image.shape[0]} x "
                         f"{image.shape[1]}. Correct --crop or the camera's size.")
    return image[top : top + height, left : left + width]


def yuv422_to_rgb8(pixels: np.ndarray, chroma_first: bool, size: tuple[int, int]) -> np.ndarray:
    """Return rgb8 of `size` from pixels (H, W, 2) of which each pair shares its chroma; columns must be even.

    Averaging comes before the conversion, which is linear, so nothing is rounded twice.
    """
    height, width = pixels.shape[:2]
    if width % 2:
        raise ImageError(f"image width {width}: 4:2:2 stores pixels in pairs, so it must be even. Correct the "
                         "publisher or the crop.")
    luma = pixels[:, :, 1 if chroma_first else 0, None]
    chroma = pixels[:, :, 0 if chroma_first else 1].reshape(height, width // 2, 2)
    yuv = np.concatenate([area_mean(luma, size) - 16, area_mean(chroma, size) - 128], axis=2)
    return np.clip(np.rint(yuv @ YUV_TO_RGB.T), 0, 255).astype(np.uint8)


def area_resize(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return (H, W, C) uint8: each output pixel is the mean of the input area it covers, rounded."""
    if image.shape[:2] == size:
        return np.array(image)
    return np.clip(np.rint(area_mean(image, size)), 0, 255).astype(np.uint8)


def area_mean(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return (H, W, C) float32: the mean of the input area that each output pixel covers.

    Both directions are weighted sums, so any size works, also enlarging and sizes that do not divide.
    """
    height, width = size
    channels = image.shape[2]
    if image.shape[0] % height == 0 and image.shape[1] % width == 0:
        blocks = image.reshape(height, image.shape[0] // height, width, image.shape[1] // width, channels)
        return blocks.mean(axis=(1, 3), dtype=np.float32)
    rows = _row_means(image, height)
    means = np.empty((height, width, channels), np.float32)
    for channel in range(channels):
        one = np.ascontiguousarray(rows[:, :, channel])
        for outputs, inputs, weights in _bands(image.shape[1], width, COLUMNS):
            means[:, outputs, channel] = one[:, inputs] @ weights.T
    return means


def _row_means(image: np.ndarray, height: int) -> np.ndarray:
    """Return (height, width_in, C) float32, the weighted mean of the rows; a strip of a band at a time."""
    _, width, channels = image.shape
    out = np.empty((height, width, channels), np.float32)
    for outputs, inputs, weights in _bands(image.shape[0], height, ROWS):
        strip = max(1, ALONE // (weights.size * channels))
        for first in range(0, width, strip):
            part = image[inputs, first : first + strip].astype(np.float32)
            sums = weights @ part.reshape(len(part), -1)
            out[outputs, first : first + strip] = sums.reshape(len(weights), -1, channels)
    return out


@lru_cache(maxsize=32)
def _bands(source: int, target: int, cells: int) -> tuple[tuple[slice, slice, np.ndarray], ...]:
    """Return target cells, the source cells under them and their weights (targets, sources); `cells` at a time."""
    found = []
    for first in range(0, target, cells):
        weights = _weights(source, target)[first : first + cells]
        (used,) = np.nonzero(weights.any(axis=0))
        inputs = slice(used[0], used[-1] + 1)
        found.append((slice(first, first + len(weights)), inputs, np.ascontiguousarray(weights[:, inputs])))
    return tuple(found)


@lru_cache(maxsize=16)
def _weights(source: int, target: int) -> np.ndarray:
    """Return (target, source) float32: the share of each source cell in each target cell; rows sum to 1."""
    edges = np.arange(target + 1) * (source / target)
    cells = np.arange(source)
    overlap = np.minimum(edges[1:, None], cells + 1) - np.maximum(edges[:-1, None], cells)
    weights = np.clip(overlap, 0, None)
    weights[weights < 1e-9] = 0  # an edge that only touches a cell
    weights = (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)
    weights.setflags(write=False)
    return weights

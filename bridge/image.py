"""Turns a camera message into the image a policy was trained on; pure numpy, no ROS.

rclpy hands over messages whose data does not match their size, so every field is checked before it is used. Only rgb8
and bgr8 are declared; any other encoding is refused rather than guessed.
"""

from functools import lru_cache

import numpy as np

ENCODINGS = ("rgb8", "bgr8")
MAX_SIDE = 8192
"""Largest width or height [pixels] that is believed."""


class ImageError(ValueError):
    """The message does not describe a usable image; the frame is to be dropped."""


def to_rgb8(height: int, width: int, encoding: str, step: int, data: object,
            size: tuple[int, int] = (64, 64)) -> np.ndarray:
    """Return the image (H, W, 3) uint8 in red, green, blue order, resized by area averaging.

    Args:
        height: rows of the message.
        width: columns of the message.
        encoding: "rgb8" or "bgr8".
        step: bytes of one row, at least 3 * width.
        data: the bytes: `bytes`, `array.array` or anything else with the buffer protocol.
        size: rows and columns of the result.

    Raises:
        ImageError: naming the field, its value, the rule and the remedy.
    """
    if encoding not in ENCODINGS:
        raise ImageError(f"image encoding {encoding!r}: only {ENCODINGS} are read. Set the camera to one of them.")
    if not (1 <= height <= MAX_SIDE and 1 <= width <= MAX_SIDE):
        raise ImageError(f"image size {height} x {width}: both must be from 1 to {MAX_SIDE}. Check the camera.")
    if step < 3 * width:
        raise ImageError(f"image step {step}: a row of {width} pixels has {3 * width} bytes. Correct the publisher.")
    buffer = np.frombuffer(data, np.uint8)  # type: ignore[call-overload]  # any buffer
    if buffer.size != height * step:
        raise ImageError(f"image data of {buffer.size} bytes: {height} rows of {step} bytes are {height * step}. "
                         "Correct the publisher.")
    pixels = buffer.reshape(height, step)[:, : 3 * width].reshape(height, width, 3)
    small = area_resize(pixels, size)
    return np.ascontiguousarray(small[:, :, ::-1]) if encoding == "bgr8" else small


def area_resize(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return (H, W, 3) uint8: each output pixel is the mean of the input area it covers, rounded.

    Both directions are weighted sums, so any size works, also enlarging and sizes that do not divide.
    """
    height, width = size
    if image.shape[:2] == (height, width):
        return np.array(image)
    if image.shape[0] % height == 0 and image.shape[1] % width == 0:
        blocks = image.reshape(height, image.shape[0] // height, width, image.shape[1] // width, 3)
        mean = blocks.mean(axis=(1, 3), dtype=np.float32)
    else:
        rows = _row_sums(image, height)  # (H, width_in * 3)
        columns = _weights(image.shape[1], width)  # (W, width_in)
        mean = np.matmul(columns, rows.reshape(height, image.shape[1], 3))
    return np.clip(np.rint(mean), 0, 255).astype(np.uint8)


def _row_sums(image: np.ndarray, height: int) -> np.ndarray:
    """Return (height, width_in * 3) float32, the weighted mean of the rows; a band of rows at a time."""
    flat = image.reshape(image.shape[0], -1)
    weights = _weights(image.shape[0], height)
    out = np.empty((height, flat.shape[1]), np.float32)
    for i, row in enumerate(weights):
        (used,) = np.nonzero(row)
        out[i] = row[used] @ flat[used[0] : used[-1] + 1].astype(np.float32)
    return out


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

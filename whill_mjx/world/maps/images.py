"""Images of maps (PGM, PBM, PPM, PNG, BMP) as grey levels and opacity, by the arithmetic of GraphicsMagick.

nav2 reads its maps with GraphicsMagick (16 bits per colour): a sample is scaled to 16 bits, colours become Rec. 601
luma, and the upper byte of the result is the level.
"""

from __future__ import annotations

import re
import struct
from pathlib import Path

import numpy as np

from whill_mjx.io.reading import MB, read_bytes

IMAGE_BYTES, HEADER_BYTES = 100 * MB, 10_000
MAX_PIXELS, LONGEST_SIDE = 50 * MB, 50_000
PROBLEM = "is missing or no PGM, PBM, PPM, PNG or BMP. Put the map's image there."
WHITE = 65535
"""Largest sample of 16 bits."""
BLOCK = 1_000_000
"""Pixels converted at a time."""
LUMA = np.array([0.299, 0.587, 0.114], np.float32)
PNG = b"\x89PNG\r\n\x1a\n"
NETPBM = re.compile(rb"P([1-6])((?:\s|#[^\n]*\n)+)(\d{1,9})((?:\s|#[^\n]*\n)+)(\d{1,9})")
NUMBER = re.compile(rb"(?:\s|#[^\n]*\n)+(\d{1,9})")


def read_levels(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Grey level and opacity, each (rows, columns) uint8, top row first; the opacity is None where there is none.

    Raises:
        ValueError: the file is missing, damaged, too large or of another format; names file and remedy.
    """
    try:
        data = read_bytes(path, IMAGE_BYTES, PROBLEM)
    except FileNotFoundError as error:
        raise ValueError(str(error)) from None
    size = image_size(data)
    if size is None:
        raise ValueError(f"{path}: {PROBLEM}")
    if max(size) > LONGEST_SIDE or size[0] * size[1] > MAX_PIXELS:
        raise ValueError(
            f"{path}: is {size[0]} x {size[1]} pixels; at most {MAX_PIXELS} pixels, {LONGEST_SIDE} a side,"
            " are read. Cut the map."
        )
    samples, alpha = (_netpbm(path, data), None) if data[:1] == b"P" else _decoded(path, data)
    return (_upper_byte(samples) if samples.ndim == 2 else luma(samples)), alpha


def image_size(data: bytes) -> tuple[int, int] | None:
    """Width and height that the header of an image states; None of other formats and of sizes that are none."""
    size = None
    if data[:8] == PNG and data[12:16] == b"IHDR" and len(data) >= 24:
        size = struct.unpack(">II", data[16:24])
    elif data[:2] == b"BM" and len(data) >= 26:
        width, height = struct.unpack("<ii", data[18:26])
        size = width, abs(height)
    elif header := NETPBM.match(data[:HEADER_BYTES]):
        size = int(header[3]), int(header[5])
    return size if size and min(size) > 0 else None


def luma(colours: np.ndarray) -> np.ndarray:
    """Levels (rows, columns) uint8 of RGB (rows, columns, 3): Rec. 601 in single precision, then the upper byte."""
    flat = colours.reshape(-1, 3)
    grey = np.empty(len(flat), np.uint16)
    for start in range(0, len(flat), BLOCK):
        block = _wide(flat[start : start + BLOCK]).astype(np.float32) * LUMA
        total = (block[:, 0] + block[:, 1] + block[:, 2]).astype(float)
        grey[start : start + BLOCK] = np.minimum(total + 0.5, WHITE)
    return _upper_byte(grey).reshape(colours.shape[:2])


def _wide(samples: np.ndarray) -> np.ndarray:
    """Samples (...) uint16 of samples of 8 or 16 bits."""
    return samples.astype(np.uint16) * 257 if samples.dtype == np.uint8 else samples


def _upper_byte(samples: np.ndarray) -> np.ndarray:
    """Levels (...) uint8 of samples of 16 bits; those of 8 bits as they are."""
    return samples if samples.dtype == np.uint8 else (samples // 257).astype(np.uint8)


def _netpbm(path: Path, data: bytes) -> np.ndarray:
    """Samples of a Netpbm file, (rows, columns) or (rows, columns, 3), uint8 or uint16."""
    header = NETPBM.match(data[:HEADER_BYTES])
    assert header is not None  # `image_size` has found it
    kind, columns, rows, place = int(header[1]), int(header[3]), int(header[5]), header.end()
    largest = 1
    if kind not in (1, 4):
        number = NUMBER.match(data[:HEADER_BYTES], place)
        largest, place = (int(number[1]), number.end()) if number else (0, place)
        if not 0 < largest <= WHITE:
            raise ValueError(f"{path}: its largest sample is {largest}; it must be 1 to {WHITE}. Save it again.")
    shape = (rows, columns, 3) if kind in (3, 6) else (rows, columns)
    count = rows * columns * (3 if kind in (3, 6) else 1)
    body = data[place + 1 :]  # one character parts header and samples
    if kind <= 3:
        samples = _plain(path, body, digits=kind == 1)
    elif kind == 4:
        samples = _bits(body, rows, columns)
    else:
        wide = largest > 255
        samples = np.frombuffer(body[: len(body) // 2 * 2] if wide else body, ">u2" if wide else np.uint8)
    if len(samples) < count:
        raise ValueError(f"{path}: ends after {len(samples)} of {count} samples. Copy it or save it again.")
    samples = samples[:count]
    if samples.max() > largest:
        raise ValueError(f"{path}: has a sample of {samples.max()}, its largest being {largest}. Save it again.")
    if kind in (1, 4):
        samples = 1 - samples  # 1 is black
    if largest != 255:
        samples = (samples.astype(np.uint32) * WHITE // largest).astype(np.uint16)
    return samples.astype(np.uint8 if largest == 255 else np.uint16).reshape(shape)


def _plain(path: Path, body: bytes, digits: bool) -> np.ndarray:
    """Numbers of a plain Netpbm file; of a bitmap, whose `digits` need no space between them."""
    body = re.sub(rb"#[^\n]*", b" ", body)
    if digits:
        marks = np.frombuffer(body, np.uint8)
        return marks[(marks == ord("0")) | (marks == ord("1"))] - np.uint8(ord("0"))
    words = body.split()
    if any(len(word) > 5 or not word.isdigit() for word in words):
        raise ValueError(f"{path}: has something else than numbers up to {WHITE} in it. Save it again.")
    return np.array(words).astype(np.int64) if words else np.zeros(0, np.int64)


def _bits(body: bytes, rows: int, columns: int) -> np.ndarray:
    """Bits of the whole rows of a binary bitmap; each row begins with a new byte."""
    stride = -(-columns // 8)
    whole = min(rows, len(body) // stride)
    packed = np.frombuffer(body, np.uint8, whole * stride).reshape(whole, stride)
    return np.unpackbits(packed, axis=1)[:, :columns].ravel()


def _decoded(path: Path, data: bytes) -> tuple[np.ndarray, np.ndarray | None]:
    """Samples (rows, columns) or RGB (rows, columns, 3) of a PNG or BMP, uint8 or uint16, and the opacity."""
    import cv2

    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # the error below says it
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except (cv2.error, MemoryError):
        image = None
    finally:
        cv2.utils.logging.setLogLevel(level)
    if image is None or image.dtype not in (np.uint8, np.uint16) or not image.size:
        raise ValueError(f"{path}: is damaged. Copy it or save it again.")
    if image.ndim == 2:
        return image, _one_transparent(data, image)
    alpha = _upper_byte(image[..., 3]) if image.shape[2] == 4 else None
    return image[..., 2::-1], alpha


def _one_transparent(data: bytes, grey: np.ndarray) -> np.ndarray | None:
    """Opacity of a grey PNG that declares one of its levels transparent (chunk tRNS); None without one."""
    if data[:8] != PNG:
        return None
    place, depth = 8, data[24]
    while place + 8 <= len(data):
        length, name = struct.unpack(">I4s", data[place : place + 8])
        if name == b"tRNS" and length == 2:
            sample = struct.unpack(">H", data[place + 8 : place + 10])[0]
            scale = 1 if depth >= 8 else 255 // (2**depth - 1)
            return np.where(grey == sample * scale, 0, 255).astype(np.uint8)
        if name == b"IDAT":
            return None
        place += length + 12
    return None

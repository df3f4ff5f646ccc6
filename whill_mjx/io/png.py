"""Pictures as PNG files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from whill_mjx.io.folders import write_whole


def write_png(path: Path, image: np.ndarray) -> None:
    """Write an image (H, W, 3) uint8, whole or not at all."""
    import cv2

    ok, data = cv2.imencode(".png", image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])
    if not ok:
        raise ValueError(f"{path}: an image of shape {image.shape} and type {image.dtype} cannot be written as PNG.")
    write_whole(path, data.tobytes())

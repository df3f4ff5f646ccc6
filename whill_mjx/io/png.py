"""Pictures as PNG files: images, and figures of matplotlib, which is imported on demand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from whill_mjx.io.folders import whole_file, write_whole


def write_png(path: Path, image: np.ndarray) -> None:
    """Write an image (H, W, 3) uint8, whole or not at all."""
    import cv2

    ok, data = cv2.imencode(".png", image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])
    if not ok:
        raise ValueError(f"{path}: an image of shape {image.shape} and type {image.dtype} cannot be written as PNG.")
    write_whole(path, data.tobytes())


def pyplot() -> Any:
    """Matplotlib without a window."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    return pyplot


def save_figure(figure: Any, path: Path, dpi: int = 130) -> Path:
    """Write a figure of `pyplot`, whole or not at all, and close it."""
    try:
        with whole_file(path) as temporary:
            figure.savefig(temporary, dpi=dpi)
    finally:
        pyplot().close(figure)
    return path

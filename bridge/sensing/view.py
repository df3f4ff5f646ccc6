"""From a camera's message to the image that the policy sees: a declared crop, or the rectified view of its training.

A real lens bends straight lines and sees another angle than the camera of the training. With the lens's calibration
each pixel of the policy becomes the mean of what the training's ideal camera would see there. Where the lens is that
camera, the result is the plain area average, bit for bit. Pure numpy, no ROS.
"""

import math
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bridge.nodes.exits import OptionError
from bridge.nodes.parameters import load_yaml
from bridge.policy import SensorInput
from bridge.sensing.image import Crop, ImageError, RawImage, compressed_size, compressed_to_rgb8, to_rgb8

MODELS = {"plumb_bob": (4, 5), "rational_polynomial": (8,), "equidistant": (4,)}
"""Distortion models of sensor_msgs/CameraInfo, and how many coefficients they have."""
LARGEST = 100_000
"""Bytes of a calibration file; usual ones have 1 kB."""
FINEST = 16
"""Samples along an edge of a pixel at most."""
SHIFTS = (0, 8, 16) if sys.byteorder == "little" else (24, 16, 8)
"""Where red, green and blue are in a pixel that is read as one number."""


@dataclass(frozen=True)
class Calibration:
    """A camera's lens, as ROS's camera_calibration writes it."""

    width: int
    """[pixels]"""
    height: int
    """[pixels]"""
    matrix: tuple[float, float, float, float]
    """fx, fy, cx, cy [pixels]; the centre of the first pixel is at 0, 0."""
    model: str
    """One of MODELS."""
    coefficients: tuple[float, ...]

    def project(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return column and row [pixels] of directions x to the right and y down, both over the depth."""
        square = x * x + y * y
        if self.model == "equidistant":
            k1, k2, k3, k4 = self.coefficients
            radius = np.sqrt(square)
            angle = np.arctan(radius)
            bent = angle * (1 + k1 * angle**2 + k2 * angle**4 + k3 * angle**6 + k4 * angle**8)
            scale = np.where(radius > 1e-12, bent / np.maximum(radius, 1e-12), 1.0)
            x, y = x * scale, y * scale
        else:
            k1, k2, p1, p2, k3, k4, k5, k6 = (*self.coefficients, *[0.0] * 8)[:8]
            scale = ((1 + square * (k1 + square * (k2 + square * k3)))
                     / (1 + square * (k4 + square * (k5 + square * k6))))
            x, y = (x * scale + 2 * p1 * x * y + p2 * (square + 2 * x * x),
                    y * scale + p1 * (square + 2 * y * y) + 2 * p2 * x * y)
        fx, fy, cx, cy = self.matrix
        return fx * x + cx, fy * y + cy


def read_calibration(path: str | Path) -> Calibration:
    """Return the calibration of a YAML file of ROS's camera_calibration.

    Raises:
        ValueError: naming the file, the field, the value, the rule and the remedy.
    """
    path = Path(path)
    remedy = "Give the YAML file that camera_calibration writes."
    table = load_yaml(path, LARGEST, remedy)
    if not isinstance(table, Mapping):
        raise ValueError(f"{path}: holds no table. {remedy}")

    def numbers(name: str, allowed: tuple[int, ...]) -> tuple[float, ...]:
        part = table.get(name)
        data = part.get("data") if isinstance(part, Mapping) else None
        if not (isinstance(data, list) and len(data) in allowed and all(map(_is_number, data))):
            raise ValueError(f"{path}: {name}.data must be {' or '.join(map(str, allowed))} finite numbers. {remedy}")
        return tuple(float(one) for one in data)

    for name in ("image_width", "image_height"):
        if not (isinstance(table.get(name), int) and 1 <= table[name] <= 8192):
            raise ValueError(f"{path}: {name} is {str(table.get(name))[:40]}; it must be a whole number from 1 to 8192."
                             f" {remedy}")
    model = table.get("distortion_model")
    if not isinstance(model, str) or model not in MODELS:
        raise ValueError(f"{path}: distortion_model is {str(model)[:40]!r}; it must be one of {', '.join(MODELS)}. "
                         "Calibrate with one of them.")
    matrix = numbers("camera_matrix", (9,))
    fx, fy, cx, cy = matrix[0], matrix[4], matrix[2], matrix[5]
    if fx <= 0 or fy <= 0 or matrix[1] or matrix[3:9:3] != (0.0, 0.0) or matrix[7:] != (0.0, 1.0):
        raise ValueError(f"{path}: camera_matrix.data is no matrix fx 0 cx 0 fy cy 0 0 1 with focal lengths above 0. "
                         f"{remedy}")
    return Calibration(table["image_width"], table["image_height"], (fx, fy, cx, cy), model,
                       numbers("distortion_coefficients", MODELS[model]))


def _is_number(value: Any) -> bool:
    """Return whether a value of a YAML file is a finite number; its whole numbers may have any number of digits."""
    largest = sys.float_info.max
    return isinstance(value, int | float) and not isinstance(value, bool) and -largest <= value <= largest


class Rectifier:
    """Resamples images of one camera to the ideal pinhole camera of a policy."""

    def __init__(self, calibration: Calibration, fov_y: float, size: tuple[int, int]) -> None:
        """Prepare the samples.

        Args:
            calibration: of the camera.
            fov_y: vertical field of view of the training's camera [rad]; its pixels are square.
            size: rows and columns of the result.

        Raises:
            ValueError: the camera does not see all that the training's camera saw.
        """
        self.calibration = calibration
        height, width = size
        focal = height / 2 / math.tan(fov_y / 2)
        fine = min(FINEST, max(1, math.ceil(max(calibration.matrix[:2]) / focal - 1e-6)))
        across = ((np.arange(width * fine) + 0.5) / fine - width / 2) / focal
        down = ((np.arange(height * fine) + 0.5) / fine - height / 2) / focal
        with np.errstate(all="ignore"):  # what a wild polynomial makes of a corner is outside
            columns, rows = calibration.project(*np.meshgrid(across, down))
        inside = [(-0.5 <= one) & (one <= most - 0.5)
                  for one, most in ((columns, calibration.width), (rows, calibration.height))]
        outside = ~(inside[0] & inside[1])
        if outside.any():
            raise ValueError(f"the camera does not see {100 * outside.mean():.1f} % of what the training's camera saw "
                             f"({math.degrees(fov_y):.0f} degrees high, {height} x {width} pixels). Take a wider lens, "
                             "or train with this camera's field of view")
        row = np.clip(np.rint(rows), 0, calibration.height - 1).astype(np.intp)
        column = np.clip(np.rint(columns), 0, calibration.width - 1).astype(np.intp)
        samples = (row * calibration.width + column).reshape(height, fine, width, fine)
        self._samples = np.ascontiguousarray(samples.transpose(0, 2, 1, 3).reshape(height, width, fine * fine))

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Return the rectified image, uint8, of a camera image (H, W, 3).

        Raises:
            ImageError: the image has another size than the calibration.
        """
        want = (self.calibration.height, self.calibration.width)
        if image.shape[:2] != want:
            raise ImageError(f"image of {image.shape[0]} x {image.shape[1]}: the calibration is of {want[0]} x "
                             f"{want[1]}. Set the camera to that size, or calibrate it at this one.")
        packed = np.zeros((*want, 4), np.uint8)  # a pixel is picked as one number
        packed[..., :3] = image
        picked = packed.view(np.uint32).ravel().take(self._samples, mode="clip")
        sums = [((picked >> shift) & 255).sum(axis=2, dtype=np.uint32) for shift in SHIFTS]
        return np.rint(np.stack(sums, axis=2) / np.float32(picked.shape[2])).astype(np.uint8)


class View:
    """What the policy sees of a camera's messages."""

    def __init__(self, size: tuple[int, int], crop: Crop | None = None, rectifier: Rectifier | None = None) -> None:
        """Choose the part of the image.

        Args:
            size: rows and columns of the policy's image.
            crop: the part of the camera's image that is used; None: all of it.
            rectifier: takes the place of resizing; not with a crop.
        """
        self.size, self.crop, self.rectifier = size, crop, rectifier

    def raw(self, image: RawImage) -> np.ndarray:
        """Return the image (H, W, 3) uint8 of a sensor_msgs/Image; errors as of `to_rgb8`."""
        if self.rectifier is None:
            return to_rgb8(image, self.size, self.crop)
        return self.rectifier(to_rgb8(image, (image.height, image.width)))

    def compressed(self, data: bytes) -> np.ndarray:
        """Return the image (H, W, 3) uint8 of a JPEG or PNG; errors as of `compressed_to_rgb8`."""
        if self.rectifier is None:
            return compressed_to_rgb8(data, self.size, self.crop)
        return self.rectifier(compressed_to_rgb8(data, compressed_size(data)))


def view_of(pacer: SensorInput, crop: Crop | None = None, calibration: Path | None = None) -> View | None:
    """Return the view of a policy's first camera, by the options of the command line; None where it has no camera.

    Raises:
        ValueError: the calibration cannot be read, or an option does not serve this policy.
    """
    if pacer.kind != "camera":
        if crop is not None or calibration is not None:
            raise OptionError(f"--crop and --calibration are of a camera, and the policy reads none (its {pacer.kind} "
                              "paces it). Leave them out.")
        return None
    size = pacer.size
    if crop is not None and not (crop[2] and crop[3]):
        raise OptionError(f"--crop {' '.join(map(str, crop))}: HEIGHT and WIDTH must be at least 1. Correct them.")
    if calibration is None:
        return View(size, crop)
    if crop is not None:
        raise OptionError("--crop and --calibration: the calibrated view needs the whole image. Leave one of them "
                          "out.")
    if "fov_y" not in pacer.camera:
        raise ValueError(f"--calibration {calibration}: the policy file does not state its camera's field of view "
                         "(camera.fov_y). Export the policy again, or give --crop.")
    try:
        return View(size, rectifier=Rectifier(read_calibration(calibration), pacer.camera["fov_y"], size))
    except ValueError as error:
        text = str(error)
        raise ValueError(text if text.startswith(str(calibration)) else f"{calibration}: {text}.") from None

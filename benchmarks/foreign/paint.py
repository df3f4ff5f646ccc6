"""Pictures for the surfaces of the foreign rooms, made with numpy and OpenCV alone: (S, S, 3) uint8."""

from __future__ import annotations

import cv2
import numpy as np

SIZE = 256
Random = np.random.Generator


def png(picture: np.ndarray) -> bytes:
    """A picture as PNG."""
    return cv2.imencode(".png", np.ascontiguousarray(picture[..., ::-1]))[1].tobytes()


def _cloud(random: Random, steps: tuple[int, ...], size: int = SIZE) -> np.ndarray:
    """(size, size) of blurred noise of several scales, mean 0 and deviation 1."""
    total = np.zeros((size, size), np.float32)
    for step in steps:
        small = random.standard_normal((max(2, size // step), max(2, size // step))).astype(np.float32)
        total += cv2.resize(small, (size, size), interpolation=cv2.INTER_CUBIC)
    return (total - total.mean()) / (total.std() + 1e-6)


def _tinted(colour, shade: np.ndarray) -> np.ndarray:
    return np.clip(np.asarray(colour, np.float32) * 255.0 * shade[..., None], 0, 255).astype(np.uint8)


def plaster(random: Random, colour) -> np.ndarray:
    """Rough coat with stains."""
    return _tinted(colour, 1 + 0.035 * _cloud(random, (2, 4)) + 0.03 * _cloud(random, (64,)))


def tiles(random: Random, colour, count: int = 4) -> np.ndarray:
    """Square tiles of slightly different shade, with dark joints."""
    shade = 1 + 0.02 * _cloud(random, (3, 16))
    edge = SIZE // count
    for i in range(count):
        for j in range(count):
            shade[i * edge : (i + 1) * edge, j * edge : (j + 1) * edge] *= random.uniform(0.92, 1.06)
    picture = _tinted(colour, shade)
    for k in range(count):
        cv2.line(picture, (0, k * edge), (SIZE, k * edge), (70, 68, 66), 3)
        cv2.line(picture, (k * edge, 0), (k * edge, SIZE), (70, 68, 66), 3)
    return picture


def bricks(random: Random) -> np.ndarray:
    """Red to yellow bricks in running bond."""
    clay = np.array([random.uniform(0.45, 0.75), random.uniform(0.25, 0.45), random.uniform(0.18, 0.3)])
    picture = _tinted((0.68, 0.66, 0.62), 1 + 0.05 * _cloud(random, (2,)))
    height, width = SIZE // 12, SIZE // 4
    for row in range(12):
        for column in range(-1, 5):
            left = column * width + (row % 2) * width // 2
            colour = 255 * np.clip(clay * random.uniform(0.7, 1.25), 0, 1)
            corner = (left + 2, row * height + 2), (left + width - 2, (row + 1) * height - 2)
            cv2.rectangle(picture, *corner, tuple(float(c) for c in colour), -1)
    noise = 1 + 0.07 * _cloud(random, (2,))
    return np.clip(picture * noise[..., None], 0, 255).astype(np.uint8)


def boards(random: Random) -> np.ndarray:
    """Wooden boards with veins."""
    wood = np.array([random.uniform(0.35, 0.7), random.uniform(0.22, 0.45), random.uniform(0.1, 0.25)])
    shade = np.ones((SIZE, SIZE), np.float32)
    for k in range(8):
        band = slice(k * SIZE // 8, (k + 1) * SIZE // 8)
        y, x = np.mgrid[0 : SIZE // 8, 0:SIZE]
        veins = np.sin(y * random.uniform(0.5, 1.2) + 3 * np.sin(x / random.uniform(20, 60) + random.uniform(0, 6)))
        shade[band] = random.uniform(0.75, 1.2) * (1 + 0.08 * veins)
        shade[k * SIZE // 8] *= 0.4
        joint = int(random.integers(0, SIZE))
        shade[band, joint : joint + 2] *= 0.5
    return _tinted(wood, shade)


def carpet(random: Random) -> np.ndarray:
    """Coarse loops in one colour, or with figures."""
    colour = random.uniform(0.1, 0.5, 3)
    picture = _tinted(colour, 1 + 0.22 * _cloud(random, (1, 2)))
    if random.random() < 0.5:
        other = tuple(float(c) for c in random.uniform(20, 200, 3))
        for _ in range(14):
            middle = tuple(int(c) for c in random.integers(0, SIZE, 2))
            cv2.circle(picture, middle, int(random.integers(6, 30)), other, int(random.choice([-1, 3])))
    return picture


def terrazzo(random: Random) -> np.ndarray:
    """Chips of stone in a pale ground."""
    picture = _tinted(np.full(3, random.uniform(0.4, 0.75)), np.ones((SIZE, SIZE), np.float32))
    for _ in range(500):
        middle = tuple(int(c) for c in random.integers(0, SIZE, 2))
        colour = tuple(float(c) for c in random.uniform(40, 230) * random.uniform(0.85, 1.1, 3))
        axes = tuple(int(c) for c in random.integers(2, 7, 2))
        cv2.ellipse(picture, middle, axes, float(random.uniform(0, 180)), 0, 360, colour, -1)
    return picture


def letters(random: Random, ground, ink) -> np.ndarray:
    """A poster or a label: a title, lines of text and a picture."""
    picture = np.full((SIZE, SIZE, 3), np.asarray(ground) * 255, np.uint8)
    ink = tuple(float(255 * c) for c in ink)
    words = ("NOTICE", "SALE", "EXIT 7", "KEEP LEFT", "OPEN DAY", "FRAGILE", "Lab 204")
    cv2.putText(picture, str(random.choice(words)), (14, 60), cv2.FONT_HERSHEY_DUPLEX, 1.5, ink, 4)
    for line in range(6):
        cv2.line(picture, (16, 90 + 13 * line), (int(random.integers(90, 240)), 90 + 13 * line), ink, 4)
    for _ in range(int(random.integers(1, 6))):
        corner = tuple(int(c) for c in random.integers(20, 200, 2))
        colour = tuple(float(c) for c in random.uniform(0, 255, 3) * (1, 1, 0.7))
        cv2.ellipse(picture, corner, (int(random.integers(8, 50)), int(random.integers(8, 40))), 0, 0, 360, colour, -1)
    return picture


def carton(random: Random, colour) -> np.ndarray:
    """One side of a printed carton: flutes, tape, arrows, a label, dents."""
    y = np.arange(SIZE, dtype=np.float32)[:, None]
    shade = 1 + 0.03 * np.sin(y / 1.7) + 0.05 * _cloud(random, (32,)) + 0.02 * _cloud(random, (2,))
    picture = _tinted(colour, np.broadcast_to(shade, (SIZE, SIZE)).copy())
    tape = tuple(float(c) for c in np.clip(np.asarray(colour) * random.uniform(1.1, 1.5) * 255, 0, 255))
    cv2.rectangle(picture, (108, 0), (148, SIZE), tape, -1)
    black = (25.0, 22.0, 20.0)
    cv2.arrowedLine(picture, (40, 220), (40, 150), black, 7, tipLength=0.4)
    cv2.arrowedLine(picture, (75, 220), (75, 150), black, 7, tipLength=0.4)
    cv2.putText(picture, str(random.choice(["THIS SIDE UP", "FRAGILE", "20 PCS"])), (12, 130), cv2.FONT_HERSHEY_SIMPLEX,
                1.0, black, 3)  # fmt: skip
    if random.random() < 0.7:
        left, top = int(random.integers(120, 170)), int(random.integers(20, 160))
        cv2.rectangle(picture, (left, top), (left + 80, top + 60), (238, 238, 232), -1)
        for bar in range(12):
            x = left + 6 + 6 * bar
            cv2.line(picture, (x, top + 8), (x, top + 40), black, int(random.integers(1, 4)))
    return picture


def door(random: Random, colour) -> np.ndarray:
    """A door leaf with panels, a handle and a sign."""
    picture = _tinted(colour, 1 + 0.02 * _cloud(random, (2, 64)))
    dark = tuple(float(c) for c in np.asarray(colour) * 150)
    for top, bottom in ((20, 110), (140, 236)):
        cv2.rectangle(picture, (40, top), (216, bottom), dark, 4)
    cv2.circle(picture, (232, 128), 8, (190, 190, 185), -1)
    cv2.rectangle(picture, (96, 40), (160, 62), (235, 235, 235), -1)
    return picture

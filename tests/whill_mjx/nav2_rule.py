"""The rule of nav2_map_server, written from its documentation as plainly as can be: one cell at a time.

Only what decides a cell is here: the numbers of a pixel, the mode, the thresholds. Images are written by the tests
themselves, so that no image library stands between the pixels and the rule.
"""

import math

import numpy as np

f32 = np.float32


def grey_level(pixel, largest):
    """Level 0 to 255 of a pixel: one sample or three, each 0 to `largest`; the upper byte of 16 bits."""
    wide = [int(sample) * 65535 // largest for sample in pixel]
    if len(wide) == 1:
        return wide[0] // 257
    red, green, blue = wide
    luma = f32(f32(f32(0.299) * f32(red)) + f32(f32(0.587) * f32(green))) + f32(f32(0.114) * f32(blue))
    return min(65535, math.floor(float(luma) + 0.5)) // 257


def nav2_cell(level, alpha, mode, negate, occupied, free):
    """Occupancy of one cell: 0 to 100, or -1 for unknown. `alpha` 0 to 255; 255 is opaque."""
    if mode == "raw":
        return level if level <= 100 else -1
    if alpha < 255:
        return -1
    bright = f32(level) / f32(255)
    dark = bright if negate else f32(1) - bright
    if dark <= f32(free):
        return 0
    if dark >= f32(occupied):
        return 100
    if mode == "trinary":
        return -1
    return math.floor(float((dark - f32(free)) / f32(occupied - free) * f32(100)) + 0.5)


def nav2_map(pixels, largest, alpha=None, mode="trinary", negate=False, occupied=0.65, free=0.196):
    """(rows, columns) occupancies of pixels (rows, columns, samples), the image's last row first."""
    rows, columns = len(pixels), len(pixels[0])
    cells = np.zeros((rows, columns), int)
    for row in range(rows):
        for column in range(columns):
            opaque = 255 if alpha is None else alpha[row][column]
            level = grey_level(pixels[row][column], largest)
            cells[rows - 1 - row, column] = nav2_cell(level, opaque, mode, negate, occupied, free)
    return cells

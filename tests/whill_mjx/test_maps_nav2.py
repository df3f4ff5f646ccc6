"""Maps against nav2's rule, cell by cell: the shared maps, and made ones that cover every option of file and image."""

from __future__ import annotations

import re
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from nav2_rule import grey_level, nav2_map

from whill_mjx.world.maps import FREE, OCCUPIED, UNKNOWN, load_map

pytestmark = pytest.mark.quick
SHARED = Path(__file__).parents[3] / "shared" / "data" / "maps"
RANDOM = np.random.default_rng(5)
ROWS, COLUMNS = 11, 27
FLOW = "image: {image}\nresolution: 0.05\norigin: [-1.5, 2.0, 0.3]\nnegate: {negate}\n" \
       "occupied_thresh: {occupied}\nfree_thresh: {free}\n{mode}"
BLOCK = "free_thresh: {free}\noccupied_thresh: {occupied}  # of darkness\norigin:\n- -1.5\n- 2\n- 3e-1\n" \
        "negate: {negate}\n{mode}\nresolution: 5.0e-02\nimage: {image}\nelevation: {{a: [1, 2]}}\n"
INLINE = "{{image: {image}, resolution: 0.05, origin: [-1.5, 2.0, 0.3], negate: {negate}, " \
         "occupied_thresh: {occupied}, free_thresh: {free}}}\n"


@pytest.mark.parametrize("name", ["m.stl", "c.npy", "x.osm", "bad.gltf", "map.pgm"])
def test_other_kinds_are_sent_to_the_function_and_the_command_that_read_them(name):
    with pytest.raises(ValueError, match=rf"{name}: load_map reads only nav2 .*read_map.*python -m whill_mjx.maps"):
        load_map(name)


def png(samples, depth, kind, *chunks):
    """Bytes of a PNG of samples (rows, columns, channels), written here so that its samples are known."""
    def chunk(name, data):
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    rows = b""
    for row in np.asarray(samples).reshape(len(samples), -1):
        if depth < 8:
            bits = "".join(f"{int(value):0{depth}b}" for value in row)
            bits += "0" * (-len(bits) % 8)
            rows += b"\0" + int(bits, 2).to_bytes(len(bits) // 8, "big")
        else:
            rows += b"\0" + row.astype(np.uint8 if depth == 8 else ">u2").tobytes()
    header = struct.pack(">IIBBBBB", np.shape(samples)[1], len(samples), depth, kind, 0, 0, 0)
    parts = [chunk(b"IHDR", header), *(chunk(*one) for one in chunks), chunk(b"IDAT", zlib.compress(rows))]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts) + chunk(b"IEND", b"")


def netpbm(kind, samples, largest):
    """Bytes of a Netpbm file of samples (rows, columns, channels), with comments in its header."""
    rows, columns = np.shape(samples)[:2]
    end = "" if kind in (1, 4) else f"\n# largest\n{largest}"
    header = f"P{kind}\n# made by hand\n{columns} {rows}{end}\n".encode()
    if kind == 1:
        return header + "\n".join("".join(str(int(v)) for v in row.ravel()) for row in samples).encode()
    if kind in (2, 3):
        return header + "\n".join(" ".join(str(int(v)) for v in row.ravel()) for row in samples).encode()
    if kind == 4:
        return header + np.packbits(samples[..., 0].astype(np.uint8), axis=1).tobytes()
    return header + np.asarray(samples).astype(np.uint8 if largest <= 255 else ">u2").tobytes()


def bmp(samples):
    """Bytes of a BMP of 24 bits of samples (rows, columns, 3)."""
    rows, columns = samples.shape[:2]
    body = b"".join(row[:, ::-1].astype(np.uint8).tobytes() + b"\0" * (-3 * columns % 4) for row in samples[::-1])
    info = struct.pack("<IiiHHIIiiII", 40, columns, rows, 1, 24, 0, len(body), 2835, 2835, 0, 0)
    return b"BM" + struct.pack("<IHHI", 54 + len(body), 0, 0, 54) + info + body


def draw(largest, channels=1):
    """Random samples, with all that lies near the usual thresholds."""
    return RANDOM.integers(0, largest + 1, (ROWS, COLUMNS, channels))


def made(form):
    """Bytes of an image, its pixels, largest sample and opacity."""
    kind, _, largest = form.partition(" ")
    top = int(largest or 255)
    if kind in ("P2", "P3", "P5", "P6"):
        pixels = draw(top, 3 if kind in ("P3", "P6") else 1)
        return netpbm(int(kind[1]), pixels, top), pixels, top, None
    if kind in ("P1", "P4"):
        bits = draw(1)
        return netpbm(int(kind[1]), bits, 1), 1 - bits, 1, None
    if kind == "bmp":
        pixels = draw(255, 3)
        return bmp(pixels), pixels, 255, None
    if kind == "palette":
        colours, index = RANDOM.integers(0, 256, (256, 3)), draw(255)
        opacity = np.where(RANDOM.random(256) < 0.3, 120, 255).astype(np.uint8)
        data = png(index, 8, 3, (b"PLTE", colours.astype(np.uint8).tobytes()), (b"tRNS", opacity.tobytes()))
        return data, colours[index[..., 0]], 255, opacity[index[..., 0]]
    if kind == "keyed":  # one level is declared transparent
        pixels = draw(255)
        key = int(pixels[3, 3, 0])
        return (png(pixels, 8, 0, (b"tRNS", struct.pack(">H", key))), pixels, 255,
                np.where(pixels[..., 0] == key, 0, 255))
    colour, alpha = kind in ("rgb", "rgba"), kind in ("grey+alpha", "rgba")
    depth = top.bit_length()
    pixels, opacity = draw(top, 3 if colour else 1), draw(top)
    opacity[RANDOM.random((ROWS, COLUMNS)) < 0.6] = top
    samples = np.concatenate([pixels, opacity], -1) if alpha else pixels
    png_kind = {(False, False): 0, (True, False): 2, (False, True): 4, (True, True): 6}[colour, alpha]
    return png(samples, depth, png_kind), pixels, top, opacity[..., 0] // (top // 255) if alpha else None


MADE = [  # image, mode, negate, thresholds, form of the YAML, image's name
    ("P5 255", "", "0", (0.65, 0.196), FLOW, "map.pgm"),
    ("P5 255", "trinary", "1", (0.65, 0.196), BLOCK, "map.pgm"),
    ("P5 255", "scale", "0", (0.65, 0.196), FLOW, "my map.pgm"),
    ("P5 255", "scale", "1", (0.9, 0.1), BLOCK, "'floor #2.pgm'"),
    ("P5 255", "raw", "0", (0.65, 0.196), FLOW, "floor#2.pgm"),
    ("P5 255", "raw", "1", (0.65, 0.196), BLOCK, '"floor: #3.pgm"'),
    ("P5 255", "", "true", (0.6, 0.2), FLOW, "map.pgm"),
    ("P5 255", "", "false", (0.8, 0.4), BLOCK, "map.pgm"),
    ("P5 255", "Scale", "True", (0.6, 0.4), FLOW, "map.pgm"),
    ("P5 255", "", "yes", (1.0, 0.0), INLINE, "map.pgm"),
    ("P5 255", "", "'no'", (0.5, 0.49), INLINE, "map.pgm"),
    ("P5 255", "trinary", '"1"', (".65", "1.96e-1"), FLOW, "map.pgm"),
    ("P5 100", "", "0", (0.65, 0.196), FLOW, "map.pgm"),
    ("P5 1", "", "0", (0.65, 0.196), FLOW, "map.pgm"),
    ("P5 15", "scale", "0", (0.65, 0.196), FLOW, "map.pgm"),
    ("P5 200", "raw", "0", (0.65, 0.196), FLOW, "map.pgm"),
    ("P5 65535", "", "0", (0.65, 0.196), FLOW, "map.pgm"),
    ("P5 65535", "scale", "true", (0.65, 0.196), BLOCK, "map.pgm"),
    ("P5 4095", "", "0", (0.65, 0.196), FLOW, "map.pgm"),
    ("P5 1000", "raw", "0", (0.65, 0.196), FLOW, "map.pgm"),
    ("P2 255", "", "0", (0.65, 0.196), FLOW, "map.pgm"),
    ("P2 100", "scale", "0", (0.65, 0.25), FLOW, "map.pgm"),
    ("P2 65535", "", "1", (0.65, 0.196), FLOW, "map.pgm"),
    ("P1", "", "0", (0.65, 0.196), FLOW, "map.pbm"),
    ("P4", "", "0", (0.65, 0.196), FLOW, "map.pbm"),
    ("P4", "scale", "1", (0.65, 0.196), FLOW, "map.pbm"),
    ("P3 255", "", "0", (0.65, 0.196), FLOW, "map.ppm"),
    ("P6 255", "scale", "0", (0.65, 0.196), FLOW, "map.ppm"),
    ("P6 65535", "", "0", (0.65, 0.196), FLOW, "map.ppm"),
    ("bmp", "", "0", (0.65, 0.196), FLOW, "map.bmp"),
    ("grey 1", "", "0", (0.65, 0.196), FLOW, "map.png"),
    ("grey 3", "scale", "0", (0.65, 0.196), FLOW, "map.png"),
    ("grey 15", "", "1", (0.65, 0.196), FLOW, "map.png"),
    ("grey 255", "", "0", (0.65, 0.196), FLOW, "map.png"),
    ("grey 65535", "scale", "0", (0.65, 0.196), FLOW, "map.png"),
    ("grey+alpha 255", "", "0", (0.65, 0.196), FLOW, "map.png"),
    ("grey+alpha 255", "scale", "1", (0.65, 0.196), BLOCK, "map.png"),
    ("grey+alpha 65535", "raw", "0", (0.65, 0.196), FLOW, "map.png"),
    ("rgb 255", "", "0", (0.65, 0.196), FLOW, "map.png"),
    ("rgb 65535", "scale", "0", (0.65, 0.196), FLOW, "map.png"),
    ("rgba 255", "", "0", (0.65, 0.196), FLOW, "map.png"),
    ("rgba 255", "raw", "0", (0.65, 0.196), FLOW, "map.png"),
    ("rgba 65535", "trinary", "1", (0.65, 0.196), FLOW, "map.png"),
    ("palette", "scale", "0", (0.65, 0.196), FLOW, "map.png"),
    ("palette", "", "0", (0.65, 0.196), FLOW, "map.png"),
    ("keyed", "", "0", (0.65, 0.196), FLOW, "map.png"),
]  # fmt: skip


@pytest.mark.parametrize("case", MADE, ids=lambda case: f"{case[0]}-{case[1]}-{case[2]}-{case[5]}")
def test_a_made_map_has_the_cells_of_nav2(tmp_path, case):
    form, mode, negate, (occupied, free), layout, name = case
    data, pixels, largest, alpha = made(form)
    plain = name.strip("'\"")
    (tmp_path / plain).write_bytes(data)
    path = tmp_path / "map.yaml"
    path.write_text(layout.format(image=name, negate=negate, occupied=occupied, free=free,
                                  mode=f"mode: {mode}" if mode else ""))
    grid = load_map(path)
    turned = negate.strip("'\"").lower() in ("1", "true", "yes")
    expected = nav2_map(pixels, largest, alpha, mode.lower() or "trinary", turned, float(occupied), float(free))
    np.testing.assert_array_equal(grid.occupancy, expected)
    assert grid.resolution == 0.05 and grid.origin == (-1.5, 2.0, 0.3)
    if mode != "raw":
        np.testing.assert_array_equal(grid.cells == FREE, expected == 0)
        np.testing.assert_array_equal(grid.cells == OCCUPIED, expected == 100)


@pytest.mark.parametrize(("level", "darkness"), [(51, 0.8), (102, 0.6), (153, 0.4), (204, 0.2)])
def test_a_level_right_at_a_threshold_is_inside_of_it(tmp_path, level, darkness):
    """nav2 compares with >= and <= in single precision, in which the darkness of 153 and 204 is a little less."""
    (tmp_path / "map.pgm").write_bytes(netpbm(5, np.full((1, 1, 1), level), 255))
    for name, occupied, free, cell in (("a", 0.9, darkness, 0), ("b", darkness, 0.1, 100 if level < 128 else -1)):
        path = tmp_path / f"{name}.yaml"
        path.write_text(FLOW.format(image="map.pgm", negate=0, occupied=occupied, free=free, mode=""))
        assert load_map(path).occupancy.item() == cell == nav2_map([[[level]]], 255, occupied=occupied, free=free)


def test_raw_maps_hold_probabilities_that_the_thresholds_divide(tmp_path):
    (tmp_path / "map.pgm").write_bytes(netpbm(5, np.array([[[0], [19], [40], [65], [100], [255]]]), 255))
    text = FLOW.format(image="map.pgm", negate=0, occupied=0.65, free=0.196, mode="mode: raw")
    (tmp_path / "map.yaml").write_text(text)
    kinds = [FREE, FREE, UNKNOWN, OCCUPIED, OCCUPIED, UNKNOWN]
    np.testing.assert_array_equal(load_map(tmp_path / "map.yaml").cells, [kinds])


def test_the_image_may_have_an_absolute_name(tmp_path):
    (tmp_path / "there").mkdir()
    image = tmp_path / "there" / "map.pgm"
    image.write_bytes(netpbm(5, np.array([[[0], [254]]]), 255))
    (tmp_path / "map.yaml").write_text(FLOW.format(image=image, negate=0, occupied=0.65, free=0.196, mode=""))
    np.testing.assert_array_equal(load_map(tmp_path / "map.yaml").cells, [[OCCUPIED, FREE]])
    (tmp_path / "map.yaml").write_text(FLOW.format(image="there/../there/map.pgm", negate=0, occupied=0.65, free=0.196,
                                                   mode=""))
    np.testing.assert_array_equal(load_map(tmp_path / "map.yaml").cells, [[OCCUPIED, FREE]])


@pytest.mark.parametrize(("text", "message"), [
    ("", "has no fields"), ("- 1\n- 2\n", "has no fields"), ("image: [", "line 1: is no YAML"),
    ("a: 1\n  b: 2\n", "line 2: is no YAML"), ("[" * 4_000, "is no YAML"), ("- " * 4_000, "is no YAML"),
    ("image: {a: b}\nresolution: 1\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 1\nfree_thresh: 0", "image is {}"),
    ("image: a.pgm\nimage: b.pgm", "image is there twice"), ("x: 1\n" * 10_000, "is larger than"),
    ("image: a.pgm\nresolution: 1\norigin: [0, 0, 90]\nnegate: 0\noccupied_thresh: 1\nfree_thresh: 0",
     "the yaw of origin is 90 rad, more than a full turn. Convert it to radians"),
    ("image: ''\nresolution: 1\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 1\nfree_thresh: 0", "image is ''"),
])  # fmt: skip
def test_a_file_that_is_no_map_is_refused_in_one_line(tmp_path, text, message):
    path = tmp_path / "map.yaml"
    path.write_text(text)
    with pytest.raises(ValueError, match=re.escape(message)) as error:
        load_map(path)
    assert str(error.value).startswith(str(path)) and "\n" not in str(error.value)


@pytest.mark.parametrize(("data", "message"), [
    (b"P5\n2 2\n255\n\0\0", "ends after 2 of 4 samples"), (b"P5\n2 1\n65535\n\0\0\0", "ends after 1 of 2"),
    (b"P5\n2 1\n0\n\0\0", "largest sample is 0"), (b"P5\n2 1\n70000\n\0\0", "largest sample is 70000"),
    (b"P5\n1 1\n100\n\xff", "has a sample of 255"), (b"P2\n2 1\n255\n1 x\n", "something else than numbers"),
    (b"P2\n2 1\n255\n1\n", "ends after 1 of 2"), (b"P4\n9 2\n\0\0\0", "ends after 9 of 18"), (b"P7\n", "no PGM"),
    (b"P5\n0 3\n255\n", "no PGM"), (png(draw(255), 8, 0)[:60], "is damaged"), (b"BM" + bytes(40), "no PGM"),
])  # fmt: skip
def test_a_damaged_image_is_refused_in_one_line(tmp_path, data, message):
    (tmp_path / "map.pgm").write_bytes(data)
    (tmp_path / "map.yaml").write_text(FLOW.format(image="map.pgm", negate=0, occupied=0.65, free=0.196, mode=""))
    with pytest.raises(ValueError, match=message) as error:
        load_map(tmp_path / "map.yaml")
    assert str(error.value).startswith(str(tmp_path / "map.pgm")) and "\n" not in str(error.value)


@pytest.mark.skipif(not SHARED.is_dir(), reason="the maps of ../shared/data are not there")
@pytest.mark.parametrize("name", ["stata_basement/stata_basement", "willow_garage/willow-full",
                                  "fetch_office/3_1_16_localization", "fetch_office/9_16_15"])
def test_a_shared_map_has_the_cells_of_nav2(name):
    """By another image library than the loader's; a cell of each distinct pixel goes through the slow rule."""
    import imageio.v3 as imageio
    import yaml

    path = SHARED / f"{name}.yaml"
    table = yaml.safe_load(path.read_text())
    image = np.asarray(imageio.imread(path.parent / table["image"]))
    image = image[..., None] if image.ndim == 2 else image
    assert image.dtype == np.uint8 and image.shape[2] in (1, 3)
    packed = sum(image[..., channel].astype(int) << 8 * channel for channel in range(image.shape[2]))
    found, place = np.unique(packed, return_inverse=True)
    colours = np.stack([found >> 8 * channel & 255 for channel in range(image.shape[2])], -1)
    cells = nav2_map(colours[:, None], 255, None, table.get("mode", "trinary"), bool(table["negate"]),
                     table["occupied_thresh"], table["free_thresh"])[::-1, 0]
    expected = cells[place.ravel()].reshape(image.shape[:2])[::-1]
    np.testing.assert_array_equal(load_map(path).occupancy, expected)
    assert {grey_level(colour, 255) for colour in colours} >= {0}

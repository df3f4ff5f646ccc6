"""The page of the effects is that of the present classes and cards."""

import pytest
from PIL import Image

from benchmarks.effects import BASE, COLOURS, DOCS, own_effects, page, place_of

pytestmark = pytest.mark.quick


def test_the_page_of_the_effects_is_up_to_date():
    assert (DOCS / "effects.md").read_text() == page(), "write it again: python -m benchmarks.effects page"


def test_the_picture_of_the_effects_shows_each_of_them():
    shown = Image.open(DOCS / "images" / "effects.png").text["Description"].split()
    moving = {kind.name for kind in own_effects() if place_of(kind) in COLOURS}  # no drive differs by the others
    assert shown == sorted(moving - set(BASE)), (
        "draw it again: python -m benchmarks.effects figure")


def test_the_page_shows_what_the_loop_looks_for():
    rows = page().partition("## What the closed loop")[2].splitlines()
    [delay] = [row for row in rows if row.startswith("| `command_delay` | `delay`")]
    assert "`delay` +0.04 s" in delay and "does not show while the command is constant" in delay
    [sag] = [row for row in rows if row.startswith("| `supply_sag` | `per")]
    assert "<br>`torque_drive.kp` times 0.905 (either way)" in sag and "supply voltage" in sag

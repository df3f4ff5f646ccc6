"""Figures under their fixed names: copied from what was measured, or counted."""

import ast
import json

import pytest

from benchmarks import fixed_names
from benchmarks.harness import RESULTS

pytestmark = pytest.mark.quick
STEMS = sorted({*fixed_names.SAME, *fixed_names.ELSEWHERE, *fixed_names.DERIVED})


@pytest.mark.parametrize("stem", STEMS)
def test_fixed_names_have_the_figures_of_their_sources(stem):
    figures = json.loads((RESULTS / f"{stem}.json").read_text())["figures"]
    found = fixed_names.fixed(stem, figures)
    assert {*fixed_names.SAME.get(stem, {}), *fixed_names.ELSEWHERE.get(stem, {})} <= set(found)
    old = [name for name, one in found.items() if figures.get(name, {}).get("value") != one["value"]]
    assert not old, f"{stem}.json: {', '.join(old)}: write it again: python -m benchmarks.fixed_names"


def test_the_last_rung_of_a_ladder_is_compared_with_the_best_peer():
    def one(value):
        return {"value": value, "unit": "m", "device": "cpu", "repeats": [value], "commit": "c"}

    figures = {"ladder_all_position_base": one(2.0), "ladder_all_position_with_1_a": one(1.5),
               "ladder_all_position_with_10_b_c": one(1.2), "ladder_all_position_with_2_d": one(1.4),
               "peer_ideal_position": one(0.5), "peer_one_position": one(1.6),
               "peer_two_position": one(1.5)}  # fmt: skip
    found = fixed_names.ladder(figures)
    assert found["ladder_position"]["value"] == 1.2 and found["ladder_position"]["commit"] == "c"
    assert found["ladder_over_best_peer"]["value"] == pytest.approx(0.8)
    assert fixed_names.ladder({}) == {}


def test_a_processor_stands_in_until_an_accelerator_has_measured_the_first_step():
    def one(value, device):
        return {"value": value, "unit": "s", "device": device, "repeats": [value]}

    figures = {"cpu_first_step_warm_s": one(9.0, "cpu, 2 cores")}
    found = fixed_names.standing_in(figures)
    assert found["first_step_warm_s"]["value"] == 9.0 and found["first_step_warm_s"]["device"] == "cpu, 2 cores"
    newer = {**found, "cpu_first_step_warm_s": one(8.0, "cpu, 2 cores")}
    assert fixed_names.standing_in(newer)["first_step_warm_s"]["value"] == 8.0
    assert fixed_names.standing_in({**newer, "first_step_warm_s": one(5.0, "NVIDIA H200")}) == {}


def test_lines_of_code_are_counted_without_docstrings_comments_and_blank_lines():
    text = '"""What it is."""\n\n# a comment\nx = 1\n\ndef twice(a):\n    """Twice."""\n'
    text += "    return (\n        2 * a\n    )\n"
    assert fixed_names.code_lines(ast.parse(text)) == 5  # x, def, and three of the return

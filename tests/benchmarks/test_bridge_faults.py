"""The documented fault table, and the faults that are measured."""

from pathlib import Path

import pytest

from benchmarks.bridge import fuzz, with_former
from benchmarks.bridge_faults import FAULTS, fault_rows, title_of

pytestmark = pytest.mark.quick

OTHERS = {"stop_input_ms", "stop_action_ms", "stop_deactivated_ms", "fuzz_outside_limits", "fuzz_outside_slew"}
TESTS = {path.stem for path in (Path(__file__).parents[1] / "bridge").glob("test_*.py")}


def test_every_row_of_the_fault_table_names_a_figure_or_a_test_that_exists():
    rows = fault_rows()
    known = {*map(title_of, FAULTS), *OTHERS, *TESTS}
    assert len(rows) > 20
    assert {fault: checks for fault, checks in rows if not checks or not known.issuperset(checks)} == {}


def test_every_fault_that_is_measured_belongs_to_a_row_of_the_table():
    named = {check for _, checks in fault_rows() for check in checks} | OTHERS
    assert named.issuperset(map(title_of, FAULTS))


def test_no_output_of_any_bits_leaves_the_limits_or_the_slew_limits():
    assert fuzz(300) == (0, 0)


def test_of_drives_of_one_kind_all_values_count_and_the_largest_is_the_largest_of_all():
    shape = {"histogram_from_ms": [0.0, 1.0]}
    one = ([2.0], "ms", {**shape, "histogram_counts": [1.0, 2.0]})
    other = ([3.0], "ms", {**shape, "histogram_counts": [4.0, 0.0]})
    assert with_former("frame_p50_ms", one, other) == ([2.0, 3.0], "ms", {**shape, "histogram_counts": [5.0, 2.0]})
    assert with_former("frame_max_ms", ([9.0], "ms"), ([3.0], "ms")) == ([9.0], "ms")

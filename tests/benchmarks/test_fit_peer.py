import pytest

from benchmarks.fit_peer import EQUAL, arrival, own_arrival

pytestmark = pytest.mark.quick
CURVE = [(1.0, 0.5), (2.0, 0.2), (5.0, 0.1), (9.0, 0.099)]


def test_a_search_arrives_with_its_first_point_that_is_as_good():
    assert arrival(CURVE, 0.2) == 2.0
    assert arrival(CURVE, 0.15) == 5.0


def test_a_search_is_at_its_own_best_where_what_follows_is_as_good_as_equal():
    assert 0.099 * EQUAL > 0.1
    assert own_arrival(CURVE) == 5.0

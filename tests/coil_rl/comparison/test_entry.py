"""The paired difference of two entries of a comparison."""

import numpy as np
import pytest

from coil_rl.comparison.entry import Entry, difference

CASES = np.linspace(-1, 1, 8)


@pytest.mark.parametrize("seeds", [1, 2])
def test_one_case_is_never_clear_and_has_no_interval(seeds):
    one, other = Entry("one", np.full((seeds, 1), 90.0)), Entry("other", np.array([[10.0]]))
    found = difference(one, other)
    assert found.of_cases.mean == 80
    assert found.one_case
    assert not found.above(0.0)
    assert str(found) == "+80.0 (no interval: one case)"


@pytest.mark.parametrize("seeds", [1, 2, 3])
def test_difference_is_paired_by_case(seeds):
    one = Entry("one", np.tile(100 * CASES + 1, (seeds, 1)))
    found = difference(one, Entry("other", 100 * CASES[None]))
    assert found.of_cases[:3] == pytest.approx((1, 1, 1))
    assert found.above(0.5)
    assert not found.above(2.0)

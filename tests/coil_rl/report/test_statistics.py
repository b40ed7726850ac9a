import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from coil_rl.report.statistics import (
    Estimate,
    count_of_seeds,
    difference,
    estimate,
    holm,
    wins,
)


def test_few_seeds_have_interval_and_p_of_a_t_test():
    values = [3.0, 1.0, 4.0, 1.0, 5.0]
    expected = stats.ttest_1samp(values, 0)
    found = estimate(values)
    assert found[1:3] == pytest.approx(tuple(expected.confidence_interval(0.95)))
    assert (found.mean, found.p) == pytest.approx((2.8, expected.pvalue))
    assert found.seeds == 5


@pytest.mark.parametrize("shift", [0.3, -0.6])
def test_p_of_ten_seeds_is_the_share_of_sign_patterns_with_such_a_mean(shift):
    values = np.random.default_rng(0).normal(size=10) + shift
    means = [np.mean(values * signs) for signs in itertools.product([-1, 1], repeat=10)]
    assert estimate(values).p == pytest.approx(np.mean(np.abs(means) >= abs(values.mean()) - 1e-12))


def test_p_of_many_seeds_is_reproducible():
    values = np.random.default_rng(0).normal(0.3, size=20)
    assert estimate(values) == estimate(values)
    assert estimate(values).p == pytest.approx(stats.ttest_1samp(values, 0).pvalue, rel=0.2)


@pytest.mark.fast(1)
@pytest.mark.parametrize(
    ("seeds", "samples", "within"), [(3, 1000, 0.02), (5, 1000, 0.02), (12, 100, 0.05)]
)
def test_interval_has_its_coverage(seeds, samples, within):
    drawn = np.random.default_rng(1).normal(7, size=(samples, seeds))
    hits = sum(low <= 7 <= high for _, low, high, *_ in map(estimate, drawn))
    assert hits / samples == pytest.approx(0.95, abs=within)


def test_estimates_without_spread_or_numbers():
    assert estimate([2.0, 2.0, 2.0]) == Estimate(2, 2, 2, 3, 0)
    assert estimate([0.0, 0.0]).p == 1
    single = estimate([2.0])
    assert (single.mean, single.seeds) == (2, 1)
    unknown = [single.low, single.high, single.p, estimate([]).mean, estimate([1, math.nan]).mean]
    assert all(map(math.isnan, unknown))


def test_difference_is_that_of_pairs():
    ours, theirs = [3.0, 5.0, 9.0], [1.0, 4.0, 6.0]
    expected = stats.ttest_rel(ours, theirs).confidence_interval(0.95)
    found = difference(ours, theirs)
    assert (found.mean, found.seeds) == (2, 3)
    assert found[1:3] == pytest.approx(tuple(expected))
    assert math.isnan(difference([2.0], [1.0]).low)
    assert math.isnan(difference([math.inf, 1.0], [1.0, 1.0]).mean)


def test_cells_show_the_interval_if_there_is_one():
    assert Estimate(1.5, 1.0, 2.0, 3).cell("+.1f") == "+1.5 (+1.0 to +2.0)"
    assert estimate([2.0]).cell(".1f") == "2.0"
    assert estimate([]).cell(".1f") is None


def test_holm_corrects_known_p_values():
    np.testing.assert_allclose(
        holm([0.01, 0.04, math.nan, 0.03, 0.9]), [0.04, 0.09, math.nan, 0.09, 0.9]
    )
    assert len(holm([])) == 0


@given(st.lists(st.floats(0, 1), min_size=1, max_size=10), st.randoms())
def test_holm_is_between_no_correction_and_bonferroni_in_any_order(p_values, random):
    corrected = holm(p_values)
    assert (corrected >= p_values).all()
    assert (corrected <= np.minimum(1, np.array(p_values) * len(p_values))).all()
    order = random.sample(range(len(p_values)), len(p_values))
    np.testing.assert_array_equal(holm(np.array(p_values)[order]), corrected[order])


def test_count_of_seeds_has_the_interval_of_clopper_and_pearson():
    assert count_of_seeds(2, 5) == "2 of 5 (5% to 85%)"
    # With no success of n the upper end is 1 - 0.025 ** (1 / n).
    assert count_of_seeds(0, 10) == f"0 of 10 (0% to {1 - 0.025**0.1:.0%})"


def test_wins_compare_the_same_seed_and_track():
    x, y = [[3.0, 1.0], [0.0, 5.0]], [[2.0, 1.0], [4.0, 4.0]]
    np.testing.assert_array_equal(wins(x, y), [[1, 0.5], [0, 1]])
    np.testing.assert_array_equal(wins(x, [[2.0, 2.0]]), [[1, 0], [0, 1]], "shared by all seeds")


def test_very_many_values_take_no_patterns_of_signs():
    values = np.tile([1.0, -0.9], 100_000)
    assert estimate(values).p == pytest.approx(stats.ttest_1samp(values, 0).pvalue)

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from coil_rl.report.statistics import iqm, probability_of_improvement, stratified_bootstrap, wins

SCORES = st.lists(st.floats(-1000, 1000), min_size=1, max_size=30)


def test_iqm_of_known_numbers():
    assert iqm([1, 2, 3, 4, 5, 6, 7, 8]) == 4.5
    assert iqm([0, 10, 11, 1000]) == 10.5
    assert iqm([0, 10, 100]) == pytest.approx((0.25 * 0 + 10 + 0.25 * 100) / 1.5), "edges count in part"
    assert iqm([7.0]) == 7
    with pytest.raises(ValueError, match="at least one score"):
        iqm([])


@given(SCORES, st.integers(2, 5), st.randoms())
def test_iqm_depends_neither_on_order_nor_on_copies_of_all_scores(scores, copies, random):
    shuffled = random.sample(scores, len(scores))
    assert iqm(shuffled * copies) == pytest.approx(iqm(scores), abs=1e-9)
    assert iqm(scores * 4) == pytest.approx(stats.trim_mean(scores * 4, 0.25), abs=1e-9)
    assert iqm([*scores, *(10 - score for score in scores)]) == pytest.approx(5, abs=1e-9), "symmetric"


def test_iqm_along_an_axis_is_that_of_each_row():
    table = np.random.default_rng(0).normal(size=(4, 7))
    np.testing.assert_allclose(iqm(table, axis=1), [iqm(row) for row in table])
    assert iqm(table) == pytest.approx(iqm(table.ravel()))


def test_interval_is_the_percentile_bootstrap_of_scipy_on_one_track():
    scores = np.random.default_rng(1).normal(size=12)
    expected = stats.bootstrap(
        (scores,), np.mean, n_resamples=999, method="percentile", rng=np.random.default_rng(5)
    ).confidence_interval
    interval = stratified_bootstrap(scores[:, None], np.mean, resamples=999, seed=5)
    assert interval == pytest.approx(tuple(expected))
    assert interval != stratified_bootstrap(scores[:, None], np.mean, resamples=999, seed=6)


def test_interval_of_correlated_scores_has_its_coverage():
    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(200):
        of_seed, of_track = rng.normal(size=(20, 1)), rng.normal(size=(20, 3))
        low, high = stratified_bootstrap(math.sqrt(0.8) * of_seed + math.sqrt(0.2) * of_track, np.mean, resamples=300)
        hits += low <= 0 <= high
    assert 0.88 < hits / 200 < 0.98


def test_tracks_are_not_resampled():
    assert stratified_bootstrap(np.array([[0.0, 1000.0]] * 5), np.mean) == (500, 500)


def test_single_seed_has_no_interval():
    assert all(map(math.isnan, stratified_bootstrap([[1.0, 2.0, 3.0]])))


def test_probability_of_improvement_of_known_numbers():
    assert probability_of_improvement([[1.0], [2.0]], [[1.0], [2.0]]) == 0.5
    assert probability_of_improvement([[3.0], [4.0]], [[1.0], [2.0], [2.5]]) == 1
    assert probability_of_improvement([[1.0, 9.0]], [[2.0, 3.0]]) == 0.5, "worse on one track, better on the other"
    assert probability_of_improvement([[2.0]], [[1.0], [2.0], [3.0], [3.0]]) == (1 + 0.5) / 4


@given(st.integers(0, 2**32 - 1), st.integers(1, 6), st.integers(1, 6), st.integers(1, 4))
def test_probability_of_improvement_is_the_share_of_pairs_won(seed, count, other, tracks):
    rng = np.random.default_rng(seed)
    x, y = rng.integers(0, 4, size=(count, tracks)), rng.integers(0, 4, size=(other, tracks))
    won = (x[:, None] > y).mean() + 0.5 * (x[:, None] == y).mean()
    assert probability_of_improvement(x, y) == pytest.approx(won)
    assert probability_of_improvement(y, x) == pytest.approx(1 - won)


def test_wins_compare_the_same_seed_and_track():
    x, y = [[3.0, 1.0], [0.0, 5.0]], [[2.0, 1.0], [4.0, 4.0]]
    np.testing.assert_array_equal(wins(x, y), [[1, 0.5], [0, 1]])
    np.testing.assert_array_equal(wins(x, [[2.0, 2.0]]), [[1, 0], [0, 1]], "shared by all seeds")


@pytest.mark.parametrize(
    ("function", "tables", "message"),
    [
        (stratified_bootstrap, [[1.0, 2.0]], r"\[seeds, tracks\] that is not empty"),
        (probability_of_improvement, ([[1.0, 2.0]], [[1.0, 2.0, 3.0]]), r"got \(1, 2\) and \(1, 3\)"),
        (wins, ([[1.0]] * 3, [[1.0]] * 2), r"same seeds; got \(3, 1\) and \(2, 1\)"),
    ],
)
def test_tables_that_do_not_match_are_an_error(function, tables, message):
    with pytest.raises(ValueError, match=message):
        function(*tables)

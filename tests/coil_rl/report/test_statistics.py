import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from coil_rl.report.statistics import iqm, probability_of_improvement, stratified_bootstrap, wins

SCORES = st.lists(st.floats(-1000, 1000), min_size=1, max_size=30)


@given(SCORES)
def test_iqm_is_scipys_trimmed_mean_where_a_quarter_is_a_whole_number(scores):
    four = scores * 4
    assert iqm(four) == pytest.approx(stats.trim_mean(four, 0.25), abs=1e-9)


def test_iqm_of_known_numbers():
    assert iqm([1, 2, 3, 4, 5, 6, 7, 8]) == 4.5
    assert iqm([0, 10, 11, 1000]) == 10.5
    assert iqm([0, 10, 100]) == pytest.approx((0.25 * 0 + 10 + 0.25 * 100) / 1.5), "edges count in part"
    assert iqm([7.0]) == 7


@given(SCORES, st.integers(2, 5), st.randoms())
def test_iqm_depends_neither_on_order_nor_on_how_often_all_scores_are_there(scores, times, random):
    shuffled = random.sample(scores, len(scores))
    assert iqm(shuffled * times) == pytest.approx(iqm(scores), abs=1e-9)


@given(SCORES)
def test_iqm_of_symmetric_numbers_is_their_mean(scores):
    assert iqm([*scores, *(10 - score for score in scores)]) == pytest.approx(5, abs=1e-9)


def test_iqm_along_an_axis_is_that_of_each_row():
    table = np.random.default_rng(0).normal(size=(4, 7))
    np.testing.assert_allclose(iqm(table, axis=1), [iqm(row) for row in table])
    assert iqm(table) == pytest.approx(iqm(table.ravel()))


def test_iqm_of_nothing_is_refused():
    with pytest.raises(ValueError, match="at least one score"):
        iqm([])


@pytest.mark.parametrize("paired", [True, False])
def test_interval_is_scipys_percentile_bootstrap_on_one_track(paired):
    scores = np.random.default_rng(1).normal(size=12)
    expected = stats.bootstrap(
        (scores,), np.mean, n_resamples=999, method="percentile", rng=np.random.default_rng(5)
    ).confidence_interval
    found = stratified_bootstrap(scores[:, None], np.mean, resamples=999, seed=5, paired=paired)
    assert found == pytest.approx(tuple(expected))


def covered(correlation, paired, seeds=20, tracks=3, repeats=200):
    """How often an interval of the mean holds the true one, 0, where the scores of a seed are correlated."""
    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(repeats):
        of_seed, of_track = rng.normal(size=(seeds, 1)), rng.normal(size=(seeds, tracks))
        scores = math.sqrt(correlation) * of_seed + math.sqrt(1 - correlation) * of_track
        low, high = stratified_bootstrap(scores, np.mean, resamples=300, paired=paired)
        hits += low <= 0 <= high
    return hits / repeats


def test_intervals_hold_the_true_mean_about_as_often_as_they_say():
    assert 0.88 < covered(0.8, paired=True) < 0.98
    assert 0.88 < covered(0.0, paired=False) < 0.98


def test_seeds_drawn_anew_for_each_track_miss_the_mean_where_a_policy_drives_all_of_them():
    assert covered(0.8, paired=False) < 0.85


def test_every_resample_has_each_track_as_often():
    scores = np.array([[0.0, 1000.0]] * 5)
    for paired in (True, False):
        assert stratified_bootstrap(scores, np.mean, paired=paired) == (500, 500)


def test_interval_grows_with_the_confidence_and_repeats_with_the_seed():
    scores = np.random.default_rng(2).normal(size=(8, 3))
    wide, narrow = stratified_bootstrap(scores, confidence=0.99), stratified_bootstrap(scores, confidence=0.5)
    assert wide[0] < narrow[0] < iqm(scores) < narrow[1] < wide[1]
    assert stratified_bootstrap(scores, seed=3) == stratified_bootstrap(scores, seed=3)
    assert stratified_bootstrap(scores, seed=3) != stratified_bootstrap(scores, seed=4)


def test_one_seed_has_no_interval():
    assert all(map(math.isnan, stratified_bootstrap([[1.0, 2.0, 3.0]])))


@pytest.mark.parametrize(
    ("scores", "confidence", "words"),
    [([1.0, 2.0], 0.95, r"\[seeds, tracks\]"), ([[1.0], [2.0]], 95, "as 0.95; got 95")],
)
def test_what_has_no_interval_is_refused(scores, confidence, words):
    with pytest.raises(ValueError, match=words):
        stratified_bootstrap(scores, confidence=confidence)


def test_probability_of_improvement_of_known_numbers():
    assert probability_of_improvement([[1.0], [2.0]], [[1.0], [2.0]]) == 0.5
    assert probability_of_improvement([[3.0], [4.0]], [[1.0], [2.0], [2.5]]) == 1
    assert probability_of_improvement([[1.0, 9.0]], [[2.0, 3.0]]) == 0.5, "worse on one track, better on the other"
    assert probability_of_improvement([[2.0]], [[1.0], [2.0], [3.0], [3.0]]) == (1 + 0.5) / 4


@given(st.integers(0, 2**32 - 1), st.integers(1, 6), st.integers(1, 6), st.integers(1, 4))
def test_probability_of_improvement_is_the_share_of_pairs_that_are_won(seed, count, other, tracks):
    rng = np.random.default_rng(seed)
    x, y = rng.integers(0, 4, size=(count, tracks)), rng.integers(0, 4, size=(other, tracks))
    won = (x[:, None] > y).mean() + 0.5 * (x[:, None] == y).mean()
    assert probability_of_improvement(x, y) == pytest.approx(won)
    assert probability_of_improvement(y, x) == pytest.approx(1 - won)


def test_tables_of_different_tracks_are_not_compared():
    with pytest.raises(ValueError, match=r"same tracks, not empty; got the shapes \(1, 2\) and \(1, 3\)"):
        probability_of_improvement([[1.0, 2.0]], [[1.0, 2.0, 3.0]])


def test_wins_are_of_the_same_seed_on_the_same_track():
    x, y = [[3.0, 1.0], [0.0, 5.0]], [[2.0, 1.0], [4.0, 4.0]]
    np.testing.assert_array_equal(wins(x, y), [[1, 0.5], [0, 1]])
    np.testing.assert_array_equal(wins(x, [[2.0, 2.0]]), [[1, 0], [0, 1]], "the same with each seed")
    shuffled = probability_of_improvement([[1.0], [2.0], [3.0]], [[0.5], [1.5], [2.5]])
    assert wins([[1.0], [2.0], [3.0]], [[0.5], [1.5], [2.5]]).mean() == 1 > shuffled


def test_wins_of_different_seeds_are_refused():
    with pytest.raises(ValueError, match=r"same seeds and tracks; got the shapes \(3, 1\) and \(2, 1\)"):
        wins([[1.0]] * 3, [[1.0]] * 2)
